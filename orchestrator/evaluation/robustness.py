"""MS: the largest noise at which every task of the grid is reached (section 6), by bisection.

More noise is taken to reach no more: the noises between two that were tried are left out. That a noise does not do is
clear from the first failed task, which mostly is one that failed before; that it does takes the whole grid.
"""

import math

from orchestrator.evaluation.evaluator import KNOWN


def candidates(config):
    """The noises (log sigma) that MS may be: every `robustness_resolution` over the bracket, from its lower end."""
    (low, high), step = config.robustness_bracket, config.robustness_resolution
    return [round(low + step * i, 6) for i in range(math.floor((high - low) / step + 1e-6) + 1)]


def largest(noises, holds, known=()):
    """The largest of sorted `noises` that holds, all below it being taken to hold, or None if not even the first does.

    holds: noise -> bool, called as rarely as possible. known: (noise, bool) pairs that need no call; noises need not be
    among `noises`.
    """
    below, above = -1, len(noises)  # the largest index that holds, the smallest that does not
    for noise, held in known:
        if held:
            below = max(below, sum(candidate <= noise + 1e-9 for candidate in noises) - 1)
        else:
            above = min(above, sum(candidate < noise - 1e-9 for candidate in noises))
    ends = [0, len(noises) - 1]
    while below + 1 < above:
        # the ends of the bracket first: most policies fail, or none, and a failure is cheap to find
        middle = (below + above) // 2
        if below < 0:
            middle = 0
        elif above == len(noises):
            middle = ends[1]
        if holds(noises[middle]):
            below = middle
        else:
            above = middle
    return noises[below] if below >= 0 else None


class Search:
    """Tries noises on the whole grid at one level, shard by shard, up to the first failed task."""

    def __init__(self, level, count, pool, kept, suspects, show=lambda noise, done, total: None):
        """count: number of shards. pool: see `pools`. kept: `Kept`. suspects: numbers of tasks that failed elsewhere.

        show: called with the noise, the shards it has passed, and their number.
        """
        self._level, self._count, self._pool, self._kept = level, count, pool, kept
        self._suspects, self._show = list(dict.fromkeys(suspects)), show

    def holds(self, noise):
        """Whether every task is reached at this noise (log sigma)."""
        name = f"noise-{self._level}-{noise:g}"
        state = self._kept.read(name) or {"passed": [], "failed": []}
        if state["failed"]:
            return False
        left = [index for index in range(self._count) if index not in set(state["passed"])]
        if left and self._suspects:
            jobs = [("failed", (self._level, noise, self._suspects[:KNOWN]))]
            state["failed"] = next(iter(self._pool.run(jobs)))[1]
        if not state["failed"]:
            jobs = [("failed", (self._level, noise, None, index)) for index in left]
            for job, failed in self._pool.run(jobs):
                if failed:
                    state["failed"] = failed
                    break
                state["passed"].append(left[job])
                self._kept.write(name, state)
                self._show(noise, len(state["passed"]), self._count)
        if state["failed"]:
            self._kept.write(name, state)
            self._suspects = list(dict.fromkeys([*state["failed"], *self._suspects]))
        return not state["failed"]
