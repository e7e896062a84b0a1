"""Rotations on arrays: quaternions (w, x, y, z), exponential maps, headings.

Every function is vectorised over leading dimensions and returns a new float64 array. A quaternion is a unit
quaternion in the last axis, order wxyz (MuJoCo's); an exponential map is axis * angle in radians, (..., 3).
z is up, x is forward, y is left.
"""

import numpy as np

IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])


def normalize(quaternion):
    """Quaternion(s) (..., 4) scaled to unit length. A zero quaternion becomes the identity."""
    quaternion = np.asarray(quaternion, dtype=np.float64)
    length = np.linalg.norm(quaternion, axis=-1, keepdims=True)
    return np.where(length > 1e-12, quaternion / np.maximum(length, 1e-12), IDENTITY)


def conjugate(quaternion):
    """The inverse of unit quaternion(s) (..., 4)."""
    return np.asarray(quaternion, dtype=np.float64) * np.array([1.0, -1.0, -1.0, -1.0])


def multiply(a, b):
    """Hamilton product a b, (..., 4): the rotation b followed by the rotation a (in the fixed frame)."""
    a, b = np.broadcast_arrays(np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64))
    aw, ax, ay, az = np.moveaxis(a, -1, 0)
    bw, bx, by, bz = np.moveaxis(b, -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def rotate(quaternion, vector):
    """Vector(s) (..., 3) turned by quaternion(s) (..., 4)."""
    quaternion = np.asarray(quaternion, dtype=np.float64)
    vector = np.asarray(vector, dtype=np.float64)
    w, xyz = quaternion[..., :1], quaternion[..., 1:]
    t = 2.0 * np.cross(xyz, vector)
    return vector + w * t + np.cross(xyz, t)


def from_exponential_map(vector):
    """Quaternion(s) (..., 4) of exponential map(s) (..., 3)."""
    vector = np.asarray(vector, dtype=np.float64)
    angle = np.linalg.norm(vector, axis=-1, keepdims=True)
    # np.sinc(x) is sin(pi x) / (pi x): exact at zero, where sin(a / 2) / a would divide by it
    return np.concatenate([np.cos(angle / 2), 0.5 * np.sinc(angle / (2 * np.pi)) * vector], axis=-1)


def to_exponential_map(quaternion):
    """Exponential map(s) (..., 3) of quaternion(s) (..., 4), angle in [0, pi]."""
    quaternion = normalize(quaternion)
    quaternion = np.where(quaternion[..., :1] < 0.0, -quaternion, quaternion)
    xyz = quaternion[..., 1:]
    sine = np.linalg.norm(xyz, axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, quaternion[..., :1])
    # angle / sin(angle / 2) tends to 2 at zero
    scale = np.where(sine > 1e-9, angle / np.maximum(sine, 1e-12), 2.0)
    return scale * xyz


def angle_between(a, b):
    """Rotation angle (...,) in [0, pi] between quaternions a and b (..., 4)."""
    return np.linalg.norm(to_exponential_map(multiply(conjugate(b), a)), axis=-1)


def slerp(a, b, t):
    """Spherical interpolation from a (t = 0) to b (t = 1) by the shorter way; t broadcasts against (...,)."""
    step = to_exponential_map(multiply(conjugate(a), b))
    return multiply(a, from_exponential_map(step * np.asarray(t, dtype=np.float64)[..., None]))


def heading(quaternion):
    """Yaw angle(s) (...,) of the body's x axis projected on the ground."""
    forward = rotate(quaternion, np.array([1.0, 0.0, 0.0]))
    return np.arctan2(forward[..., 1], forward[..., 0])


def about_z(angle):
    """Quaternion(s) (..., 4) of rotation(s) about the vertical by angle(s) (...,)."""
    half = np.asarray(angle, dtype=np.float64) / 2
    zero = np.zeros_like(half)
    return np.stack([np.cos(half), zero, zero, np.sin(half)], axis=-1)


def about_y(angle):
    """Quaternion(s) (..., 4) of rotation(s) about y (elbows and knees) by angle(s) (...,)."""
    half = np.asarray(angle, dtype=np.float64) / 2
    zero = np.zeros_like(half)
    return np.stack([np.cos(half), zero, np.sin(half), zero], axis=-1)


def tangent_normal(quaternion):
    """6-D encoding (..., 6): the turned x axis (tangent), then the turned z axis (normal)."""
    return np.concatenate(
        [rotate(quaternion, np.array([1.0, 0.0, 0.0])), rotate(quaternion, np.array([0.0, 0.0, 1.0]))], axis=-1
    )


def nearest_branch(vector, reference):
    """The exponential map(s) of the same rotation(s) as vector (..., 3) that lie nearest to reference (..., 3).

    The exponential map is 2 pi-periodic along its axis; a controller that compares two maps needs both on one branch.
    """
    vector = np.asarray(vector, dtype=np.float64)
    angle = np.linalg.norm(vector, axis=-1, keepdims=True)
    axis = vector / np.maximum(angle, 1e-12)
    along = np.sum(axis * np.asarray(reference, dtype=np.float64), axis=-1, keepdims=True)
    turns = np.round((along - angle) / (2 * np.pi))
    return np.where(angle > 1e-9, vector + 2 * np.pi * turns * axis, vector)
