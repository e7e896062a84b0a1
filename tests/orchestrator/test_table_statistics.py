"""Intervals, tests and marks against slow code written from their definitions."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from orchestrator.table import statistics
from orchestrator.table.statistics import interval, marked, p_value, rate_interval

NUMBERS = st.floats(-100, 100).map(lambda value: round(value, 3))


def all_resamples(values):
    """The interval by its definition: between the smallest means that 2.5 % and 97.5 % of all samples do not exceed."""
    means = sorted(np.mean(sample) for sample in itertools.product(values, repeat=len(values)))
    return [means[math.ceil(share * len(means) - 1e-9) - 1] for share in (0.025, 0.975)]


@settings(deadline=None, max_examples=25)
@given(st.lists(NUMBERS, min_size=2, max_size=5))
def test_the_interval_of_few_runs_is_that_of_all_resamples(values):
    assert interval(values) == pytest.approx(all_resamples(values), abs=1e-9)


def test_the_interval_of_many_runs_is_near_that_of_a_normal_mean():
    values = np.random.default_rng(0).normal(size=40)
    low, high = interval(list(values))
    half = 1.96 * values.std() / 40**0.5
    assert [low, high] == pytest.approx([values.mean() - half, values.mean() + half], abs=0.1 * half)
    assert interval(list(values)) == [low, high]  # no chance in it


def test_no_interval_without_two_known_values():
    assert interval([]) is None and interval([1.0]) is None and interval([1.0, None]) is None


def dealt_out(one, other):
    """The p-value by its definition: every way to deal the runs out to two rows of these sizes."""
    values, size = [*one, *other], len(one)
    observed = np.mean(one) - np.mean(other)
    differences = []
    for chosen in itertools.combinations(range(len(values)), size):
        rest = [values[i] for i in range(len(values)) if i not in chosen]
        differences.append(np.mean([values[i] for i in chosen]) - np.mean(rest))
    differences = np.array(differences)
    above = np.mean(differences >= observed - 1e-9)
    below = np.mean(differences <= observed + 1e-9)
    return min(2 * min(above, below), 1.0)


@settings(deadline=None, max_examples=25)
@given(st.lists(NUMBERS, min_size=2, max_size=5), st.lists(NUMBERS, min_size=2, max_size=5))
def test_the_p_value_is_that_of_all_ways_to_deal_the_runs_out(one, other):
    assert p_value(one, other) == pytest.approx(dealt_out(one, other), abs=1e-9)


def test_fewer_runs_than_the_fewest_cannot_reach_a_mark():
    apart = {n: p_value([0.0 + i for i in range(n)], [100.0 + i for i in range(n)]) for n in (2, 3, 4)}
    assert apart[2] == pytest.approx(2 / 6) and apart[3] == pytest.approx(2 / 20) and apart[4] == pytest.approx(2 / 70)
    fewest = min(n for n, p in apart.items() if p <= statistics.RATE)
    assert fewest == statistics.FEWEST
    assert p_value([1.0], [2.0]) is None and p_value([1.0, None], [2.0, 3.0]) is None


def step_up(p_values):
    """Benjamini and Hochberg: mark the k smallest, k the largest with p_(k) <= k / m * rate."""
    ordered = sorted(p for p in p_values.values() if p is not None)
    limit = max((p for k, p in enumerate(ordered, 1) if p <= k / len(ordered) * statistics.RATE), default=-1.0)
    return {key: p is not None and p <= limit for key, p in p_values.items()}


@settings(deadline=None)
@given(st.lists(st.none() | st.floats(0, 1) | st.floats(0, 0.05), max_size=40))
def test_marks_are_those_of_benjamini_and_hochberg(p_values):
    p_values = dict(enumerate(p_values))
    assert marked(p_values) == step_up(p_values)


def test_runs_that_differ_by_chance_are_seldom_marked():
    """Tables of three rows and 12 columns without any difference: at most 5 % of them may have a mark."""
    random = np.random.default_rng(0)
    tables = 0
    for _ in range(12):
        runs = random.normal(size=(4, 12, 4))  # row, column, run
        p_values = {
            (row, column): p_value(runs[row, column], runs[0, column]) for row in (1, 2, 3) for column in range(12)
        }
        tables += any(marked(p_values).values())
    assert tables <= 2


def test_the_interval_of_a_rate_against_its_formula():
    for reached, count in ((0, 8), (437, 500), (500, 500)):
        p, z = reached / count, 1.959963984540054
        centre = (p + z**2 / (2 * count)) / (1 + z**2 / count)
        half = z / (1 + z**2 / count) * np.sqrt(p * (1 - p) / count + z**2 / (4 * count**2))
        assert rate_interval(p, count) == pytest.approx([max(centre - half, 0), min(centre + half, 1)], abs=1e-9)
