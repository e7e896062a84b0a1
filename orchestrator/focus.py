"""Tasks drawn by how often such tasks fail: pure functions of the outcomes in order (`task.focus`).

All tasks are sorted into cells (`workers.planner.cells_of`); a tally of failures and episodes per cell, which fades
with the iterations, gives the shares by which the planner draws cells. Episodes of tasks kept after a failure do not
count: they would tell of the stay probability.
"""

import numpy as np

from workers.planner import cells_of, number_of_cells
from workers.types import REACHED

FADE = 0.99  # of the tally per iteration: what the policy could do a hundred iterations ago is forgotten
PRIOR = 5.0  # episodes at the mean failure rate that every cell is granted: a cell seen once is neither 0 nor 1


def empty_tally(library):
    """The tally (2, cells) before the first outcome: failures, episodes."""
    return np.zeros((2, number_of_cells(library)))


def count(tally, outcomes, library):
    """The tally after one more iteration's `Outcomes`; library: `MotionLibrary`."""
    fresh = outcomes.take(np.flatnonzero(~outcomes.retained))
    cells, size = cells_of(fresh.task, library), tally.shape[1]
    failures = np.bincount(cells, weights=fresh.end != REACHED, minlength=size)
    return FADE * tally + np.stack([failures, np.bincount(cells, minlength=size)])


def shares(tally):
    """Cumulative shares of the cells, a tuple of floats that ends with 1: each in proportion to its failure rate."""
    failures, episodes = tally
    mean = (failures.sum() + 1.0) / (episodes.sum() + 2.0)
    rate = (failures + PRIOR * mean) / (episodes + PRIOR)
    return tuple((np.cumsum(rate) / rate.sum()).tolist())
