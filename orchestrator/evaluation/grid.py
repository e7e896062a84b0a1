"""The evaluation of one policy on the whole grid: evaluation.json's content, and failures.csv beside it."""

from pathlib import Path

import numpy as np

from motion.errors import InputError
from motion.state_machine import build_state_machine
from orchestrator.evaluation import failures
from orchestrator.evaluation.evaluator import LEVELS, levels, num_shards, rungs, shard_size
from orchestrator.evaluation.kept import Kept, key_of, shard_name
from orchestrator.evaluation.pools import within_run
from orchestrator.evaluation.robustness import Search, candidates, largest
from orchestrator.evaluation.statistics import Breakdown, all_reached, columns
from orchestrator.tasks import TaskGrid
from workers.library import build_library

FAILURES = "failures.csv"
KEPT = "evaluation"  # the folder of finished shards


class Silent:
    """Shows nothing of an evaluation's progress."""

    def __call__(self, total, done):
        """A context manager with `advance(tasks, steps)` and `say(text)`. total, done: tasks, and those done before."""
        return self

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def advance(self, tasks, steps):
        """So many tasks more are finished, which took so many policy steps."""

    def say(self, text):
        """What is being done now."""


def evaluate(config, subject, folder=None, make_pool=within_run, show=None):
    """evaluation.json's content (dict, see docs/evaluation.md) of a `Subject`.

    folder: where failures.csv and finished shards go; nothing is written without. make_pool: a function of (config,
    subject, number of shards) giving one of `pools`. show: see `Silent`. InputError if there is nothing to evaluate.
    """
    machine = build_state_machine(config.motions)
    library = build_library(machine)
    grid = TaskGrid(library, config.evaluation)
    if not len(grid):
        raise InputError("evaluation: the grid holds no task; widen a cancel range or motions.rotation")
    limits = levels(config, subject.tightenings)
    count = num_shards(len(grid))
    kept = Kept(folder and Path(folder) / KEPT, key_of(config, subject, machine, limits, shard_size(len(grid))))
    pool = None
    try:
        pool = make_pool(config, subject, count)
        with (show or Silent())(len(grid), _tasks_done(kept, grid, count)) as progress:
            play(pool, kept, grid, count, progress)
            total = Totals(kept, count)
            ms = robustness(config, limits, total, pool, kept, count, progress)
    finally:
        if pool:
            pool.close()
    states = [state.name for state in machine.states]
    if folder:
        failures.write(Path(folder) / FAILURES, (kept.read(shard_name(i))["failures"] for i in range(count)), states)
        kept.forget_others()
    return {
        "tasks": len(grid),
        "tightenings": subject.tightenings,
        "final_tightenings": limits["metrics"].tightenings,
        **{level: total.metrics("noise", level, ms, subject) for level in ("metrics", "trained")},
        "deterministic": total.metrics("deterministic", "metrics", ms, subject),
        "trained_deterministic": total.metrics("deterministic", "trained", ms, subject),
        **{f"{name}_thresholds": [level.root_position, level.key_bodies, level.joint_rotation]
           for name, level in limits.items()},
        "log_sigma": config.evaluation.log_sigma,
        "grid": {
            "moment_spacing": config.evaluation.moment_spacing, "rotation_spacing": config.evaluation.rotation_spacing,
            "max_tasks": config.evaluation.max_tasks, "whole": grid.whole,
        },
        "states": states,
        **Breakdown(library).lists(total.counts, rungs(config)),
    }  # fmt: skip


def _tasks_done(kept, grid, count):
    """How many tasks the kept shards hold."""
    size, names = shard_size(len(grid)), kept.names()
    return sum(len(grid.numbers(i * size, (i + 1) * size)) for i in range(count) if shard_name(i) in names)


def play(pool, kept, grid, count, progress):
    """Play the shards that are not kept yet, and keep them."""
    left = [index for index in range(count) if kept.read(shard_name(index)) is None]
    for job, content in pool.run([("shard", (index,)) for index in left]):
        kept.write(shard_name(left[job]), content)
        entry = np.array([content["sums"][name]["metrics"] for name in content["sums"]])
        progress.advance(int(entry[0, -1]), int(entry[:, -3].sum()))


class Totals:
    """The sums of all shards, added in their order: the same bits whoever played them, and in which order."""

    def __init__(self, kept, count):
        self._sums, self.counts, self.suspects = {}, {}, {level: [] for level in LEVELS}
        for index in range(count):
            shard = kept.read(shard_name(index))
            for name, by_level in shard["sums"].items():
                for level, values in by_level.items():
                    self._sums[name, level] = self._sums.get((name, level), 0.0) + np.array(values)
            for name, values in shard["counts"].items():
                self.counts[name] = self.counts.get(name, 0) + np.array(values, dtype=np.int64)
            for level, numbers in shard["failed"].items():
                if len(self.suspects[level]) < len(numbers):
                    self.suspects[level] = numbers

    def all_reached(self, level):
        """Whether every task was reached with the evaluation's noise."""
        return all_reached(self._sums["noise", level])

    def metrics(self, name, level, ms, subject):
        """The 13 columns of a pass (`noise` or `deterministic`) at a level."""
        return {**columns(self._sums[name, level]), "MS": ms[level], "IRFA": subject.irfa}


def robustness(config, limits, total, pool, kept, count, progress):
    """{level: MS}: the largest noise of the bracket at which every task is reached, None if there is none."""
    out, noises = {}, candidates(config.evaluation)
    for level in LEVELS:
        if level == "metrics" and vars(limits["metrics"]) == vars(limits["trained"]):
            out[level] = out["trained"]
            continue

        def say(noise, done, of, level=level):
            progress.say(f"MS ({level}): is every task reached at log sigma {noise:g}? {done}/{of} shards")

        search = Search(level, count, pool, kept, total.suspects[level], say)
        known = [(config.evaluation.log_sigma, total.all_reached(level))]
        out[level] = largest(noises, search.holds, known)
    return out
