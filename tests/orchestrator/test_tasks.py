"""The grid of tasks: which there are, their numbers, and that it is not held in memory."""

import itertools
import math
import tracemalloc
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from orchestrator.config import EvaluationConfig
from orchestrator.tasks import TaskGrid, task_grid


def library_of(cancel, rotation=(-math.pi / 2, math.pi / 2), groups=None):
    count = len(cancel)
    groups = groups or [(s, t) for s in range(count) for t in range(count)]
    return SimpleNamespace(groups=np.array(groups), cancel=np.array(cancel), rotation=np.array(rotation))


def grid_of(cancel, rotation=(-math.pi / 2, math.pi / 2), **config):
    return task_grid(library_of(cancel, rotation), EvaluationConfig(**config))


def test_the_papers_set_has_460278_tasks():
    """9 targets x 562 moments x 91 angles: moments every 0.03 s, angles every pi / 90, both ends included."""
    moments = [62] * 8 + [66]
    assert sum(moments) == 562
    starts = np.linspace(0.1, 1.7, 9)
    grid = grid_of([(start, start + 0.03 * (n - 1)) for start, n in zip(starts, moments, strict=True)])
    assert grid.shape == (460_278, 4)
    angles = np.unique(grid[:, 3].round(9))
    assert len(angles) == 91
    np.testing.assert_allclose(angles, np.radians(np.arange(-90, 91, 2)), atol=1e-8)
    for source, (start, n) in enumerate(zip(starts, moments, strict=True)):
        own = grid[grid[:, 0] == source]
        assert len(own) == 9 * n * 91
        assert own[:, 1].min() == pytest.approx(start) and own[:, 1].max() == pytest.approx(start + 0.03 * (n - 1))
        assert (np.bincount(own[:, 2].astype(int)) == n * 91).all()
    assert len(np.unique(grid, axis=0)) == len(grid)


@given(
    cancel=st.lists(st.tuples(st.floats(0, 1), st.floats(0, 0.5)), min_size=1, max_size=3),
    turn=st.floats(0.1, 1.0),
    spacing=st.floats(0.05, 0.4),
)
def test_the_grid_is_three_nested_loops_in_the_order_of_the_numbers(cancel, turn, spacing):
    library = library_of([(begin, begin + length) for begin, length in cancel], rotation=(-0.7, 0.9))
    grid = TaskGrid(library, EvaluationConfig(moment_spacing=spacing, rotation_spacing=turn))
    wanted = []
    for source, target in library.groups:
        begin, end = library.cancel[source]
        moments = [m for i in range(99) if (m := begin + spacing * i) <= end + 1e-6 * spacing]
        rotations = [r for i in range(99) if (r := -0.7 + turn * i) <= 0.9 + 1e-6 * turn]
        wanted += [(source, moment, target, rotation) for moment, rotation in itertools.product(moments, rotations)]
    assert len(grid) == grid.whole == len(wanted)
    np.testing.assert_allclose(grid.tasks(range(len(grid))), wanted, atol=1e-12)


@pytest.mark.parametrize("end, moments", [(0.0, 1), (0.029, 1), (0.03, 2), (0.0599, 2), (0.06, 3), (2.97, 100)])
def test_moments_begin_at_the_start_of_the_range_and_never_leave_it(end, moments):
    grid = grid_of([(0.0, end)], rotation=(0.2, 0.2))
    np.testing.assert_allclose(grid[:, 1], 0.03 * np.arange(moments), atol=1e-12)
    np.testing.assert_array_equal(grid[:, 3], 0.2)


def test_a_range_that_ends_before_it_begins_holds_no_task():
    assert len(grid_of([(1.0, 0.5)])) == 0 and len(grid_of([(0.0, 1.0)], rotation=(0.5, 0.3))) == 0
    assert len(grid_of([(1.0, 0.99), (0.0, 0.0)], rotation=(0.0, 0.0))) == 2  # those that leave the other state


def test_only_allowed_transitions_are_evaluated(library):
    some = replace(library, groups=np.array([[0, 2], [1, 0]]))
    grid = task_grid(some, EvaluationConfig())
    assert {tuple(pair) for pair in grid[:, [0, 2]].astype(int)} == {(0, 2), (1, 0)}


def test_max_tasks_takes_the_same_spread_of_the_grid_every_time(library):
    whole = task_grid(library, EvaluationConfig())
    some = task_grid(library, EvaluationConfig(max_tasks=900))
    np.testing.assert_array_equal(some, task_grid(library, EvaluationConfig(max_tasks=900)))
    rows = {tuple(task) for task in whole}
    assert len(some) == 900 == len({tuple(task) for task in some}) and all(tuple(task) in rows for task in some)
    # about as many of each source as the grid has
    wanted = np.bincount(whole[:, 0].astype(int)) / len(whole)
    np.testing.assert_allclose(np.bincount(some[:, 0].astype(int)) / 900, wanted, atol=0.06)
    assert len(task_grid(library, EvaluationConfig(max_tasks=10**9))) == len(whole)


def test_a_task_has_one_number_whether_all_are_evaluated_or_some(library):
    whole, some = TaskGrid(library, EvaluationConfig()), TaskGrid(library, EvaluationConfig(max_tasks=50))
    numbers = some.numbers(0, 50)
    assert (np.diff(numbers) > 0).all() and some.whole == whole.whole == len(whole) > len(some) == 50
    np.testing.assert_array_equal(whole.tasks(numbers), some.tasks(numbers))
    np.testing.assert_array_equal(np.concatenate([some.numbers(0, 20), some.numbers(20, 999)]), numbers)


def test_a_grid_of_ten_billion_tasks_takes_no_more_memory_than_a_small_one():
    config = EvaluationConfig(moment_spacing=1e-4, rotation_spacing=1e-5)
    tracemalloc.start()
    grid = TaskGrid(library_of([(0.0, 1.0)] * 2), config)
    last = grid.tasks(grid.numbers(len(grid) - 1000, len(grid)))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(grid) > 10**10 and peak < 10**6
    assert (last[-1, [0, 2]] == 1).all() and last[-1, 1] == pytest.approx(1.0)
    assert math.pi / 2 - 1e-5 < last[-1, 3] <= math.pi / 2
