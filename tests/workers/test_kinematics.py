"""Compiled kinematics: against scipy, `motion.skeleton`, the spec's table of 4 x 4 matrices, and MuJoCo."""

import math

import mujoco
import numpy as np
import pytest
import reference
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from motion import skeleton
from workers import kinematics

seeds = st.integers(0, 2**32 - 1)
component = st.floats(-3, 3)


def as_tuple(rotation):
    return tuple(float(x) for x in reference.quaternion(rotation))


def assert_same_rotation(a, b):
    """Quaternions (..., 4) are equal up to their sign."""
    np.testing.assert_allclose(np.abs(np.sum(np.asarray(a) * np.asarray(b), axis=-1)), 1.0, atol=1e-12)


def test_the_skeleton_is_the_specs_table():
    assert skeleton.BODY_NAMES == tuple(row[0] for row in reference.FIGURE)
    for body, (_, parent, offset, *_) in zip(skeleton.BODIES, reference.FIGURE, strict=True):
        assert (skeleton.BODY_NAMES[body.parent] if body.parent >= 0 else None) == parent
        assert body.offset == tuple(map(float, offset))
    assert [(j.name, "ball" if j.dof == 3 else "hinge", j.chain) for j in skeleton.JOINTS] == reference.JOINTS
    assert [skeleton.JOINT_NAMES[i] for i in skeleton.UPPER_JOINTS] == reference.UPPER
    assert [skeleton.JOINT_NAMES[i] for i in skeleton.LOWER_JOINTS] == reference.LOWER
    assert list(skeleton.KEY_BODY_NAMES) == reference.KEY_BODIES
    np.testing.assert_allclose(skeleton.JOINT_WEIGHTS, [reference.weight(zeta) for _, _, zeta in reference.JOINTS])


@given(seed=seeds)
def test_products_and_turned_vectors_are_scipys(seed):
    generator = np.random.default_rng(seed)
    a, b = Rotation.random(rng=generator), Rotation.random(rng=generator)
    vector = generator.normal(size=3)
    assert_same_rotation(kinematics.multiply(as_tuple(a), as_tuple(b)), as_tuple(a * b))
    assert_same_rotation(kinematics.conjugate(as_tuple(a)), as_tuple(a.inv()))
    np.testing.assert_allclose(kinematics.rotate(as_tuple(a), *map(float, vector)), a.apply(vector), atol=1e-12)


@given(x=component, y=component, z=component)
def test_the_exponential_is_scipys_at_every_size(x, y, z):
    for scale in (1.0, 1e-6, 1e-10, 0.0):
        vector = scale * np.array([x, y, z])
        quaternion = kinematics.exponential(*map(float, vector))
        np.testing.assert_allclose(np.linalg.norm(quaternion), 1.0, atol=1e-12)
        assert_same_rotation(quaternion, as_tuple(Rotation.from_rotvec(vector)))


@given(seed=seeds, angle=st.sampled_from([0.0, 1e-9, 1e-6, 0.5, 3.0, math.pi - 1e-6]), sign=st.sampled_from([-1, 1]))
def test_the_logarithm_inverts_the_exponential_and_ignores_the_quaternions_sign(seed, angle, sign):
    axis = np.random.default_rng(seed).normal(size=3)
    vector = angle * axis / np.linalg.norm(axis)
    quaternion = tuple(sign * c for c in kinematics.exponential(*map(float, vector)))
    np.testing.assert_allclose(kinematics.logarithm(quaternion), vector, atol=1e-12 if angle < 3.1 else 1e-9)


@given(angle=st.floats(-3.14, 3.14))
def test_heading_is_the_yaw_of_the_x_axis(angle):
    assert kinematics.heading(kinematics.about_z(angle)) == pytest.approx(angle, abs=1e-12)
    tilted = Rotation.from_rotvec([0, 0, angle]) * Rotation.from_euler("YX", [0.7, -0.4])
    assert kinematics.heading(as_tuple(tilted)) == pytest.approx(angle, abs=1e-12)


@given(seed=seeds)
def test_forward_kinematics_are_the_matrices_of_the_specs_table(seed, random_pose, bodies_of):
    qpos, _ = random_pose(seed)
    position, rotation = bodies_of(qpos[None])
    for i, (name, matrix) in enumerate(reference.forward_kinematics(qpos).items()):
        np.testing.assert_allclose(position[0, i], matrix[:3, 3], atol=1e-12, err_msg=name)
        np.testing.assert_allclose(reference.rotation(rotation[0, i]).as_matrix(), matrix[:3, :3], atol=1e-12)


def test_forward_kinematics_are_those_of_motion_skeleton(random_poses, clip_poses, bodies_of):
    for qpos in (random_poses(200)[0], clip_poses[0]):
        position, rotation = bodies_of(qpos)
        wanted_position, wanted_rotation = skeleton.forward_kinematics(qpos)
        np.testing.assert_allclose(position, wanted_position, atol=1e-12)
        assert_same_rotation(rotation, wanted_rotation)


def test_forward_kinematics_are_mujocos(random_poses, clip_poses, bodies_of, model):
    data = mujoco.MjData(model)
    for qpos in (random_poses(100)[0], clip_poses[0]):
        position, rotation = bodies_of(qpos)
        for i in range(len(qpos)):
            data.qpos[:] = qpos[i]
            mujoco.mj_kinematics(model, data)
            # body 0 is the world
            np.testing.assert_allclose(position[i], data.xpos[1:], atol=1e-12)
            assert_same_rotation(rotation[i], data.xquat[1:])


def test_joint_rotations_and_coordinates_agree_with_the_reference(random_poses):
    qpos, _ = random_poses(50)
    for row in qpos:
        wanted = reference.joint_rotations(row)
        for j, (name, _, _) in enumerate(reference.JOINTS):
            assert_same_rotation(kinematics.joint_quaternion(row, j), as_tuple(wanted[name]))
