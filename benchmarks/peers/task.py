"""What every library trains: the same environment and the same numbers of PPO, taken from scale=demo."""

import math
from dataclasses import dataclass

from orchestrator import settings
from orchestrator.curriculum import thresholds

WARM_UP = 2  # iterations at the start that no time or rate counts: compilation, first allocations

# Segue without what the other libraries do not have, at the one learning rate that all of them keep
PLAIN = {
    "sbc.enabled": False, "policy.noise_window": 1, "policy.judges": 0, "policy.average": 0.0,
    "task.focus": 0.0, "ppo.target_kl": None, "ppo.final_kl": None, "ppo.kl_updates": 0, "policy.sigma_factor": 1.0,
    "ppo.optimizer": "adam", "ppo.epochs": 4, "ppo.first_updates": 0, "observation.target": "absolute",
}  # fmt: skip


@dataclass(frozen=True)
class Task:
    """The numbers that a user of any library would write down.

    config: `orchestrator.config.Config` of plain PPO; make_env: a function (num_envs, threads,
    autoreset_mode=SAME_STEP) giving a Gymnasium `VectorEnv`; env_runners: processes that collect, 0 for the learner's
    own; threads: of physics, in each process.
    """

    config: object
    make_env: object
    env_runners: int
    threads: int

    @property
    def num_envs(self):
        """Environments in all."""
        return self.config.num_envs

    @property
    def batch_size(self):
        """Samples per iteration."""
        return self.config.samples_per_iteration

    @property
    def std(self):
        """Standard deviation of every action dimension, in units of the network's output."""
        return math.exp(self.config.policy.log_sigma)


def build_config(overrides):
    """The demo's `Config` with the curriculum held at its first thresholds, and plain PPO."""
    plain = {"scale": "demo", **PLAIN, "curriculum.achievement": 1.0}
    return settings.build([settings.Layer(plain, "benchmark"), settings.command_line(overrides)])


def first_thresholds(config):
    """The thresholds before any tightening."""
    return thresholds(config.curriculum, config.reach, 0)
