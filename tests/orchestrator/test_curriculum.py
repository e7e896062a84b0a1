"""Shrinking thresholds (Eq. 16) against the reference's plain list of results."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import reference
from orchestrator.config import CurriculumConfig
from orchestrator.curriculum import CurriculumState, final_tightenings, observe, thresholds
from workers.config import ReachConfig
from workers.types import FELL, REACHED, TIMED_OUT


class Ended(SimpleNamespace):
    """The only thing that the curriculum reads of outcomes: how episodes ended, in order."""

    def __len__(self):
        return len(self.end)


def outcomes(hits, seed=0):
    """Episodes that reached (True) or failed one way or the other."""
    failed = np.random.default_rng(seed).choice([FELL, TIMED_OUT], len(hits))
    return Ended(end=np.where(np.array(hits, dtype=bool), REACHED, failed).astype(np.int8))


def values(config, state, reach=ReachConfig()):
    limits = thresholds(config, reach, state.tightenings)
    return limits.root_position, limits.key_bodies, limits.joint_rotation


@pytest.mark.parametrize("unit", ["iterations", "episodes"])
@given(
    seed=st.integers(0, 2**32 - 1), window=st.sampled_from([1, 3, 10, 100]), rate=st.sampled_from([0.5, 0.87, 0.93, 1.0]),
    iterations=st.sampled_from([5, 150]),
)  # fmt: skip
def test_any_sequence_of_outcomes_gives_the_references_thresholds(unit, seed, window, rate, iterations):
    generator = np.random.default_rng(seed)
    config = CurriculumConfig(window=window, window_unit=unit)
    state, slow = CurriculumState(), reference.Curriculum(window)
    for iteration in range(iterations):
        hits = generator.random(generator.integers(0, 30)) < rate  # also none at all
        state = observe(state, config, outcomes(hits, iteration))
        if unit == "iterations":
            slow.add(int(hits.sum()), len(hits))
        else:
            for hit in hits:
                slow.add(int(hit), 1)
        assert state.tightenings == slow.tightenings
        assert values(config, state) == pytest.approx(slow.thresholds, rel=1e-12)
        assert list(state.window) == slow.results
        assert state.iteration == iteration + 1


def test_the_achievement_rate_is_over_the_windows_episodes_not_a_mean_of_rates():
    """99 of 100 in one iteration and 0 of 1 in the next: 98 %, not 49.5 %."""
    config = CurriculumConfig(window=2)
    state = observe(CurriculumState(), config, outcomes([True] * 99 + [False]))
    assert observe(state, config, outcomes([False])).tightenings == 1


@pytest.mark.parametrize("unit", ["iterations", "episodes"])
def test_the_rate_must_exceed_88_percent_over_a_full_window(unit):
    config = CurriculumConfig(window=100, window_unit=unit)

    def run(hits):
        state = CurriculumState()
        for hit in hits:
            state = observe(state, config, outcomes([hit]))
        return state.tightenings

    assert run([True] * 99) == 0
    assert run([True] * 100) == 1
    assert run([False] * 12 + [True] * 88) == 0
    assert run([False] * 11 + [True] * 89) == 1
    # the window slides: failures that have left it are forgotten
    assert run([False] * 12 + [True] * 89) == 1


@pytest.mark.parametrize("unit", ["iterations", "episodes"])
def test_the_window_starts_again_after_every_tightening(unit):
    config, state, cuts = CurriculumConfig(window=4, window_unit=unit), CurriculumState(), []
    for _ in range(12):
        state = observe(state, config, outcomes([True]))
        cuts.append(state.tightenings)
    assert cuts == [0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3]


def test_an_iteration_of_many_episodes_may_tighten_more_than_once():
    config = CurriculumConfig(window=10, window_unit="episodes")
    assert observe(CurriculumState(), config, outcomes([True] * 35)).tightenings == 3


def test_34_tightenings_lead_from_the_start_to_the_final_accuracy():
    config = CurriculumConfig()
    assert final_tightenings(config) == 34
    state = CurriculumState()
    assert values(config, state) == reference.START
    seen = [values(config, state)]
    while state.iteration < 4000 and state.achieved_at is None:
        state = observe(state, config, outcomes([True]))
        seen.append(values(config, state))
    assert state.achieved_at == state.iteration == 34 * 100
    assert seen[-1] == reference.FLOOR and seen[-2] != reference.FLOOR
    assert (np.diff(np.array(seen), axis=0) <= 0).all()
    # and there they stay
    for _ in range(250):
        state = observe(state, config, outcomes([True]))
    assert (state.tightenings, state.achieved_at) == (34, 3400)
    assert values(config, state) == reference.FLOOR


def test_the_heading_counts_only_when_asked_for_and_has_a_floor_of_its_own():
    config = CurriculumConfig()
    assert thresholds(config, ReachConfig(), 34).heading == np.inf
    reach = ReachConfig(heading=True, heading_start=1.0, heading_floor=0.1)
    assert [thresholds(config, reach, n).heading for n in (0, 1, 34)] == pytest.approx([1.0, 0.9, 0.1])


def test_observing_leaves_the_state_as_it_was():
    config, state = CurriculumConfig(window=2), CurriculumState(window=((1, 1),))
    observe(state, config, outcomes([True] * 5))
    assert state == CurriculumState(window=((1, 1),))
