"""Deviations and reward (Eq. 1-13) against the spec's scalar version, with both switches and both key body frames."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
import reference
from hypothesis import given
from hypothesis import strategies as st

from workers import reward
from workers.config import RewardConfig
from workers.environment import Environment
from workers.types import CONTINUES, FELL, REACHED, REWARD_PARTS, TIMED_OUT, Thresholds

seeds = st.integers(0, 2**32 - 1)
NEVER = Thresholds(0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def deviate(bodies_of):
    """A function of poses and targets (arrays of n rows) giving deviations (n, 7) and the joints' L1 norms (n, 13)."""

    def call(qpos, qvel, target_qpos, target_qvel, own_frame=False):
        out, joints = np.full((len(qpos), 7), np.nan), np.full((len(qpos), 13), np.nan)
        reward.deviate_batch(
            qpos, qvel, bodies_of(qpos)[0], target_qpos, target_qvel, bodies_of(target_qpos)[0], own_frame, out, joints
        )
        return out, joints

    return call


def as_row(d):
    """The reference's deviations in `workers.types.DEVIATIONS` order."""
    return np.array([d.rp, d.rv, d.rq, d.kp, d.q, d.lq, d.qv])


def weighted(joints):
    """The reference's mean over the upper body of w_u times each joint's number, of (13,) numbers."""
    names = [name for name, _, _ in reference.JOINTS]
    return reference.weighted_mean(dict(zip(names, joints, strict=True)), reference.UPPER)


def parts_of(
    before, after, joints_before, joints_after, changes, trembles, end, penalty=True, tremble=True, failure=-3.0
):
    out = np.full(len(REWARD_PARTS), np.nan)
    share = 1.0 if tremble else 0.0
    reward.reward(before, after, joints_before, joints_after, changes, trembles, end, penalty, share, failure, out)
    return dict(zip(REWARD_PARTS, out, strict=True))


@pytest.mark.parametrize("frame", ["common", "own"])
@given(seed=seeds)
def test_deviations_are_the_references(frame, seed, random_pose, deviate):
    poses = (*random_pose([seed, 0]), *random_pose([seed, 1]))
    out, joints = deviate(*(array[None] for array in poses), frame == "own")
    wanted = reference.deviations(*poses, frame)
    np.testing.assert_allclose(out[0], as_row(wanted), rtol=1e-9, atol=1e-7)
    distance = reference.joint_distance(poses[0], poses[2])
    np.testing.assert_allclose(joints[0], [distance[name] for name, _, _ in reference.JOINTS], rtol=1e-9, atol=1e-7)


@pytest.mark.parametrize("frame", ["common", "own"])
def test_deviations_are_the_references_on_frames_of_clips(frame, clip_poses, deviate):
    qpos, qvel = clip_poses
    target_qpos, target_qvel = np.roll(qpos, 5, axis=0), np.roll(qvel, 5, axis=0)
    out, _ = deviate(qpos, qvel, target_qpos, target_qvel, frame == "own")
    for i in range(len(qpos)):
        wanted = reference.deviations(qpos[i], qvel[i], target_qpos[i], target_qvel[i], frame)
        np.testing.assert_allclose(out[i], as_row(wanted), atol=1e-9)


@given(seed=seeds)
def test_a_pose_deviates_from_itself_by_nothing(seed, random_pose, deviate):
    pose = [array[None] for array in random_pose(seed)]
    for own in (False, True):
        out, joints = deviate(*pose, *pose, own)
        np.testing.assert_allclose(out, 0.0, atol=1e-9)
        np.testing.assert_allclose(joints, 0.0, atol=1e-9)


@given(seed=seeds, angle=st.floats(0.1, 3.1))
def test_only_the_common_frame_sees_a_turned_target_in_the_key_bodies(seed, angle, random_pose, deviate):
    qpos, qvel = random_pose(seed)
    turned = qpos.copy()
    turned[3:7] = reference.quaternion(reference.about_z(angle) * reference.root_rotation(qpos))
    poses = [array[None] for array in (qpos, qvel, turned, qvel)]
    common, _ = deviate(*poses, False)
    own, _ = deviate(*poses, True)
    assert own[0, reward.KP] == pytest.approx(0.0, abs=1e-9) and common[0, reward.KP] > 1e-3
    assert common[0, reward.RQ] == pytest.approx(angle, abs=1e-7)
    np.testing.assert_array_equal(np.delete(common, reward.KP), np.delete(own, reward.KP))


@pytest.mark.parametrize("penalty", [True, False])
@given(seed=seeds)
def test_upper_body_improvement_is_equation_6_with_the_scaling_of_equation_8(penalty, seed, random_pose, deviate):
    first, second, target = (random_pose([seed, i]) for i in range(3))
    (_, before), (_, after) = (deviate(*(a[None] for a in (*pose, *target))) for pose in (first, second))
    got = reward.upper_body_improvement(before[0], after[0], penalty)
    wanted = reference.upper_body_improvement(
        reference.deviations(*first, *target), reference.deviations(*second, *target), penalty
    )
    assert got == pytest.approx(wanted, abs=1e-6)
    plain = reward.upper_body_improvement(before[0], after[0], False)
    # doubling the losses can only lower the sum, and a loss costs twice what the same gain brings
    assert reward.upper_body_improvement(before[0], after[0], True) <= plain + 1e-12
    assert reward.upper_body_improvement(after[0], before[0], False) == pytest.approx(-plain)


