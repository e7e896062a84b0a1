"""Actions: decode and encode, the branch of the exponential map, and MuJoCo's actuators that read it."""

import math

import mujoco
import numpy as np
import pytest
import reference
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from motion import rotations, skeleton
from workers.action import ABSOLUTE, CURRENT, MODES, TARGET, act_batch, control, decode, encode

seeds = st.integers(0, 2**32 - 1)
BALLS = [
    slice(start, start + 3) for joint, start in zip(skeleton.JOINTS, skeleton.JOINT_DOF, strict=True) if joint.dof == 3
]
HINGES = [start for joint, start in zip(skeleton.JOINTS, skeleton.JOINT_DOF, strict=True) if joint.dof == 1]


def out_of(function, *arguments):
    out = np.full(31, np.nan)
    function(*arguments, out)
    return out


def coordinates(seed, largest=3.1):
    """(31,) joint coordinates: exponential maps shorter than `largest`, hinge angles."""
    generator = np.random.default_rng(seed)
    out = generator.uniform(-largest, largest, 31)
    for ball in BALLS:
        out[ball] = Rotation.random(rng=generator).as_rotvec() * largest / math.pi
    return out


def assert_same_rotations(a, b, atol=1e-7):
    """Joint coordinates stand for the same rotations (hinges: the same angles)."""
    np.testing.assert_allclose(a[HINGES], b[HINGES], atol=atol)
    for ball in BALLS:
        difference = Rotation.from_rotvec(a[ball]).inv() * Rotation.from_rotvec(b[ball])
        assert difference.magnitude() < atol


@pytest.mark.parametrize("absolute", [True, False])
@given(seed=seeds, scale=st.sampled_from([0.25, 1.0, 2.0]))
def test_encode_inverts_decode(absolute, seed, scale, random_pose):
    base, _ = random_pose(seed)
    action = coordinates(seed) / scale
    target = out_of(decode, action, base, scale, absolute)
    np.testing.assert_allclose(out_of(encode, target, base, scale, absolute), action, atol=1e-8)


@pytest.mark.parametrize("absolute", [True, False])
@given(seed=seeds, scale=st.sampled_from([0.25, 1.0, 2.0]))
def test_decode_inverts_encode(absolute, seed, scale, random_pose):
    base, _ = random_pose(seed)
    target = coordinates(seed)
    action = out_of(encode, target, base, scale, absolute)
    assert_same_rotations(out_of(decode, action, base, scale, absolute), target)


@given(seed=seeds)
def test_an_offset_turns_the_base_in_the_joints_own_frame(seed, random_pose):
    base, _ = random_pose(seed)
    action = coordinates(seed, 1.0)
    got = out_of(decode, action, base, 0.5, False)
    joints, angles = reference.joint_rotations(base), reference.hinge_angles(base)
    for joint, start in zip(skeleton.JOINTS, skeleton.JOINT_DOF, strict=True):
        if joint.dof == 3:
            part = slice(start, start + 3)
            wanted = joints[joint.name] * Rotation.from_rotvec(0.5 * action[part])
            assert (wanted.inv() * Rotation.from_rotvec(got[part])).magnitude() < 1e-7
        else:
            assert got[start] == pytest.approx(angles[joint.name] + 0.5 * action[start])


def test_the_mode_chooses_what_an_action_is_an_offset_from(random_poses):
    qpos, targets = random_poses(5, seed=1)[0], random_poses(5, seed=2)[0]
    zero = np.zeros((5, 31), dtype=np.float32)
    for mode, base in ((TARGET, targets), (CURRENT, qpos), (ABSOLUTE, None)):
        pd_target, ctrl = np.empty((5, 31)), np.empty((5, 31))
        act_batch(zero, mode, 1.0, qpos, targets, pd_target, ctrl)
        wanted = np.zeros((5, 31)) if base is None else skeleton.joint_coordinates(base)
        for i in range(5):
            assert_same_rotations(pd_target[i], wanted[i])
            assert_same_rotations(ctrl[i], wanted[i])
    assert MODES == {"absolute": ABSOLUTE, "target": TARGET, "current": CURRENT}


