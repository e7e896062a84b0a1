"""The state s_t against the spec's scalar version, and its invariances."""

import numpy as np
import pytest
import reference
from hypothesis import given
from hypothesis import strategies as st

from workers.observation import OBSERVATION_SIZE, POSE_SIZE, TARGET_SIZE, observe_batch
from workers.rollout import Rollout

seeds = st.integers(0, 2**32 - 1)


@pytest.fixture(scope="module")
def observe(bodies_of):
    """A function of poses and targets, arrays with n rows each, giving observations (n, 282) in float64."""

    def call(qpos, qvel, target_qpos, target_qvel, difference=False):
        out = np.full((len(qpos), OBSERVATION_SIZE), np.nan)
        bodies, target_bodies = bodies_of(qpos)[0], bodies_of(target_qpos)[0]
        observe_batch(qpos, qvel, bodies, target_qpos, target_qvel, target_bodies, difference, out)
        return out

    return call


def moved(qpos, qvel, angle, shift):
    """A pose after a rigid motion of the world: a turn about the vertical, then a horizontal shift."""
    turn = reference.about_z(angle)
    qpos, qvel = qpos.copy(), qvel.copy()
    qpos[:3] = turn.apply(qpos[:3]) + [*shift, 0.0]
    qpos[3:7] = reference.quaternion(turn * reference.root_rotation(qpos))
    qvel[:3] = turn.apply(qvel[:3])
    return qpos, qvel


def test_the_state_has_140_and_142_numbers():
    assert (POSE_SIZE, TARGET_SIZE, OBSERVATION_SIZE) == (140, 142, 282)


@given(seed=seeds, difference=st.booleans())
def test_the_observation_is_the_references(seed, difference, random_pose, observe):
    pose, target = random_pose([seed, 0]), random_pose([seed, 1])
    got = observe(*(array[None] for array in (*pose, *target)), difference)[0]
    np.testing.assert_allclose(got, reference.observation(*pose, *target, difference), atol=1e-9)


def test_the_observation_is_the_references_on_frames_of_clips(clip_poses, observe):
    qpos, qvel = clip_poses
    target_qpos, target_qvel = np.roll(qpos, 5, axis=0), np.roll(qvel, 5, axis=0)
    got = observe(qpos, qvel, target_qpos, target_qvel)
    for i in range(len(qpos)):
        wanted = reference.observation(qpos[i], qvel[i], target_qpos[i], target_qvel[i])
        np.testing.assert_allclose(got[i], wanted, atol=1e-9)


@given(seed=seeds, angle=st.floats(-3.14, 3.14), x=st.floats(-50, 50), y=st.floats(-50, 50))
def test_turning_and_shifting_the_world_with_character_and_target_changes_nothing(
    seed, angle, x, y, random_pose, observe
):
    pose, target = random_pose([seed, 0]), random_pose([seed, 1])
    before = observe(*(array[None] for array in (*pose, *target)))
    other = (*moved(*pose, angle, (x, y)), *moved(*target, angle, (x, y)))
    np.testing.assert_allclose(observe(*(array[None] for array in other)), before, atol=1e-9)


@given(seed=seeds, angle=st.floats(0.1, 3.0))
def test_turning_only_the_target_is_seen_in_the_targets_half_alone(seed, angle, random_pose, observe):
    pose, target = random_pose([seed, 0]), random_pose([seed, 1])
    before = observe(*(array[None] for array in (*pose, *target)))[0]
    after = observe(*(array[None] for array in (*pose, *moved(*target, angle, (0, 0)))))[0]
    np.testing.assert_array_equal(before[:POSE_SIZE], after[:POSE_SIZE])
    assert np.abs(before[POSE_SIZE:] - after[POSE_SIZE:]).max() > 1e-3


@given(seed=seeds)
def test_a_pose_that_is_its_own_target_is_seen_twice(seed, random_pose, observe):
    pose = random_pose(seed)
    got = observe(*(array[None] for array in (*pose, *pose)))[0]
    np.testing.assert_array_equal(got[POSE_SIZE : POSE_SIZE + 3], 0.0)
    np.testing.assert_array_equal(got[1:POSE_SIZE], got[POSE_SIZE + 3 :])


@given(seed=seeds)
def test_at_the_target_the_difference_is_nothing(seed, random_pose, observe):
    pose = random_pose(seed)
    got = observe(*(array[None] for array in (*pose, *pose)), True)[0]
    np.testing.assert_array_equal(got[POSE_SIZE:], 0.0)


@pytest.mark.parametrize("target", ["absolute", "difference"])
def test_what_a_rollout_observes_is_the_reference_of_its_poses_and_targets(
    target, trajectories, library, make_config, make_policy, easy
):
    state, config = trajectories.states[2], make_config({"observation.target": target})
    rollout = Rollout(config, library, len(state.environment), 2, seed=0)
    chunk, _ = rollout.collect(state, make_policy(), easy)
    for i in range(0, len(state.environment), 5):
        pose = chunk.pose[0, i].astype(float)
        targets = state.target_qpos[i], state.target_qvel[i]
        wanted = reference.observation(pose[:47], pose[47:], *targets, target == "difference")
        np.testing.assert_allclose(chunk.observation[0, i], wanted, atol=1e-4)
