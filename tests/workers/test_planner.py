"""The task planner: distributions of tasks, Eq. 14 against the reference, grounding, the stay probability."""

import numpy as np
import pytest
import reference
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from workers.environment import Environment
from workers.planner import MOMENTS, ROTATIONS, begin, cells_of, draw_task, ground, number_of_cells, place_target
from workers.rollout import Rollout
from workers.termination import lowest
from workers.types import FELL, REACHED, TIMED_OUT

seeds = st.integers(0, 2**32 - 1)
EVERYTHING = np.ones(17, dtype=bool)


def tasks_of(library, count, seed=3, groups=None, focus=0.0, shares=()):
    groups = library.groups if groups is None else groups
    out, shares = np.empty((count, 4)), np.array(shares, dtype=float)
    for i in range(count):
        draw_task(seed, i % 500, i // 500, groups, library.cancel, library.rotation, focus, shares, out[i])
    return out


@pytest.fixture(scope="module")
def tasks(library):
    return tasks_of(library, 18_000)


def test_every_allowed_transition_is_equally_likely(tasks, library):
    pairs = tasks[:, [0, 2]].astype(int)
    counts = [(pairs == group).all(axis=1).sum() for group in library.groups]
    assert sum(counts) == len(tasks)
    assert stats.chisquare(counts).pvalue > 1e-4


def test_moments_are_uniform_over_the_sources_cancel_range(tasks, library):
    for source, (first, last) in enumerate(library.cancel):
        moments = tasks[tasks[:, 0] == source, 1]
        assert first <= moments.min() and moments.max() <= last
        assert stats.kstest(moments, "uniform", (first, last - first)).pvalue > 1e-4


def test_rotations_are_uniform_over_their_range_and_independent_of_the_moment(tasks, library):
    low, high = library.rotation
    assert low <= tasks[:, 3].min() and tasks[:, 3].max() <= high
    assert stats.kstest(tasks[:, 3], "uniform", (low, high - low)).pvalue > 1e-4
    assert abs(np.corrcoef(tasks[:, 1], tasks[:, 3])[0, 1]) < 5 / np.sqrt(len(tasks))


def test_only_the_allowed_transitions_are_drawn(library):
    groups = np.array([[0, 2], [2, 0]])
    drawn = {tuple(row) for row in tasks_of(library, 500, groups=groups)[:, [0, 2]].astype(int)}
    assert drawn == {(0, 2), (2, 0)}


def test_a_task_is_a_function_of_seed_environment_and_episode(library):
    first, again = tasks_of(library, 1000), tasks_of(library, 1000)
    np.testing.assert_array_equal(first, again)
    assert len(np.unique(first[:, 3])) == 1000
    assert (first != tasks_of(library, 1000, seed=4)).any(axis=1).mean() > 0.99


def slow_cell(task, library):
    group = [tuple(pair) for pair in library.groups.tolist()].index((int(task[0]), int(task[2])))
    low, high = library.cancel[int(task[0])]
    moment = next(k for k in range(MOMENTS) if k == MOMENTS - 1 or task[1] < low + (k + 1) * (high - low) / MOMENTS)
    low, high = library.rotation
    turn = next(k for k in range(ROTATIONS) if k == ROTATIONS - 1 or task[3] < low + (k + 1) * (high - low) / ROTATIONS)
    return group * MOMENTS * ROTATIONS + moment * ROTATIONS + turn


def test_the_cell_of_a_task_is_its_group_and_its_parts_of_both_ranges(tasks, library):
    some = tasks[::60]
    assert cells_of(some, library).tolist() == [slow_cell(task, library) for task in some]
    assert cells_of(np.empty((0, 4)), library).shape == (0,)


@pytest.mark.parametrize("focus", [1.0, 0.4])
def test_focused_tasks_are_drawn_by_the_shares_of_their_cells(focus, library):
    share = np.random.default_rng(0).dirichlet(np.full(number_of_cells(library), 0.3))
    drawn = tasks_of(library, 20_000, focus=focus, shares=np.cumsum(share))
    wanted = focus * share + (1 - focus) / len(share)
    counts = np.bincount(cells_of(drawn, library), minlength=len(share))
    # cells that are hardly ever drawn are one class for the test
    rare = wanted * len(drawn) < 5
    classes = [np.append(x[~rare], x[rare].sum()) for x in (counts, wanted * len(drawn))]
    classes = [x[:-1] if classes[1][-1] < 1 else x for x in classes]
    expected = classes[1] * classes[0].sum() / classes[1].sum()
    assert stats.chisquare(classes[0], expected).pvalue > 1e-4
    moments = (drawn[:, 1] - library.cancel[drawn[:, 0].astype(int), 0]) / np.ptp(library.cancel, axis=1)[
        drawn[:, 0].astype(int)
    ]
    assert stats.kstest(moments * MOMENTS % 1.0, "uniform").pvalue > 1e-4


def test_without_focus_or_shares_the_paper_s_tasks_are_drawn(library):
    plain = tasks_of(library, 500)
    even = np.linspace(0, 1, number_of_cells(library) + 1)[1:]
    np.testing.assert_array_equal(tasks_of(library, 500, focus=0.0, shares=even), plain)
    np.testing.assert_array_equal(tasks_of(library, 500, focus=1.0), plain)


@pytest.mark.parametrize("rotation_reference", ["source", "world"])
@given(seed=seeds, angle=st.floats(-3.1, 3.1), time=st.floats(0.1, 2.0))
def test_the_target_stands_where_equation_14_puts_it(rotation_reference, seed, angle, time, random_pose):
    (source_qpos, source_qvel), (clip_qpos, clip_qvel) = random_pose([seed, 0]), random_pose([seed, 1])
    qpos, qvel = clip_qpos.copy(), clip_qvel.copy()
    place_target(source_qpos, source_qvel, angle, time, rotation_reference == "source", qpos, qvel)
    wanted_qpos, wanted_qvel = reference.placed_target(
        source_qpos, source_qvel, clip_qpos, clip_qvel, angle, rotation_reference, time
    )
    np.testing.assert_allclose(qvel, wanted_qvel, atol=1e-9)
    rotation = reference.root_rotation(qpos).inv() * reference.root_rotation(wanted_qpos)
    assert rotation.magnitude() < 1e-7
    same = np.r_[0:3, 7:47]
    np.testing.assert_allclose(qpos[same], wanted_qpos[same], atol=1e-9)
    assert qpos[2] == clip_qpos[2]
    if rotation_reference == "source":
        turned = reference.heading(qpos) - reference.heading(source_qpos) - angle
        assert np.cos(turned) == pytest.approx(1.0, abs=1e-9)


def begun(library, task, from_source=True):
    """Source and target pose of a task, by the compiled `begin`."""
    qpos, qvel, target_qpos, target_qvel = np.empty(47), np.empty(37), np.empty(47), np.empty(37)
    bodies, rotations = [np.empty((17, 3)) for _ in range(2)], [np.empty((17, 4)) for _ in range(2)]
    begin(
        library.qpos, library.qvel, library.first, library.frames, library.fps, library.start, task, 0.8, from_source,
        qpos, qvel, bodies[0], rotations[0], target_qpos, target_qvel, bodies[1], rotations[1],
    )  # fmt: skip
    return qpos, qvel, target_qpos, target_qvel, bodies, rotations


@pytest.mark.parametrize("which", ["library", "real_library"])
def test_a_task_begins_in_the_sources_pose_and_its_target_is_placed_from_there(which, all_clips, bodies_of, request):
    library = request.getfixturevalue(which)
    clips = all_clips[:3] if which == "library" else all_clips[3:]
    for task in tasks_of(library, 60):
        source, target = int(task[0]), int(task[2])
        qpos, qvel, target_qpos, target_qvel, bodies, rotations = begun(library, task)
        clip_qpos, clip_qvel = clips[source].sample(task[1])
        # the world is the figure's: it starts at the origin, only lifted out of the ground
        np.testing.assert_allclose(qpos[3:], clip_qpos[3:], atol=1e-12)
        np.testing.assert_array_equal(qpos[:2], 0.0)
        assert qpos[2] >= clip_qpos[2] - 1e-12
        np.testing.assert_allclose(qvel, clip_qvel, atol=1e-12)
        start_qpos, start_qvel = clips[target].sample(library.start[target])
        wanted = reference.placed_target(qpos, qvel, start_qpos, start_qvel, task[3])
        np.testing.assert_allclose(target_qpos, wanted[0], atol=1e-9)
        np.testing.assert_allclose(target_qvel, wanted[1], atol=1e-9)
        for pose, body, rotation in zip((qpos, target_qpos), bodies, rotations, strict=True):
            np.testing.assert_allclose(body, bodies_of(pose[None])[0][0], atol=1e-12)
            np.testing.assert_allclose(rotation, bodies_of(pose[None])[1][0], atol=1e-12)


@pytest.mark.parametrize("which", ["library", "real_library"])
def test_no_source_pose_begins_below_the_ground(which, request):
    library, heights = request.getfixturevalue(which), []
    for task in tasks_of(library, 500):
        _, _, _, _, bodies, rotations = begun(library, task)
        heights.append(lowest(bodies[0], rotations[0], EVERYTHING)[0])
    assert min(heights) > -1e-12


@given(seed=seeds, height=st.floats(-1, 2))
def test_grounding_lifts_what_is_below_the_floor_and_nothing_else(seed, height, random_pose, bodies_of):
    qpos, _ = random_pose(seed)
    qpos[2] = height
    before = qpos.copy()
    low = lowest(*(array[0] for array in bodies_of(qpos[None])), EVERYTHING)[0]
    position, rotation = np.empty((17, 3)), np.empty((17, 4))
    ground(qpos, position, rotation)
    np.testing.assert_array_equal(np.delete(qpos, 2), np.delete(before, 2))
    assert qpos[2] == pytest.approx(before[2] + max(0.0, -low), abs=1e-12)
    if low >= 0:
        assert qpos[2] == before[2]
    np.testing.assert_allclose(position, bodies_of(qpos[None])[0][0], atol=1e-12)
    assert lowest(position, rotation, EVERYTHING)[0] > -1e-12


def planned(library, config, ends, episode=7):
    """Tasks of len(ends) environments before and after episodes that ended so."""
    n = len(ends)
    env, index, ids = Environment(config, library, n), np.arange(n), np.arange(n)
    env.plan(0, index, np.full(n, -1), ids)
    before, count = env.task.copy(), np.full(n, episode)
    env.end[:] = ends
    env.plan(0, index, count, ids)
    np.testing.assert_array_equal(count, episode + 1)
    return before, env.task.copy()


@pytest.mark.parametrize("probability", [0.5, 0.9])
@pytest.mark.parametrize("end", [FELL, TIMED_OUT])
def test_a_failed_task_is_kept_with_the_stay_probability(end, probability, library, make_config):
    before, after = planned(library, make_config({"task.stay_probability": probability}), [end] * 2000)
    kept = (before == after).all(axis=1)
    assert stats.binomtest(int(kept.sum()), len(kept), probability).pvalue > 1e-4
    # what is not kept is drawn anew, as a whole
    assert (before[~kept, 1] != after[~kept, 1]).all() and (before[~kept, 3] != after[~kept, 3]).all()


def test_a_reached_task_is_never_kept(library, make_config):
    before, after = planned(library, make_config({"task.stay_probability": 1.0}), [REACHED] * 500)
    assert (before[:, 3] != after[:, 3]).all()


def test_rollouts_keep_tasks_after_failures_only(library, make_config, make_policy, easy):
    rollout = Rollout(make_config({"task.max_steps": 5}), library, 64, 24, seed=9)
    state = rollout.initial_state(0)
    assert not state.retained.any()
    chunk, after = rollout.collect(state, make_policy(), easy)
    kept, changed = {REACHED: 0, FELL: 0, TIMED_OUT: 0}, {REACHED: 0, FELL: 0, TIMED_OUT: 0}
    for environment in range(64):
        mine = chunk.outcomes.take(np.flatnonzero(chunk.outcomes.environment == environment))
        for i in range(len(mine) - 1):
            same = (mine.task[i] == mine.task[i + 1]).all()
            (kept if same else changed)[int(mine.end[i])] += 1
            assert mine.retained[i + 1] == same
        assert not mine.retained[0] and after.retained[environment] == (after.task[environment] == mine.task[-1]).all()
    assert kept[REACHED] == 0 and changed[REACHED] > 0
    failures = kept[FELL] + kept[TIMED_OUT], changed[FELL] + changed[TIMED_OUT]
    assert stats.binomtest(failures[0], sum(failures), 0.5).pvalue > 1e-4 and sum(failures) > 100
