"""The rollout worker: the part of a run that a Ray actor (or the local runtime) holds for one share of environments."""

from motion.state_machine import build_state_machine
from workers.library import build_library
from workers.rollout import Rollout


class RolloutWorker:
    """Collects chunks with one share of the environments. Keeps nothing between two calls: states come and go."""

    def __init__(self, config, num_envs):
        """config: the run's `orchestrator.config.Config`; num_envs: of this worker."""
        library = build_library(build_state_machine(config.motions))
        self._rollout = Rollout(config, library, num_envs, config.horizon, config.seed, config.worker_threads)

    def initial_state(self, first):
        """`WorkerState` of environments first, first + 1, ... before the first chunk."""
        return self._rollout.initial_state(first)

    def collect(self, state, policy, thresholds):
        """(chunk, its outcomes, next worker state)."""
        chunk, state = self._rollout.collect(state, policy, thresholds)
        return chunk, chunk.outcomes, state
