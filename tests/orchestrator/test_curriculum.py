"""Shrinking thresholds (Eq. 16) against the reference's plain list of results."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import reference
from hypothesis import given
from hypothesis import strategies as st

from orchestrator.config import CurriculumConfig
from orchestrator.curriculum import Curriculum, CurriculumState, final_tightenings, observe, thresholds, tracks_of
from workers.config import ReachConfig
from workers.types import FELL, REACHED, TIMED_OUT


class Ended(SimpleNamespace):
    """What the curriculum reads of outcomes: ends, cuts of the thresholds that judged them, whose task was kept."""

    def __len__(self):
        return len(self.end)

    def take(self, which):
        return Ended(**{name: array[which] for name, array in vars(self).items()})


def outcomes(hits, tightenings=0, seed=0, retained=None):
    """Episodes that reached (True) or failed one way or the other, under thresholds that had been cut so often."""
    retained = np.zeros(len(hits), dtype=bool) if retained is None else retained
    failed = np.random.default_rng(seed).choice([FELL, TIMED_OUT], len(hits))
    end = np.where(np.array(hits, dtype=bool), REACHED, failed).astype(np.int8)
    return Ended(end=end, tightenings=np.full(len(hits), tightenings), retained=retained)


def values(config, state):
    limits = thresholds(config, ReachConfig(), state.tightenings)
    return limits.root_position, limits.key_bodies, limits.joint_rotation


@pytest.mark.parametrize("unit", ["iterations", "episodes"])
@given(
    seed=st.integers(0, 2**32 - 1), window=st.sampled_from([1, 3, 10, 100]), lag=st.sampled_from([0, 1]),
    rate=st.sampled_from([0.5, 0.87, 0.93, 1.0]), iterations=st.sampled_from([5, 150]), count_retained=st.booleans(),
)  # fmt: skip
def test_any_sequence_of_outcomes_gives_the_references_thresholds(
    unit, seed, window, lag, rate, iterations, count_retained
):
    """lag: `pipeline_depth`, by which outcomes are judged with thresholds one iteration older."""
    generator = np.random.default_rng(seed)
    config = CurriculumConfig(window=window, window_unit=unit, count_retained=count_retained)
    state, slow, cuts = CurriculumState(), reference.Curriculum(window, unit), [0]
    for iteration in range(iterations):
        hits = generator.random(generator.integers(0, 30)) < rate  # also none at all
        retained = generator.random(len(hits)) < 0.3
        judged_by = cuts[max(0, iteration - lag)]
        state = observe(state, config, outcomes(hits, judged_by, iteration, retained))
        slow.iteration(hits if count_retained else hits[~retained], judged_by)
        cuts.append(state.tightenings)
        assert state.tightenings == slow.tightenings
        assert values(config, state) == pytest.approx(slow.thresholds, rel=1e-12)
        assert list(state.window) == slow.results or state.tightenings == 34
        assert state.iteration == iteration + 1


@pytest.mark.parametrize("unit", ["iterations", "episodes"])
@given(
    seed=st.integers(0, 2**32 - 1), count=st.integers(1, 4), window=st.sampled_from([1, 3, 10]),
    count_retained=st.booleans(),
)  # fmt: skip
def test_every_track_is_a_curriculum_of_its_own_episodes(unit, seed, count, window, count_retained):
    """Several tracks side by side, of unlike skill, against as many references that see their own episodes alone."""
    generator = np.random.default_rng(seed)
    config = CurriculumConfig(window=window, window_unit=unit, count_retained=count_retained)
    state = CurriculumState(tracks=(((), 0),) * count)
    slow, skill = [reference.Curriculum(window, unit) for _ in range(count)], generator.uniform(0.8, 1.0, count)
    for iteration in range(60):
        track = generator.integers(count, size=generator.integers(0, 40))
        hits, retained = generator.random(len(track)) < skill[track], generator.random(len(track)) < 0.3
        judged_by = np.array([cuts for _, cuts in state.tracks])[track] if len(track) else 0
        state = observe(state, config, outcomes(hits, judged_by, iteration, retained), track)
        for k, one in enumerate(slow):
            counted = (track == k) & (count_retained | ~retained)
            one.iteration(hits[counted], one.tightenings)
        assert [cuts for _, cuts in state.tracks] == [one.tightenings for one in slow]
        for (entries, cuts), one in zip(state.tracks, slow, strict=True):
            assert list(entries) == one.results or cuts == 34
        assert state.tightenings == min(one.tightenings for one in slow) and state.window == ()
    assert state.iteration == 60


def test_a_runs_final_accuracy_is_that_of_its_last_track():
    config = CurriculumConfig(window=1)
    state = CurriculumState(tracks=(((), 33), ((), 32)))
    for judged_by, reached_at in (([33, 32], None), ([34, 33], 2)):
        state = observe(state, config, outcomes([True, True], np.array(judged_by)), np.array([0, 1]))
        assert state.achieved_at == reached_at
    assert state.tightenings == 34


def test_scopes_put_groups_on_tracks():
    groups = np.array([(0, 0), (0, 2), (3, 0), (1, 1), (3, 3)])
    assert tracks_of("run", groups).tolist() == [0, 0, 0, 0, 0]
    assert tracks_of("source", groups).tolist() == [0, 0, 2, 1, 2]
    assert tracks_of("group", groups).tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("scope", ["source", "group"])
def test_each_source_or_group_gets_the_thresholds_that_it_has_earned(scope, make_config, trajectories, library):
    """Tasks from one clip reach their target, no others do: theirs alone are cut, and the run's are the loosest."""
    ended = trajectories.chunks[0].outcomes
    source = int(ended.task[0, 0])
    end = np.where(ended.task[:, 0] == source, REACHED, FELL).astype(np.int8)
    ended = replace(ended, end=end, retained=np.zeros(len(ended), dtype=bool), tightenings=np.zeros(len(ended), int))
    config = make_config({"curriculum.scope": scope, "curriculum.window": 1})
    curriculum = Curriculum(config)
    limits, _ = curriculum.observe(ended)
    met = set(map(tuple, ended.task[:, [0, 2]].astype(int).tolist()))
    assert (end == FELL).any() and len(limits.groups) == len(library.groups)
    for pair, row in zip(library.groups.tolist(), limits.groups, strict=True):
        cut = pair[0] == source and (scope == "source" or tuple(pair) in met)
        wanted = thresholds(config.curriculum, config.reach, int(cut))
        assert row == (wanted.root_position, wanted.key_bodies, wanted.joint_rotation, np.inf, cut)
    assert replace(limits, groups=()) == thresholds(config.curriculum, config.reach, 0)
    assert Curriculum(config, curriculum.saved()).thresholds() == limits


