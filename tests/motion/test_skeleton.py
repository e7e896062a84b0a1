"""The figure's kinematics against slow and explicit versions."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from motion import rotations, skeleton


def random_joints(count, largest=3.0, seed=0):
    """(count, 31) coordinates, exponential maps shorter than `largest`."""
    generator = np.random.default_rng(seed)
    joints = generator.normal(size=(count, skeleton.NUM_DOF))
    for joint, start in zip(skeleton.JOINTS, skeleton.JOINT_DOF, strict=True):
        part = joints[:, start : start + joint.dof]
        part *= generator.uniform(0, largest, (count, 1)) / np.linalg.norm(part, axis=1, keepdims=True)
    return joints


def random_poses(count, seed=0):
    generator = np.random.default_rng(seed + 1)
    quaternion = rotations.normalize(generator.normal(size=(count, 4)))
    return skeleton.assemble_qpos(generator.normal(size=(count, 3)), quaternion, random_joints(count, seed=seed))


def matrices(qpos):
    """World transforms (17, 4, 4) of one pose, joint after joint."""
    world = []
    for i, body in enumerate(skeleton.BODIES):
        local = np.eye(4)
        if i == 0:
            local[:3, :3] = Rotation.from_quat(qpos[3:7], scalar_first=True).as_matrix()
            local[:3, 3] = qpos[:3]
        else:
            local[:3, 3] = body.offset
            for joint, start in zip(skeleton.JOINTS, skeleton.JOINT_QPOS, strict=True):
                if joint.body == i and joint.dof == 3:
                    local[:3, :3] = Rotation.from_quat(qpos[7 + start : 11 + start], scalar_first=True).as_matrix()
                elif joint.body == i:
                    local[:3, :3] = Rotation.from_euler("y", qpos[7 + start]).as_matrix()
        world.append(local if i == 0 else world[body.parent] @ local)
    return np.array(world)


def test_the_figure_has_the_papers_degrees_of_freedom():
    assert (skeleton.NUM_BODIES, skeleton.NUM_JOINTS, skeleton.NUM_DOF) == (17, 13, 31)
    assert (skeleton.NQ, skeleton.NV) == (47, 37)
    assert all(body.parent < i for i, body in enumerate(skeleton.BODIES))
    assert sorted([*skeleton.UPPER_JOINTS, *skeleton.LOWER_JOINTS]) == list(range(13))


def test_joint_weights_are_those_of_equation_7():
    weights = dict(zip(skeleton.JOINT_NAMES, skeleton.JOINT_WEIGHTS, strict=True))
    assert weights["abdomen"] == weights["left_hip"] == 3.375
    assert weights["neck"] == weights["right_knee"] == 2.25
    assert weights["left_elbow"] == weights["right_ankle"] == 1.5
    assert weights["right_hand"] == 1.0


def test_forward_kinematics_agree_with_a_loop_of_matrices():
    poses = random_poses(20)
    position, quaternion = skeleton.forward_kinematics(poses)
    for i, pose in enumerate(poses):
        expected = matrices(pose)
        np.testing.assert_allclose(position[i], expected[:, :3, 3], atol=1e-12)
        actual = Rotation.from_quat(quaternion[i], scalar_first=True).as_matrix()
        np.testing.assert_allclose(actual, expected[:, :3, :3], atol=1e-12)


def test_forward_kinematics_take_any_leading_dimensions():
    poses = random_poses(6)
    position, quaternion = skeleton.forward_kinematics(poses.reshape(2, 3, -1))
    assert position.shape == (2, 3, 17, 3)
    assert quaternion.shape == (2, 3, 17, 4)
    np.testing.assert_array_equal(position[1, 2], skeleton.forward_kinematics(poses[5])[0])


def test_the_straight_figure_stands_upright_on_its_feet():
    pose = skeleton.assemble_qpos(np.zeros(3), rotations.IDENTITY, np.zeros(31))
    position, _ = skeleton.forward_kinematics(pose)
    place = dict(zip(skeleton.BODY_NAMES, position, strict=True))
    np.testing.assert_allclose(place["left_foot"], [0, 0.084887, -0.831416], atol=1e-12)
    np.testing.assert_allclose(place["head"], [0, 0, 0.460045], atol=1e-12)
    assert place["left_hand"][1] > 0 > place["right_hand"][1]  # y is left
    assert place["sword"][0] > 0.7  # x is forward


def test_joint_coordinates_and_poses_round_trip():
    joints = random_joints(50)
    poses = skeleton.assemble_qpos([1, 2, 3], rotations.IDENTITY, joints)
    np.testing.assert_allclose(skeleton.joint_coordinates(poses), joints, atol=1e-12)
    assert poses.shape == (50, 47)
    quaternion = skeleton.joint_quaternions(poses)
    assert quaternion.shape == (50, 13, 4)
    np.testing.assert_allclose(np.linalg.norm(quaternion, axis=-1), 1, atol=1e-12)


@pytest.mark.parametrize("fps", [30.0, 120.0])
def test_velocities_of_a_steady_spin_are_its_rate_in_the_moving_frame(fps):
    time = np.arange(12)[:, None] / fps
    generator = np.random.default_rng(3)
    velocity = generator.normal(size=skeleton.NV)
    start = random_poses(1, seed=5)[0]
    poses = np.repeat(start[None], len(time), axis=0)
    poses[:, :3] += velocity[:3] * time
    poses[:, 3:7] = rotations.multiply(start[3:7], rotations.from_exponential_map(velocity[3:6] * time))
    for joint, a, d in zip(skeleton.JOINTS, 7 + skeleton.JOINT_QPOS, 6 + skeleton.JOINT_DOF, strict=True):
        if joint.dof == 3:
            turned = rotations.from_exponential_map(velocity[d : d + 3] * time)
            poses[:, a : a + 4] = rotations.multiply(start[a : a + 4], turned)
        else:
            poses[:, a] += velocity[d] * time[:, 0]
    np.testing.assert_allclose(skeleton.velocities(poses, fps), np.tile(velocity, (12, 1)), atol=1e-9)


def test_velocities_do_not_see_the_sign_of_a_quaternion():
    poses = random_poses(4)
    flipped = poses.copy()
    flipped[1::2, 3:7] *= -1
    np.testing.assert_allclose(skeleton.velocities(flipped, 30.0), skeleton.velocities(poses, 30.0), atol=1e-9)


def test_one_frame_has_no_velocity():
    assert not skeleton.velocities(random_poses(1), 30.0).any()
