"""The vectorised rotations against scipy's, on random input and at the edges: no turn and half a turn."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from motion import rotations

EDGES = [0.0, 1e-13, 1e-10, 1e-9, 2e-9, 1e-7, 1e-4, np.pi - 1e-4, np.pi - 1e-8, np.pi]
QUICK = settings(max_examples=60, deadline=None)

axes = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array).filter(lambda axis: np.linalg.norm(axis) > 0.1)
angles = st.one_of(st.sampled_from(EDGES), st.floats(0, np.pi))
vectors = st.builds(lambda axis, angle: axis / np.linalg.norm(axis) * angle, axes, angles)
batches = st.lists(vectors, min_size=1, max_size=4).map(np.array)


def quaternions(rotation):
    return rotation.as_quat(scalar_first=True)


def assert_same_rotation(actual, expected, tolerance=1e-9):
    """Quaternions up to sign."""
    dot = np.sum(actual * expected, axis=-1, keepdims=True)
    np.testing.assert_allclose(actual * np.sign(dot), expected, atol=tolerance)


@QUICK
@given(batches)
def test_from_exponential_map_agrees_with_scipy(vector):
    assert_same_rotation(rotations.from_exponential_map(vector), quaternions(Rotation.from_rotvec(vector)))


@QUICK
@given(batches)
def test_exponential_map_round_trip_gives_the_same_rotation_and_an_angle_up_to_pi(vector):
    quaternion = rotations.from_exponential_map(vector)
    back = rotations.to_exponential_map(quaternion)
    assert np.all(np.linalg.norm(back, axis=-1) <= np.pi + 1e-12)
    assert_same_rotation(rotations.from_exponential_map(back), quaternion)
    inside = np.linalg.norm(vector, axis=-1) < np.pi - 1e-6
    np.testing.assert_allclose(back[inside], vector[inside], atol=1e-9)


@QUICK
@given(batches)
def test_both_signs_of_a_quaternion_have_one_exponential_map_away_from_pi(vector):
    vector = vector[np.linalg.norm(vector, axis=-1) < np.pi - 1e-6]
    quaternion = rotations.from_exponential_map(vector)
    np.testing.assert_allclose(rotations.to_exponential_map(-quaternion), vector, atol=1e-9)


@QUICK
@given(vectors, vectors, st.tuples(*[st.floats(-10, 10)] * 3).map(np.array))
def test_product_inverse_and_turned_vectors_agree_with_scipy(a, b, point):
    qa, qb = rotations.from_exponential_map(a), rotations.from_exponential_map(b)
    ra, rb = Rotation.from_rotvec(a), Rotation.from_rotvec(b)
    assert_same_rotation(rotations.multiply(qa, qb), quaternions(ra * rb))
    assert_same_rotation(rotations.conjugate(qa), quaternions(ra.inv()))
    np.testing.assert_allclose(rotations.rotate(qa, point), ra.apply(point), atol=1e-9)


@QUICK
@given(vectors, vectors)
def test_angle_between_is_the_magnitude_of_the_relative_rotation(a, b):
    angle = rotations.angle_between(rotations.from_exponential_map(a), rotations.from_exponential_map(b))
    assert angle == pytest.approx((Rotation.from_rotvec(b).inv() * Rotation.from_rotvec(a)).magnitude(), abs=1e-7)


@QUICK
@given(vectors, vectors, st.floats(0, 1))
def test_slerp_agrees_with_scipy_and_hits_both_ends(a, b, t):
    qa, qb = rotations.from_exponential_map(a), rotations.from_exponential_map(b)
    assert_same_rotation(rotations.slerp(qa, qb, 0.0), qa)
    assert_same_rotation(rotations.slerp(qa, qb, 1.0), qb)
    if rotations.angle_between(qa, qb) < np.pi - 1e-3:  # at half a turn both ways round are right
        expected = Slerp([0, 1], Rotation.from_rotvec([a, b]))(t)
        assert_same_rotation(rotations.slerp(qa, -qb, t), quaternions(expected))


@QUICK
@given(vectors)
def test_tangent_normal_is_the_first_and_last_column_of_the_matrix(vector):
    matrix = Rotation.from_rotvec(vector).as_matrix()
    encoded = rotations.tangent_normal(rotations.from_exponential_map(vector))
    np.testing.assert_allclose(encoded, np.concatenate([matrix[:, 0], matrix[:, 2]]), atol=1e-9)


@QUICK
@given(vectors, st.floats(-3, 3))
def test_turning_about_the_vertical_turns_the_heading_by_as_much(vector, angle):
    forward = Rotation.from_rotvec(vector).apply([1, 0, 0])
    if np.hypot(forward[0], forward[1]) < 1e-3:
        return
    quaternion = rotations.from_exponential_map(vector)
    turned = rotations.heading(rotations.multiply(rotations.about_z(angle), quaternion))
    assert rotations.heading(quaternion) == pytest.approx(np.arctan2(forward[1], forward[0]), abs=1e-6)
    assert np.exp(1j * (turned - rotations.heading(quaternion))) == pytest.approx(np.exp(1j * angle), abs=1e-6)


def test_rotations_about_one_axis_agree_with_scipy():
    angle = np.linspace(-4, 4, 17)
    zero = np.zeros_like(angle)
    assert_same_rotation(rotations.about_y(angle), quaternions(Rotation.from_rotvec(np.stack([zero, angle, zero], -1))))
    assert_same_rotation(rotations.about_z(angle), quaternions(Rotation.from_rotvec(np.stack([zero, zero, angle], -1))))


@QUICK
@given(vectors, st.tuples(*[st.floats(-12, 12)] * 3).map(np.array))
def test_nearest_branch_is_the_same_rotation_and_no_other_branch_is_nearer(vector, reference):
    near = rotations.nearest_branch(vector, reference)
    assert_same_rotation(rotations.from_exponential_map(near), rotations.from_exponential_map(vector), 1e-8)
    angle = np.linalg.norm(vector)
    if angle > 1e-6:
        turns = np.arange(-4, 5)[:, None]
        others = vector / angle * (angle + 2 * np.pi * turns)
        assert np.linalg.norm(near - reference) <= np.linalg.norm(others - reference, axis=1).min() + 1e-8


def test_nearest_branch_follows_a_joint_through_half_a_turn():
    true = np.array([0.0, 1.0, 0.0]) * np.linspace(2.9, 3.5, 30)[:, None]
    folded = rotations.to_exponential_map(rotations.from_exponential_map(true))
    assert np.abs(np.diff(folded, axis=0)).max() > 6  # the flip
    followed = [true[0]]
    for vector in folded[1:]:
        followed.append(rotations.nearest_branch(vector, followed[-1]))
    np.testing.assert_allclose(followed, true, atol=1e-9)


def test_normalize_keeps_the_direction_and_makes_a_zero_the_identity():
    np.testing.assert_allclose(rotations.normalize([[0, 3, 0, 4], [0, 0, 0, 0]]), [[0, 0.6, 0, 0.8], [1, 0, 0, 0]])


def test_functions_broadcast_over_leading_dimensions_and_leave_their_input_alone():
    generator = np.random.default_rng(0)
    a = rotations.normalize(generator.normal(size=(5, 1, 4)))
    b = rotations.normalize(generator.normal(size=(3, 4)))
    before = a.copy()
    product = rotations.multiply(a, b)
    assert product.shape == (5, 3, 4)
    np.testing.assert_allclose(product[4, 2], rotations.multiply(a[4, 0], b[2]))
    assert rotations.slerp(a, b, np.linspace(0, 1, 3)).shape == (5, 3, 4)
    rotations.to_exponential_map(a)
    np.testing.assert_array_equal(a, before)
