"""Stable-Baselines3's PPO on the transition tasks: what a user of it writes."""

import math

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from torch import nn


class Environment(VecEnv):
    """A Gymnasium `VectorEnv` by the interface of Stable-Baselines3."""

    render_mode = None

    def __init__(self, env):
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self):
        observation, _ = self.env.reset(seed=self._seeds[0])
        self._reset_seeds()
        return observation

    def step_async(self, actions):
        self.actions = actions

    def step_wait(self):
        observation, reward, terminated, truncated, infos = self.env.step(self.actions)
        each = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(terminated):
            each[i] = {"terminal_observation": infos["final_obs"][i], "TimeLimit.truncated": False}
        return observation, reward.astype(np.float32), terminated | truncated, each

    def close(self):
        self.env.close()

    def get_attr(self, attr_name, indices=None):
        return [getattr(self, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name, value, indices=None):
        setattr(self, attr_name, value)

    def env_method(self, method_name, *args, indices=None, **keywords):
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class, indices=None):
        return [False] * self.num_envs


def train(task, done):
    """Train until the environment ends it."""
    ppo, hidden = task.config.ppo, task.config.network.hidden
    env = Environment(task.make_env(task.num_envs, task.threads))
    # the returns' scale as in Segue, whose value network predicts normalised returns
    env = VecNormalize(env, norm_obs=True, norm_reward=True, gamma=ppo.gamma)
    model = PPO(
        "MlpPolicy",
        env,
        learning_rate=ppo.learning_rate,
        n_steps=task.config.horizon,
        batch_size=ppo.minibatch_size,
        n_epochs=ppo.epochs,
        gamma=ppo.gamma,
        gae_lambda=ppo.gae_lambda,
        clip_range=ppo.clip,
        max_grad_norm=ppo.max_grad_norm,
        policy_kwargs={
            "net_arch": {"pi": hidden, "vf": hidden},
            "activation_fn": nn.ReLU,
            "log_std_init": math.log(task.std),
        },
        seed=task.config.seed,
        device="cpu",
    )
    model.policy.log_std.requires_grad_(False)
    model.learn(total_timesteps=10**12)
