"""Kinematic measures: hand-made motions with known answers, and slow scalar code on random ones."""

import math

import numpy as np
import pytest
import reference
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from motion import measures, skeleton
from motion.measures import foot_skate, foot_speed, jerk, joint_velocity_jump, penetration, root_velocity_jump, soles
from workers.humanoid import SHAPES

FPS = 30


@pytest.fixture(scope="module")
def standing(machine):
    """Ten frames of one pose with both soles flat on the floor, to a tenth of a millimetre."""
    pose = machine.states[0].clip.qpos[0].copy()
    pose[2] -= soles(pose[None])[..., 2].min()
    return np.repeat(pose[None], 10, axis=0)


@pytest.fixture(scope="module")
def noisy(random_poses):
    """A function of (seed) giving a random motion (8, 47): poses with feet near the floor that move wildly."""

    def make(seed):
        qpos, _ = random_poses(8, seed, largest=0.5)
        qpos[:, 3:7] = qpos[:, 3:7] * [1, 0, 0, 0.5]
        qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
        qpos[:, 2] = 0.88 + 0.02 * qpos[:, 2]
        return qpos

    return make


def moved(qpos, velocity):
    """The motion with a constant velocity (3,) in m/s added."""
    out = qpos.copy()
    out[:, :3] += np.arange(len(qpos))[:, None] / FPS * np.asarray(velocity)
    return out


# --------------------------------------------------------------------------------------------------- known answers


def test_a_standing_foot_does_not_skate(standing):
    assert foot_skate(standing, FPS) == (0, 0)
    assert penetration(standing) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize(("velocity", "speed", "share"), [((0.3, 0, 0), 0.3, 1), ((0, 0.04, 0), 0.04, 0)])
def test_a_sliding_foot_skates_at_its_speed(standing, velocity, speed, share):
    assert foot_skate(moved(standing, velocity), FPS) == (pytest.approx(speed), share)


def test_a_foot_in_the_air_is_not_planted(standing):
    high = standing + np.eye(47)[2] * 0.03
    assert np.isnan(foot_speed(moved(high, (1, 0, 0)), FPS)).all()
    assert np.isnan(foot_skate(high, FPS)).all()


def test_one_sliding_foot_of_two_counts_half(standing):
    """The left leg swings at the hip in the air, the right foot slides at 0.2 m/s."""
    qpos = moved(standing, (0.2, 0, 0))
    hip = 7 + skeleton.JOINT_QPOS[skeleton.JOINT_INDEX["left_knee"]]
    qpos[:, hip] += 1.0
    speed = foot_speed(qpos, FPS)
    assert np.isnan(speed[:, 1]).all() and speed[:, 0] == pytest.approx(0.2)
    assert foot_skate(qpos, FPS) == (pytest.approx(0.2), 1)


def test_a_foot_that_rolls_over_its_toes_does_not_skate(standing):
    """The heel rises while the toes' edge stays: no corner that is on the ground in both frames moves."""
    ankle = 7 + skeleton.JOINT_QPOS[skeleton.JOINT_INDEX["right_ankle"]]
    toes, frames = measures.SOLE[2:].mean(axis=0), []
    for angle in np.linspace(0.2, 0.8, 5):
        pose = standing[0].copy()
        turn = Rotation.from_rotvec([0, angle, 0])
        pose[ankle : ankle + 4] = reference.quaternion(reference.rotation(pose[ankle : ankle + 4]) * turn)
        frames.append(pose)
    frames = np.array(frames)
    # put the right foot's toes where they were, so that the left foot slides instead
    position, rotation = skeleton.forward_kinematics(frames)
    foot = skeleton.BODY_INDEX["right_foot"]
    at = np.array([p + reference.rotation(q).apply(toes) for p, q in zip(position[:, foot], rotation[:, foot])])
    frames[:, :3] += at[0] * [1, 1, 0] - at
    assert np.nanmax(foot_speed(frames, FPS)[:, 0]) < 1e-9


def test_penetration_is_the_depth_of_the_sole(standing):
    assert penetration(standing - np.eye(47)[2] * 0.013) == pytest.approx(0.013)


