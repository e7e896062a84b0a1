"""The achievement rate of a run that explores or draws its tasks otherwise, measured as the other libraries' is.

Segue has, with its own scales, environments that act with less noise (`policy.judges`), noise that lasts several steps
(`policy.noise_window`) and draws tasks by how often they fail (`task.focus`), so that its own log tells a rate of
something else. Here its policies, one per iteration, act once more, in environments that nobody learns from: uniform
tasks, independent noise of the training's size.
"""

from dataclasses import asdict, replace

import numpy as np

from benchmarks.peers.task import first_thresholds
from learner import checkpoint
from motion.state_machine import build_state_machine
from orchestrator.saved import arrays
from workers.config import ObservationConfig
from workers.library import build_library
from workers.rollout import Rollout
from workers.types import REACHED, Policy

SEED = 10_007  # added to the run's: other tasks and noise than those of the training


def explores_otherwise(config):
    """Whether the log of a run of this `Config` is about other tasks or noise than plain PPO's."""
    policy = config.policy
    return bool(policy.judges or policy.noise_window > 1 or config.task.focus)


def save(folder, iteration, policy, observation):
    """Keep the `Policy` that collected the chunk of an iteration, counted from 1, and the `ObservationConfig` by which
    it sees: in another encoding its numbers mean nothing."""
    checkpoint.save(folder, iteration, {"policy": vars(policy), "observation": asdict(observation)}, keep=iteration)


def load(folder, iteration):
    """(`Policy`, `ObservationConfig`) of an iteration."""
    content = checkpoint.load(folder / f"{iteration:08d}.pt")
    return Policy(**arrays(content["policy"])), ObservationConfig(**content["observation"])


def achievement(config, folder, last, window, averaged=False):
    """Achievement rate of the policies of the `window` iterations up to iteration `last`; see `counts`."""
    numbers = [max(last - window + 1 + i, 1) for i in range(window)]
    ended, reached = counts(config, folder, numbers, averaged).sum(axis=0)
    return reached / ended if ended else None


def counts(config, folder, iterations, averaged=False):
    """(n, 2): fresh tasks that ended, and that were reached, in a chunk by the policy of each of n iterations.

    config: `Config` of plain PPO, but for the observation, which is the run's own. averaged: by the running averages of
    their weights (`policy.average`) instead.
    """
    config = replace(config, observation=load(folder, iterations[0])[1])
    rollout = Rollout(
        config, build_library(build_state_machine(config.motions)), config.num_envs, config.horizon,
        config.seed + SEED, config.worker_threads,
    )  # fmt: skip
    limits, state = first_thresholds(config), rollout.initial_state(0)
    # all environments begin together, short episodes end first: until time is up, the rate is not that of the tasks
    before = -(-config.task.max_steps // config.horizon)
    found = []
    for number in [iterations[0]] * before + list(iterations):
        policy, _ = load(folder, number)
        policy = policy.averaged() if averaged else policy
        policy = replace(policy, noise_window=1, judges=0, average_weights=(), average_biases=())
        chunk, state = rollout.collect(state, policy, limits)
        fresh = ~chunk.outcomes.retained
        found.append((fresh.sum(), (fresh & (chunk.outcomes.end == REACHED)).sum()))
    return np.array(found[before:])