@given(seed=seeds, length=st.sampled_from([3.1, 5.0, 9.0]))
def test_control_is_the_pd_target_on_the_branch_nearest_to_the_current_pose(seed, length, random_pose):
    qpos, _ = random_pose(seed)
    target = coordinates(seed, length)
    got = out_of(control, target, qpos)
    assert_same_rotations(got, target)
    now = skeleton.joint_coordinates(qpos)
    for ball in BALLS:
        vector = target[ball]
        axis = vector / np.linalg.norm(vector)
        branches = [vector + 2 * math.pi * turns * axis for turns in range(-4, 5)]
        nearest = min(np.linalg.norm(branch - now[ball]) for branch in branches)
        assert np.linalg.norm(got[ball] - now[ball]) == pytest.approx(nearest, abs=1e-7)
        np.testing.assert_allclose(got[ball], rotations.nearest_branch(vector, now[ball]), atol=1e-7)


def test_control_crosses_the_flip_of_the_map_by_the_short_way():
    """A shoulder at 3.0 rad whose target is 0.4 rad further on: 3.4 rad, not -2.88."""
    shoulder = skeleton.JOINT_INDEX["right_shoulder"]
    at, dof = 7 + skeleton.JOINT_QPOS[shoulder], skeleton.JOINT_DOF[shoulder]
    axis = np.array([0.6, -0.8, 0.0])
    qpos = skeleton.assemble_qpos(np.zeros(3), rotations.IDENTITY, np.zeros(31))
    qpos[at : at + 4] = rotations.from_exponential_map(3.0 * axis)
    target = np.zeros(31)
    target[dof : dof + 3] = rotations.to_exponential_map(rotations.from_exponential_map(3.4 * axis))
    assert np.linalg.norm(target[dof : dof + 3]) == pytest.approx(2 * math.pi - 3.4)
    np.testing.assert_allclose(out_of(control, target, qpos)[dof : dof + 3], 3.4 * axis, atol=1e-12)


def test_mujocos_actuators_read_the_joint_coordinates(random_poses, clip_poses, model):
    data = mujoco.MjData(model)
    for qpos in (random_poses(100)[0], clip_poses[0]):
        wanted = skeleton.joint_coordinates(qpos)
        for i in range(len(qpos)):
            data.qpos[:] = qpos[i]
            mujoco.mj_forward(model, data)
            np.testing.assert_allclose(data.actuator_length, wanted[i], atol=1e-6)


def test_controls_equal_to_the_current_coordinates_give_no_force(random_poses, clip_poses, model):
    data = mujoco.MjData(model)
    for qpos in (random_poses(100)[0], clip_poses[0]):
        for row in qpos:
            data.qpos[:], data.qvel[:] = row, 0.0
            data.ctrl[:] = out_of(control, skeleton.joint_coordinates(row), row)
            mujoco.mj_forward(model, data)
            np.testing.assert_allclose(data.actuator_force, 0.0, atol=1e-3)


@given(seed=seeds)
def test_the_actuators_turn_every_joint_towards_its_target(seed, random_pose, model):
    """Force = kp * (exponential map of the target - of the pose), so its power along the way there is positive."""
    qpos, _ = random_pose(seed, 2.0)
    data = mujoco.MjData(model)
    small = coordinates(seed, 0.05)
    target = out_of(decode, small, qpos, 1.0, False)
    data.qpos[:], data.qvel[:] = qpos, 0.0
    data.ctrl[:] = out_of(control, target, qpos)
    mujoco.mj_forward(model, data)
    torque = data.qfrc_actuator[6:]
    for part in (*BALLS, *(slice(h, h + 1) for h in HINGES)):
        assert torque[part] @ small[part] > 0