def test_the_achievement_rate_is_over_the_windows_episodes_not_a_mean_of_rates():
    """99 of 100 in one iteration and 0 of 1 in the next: 98 %, not 49.5 %."""
    config = CurriculumConfig(window=2)
    state = observe(CurriculumState(), config, outcomes([True] * 99 + [False]))
    assert observe(state, config, outcomes([False])).tightenings == 1


def run(config, hits):
    """The state after iterations of one episode each, always judged by the thresholds in force; and the cuts so far."""
    state, cuts = CurriculumState(), []
    for hit in hits:
        state = observe(state, config, outcomes([hit], state.tightenings))
        cuts.append(state.tightenings)
    return state, cuts


@pytest.mark.parametrize("unit", ["iterations", "episodes"])
def test_the_rate_must_exceed_88_percent_over_a_full_window(unit):
    config = CurriculumConfig(window=100, window_unit=unit)
    assert run(config, [True] * 99)[0].tightenings == 0
    assert run(config, [True] * 100)[0].tightenings == 1
    assert run(config, [False] * 12 + [True] * 88)[0].tightenings == 0
    assert run(config, [False] * 11 + [True] * 89)[0].tightenings == 1
    # the window slides: failures that have left it are forgotten
    assert run(config, [False] * 12 + [True] * 89)[0].tightenings == 1


@pytest.mark.parametrize("unit", ["iterations", "episodes"])
def test_the_window_starts_again_after_every_tightening(unit):
    _, cuts = run(CurriculumConfig(window=4, window_unit=unit), [True] * 12)
    assert cuts == [0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3]


@pytest.mark.parametrize("unit", ["iterations", "episodes"])
def test_episodes_judged_by_looser_thresholds_do_not_count_in_the_new_window(unit):
    config = CurriculumConfig(window=10, window_unit=unit)
    state = CurriculumState(tightenings=1)
    late = observe(state, config, outcomes([True] * 35, tightenings=0))
    assert (late.window, late.tightenings, late.iteration) == ((), 1, 1)
    # and in one iteration the thresholds are cut once at most: what follows in it was not judged by the new ones
    assert observe(state, CurriculumConfig(window=1, window_unit=unit), outcomes([True] * 35, 1)).tightenings == 2


def test_34_tightenings_lead_from_the_start_to_the_final_accuracy():
    config = CurriculumConfig()
    assert final_tightenings(config) == 34
    state = CurriculumState()
    assert values(config, state) == reference.START
    seen = [values(config, state)]
    while state.iteration < 4000 and state.achieved_at is None:
        state = observe(state, config, outcomes([True], state.tightenings))
        seen.append(values(config, state))
    assert state.achieved_at == state.iteration == 34 * 100
    assert seen[-1] == reference.FLOOR and seen[-2] != reference.FLOOR
    assert (np.diff(np.array(seen), axis=0) <= 0).all()
    # and there they stay
    for _ in range(250):
        state = observe(state, config, outcomes([True], 34))
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


def test_judges_alone_move_the_curriculum_where_there_are_any(make_config, trajectories):
    """All judges reach their target and no other environment does, and the other way round."""
    ended = trajectories.chunks[0].outcomes
    for judges, hit, tightenings in ((4, True, 1), (4, False, 0), (0, True, 0)):
        config = make_config({"policy.judges": judges, "curriculum.window": 1, "curriculum.achievement": 0.88})
        judge = ended.environment % 4 == 0
        assert 0 < judge.sum() < len(ended)
        end = np.where(judge == hit, REACHED, FELL).astype(np.int8)
        ends = replace(ended, end=end, retained=np.zeros(len(ended), dtype=bool))
        curriculum = Curriculum(config)
        _, summary = curriculum.observe(ends)
        assert curriculum.saved().tightenings == tightenings
        counted = end[judge] if judges else end
        assert summary["achievement_judged"] == (counted == REACHED).mean()