def test_velocity_that_changes_at_one_frame_jumps_by_its_change(standing):
    qpos = standing.copy()
    qpos[5:, :3] += np.arange(1, 6)[:, None] / FPS * np.array([0.3, 0, 0.4])
    expected = np.zeros(8)
    expected[3] = 0.5  # the motion begins after frame 4, which is the jumps' fourth
    assert root_velocity_jump(qpos, FPS) == pytest.approx(expected)
    knee = 7 + skeleton.JOINT_QPOS[skeleton.JOINT_INDEX["left_knee"]]
    qpos = standing.copy()
    qpos[5:, knee] += np.arange(1, 6) / FPS * 2.5
    assert joint_velocity_jump(qpos, FPS) == pytest.approx(expected * 5)


def test_even_acceleration_has_no_jerk_and_a_cubic_has_its_own(standing):
    t = np.arange(10) / FPS
    assert jerk(standing + np.outer(t**2, np.eye(47)[0]), FPS) == pytest.approx(0, abs=1e-8)
    assert jerk(standing + np.outer(t**3, np.eye(47)[0]), FPS) == pytest.approx(6)


def test_the_sole_is_the_lower_side_of_the_simulated_foot():
    (box,) = [shape for shape in SHAPES if shape.body == "right_foot"]
    center, half = np.array(box.a), np.array(box.b)
    corners = [center + half * (x, y, -1) for x in (-1, 1) for y in (-1, 1)]
    assert np.allclose(measures.SOLE, corners)


# ------------------------------------------------------------------------------------- slow code on random motions


@settings(max_examples=8)
@given(seed=st.integers(0, 10_000))
def test_measures_are_those_of_slow_code(noisy, seed):
    qpos = noisy(seed)
    bodies = [reference.forward_kinematics(pose) for pose in qpos]
    names = [row[0] for row in reference.FIGURE]
    corners = np.array([(x, y, -0.05) for x in (-0.0435, 0.1335) for y in (-0.045, 0.045)])
    speeds, depth = np.full((7, 2), math.nan), np.zeros(8)
    for k, pose in enumerate(bodies):
        points = [(pose[f"{side}_foot"] @ [*corner, 1])[:3] for side in ("right", "left") for corner in corners]
        depth[k] = max(0, *(-p[2] for p in points))
    for k in range(7):
        for f, side in enumerate(("right", "left")):
            rows = []
            for corner in corners:
                a, b = ((bodies[i][f"{side}_foot"] @ [*corner, 1])[:3] for i in (k, k + 1))
                if a[2] < 0.02 and b[2] < 0.02:
                    rows.append(math.hypot(b[0] - a[0], b[1] - a[1]) * FPS)
            if rows:
                speeds[k, f] = sum(rows) / len(rows)
    assert foot_speed(qpos, FPS) == pytest.approx(speeds, nan_ok=True)
    down = speeds[np.isfinite(speeds)]
    mean, share = foot_skate(qpos, FPS)
    assert mean == pytest.approx(down.mean() if len(down) else math.nan, nan_ok=True)
    assert share == pytest.approx(sum(s > 0.05 for s in down) / len(down) if len(down) else math.nan, nan_ok=True)
    assert penetration(qpos) == pytest.approx(depth)
    root, joints = [], []
    for k in range(1, 7):
        a, b, c = qpos[k - 1 : k + 2, :3]
        root.append(math.dist((c - b) * FPS, (b - a) * FPS))
        turns = [reference.joint_rotations(pose) for pose in qpos[k - 1 : k + 2]]
        joints.append(
            max(
                math.dist((before.inv() * now).as_rotvec() * FPS, (now.inv() * after).as_rotvec() * FPS)
                for before, now, after in zip(*(turn.values() for turn in turns))
            )
        )
    assert root_velocity_jump(qpos, FPS) == pytest.approx(root)
    assert joint_velocity_jump(qpos, FPS) == pytest.approx(joints)
    thirds = []
    for k in range(5):
        sizes = []
        for name in names:
            a, b, c, d = (bodies[k + i][name][:3, 3] for i in range(4))
            sizes.append(math.dist(d - 3 * c + 3 * b - a, (0, 0, 0)) * FPS**3)
        thirds.append(sum(sizes) / len(sizes))
    assert jerk(qpos, FPS) == pytest.approx(thirds)
