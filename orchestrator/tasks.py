"""The grid of evaluation tasks (section 1 and 4.3 of the paper)."""

import math

import numpy as np


class TaskGrid:
    """The tasks by their numbers, which count groups, then moments, then rotations. Holds none of them in memory.

    Moments every `moment_spacing` s over the source's cancel range, rotations every `rotation_spacing` rad over the
    range, both ends included. With `max_tasks`, a subset of that size drawn once and for all, the same for every
    policy; a task has the same number in the subset and in the whole grid.
    """

    def __init__(self, library, config):
        """library: `workers.library.MotionLibrary`; config: `EvaluationConfig`."""
        self._groups, self._begin, self._spacing = library.groups, library.cancel[:, 0], config.moment_spacing
        self._low, self._turn = library.rotation[0], config.rotation_spacing
        self._rotations = _points(*library.rotation, config.rotation_spacing)
        moments = np.array([_points(begin, end, config.moment_spacing) for begin, end in library.cancel], np.int64)
        sizes = moments[np.asarray(library.groups, np.int64).reshape(-1, 2)[:, 0]] * self._rotations
        self._last = np.cumsum(sizes)
        self.whole = int(sizes.sum())
        """Number of tasks of the whole grid."""
        self._chosen = None
        if 0 < config.max_tasks < self.whole:
            order = np.random.Generator(np.random.Philox(key=0)).permutation(self.whole)
            self._chosen = np.sort(order[: config.max_tasks])

    def __len__(self):
        return self.whole if self._chosen is None else len(self._chosen)

    def numbers(self, first, last):
        """Numbers (int64) in the whole grid of the tasks `first` to before `last` of those that are evaluated."""
        last = min(last, len(self))
        return np.arange(first, last) if self._chosen is None else self._chosen[first:last]

    def tasks(self, numbers):
        """Tasks (M, 4) of numbers (M,): source state, moment (s), target state, rotation (rad)."""
        numbers = np.asarray(numbers, dtype=np.int64)
        group = np.searchsorted(self._last, numbers, side="right")
        within = numbers - np.concatenate([[0], self._last])[group]
        source, target = np.asarray(self._groups)[group].T
        moment = self._begin[source] + self._spacing * (within // self._rotations)
        rotation = self._low + self._turn * (within % self._rotations)
        return np.stack([source, moment, target, rotation], axis=1).astype(np.float64)


def _points(low, high, spacing):
    """How many points every `spacing` there are from low to high; none if high is below low."""
    return max(0, math.floor((high - low) / spacing + 1e-6) + 1)


def task_grid(library, config):
    """All tasks (M, 4) of a `TaskGrid` at once."""
    grid = TaskGrid(library, config)
    return grid.tasks(grid.numbers(0, len(grid)))
