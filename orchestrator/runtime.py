"""Where a run's parts live: in this process, or in Ray actors. Both give the same numbers.

A runtime passes on what the parts return (chunks, outcomes, worker states, policies) as handles: values here, object
references there. The actors are thin shells around the pure functions. A worker keeps nothing between two calls: its
state travels with each, so that a chunk can be collected again by anyone.

Hence faults: Ray starts a rollout worker that dies again and repeats the call that it was in, with the state that the
call began with; whoever waits for the chunk does not notice. The learner and the curriculum hold state: if one of them
is lost (or objects, with a machine), `value` raises one of `FAULTS`, and `run.train` goes back to the last checkpoint.
"""

import time

import numpy as np
import ray
from ray import exceptions

from orchestrator import cluster
from orchestrator.curriculum import Curriculum
from workers.worker import RolloutWorker

LOOK = 5.0  # seconds between looks at what is missing, while waiting


class Hung(exceptions.RayError):
    """An actor that holds state has not answered for `faults.hang_timeout` seconds."""


# What a lost process or machine raises, and no error of our own code does
FAULTS = (
    Hung,
    exceptions.RayActorError,
    exceptions.WorkerCrashedError,
    exceptions.ObjectLostError,
    exceptions.OutOfMemoryError,
    exceptions.NodeDiedError,
    exceptions.LocalRayletDiedError,
)


def is_fault(error):
    """Whether one of `FAULTS` is worth another try: an actor whose constructor raises would raise again."""
    return not getattr(error, "actor_init_failed", False)


def describe(error):
    """A fault in a few words."""
    if isinstance(error, Hung):
        return str(error)
    if isinstance(error, exceptions.ActorUnavailableError):
        return "an actor cannot be reached"
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    who = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("class_name:")), None)
    return f"{who} died" if who else f"{type(error).__name__}: {lines[0] if lines else 'no message'}"[:200]


def shares(num_envs, num_workers):
    """(first environment, number of environments) of each worker: equal shares to within one."""
    cuts = np.linspace(0, num_envs, num_workers + 1).astype(int)
    return [(int(a), int(b - a)) for a, b in zip(cuts, cuts[1:])]


class LocalRuntime:
    """Everything in this process, one call after the other."""

    def __init__(self, config, learner=None, curriculum=None, notice=lambda line: None):
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

    def __init__(self, config, learner=None, curriculum=None, notice=lambda line: None):
        from learner.learner import Learner

        self._config, self._notice = config, notice
        gpus = 1 if cluster.resolve_device(config.device, config.runtime) == "cuda" else 0
        # an actor of several threads needs none of its own environment: one CPU each by default, and BLAS single
        environment = {"env_vars": {"OMP_NUM_THREADS": str(config.learner_threads), "NUMBA_NUM_THREADS": "1"}}
        actor = ray.remote(Learner).options(
            num_cpus=config.learner_threads, num_gpus=gpus, runtime_env=environment
        )
        self._learner = actor.remote(config, learner)
        lives = {"max_restarts": -1, "max_task_retries": config.faults.restarts}
        self._workers = [
            ray.remote(RolloutWorker).options(num_cpus=config.worker_threads, **lives)
            .remote(config, count, config.spare_threads)
            for _, count in shares(config.num_envs, config.num_workers)
        ]
        self._curriculum = ray.remote(Curriculum).options(num_cpus=0).remote(config, curriculum)
        self._calls = []  # (worker, a reference that its call fills) of calls that may still run

    def initial(self):
        """(worker states, policy, thresholds) of a new run, as references."""
        firsts = [first for first, _ in shares(self._config.num_envs, self._config.num_workers)]
        states = [worker.initial_state.remote(first) for worker, first in zip(self._workers, firsts)]
        self._calls = list(zip(self._workers, states))
        return states, self._learner.policy.remote(), self._curriculum.thresholds.remote()

    def collect(self, states, policy, thresholds):
        """(chunks, outcomes, next states), references, one each per worker."""
        calls = [
            worker.collect.options(num_returns=3).remote(state, policy, thresholds)
            for worker, state in zip(self._workers, states)
        ]
        # a worker does one call after the other, and at most depth + 1 iterations are on their way
        keep = len(self._workers) * (self._config.pipeline_depth + 1)
        self._calls = [*self._calls, *zip(self._workers, (call[1] for call in calls))][-keep:]
        return tuple(list(column) for column in zip(*calls))

    def update(self, chunks):
        """(policy, metrics), references."""
        return self._learner.update.options(num_returns=2).remote(*chunks)

    def observe(self, outcomes):
        """(thresholds, summary), references."""
        return self._curriculum.observe.options(num_returns=2).remote(*outcomes)

    def value(self, handle):
        """What a reference (or a list of references) stands for; waits for it. Raises one of `FAULTS`."""
        references = handle if isinstance(handle, list) else [handle]
        waited, tried, missing = 0.0, False, None
        while True:
            begun = time.monotonic()
            _, late = ray.wait(references, num_returns=len(references), timeout=LOOK, fetch_local=False)
            if not late:
                return ray.get(handle)
            short = cluster.shortage(self._config)
            if short and short != missing:
                self._notice(f"waiting for {short}")
            missing = short
            # a machine may take as long as it likes to come back, an actor that has one may not
            waited = 0.0 if missing else waited + time.monotonic() - begun
            if waited > self._config.faults.hang_timeout:
                if tried or not self._replace_hung():
                    raise Hung(f"no answer for {waited:.0f} s (faults.hang_timeout)")
                waited, tried = 0.0, True

    def _replace_hung(self):
        """Kill the workers that are in a call; Ray starts them again and repeats it. Whether there are any."""
        calls = dict((reference, worker) for worker, reference in self._calls)
        _, late = ray.wait(list(calls), num_returns=len(calls), timeout=0, fetch_local=False)
        hung = list({id(calls[reference]): calls[reference] for reference in late}.values())
        if hung:
            self._notice(
                f"{len(hung)} rollout worker{'s' * (len(hung) > 1)} without an answer for "
                f"{self._config.faults.hang_timeout:g} s (faults.hang_timeout): replaced"
            )
        for worker in hung:
            ray.kill(worker, no_restart=False)
        return bool(hung)

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


def build_runtime(config, learner=None, curriculum=None, notice=lambda line: None):
    """The runtime that `config.runtime` names; learner and curriculum continue from saved states, if given.

    notice: called with a line of text when a fault was met or a machine is waited for.
    """
    return {"local": LocalRuntime, "ray": RayRuntime}[config.runtime](config, learner, curriculum, notice)
