"""rsl-rl's PPO on the transition tasks: what a user of it writes."""

import torch
from rsl_rl.env import VecEnv
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict


class Environment(VecEnv):
    """A Gymnasium `VectorEnv` by the interface of rsl-rl."""

    def __init__(self, env, seed, max_episode_length):
        self.env, self.num_envs, self.num_actions = env, env.num_envs, env.single_action_space.shape[0]
        self.max_episode_length, self.device, self.cfg = max_episode_length, "cpu", {}
        self.episode_length_buf = torch.zeros(self.num_envs, dtype=torch.long)
        self.observation, _ = env.reset(seed=seed)

    def get_observations(self):
        return TensorDict({"policy": torch.from_numpy(self.observation)}, batch_size=[self.num_envs])

    def step(self, actions):
        self.observation, reward, terminated, truncated, _ = self.env.step(actions.numpy())
        done = torch.from_numpy(terminated | truncated)
        self.episode_length_buf = (self.episode_length_buf + 1) * ~done
        return self.get_observations(), torch.from_numpy(reward).float(), done.long(), {}


def train(task, done):
    """Train until the environment ends it."""
    ppo, hidden = task.config.ppo, task.config.network.hidden
    torch.manual_seed(task.config.seed)
    env = Environment(task.make_env(task.num_envs, task.threads), task.config.seed, task.config.task.max_steps)
    network = {"class_name": "MLPModel", "hidden_dims": hidden, "activation": "relu", "obs_normalization": True}
    noise = {"class_name": "GaussianDistribution", "init_std": task.std, "std_type": "log", "learn_std": False}
    runner = OnPolicyRunner(env, {
        "num_steps_per_env": task.config.horizon,
        "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
        "actor": {**network, "distribution_cfg": noise},
        "critic": dict(network),
        "algorithm": {
            "class_name": "PPO",
            "num_learning_epochs": ppo.epochs,
            "num_mini_batches": task.batch_size // ppo.minibatch_size,
            "clip_param": ppo.clip,
            "gamma": ppo.gamma,
            "lam": ppo.gae_lambda,
            "learning_rate": ppo.learning_rate,
            "schedule": "fixed",
            "max_grad_norm": ppo.max_grad_norm,
            "entropy_coef": 0.0,
            "use_clipped_value_loss": False,
        },
    })  # fmt: skip
    runner.alg.actor.mlp.init_weights((2**0.5, 2**0.5, 2**0.5, 2**0.5, task.config.network.output_scale))
    runner.learn(num_learning_iterations=10**9)