@given(seed=seeds)
def test_sign_changes_are_counted_over_the_31_joint_velocities_only(seed):
    generator = np.random.default_rng(seed)
    before, after = (generator.integers(-1, 2, 37).astype(float) for _ in range(2))
    assert reward.sign_changes(before, after) == reference.direction_changes(before[6:], after[6:])
    after[:6] = -before[:6]
    assert reward.sign_changes(before, after) == reference.direction_changes(before[6:], after[6:])
    ones = np.ones(37)
    assert reward.sign_changes(ones, -ones) == 31 and reward.sign_changes(ones, 0 * ones) == 0


ENDS = {CONTINUES: None, REACHED: "success", FELL: "failure", TIMED_OUT: "failure"}


@given(
    seed=seeds, penalty=st.booleans(), tremble=st.booleans(), end=st.sampled_from(sorted(ENDS)),
    changes=st.integers(0, 31), trembles=st.sampled_from([0, 99, 100, 101, 400]),
)  # fmt: skip
def test_the_reward_is_the_references(seed, penalty, tremble, end, changes, trembles, random_pose, deviate):
    first, second, target = (random_pose([seed, i]) for i in range(3))
    (d0, j0), (d1, j1) = (deviate(*(a[None] for a in (*pose, *target))) for pose in (first, second))
    got = parts_of(d0[0], d1[0], j0[0], j1[0], changes, trembles, end, penalty, tremble)
    before, after = (reference.deviations(*pose, *target) for pose in (first, second))
    wanted = reference.reward(before, after, ENDS[end], changes, trembles, penalty, tremble)
    assert sum(got.values()) == pytest.approx(wanted, abs=1e-6)
    assert got["end"] == pytest.approx(reference.end_reward(ENDS[end], after), abs=1e-6)
    assert got["tremble"] == pytest.approx(reference.tremble_reward(changes, trembles, tremble))


def test_each_switch_changes_its_own_part_only(random_pose, deviate):
    first, second, target = (random_pose([11, i]) for i in range(3))
    (d0, j0), (d1, j1) = (deviate(*(a[None] for a in (*pose, *target))) for pose in (first, second))
    arguments = (d0[0], d1[0], j0[0], j1[0], 7, 200, FELL)
    full = parts_of(*arguments)
    changed = {
        "upper_body": parts_of(*arguments, penalty=False),
        "tremble": parts_of(*arguments, tremble=False),
        "end": parts_of(*arguments, failure=-12.0),
    }
    for part, other in changed.items():
        assert [name for name in REWARD_PARTS if full[name] != other[name]] == [part]
    assert changed["tremble"]["tremble"] == 0.0 and changed["end"]["end"] == -12.0


def test_the_tremble_term_may_grow_with_the_curriculum():
    full, ramp = RewardConfig(), RewardConfig(tremble_ramp=4)
    cuts = np.array([0, 1, 3, 4, 34])
    assert reward.tremble_share(full, cuts).tolist() == [1.0, 1.0, 1.0, 1.0, 1.0]
    assert reward.tremble_share(ramp, cuts).tolist() == [0.0, 0.25, 0.75, 1.0, 1.0]
    assert reward.tremble_share(RewardConfig(tremble=False, tremble_ramp=4), cuts).tolist() == [0.0] * 5


@pytest.mark.parametrize("penalty,frame", itertools.product([True, False], ["common", "own"]))
def test_improvements_add_up_to_the_first_minus_the_last_deviation(penalty, frame, library, make_config, make_policy):
    """Over whole episodes of real rollouts; the upper body's too, if its losses are not doubled."""
    config = make_config({"reward.upper_body_penalty": penalty, "reward.key_body_frame": frame})
    n, steps = 16, 12
    env = Environment(config, library, n)
    env.plan(3, np.arange(n), np.full(n, -1), np.arange(n))
    env.begin(np.arange(n))
    first, joints_first = env.deviations.copy(), env.joints.copy()
    generator = np.random.default_rng(0)
    losses = np.zeros(n)
    for _ in range(steps):
        joints = env.joints.copy()
        env.step(generator.normal(size=(n, 31)).astype(np.float32) * 0.3, NEVER)
        losses += [weighted(np.maximum(now - then, 0)) for now, then in zip(env.joints, joints, strict=True)]
    totals = SimpleNamespace(**dict(zip(REWARD_PARTS, env.totals.T, strict=True)))
    gain = first - env.deviations
    np.testing.assert_allclose(totals.root_position, 2.4 * gain[:, reward.RP], atol=1e-9)
    np.testing.assert_allclose(totals.root_velocity, 0.1 * gain[:, reward.RV], atol=1e-9)
    np.testing.assert_allclose(totals.root_rotation, 0.1 * gain[:, reward.RQ], atol=1e-9)
    np.testing.assert_allclose(totals.key_bodies, 0.3 * gain[:, reward.KP], atol=1e-9)
    upper = np.array([weighted(row) for row in joints_first - env.joints])
    # SURI: what the joints lost on the way counts once more
    suri = upper - losses if penalty else upper
    np.testing.assert_allclose(totals.upper_body, 1.6 * suri, atol=1e-9)
    assert losses.min() > 0.01
