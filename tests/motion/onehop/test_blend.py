"""The blend's kernel against the vectorised rotations of `motion.rotations`."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from motion import rotations, skeleton
from motion.onehop import blend

QUATERNIONS = [3] + [7 + at for joint, at in zip(skeleton.JOINTS, skeleton.JOINT_QPOS) if joint.dof == 3]


def slow_blend(a, b, share):
    """The same blend from `rotations.slerp`, joint by joint."""
    out = a + (b - a) * share
    for at in QUATERNIONS:
        out[at : at + 4] = rotations.slerp(a[at : at + 4], b[at : at + 4], share)
    return out


def same_pose(a, b, tolerance=1e-9):
    """Positions and body rotations are equal; a quaternion and its negative are the same rotation."""
    for left, right in zip(skeleton.forward_kinematics(a), skeleton.forward_kinematics(b)):
        left = left if left.shape[-1] == 3 else left * np.where(np.sum(left * right, -1, keepdims=True) < 0, -1, 1)
        np.testing.assert_allclose(left, right, atol=tolerance, rtol=0)


@given(seed=st.integers(0, 2**32 - 1), share=st.floats(0, 1), near=st.sampled_from([1.0, 1e-3, 1e-7, 0.0]))
def test_blend_is_lerp_of_positions_and_hinges_and_slerp_of_rotations(random_pose, seed, share, near):
    a, other = random_pose([seed, 0], largest=1.4)[0], random_pose([seed, 1], largest=1.4)[0]
    b = slow_blend(a, other, near)  # also poses that are nearly or exactly the same
    for at in QUATERNIONS:
        b[at : at + 4] *= np.random.default_rng([seed, at]).choice([-1, 1])  # the same rotation
    out = np.empty(skeleton.NQ)
    blend.blend_poses(a, b, share, out)
    same_pose(out, slow_blend(a, b, share), 1e-7)  # the reference itself loses digits for nearly equal rotations
    quaternions = skeleton.joint_quaternions(out)
    np.testing.assert_allclose(np.linalg.norm(quaternions, axis=-1), 1, atol=1e-12)


@given(length=st.integers(1, 90))
def test_weight_rises_smoothly_from_nothing_before_the_blend_to_all_in_its_last_frame(length):
    weights = np.array([blend.weight(shown, length) for shown in range(-1, length)])
    assert weights[0] == 0 and weights[-1] == 1
    assert (np.diff(weights) > 0).all()
    assert np.diff(weights).max() <= 1.5 / length + 1e-12
    np.testing.assert_allclose(weights + weights[::-1], 1, atol=1e-12)
    # Kovar et al. 2002: alpha(p) = 2 s^3 - 3 s^2 + 1 of the first clip
    s = (np.arange(length) + 1) / length
    np.testing.assert_allclose(1 - weights[1:], 2 * s**3 - 3 * s**2 + 1, atol=1e-12)


@given(seed=st.integers(0, 2**32 - 1), yaw=st.floats(-10, 10), x=st.floats(-300, 300), y=st.floats(-300, 300))
def test_placing_moves_every_body_rigidly_about_the_vertical(random_pose, seed, yaw, x, y):
    pose, out = random_pose(seed)[0], np.empty(skeleton.NQ)
    blend.place_pose(pose, np.array([yaw, x, y]), out)
    position, rotation = skeleton.forward_kinematics(pose)
    moved, turned = skeleton.forward_kinematics(out)
    turn = rotations.about_z(yaw)
    np.testing.assert_allclose(moved, rotations.rotate(turn, position) + [x, y, 0], atol=1e-9)
    np.testing.assert_allclose(turned, rotations.multiply(turn, rotation), atol=1e-12)


@given(seed=st.integers(0, 2**32 - 1))
def test_composed_placements_act_one_after_the_other(seed):
    generator = np.random.default_rng(seed)
    outer, inner, pose = generator.normal(size=3), generator.normal(size=3), np.zeros(skeleton.NQ)
    pose[:3], pose[3], pose[7:] = generator.normal(size=3), 1, 0
    both, once, twice = np.empty(3), np.empty(skeleton.NQ), np.empty(skeleton.NQ)
    blend.compose(outer, inner, both)
    blend.place_pose(pose, inner, once)
    blend.place_pose(once, outer, twice)
    blend.place_pose(pose, both, once)
    np.testing.assert_allclose(once, twice, atol=1e-12)
