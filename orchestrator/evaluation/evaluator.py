"""Plays blocks of the grid's tasks: what a process of an evaluation does. Needs no torch."""

import math

import numpy as np

from motion.state_machine import build_state_machine
from orchestrator.curriculum import final_tightenings, thresholds
from orchestrator.evaluation.episodes import Ladder, Simulator
from orchestrator.evaluation.failures import failures_of
from orchestrator.evaluation.statistics import Breakdown, sums
from orchestrator.tasks import TaskGrid
from workers.library import build_library
from workers.types import REACHED

LEVELS = ("trained", "metrics")  # accuracies by their names in evaluation.json, the looser first
KNOWN = 64  # failed tasks per shard that are remembered for the search for MS


def shard_size(tasks):
    """Tasks of one shard: a function of the number of tasks alone, as sums over shards must not depend on workers.

    Small enough that many workers end at about the same time, large enough that most simulations of a shard are busy
    most of the time.
    """
    return min(4096, max(256, -(-tasks // 64)))


def num_shards(tasks):
    """How many shards so many tasks make."""
    return -(-tasks // shard_size(tasks))


def levels(config, tightenings):
    """{name in LEVELS: `Thresholds`}: those that training reached, and the final accuracy."""
    cuts = {"trained": tightenings, "metrics": final_tightenings(config.curriculum)}
    return {name: thresholds(config.curriculum, config.reach, cuts[name]) for name in LEVELS}


def rungs(config):
    """`Thresholds` of the whole curriculum: after 0, 1, ... cuts, to the final accuracy."""
    return [thresholds(config.curriculum, config.reach, n) for n in range(final_tightenings(config.curriculum) + 1)]


class Evaluator:
    """A policy, the grid, and simulations. Its results depend on nothing but its arguments, without `threads`."""

    def __init__(self, config, policy, tightenings, threads=1):
        """config: the run's `Config`; policy: `workers.types.Policy`; tightenings: cuts that training reached."""
        library = build_library(build_state_machine(config.motions))
        self._log_sigma = config.evaluation.log_sigma
        self._levels, self._rungs = levels(config, tightenings), rungs(config)
        self._simulator = Simulator(config, library, policy, threads)
        self._grid = TaskGrid(library, config.evaluation)
        self._breakdown = Breakdown(library)
        self._size = shard_size(len(self._grid))

    def numbers(self, index):
        """Numbers of the tasks of shard `index`."""
        return self._grid.numbers(index * self._size, (index + 1) * self._size)

    def shard(self, index):
        """What is kept of shard `index`, as plain data.

        sums: {pass: {level: list of `statistics.sums`}}, passes `noise` and `deterministic`; counts: lists of
        `Breakdown.count` of the pass with noise; failures: rows of `failures.failures_of`; failed: {level: numbers of
        the first tasks that failed with noise}.
        """
        numbers = self.numbers(index)
        tasks, limits = self._grid.tasks(numbers), list(self._levels.values())
        ladder = Ladder(self._rungs, len(tasks))
        noise = self._simulator.run(tasks, numbers, limits, self._log_sigma, ladder)
        calm = self._simulator.run(tasks, numbers, limits, -math.inf)
        return {
            "sums": {
                name: {level: sums(episodes).tolist() for level, episodes in zip(LEVELS, result, strict=True)}
                for name, result in (("noise", noise), ("deterministic", calm))
            },
            "counts": {
                name: array.tolist()
                for name, array in self._breakdown.count(noise[1], noise[0], ladder.met, len(self._rungs)).items()
            },
            "failures": failures_of(noise[0], calm[0]),
            "failed": {level: _failed(episodes) for level, episodes in zip(LEVELS, noise, strict=True)},
        }

    def failed(self, level, log_sigma, numbers=None, index=None):
        """Numbers of the first tasks that fail at a level's thresholds and a noise: of `numbers`, or of a shard."""
        numbers = self.numbers(index) if numbers is None else np.array(numbers, dtype=np.int64)
        return _failed(self._simulator.run(self._grid.tasks(numbers), numbers, [self._levels[level]], log_sigma)[0])


def _failed(episodes):
    return episodes.environment[episodes.end != REACHED][:KNOWN].tolist()
