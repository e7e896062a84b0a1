"""RLlib's PPO on the transition tasks: what a user of it writes."""

import math

import ray
import torch
from gymnasium.vector import AutoresetMode
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.algorithms.ppo.torch.default_ppo_torch_rl_module import DefaultPPOTorchRLModule
from ray.rllib.connectors.env_to_module import MeanStdFilter
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.tune.registry import register_env


def make_module(task):
    """RLlib's policy with the standard deviation fixed, which it has no option for, and small initial actions."""

    class FixedNoise(DefaultPPOTorchRLModule):
        def setup(self):
            super().setup()
            torch.nn.init.constant_(self.pi.log_std, math.log(task.std))
            self.pi.log_std.requires_grad_(False)
            last = [layer for layer in self.pi.modules() if isinstance(layer, torch.nn.Linear)][-1]
            torch.nn.init.orthogonal_(last.weight, gain=task.config.network.output_scale)
            torch.nn.init.zeros_(last.bias)

    return FixedNoise


def train(task, done):
    """Train until `done()`."""
    ppo = task.config.ppo
    processes = max(task.env_runners, 1)

    def make_env(context):
        return task.make_env(context["num_envs"], task.threads, AutoresetMode.NEXT_STEP)

    ray.init(address="local", include_dashboard=False, log_to_driver=False)
    register_env("transition", make_env)
    config = (
        PPOConfig()
        .environment("transition", clip_actions=False, normalize_actions=False)
        .env_runners(
            num_env_runners=task.env_runners,
            num_envs_per_env_runner=task.num_envs // processes,
            gym_env_vectorize_mode="vector_entry_point",
            env_to_module_connector=lambda env, spaces, device: MeanStdFilter(),
        )
        .learners(num_learners=0)
        .training(
            train_batch_size_per_learner=task.batch_size,
            minibatch_size=ppo.minibatch_size,
            num_epochs=ppo.epochs,
            lr=ppo.learning_rate,
            gamma=ppo.gamma,
            lambda_=ppo.gae_lambda,
            clip_param=ppo.clip,
            grad_clip=ppo.max_grad_norm,
            use_kl_loss=False,
            entropy_coeff=0.0,
            vf_clip_param=float("inf"),
        )
        .rl_module(
            rl_module_spec=RLModuleSpec(
                module_class=make_module(task),
                model_config=DefaultModelConfig(
                    fcnet_hiddens=task.config.network.hidden,
                    fcnet_activation="relu",
                    free_log_std=True,
                    vf_share_layers=False,
                ),
            )
        )
        .debugging(seed=task.config.seed)
    )
    algorithm = config.build_algo()
    while not done():
        algorithm.train()
    algorithm.stop()
