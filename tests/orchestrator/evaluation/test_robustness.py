"""MS: bisection over noises, and a search that stops at the first failed task."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from orchestrator.config import EvaluationConfig
from orchestrator.evaluation.kept import Kept
from orchestrator.evaluation.robustness import Search, candidates, largest


@given(count=st.integers(1, 40), limit=st.integers(-1, 40), known=st.none() | st.floats(-1, 40))
def test_bisection_finds_the_largest_noise_that_holds_and_never_asks_twice(count, limit, known):
    noises, asked = list(range(count)), []

    def holds(noise):
        asked.append(noise)
        return noise <= limit

    told = [] if known is None else [(known, known <= limit)]
    assert largest(noises, holds, told) == (None if limit < 0 else min(limit, count - 1))
    assert len(asked) == len(set(asked)) <= 2 + math.ceil(math.log2(count + 1))
    for noise in asked:
        assert known is None or (noise > known if known <= limit else noise < known)


def test_a_noise_that_is_known_to_fail_leaves_one_question_to_a_policy_that_fails_without_noise_too():
    asked = []
    assert largest(candidates(EvaluationConfig()), lambda noise: asked.append(noise), [(-3.7, False)]) is None
    assert asked == [-5.0]


@pytest.mark.parametrize(
    "bracket, resolution, wanted",
    [
        ([-4.0, -3.0], 0.5, [-4.0, -3.5, -3.0]),
        ([-4.0, -3.1], 0.5, [-4.0, -3.5]),
        ([-3.7, -3.7], 0.1, [-3.7]),
        ([-5.0, -2.0], 0.1, [round(-5 + i / 10, 1) for i in range(31)]),
    ],
)
def test_the_noises_are_every_resolution_over_the_bracket(bracket, resolution, wanted):
    config = EvaluationConfig(robustness_bracket=bracket, robustness_resolution=resolution)
    assert candidates(config) == wanted


class Tasks:
    """A pool whose tasks, ten to a shard, each fail from a noise of their own on."""

    def __init__(self, bears):
        self.bears, self.played = bears, 0

    def run(self, jobs):
        for index, (_, arguments) in enumerate(jobs):
            yield index, self.failed(*arguments)

    def failed(self, level, log_sigma, numbers=None, index=None):
        numbers = range(10 * index, 10 * index + 10) if numbers is None else numbers
        self.played += len(numbers)
        return [number for number in numbers if self.bears[number] < log_sigma]


def test_the_search_finds_the_weakest_tasks_limit_and_mostly_plays_few_tasks(tmp_path):
    bears = [-2.0] * 200
    bears[177], bears[155] = -3.35, -3.15
    pool, noises = Tasks(bears), candidates(EvaluationConfig())
    search = Search("metrics", 20, pool, Kept(tmp_path, "key"), [155])
    assert largest(noises, search.holds, [(-3.7, True)]) == -3.4
    # -3.5 and -3.4 took the whole grid, -3.3 up to 177; where 155 or, later, 177 fail they say so at once
    assert pool.played < 3 * 200
    played = pool.played
    again = Search("metrics", 20, pool, Kept(tmp_path, "key"), [])
    assert largest(noises, again.holds, [(-3.7, True)]) == -3.4 and pool.played == played


def test_an_interrupted_search_goes_on_with_the_shards_that_are_left(tmp_path):
    class Stops(Tasks):
        def failed(self, level, log_sigma, numbers=None, index=None):
            if index == 6:
                raise KeyboardInterrupt
            return super().failed(level, log_sigma, numbers, index)

    with pytest.raises(KeyboardInterrupt):
        Search("metrics", 10, Stops([-1.0] * 100), Kept(tmp_path, "key"), []).holds(-3.0)
    pool = Tasks([-1.0] * 100)
    assert Search("metrics", 10, pool, Kept(tmp_path, "key"), []).holds(-3.0) and pool.played == 40
    assert not Search("trained", 10, Tasks([-4.0] * 100), Kept(tmp_path, "key"), []).holds(-3.0)
