"""Who plays the shards: this process, or Ray workers. Both give the same results, in whatever order they come.

`run(jobs)` takes (name of a method of `Evaluator`, its arguments) pairs and yields (index of the job, result) as jobs
are finished; whoever stops asking gets no more.
"""

import ray

from motion.errors import InputError
from orchestrator.evaluation.evaluator import Evaluator

AHEAD = 2  # jobs that a worker is given at a time, so that it need not wait for the next


class LocalPool:
    """This process."""

    def __init__(self, config, subject):
        self._evaluator = Evaluator(config, subject.policy, subject.tightenings, threads_of_run(config))

    def run(self, jobs):
        """See the module."""
        for index, (method, arguments) in enumerate(jobs):
            yield index, getattr(self._evaluator, method)(*arguments)

    def close(self):
        """Give back what the pool holds."""


class Player:
    """What an actor holds. The policy comes with each job, not with the first: Ray can then start it again."""

    def __init__(self, kind, config, tightenings, threads):
        self._kind, self._arguments, self._evaluator = kind, (config, tightenings, threads), None

    def play(self, policy, method, arguments):
        """The result of a method of `Evaluator`; the policy is the same in every call."""
        if self._evaluator is None:
            config, tightenings, threads = self._arguments
            self._evaluator = self._kind(config, policy, tightenings, threads)
        return getattr(self._evaluator, method)(*arguments)


class RayPool:
    """Actors, which Ray starts again where they die; what they were at is played again, with the same numbers."""

    def __init__(self, config, subject, cpus, kind=Evaluator):
        """cpus: CPUs, and threads, of each actor (list). kind: the class whose methods jobs name."""
        lives = {"max_restarts": -1, "max_task_retries": config.faults.restarts}
        self._policy = ray.put(subject.policy)
        self._actors = [
            ray.remote(Player).options(num_cpus=threads, **lives).remote(kind, config, subject.tightenings, threads)
            for threads in cpus
        ]

    def run(self, jobs):
        """See the module."""
        waiting, running = list(enumerate(jobs))[::-1], {}
        hands = [actor for _ in range(AHEAD) for actor in self._actors]
        try:
            while waiting or running:
                while waiting and hands:
                    (index, job), actor = waiting.pop(), hands.pop(0)
                    running[actor.play.remote(self._policy, *job)] = index, actor
                (done, *_), _ = ray.wait(list(running), num_returns=1)
                index, actor = running.pop(done)
                hands.append(actor)
                yield index, ray.get(done)
        finally:
            for reference in running:
                ray.cancel(reference)  # those that have not begun

    def close(self):
        """End the actors, which gives their CPUs back."""
        for actor in self._actors:
            ray.kill(actor)


def threads_of_run(config):
    """CPUs that a run has."""
    return config.learner_threads + config.num_workers * config.worker_threads


def within_run(config, subject, shards):
    """The pool of a run that has just been trained: on the CPUs that its learner and workers had.

    In this process where the evaluation is too short to be worth the start of others.
    """
    if config.runtime == "ray" and ray.is_initialized() and shards > 4:
        return RayPool(config, subject, [config.learner_threads] + [config.worker_threads] * config.num_workers)
    return LocalPool(config, subject)


def of_cluster(config, subject, shards):
    """The pool of the command line: `evaluation.num_workers` actors of one CPU, or as many as Ray has CPUs free."""
    wanted = config.evaluation.num_workers or max(1, int(ray.available_resources().get("CPU", 0)))
    there = int(ray.cluster_resources().get("CPU", 0))
    if wanted > there:
        raise InputError(f"evaluation.num_workers={wanted}: Ray has {there} CPUs in all; lower it")
    return RayPool(config, subject, [1] * min(wanted, shards))
