"""Rotations from axes and from turn, pitch and roll: what authors of poses think in."""

import numpy as np

from motion import rotations


def unit(vector):
    """Vector(s) (..., 3) scaled to length 1."""
    vector = np.asarray(vector, dtype=np.float64)
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)


def across(vector, axis):
    """The part of vector(s) (..., 3) at right angles to unit `axis` (..., 3), as unit vector(s)."""
    return unit(vector - np.sum(vector * axis, axis=-1, keepdims=True) * axis)


def from_angles(degrees):
    """Quaternion(s) (..., 4) of yaw, pitch (down positive), roll in degrees (..., 3): about z, then y, then x."""
    yaw, pitch, roll = np.moveaxis(np.radians(degrees), -1, 0)
    zero = np.zeros_like(roll)
    about_x = rotations.from_exponential_map(np.stack([roll, zero, zero], axis=-1))
    return rotations.multiply(rotations.multiply(rotations.about_z(yaw), rotations.about_y(pitch)), about_x)


def from_axes(y, z):
    """Quaternion(s) (..., 4) of the frame with unit axes y and z (..., 3), at right angles to each other."""
    x = np.cross(y, z)
    # the matrix gives 4 q q^T; its row with the largest diagonal is q, scaled, with no cancellation
    m = np.stack([x, y, z], axis=-1)
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    outer = np.empty(m.shape[:-2] + (4, 4))  # 4 q q^T
    outer[..., 0, 0], outer[..., 1, 1] = 1 + xx + yy + zz, 1 + xx - yy - zz
    outer[..., 2, 2], outer[..., 3, 3] = 1 - xx + yy - zz, 1 - xx - yy + zz
    for i, j, k in ((1, 2, 3), (2, 3, 1), (3, 1, 2)):
        outer[..., 0, i] = outer[..., i, 0] = m[..., k - 1, j - 1] - m[..., j - 1, k - 1]
        outer[..., j, k] = outer[..., k, j] = m[..., k - 1, j - 1] + m[..., j - 1, k - 1]
    largest = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    return rotations.normalize(np.take_along_axis(outer, largest[..., None, None], axis=-2)[..., 0, :])


def shortest(direction):
    """Quaternion(s) (..., 4) of the shortest rotation that takes the x axis to unit direction(s) (..., 3)."""
    x = np.zeros_like(direction)
    x[..., 0] = 1.0
    real = 1 + direction[..., :1]
    return rotations.normalize(np.concatenate([real, np.cross(x, direction)], axis=-1))
