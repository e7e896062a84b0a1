"""Where a run's parts live: in this process, or in Ray actors. Both give the same numbers.

A runtime passes on what the parts return (chunks, outcomes, worker states, policies) as handles: values here, object
references there. The actors are thin shells around the pure functions. A worker keeps nothing between two calls: its
state travels with each, so that a chunk can be collected again by anyone.
"""

import numpy as np
import ray

from orchestrator.cluster import resolve_device
from orchestrator.curriculum import Curriculum
from workers.worker import RolloutWorker


def shares(num_envs, num_workers):
    """(first environment, number of environments) of each worker: equal shares to within one."""
    cuts = np.linspace(0, num_envs, num_workers + 1).astype(int)
    return [(int(a), int(b - a)) for a, b in zip(cuts, cuts[1:])]


class LocalRuntime:
    """Everything in this process, one call after the other."""

    def __init__(self, config, learner=None, curriculum=None):
        from learner.learner import Learner  # torch, which the other actors' processes need not load

        self._workers = [RolloutWorker(config, count) for _, count in shares(config.num_envs, config.num_workers)]
        self._learner = Learner(config, learner)
        self._curriculum = Curriculum(config, curriculum)
        self._config = config

    def initial(self):
        """(worker states, policy, thresholds) of a new run."""
        firsts = [first for first, _ in shares(self._config.num_envs, self._config.num_workers)]
        states = [worker.initial_state(first) for worker, first in zip(self._workers, firsts)]
        return states, self._learner.policy(), self._curriculum.thresholds()

    def collect(self, states, policy, thresholds):
        """(chunks, outcomes, next states), one each per worker."""
        return tuple(
            list(column)
            for column in zip(*(w.collect(state, policy, thresholds) for w, state in zip(self._workers, states)))
        )

    def update(self, chunks):
        """(policy, metrics) after the learner's next update."""
        return self._learner.update(*chunks)

    def observe(self, outcomes):
        """(thresholds, summary) after the curriculum's next iteration."""
        return self._curriculum.observe(*outcomes)

    def value(self, handle):
        """What a handle (or a list of handles) stands for."""
        return handle

    def handle(self, value):
        """A handle for a value, to be passed to many calls."""
        return value

    def saved(self):
        """(learner's, curriculum's) state."""
        return self._learner.saved(), self._curriculum.saved()

    def close(self):
        """Give back what the runtime holds."""


class RayRuntime:
    """One actor per rollout worker, one learner, one curriculum actor; chunks go from worker to learner directly."""

    def __init__(self, config, learner=None, curriculum=None):
        from learner.learner import Learner

        self._config = config
        gpus = 1 if resolve_device(config.device, config.runtime) == "cuda" else 0
        # an actor of several threads needs none of its own environment: one CPU each by default, and BLAS single
        environment = {"env_vars": {"OMP_NUM_THREADS": str(config.learner_threads), "NUMBA_NUM_THREADS": "1"}}
        actor = ray.remote(Learner).options(
            num_cpus=config.learner_threads, num_gpus=gpus, runtime_env=environment
        )
        self._learner = actor.remote(config, learner)
        self._workers = [
            ray.remote(RolloutWorker).options(num_cpus=config.worker_threads).remote(config, count)
            for _, count in shares(config.num_envs, config.num_workers)
        ]
        self._curriculum = ray.remote(Curriculum).options(num_cpus=0).remote(config, curriculum)

    def initial(self):
        """(worker states, policy, thresholds) of a new run, as references."""
        firsts = [first for first, _ in shares(self._config.num_envs, self._config.num_workers)]
        states = [worker.initial_state.remote(first) for worker, first in zip(self._workers, firsts)]
        return states, self._learner.policy.remote(), self._curriculum.thresholds.remote()

    def collect(self, states, policy, thresholds):
        """(chunks, outcomes, next states), references, one each per worker."""
        calls = [
            worker.collect.options(num_returns=3).remote(state, policy, thresholds)
            for worker, state in zip(self._workers, states)
        ]
        return tuple(list(column) for column in zip(*calls))

    def update(self, chunks):
        """(policy, metrics), references."""
        return self._learner.update.options(num_returns=2).remote(*chunks)

    def observe(self, outcomes):
        """(thresholds, summary), references."""
        return self._curriculum.observe.options(num_returns=2).remote(*outcomes)

    def value(self, handle):
        """What a reference (or a list of references) stands for; waits for it."""
        return ray.get(handle)

    def handle(self, value):
        """A reference to a value, to be passed to many calls."""
        return ray.put(value)

    def saved(self):
        """(learner's, curriculum's) state after all calls so far, as references."""
        return self._learner.saved.remote(), self._curriculum.saved.remote()

    def close(self):
        """End the actors, which gives their CPUs back."""
        for actor in [*self._workers, self._learner, self._curriculum]:
            ray.kill(actor)


def build_runtime(config, learner=None, curriculum=None):
    """The runtime that `config.runtime` names; learner and curriculum continue from saved states, if given."""
    return {"local": LocalRuntime, "ray": RayRuntime}[config.runtime](config, learner, curriculum)
