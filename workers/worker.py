"""The rollout worker: the part of a run that a Ray actor (or the local runtime) holds for one share of environments."""

import os

from motion.state_machine import build_state_machine
from workers.library import build_library
from workers.rollout import Rollout

NICENESS = 10  # of a worker with spare threads: the learner, whose next policy it waits for, goes first


class RolloutWorker:
    """Collects chunks with one share of the environments. Keeps nothing between two calls: states come and go."""

    def __init__(self, config, num_envs, spare_threads=0):
        """config: the run's `orchestrator.config.Config`; num_envs: of this worker. spare_threads: of physics, beyond
        `worker_threads`; with any, this process steps back for all others."""
        if spare_threads:
            os.nice(NICENESS)
        library = build_library(build_state_machine(config.motions))
        threads = config.worker_threads + spare_threads
        self._rollout = Rollout(config, library, num_envs, config.horizon, config.seed, threads)

    def initial_state(self, first):
        """`WorkerState` of environments first, first + 1, ... before the first chunk."""
        return self._rollout.initial_state(first)

    def collect(self, state, policy, thresholds):
        """(chunk, its outcomes, next worker state)."""
        chunk, state = self._rollout.collect(state, policy, thresholds)
        return chunk, chunk.outcomes, state
