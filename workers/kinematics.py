"""Compiled scalar rotations and forward kinematics: one pose at a time, no allocation.

The same definitions as `motion.rotations` and `motion.skeleton` (tests hold them together), for the inner loop of a
step, where numpy on small arrays would cost as much as physics. Quaternions are tuples (w, x, y, z).
"""

import math

import numpy as np
from numba import njit

from motion import skeleton

NUM_BODIES, NUM_JOINTS, NUM_DOF, NQ, NV = (
    skeleton.NUM_BODIES, skeleton.NUM_JOINTS, skeleton.NUM_DOF, skeleton.NQ, skeleton.NV,
)  # fmt: skip

# compile-time constants of the kernels
_PARENTS = skeleton.PARENTS
_OFFSETS = skeleton.OFFSETS
JOINT_QPOS = skeleton.JOINT_QPOS + 7
JOINT_DOF = skeleton.JOINT_DOF
JOINT_SIZE = np.array([joint.dof for joint in skeleton.JOINTS])
_BODY_JOINT = np.array(
    [next((j for j, joint in enumerate(skeleton.JOINTS) if joint.body == i), -1) for i in range(NUM_BODIES)]
)


@njit(cache=True)
def multiply(a, b):
    """Hamilton product."""
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@njit(cache=True)
def conjugate(q):
    """Inverse rotation."""
    return (q[0], -q[1], -q[2], -q[3])


@njit(cache=True)
def rotate(q, x, y, z):
    """The vector (x, y, z) turned by q."""
    tx = 2.0 * (q[2] * z - q[3] * y)
    ty = 2.0 * (q[3] * x - q[1] * z)
    tz = 2.0 * (q[1] * y - q[2] * x)
    return (
        x + q[0] * tx + q[2] * tz - q[3] * ty,
        y + q[0] * ty + q[3] * tx - q[1] * tz,
        z + q[0] * tz + q[1] * ty - q[2] * tx,
    )


@njit(cache=True)
def logarithm(q):
    """Exponential map (x, y, z) of q, angle in [0, pi]."""
    w, x, y, z = q
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 * math.atan2(sine, w) / sine if sine > 1e-9 else 2.0
    return (scale * x, scale * y, scale * z)


@njit(cache=True)
def exponential(x, y, z):
    """Quaternion of an exponential map."""
    angle = math.sqrt(x * x + y * y + z * z)
    scale = math.sin(0.5 * angle) / angle if angle > 1e-9 else 0.5
    return (math.cos(0.5 * angle), scale * x, scale * y, scale * z)


@njit(cache=True)
def about_y(angle):
    """Rotation about y."""
    return (math.cos(0.5 * angle), 0.0, math.sin(0.5 * angle), 0.0)


@njit(cache=True)
def about_z(angle):
    """Rotation about the vertical."""
    return (math.cos(0.5 * angle), 0.0, 0.0, math.sin(0.5 * angle))


@njit(cache=True)
def quaternion_at(row, start):
    """The quaternion stored at row[start : start + 4]."""
    return (row[start], row[start + 1], row[start + 2], row[start + 3])


@njit(cache=True)
def heading(q):
    """Yaw of the x axis."""
    x, y, _ = rotate(q, 1.0, 0.0, 0.0)
    return math.atan2(y, x)


@njit(cache=True)
def joint_quaternion(qpos, joint):
    """Local rotation of a joint of the pose qpos (47,)."""
    start = JOINT_QPOS[joint]
    if JOINT_SIZE[joint] == 3:
        return quaternion_at(qpos, start)
    return about_y(qpos[start])


@njit(cache=True)
def forward_kinematics(qpos, position, rotation):
    """World positions (17, 3) and quaternions (17, 4) of the bodies of the pose qpos (47,)."""
    for c in range(3):
        position[0, c] = qpos[c]
    for c in range(4):
        rotation[0, c] = qpos[3 + c]
    for body in range(1, NUM_BODIES):
        parent = _PARENTS[body]
        q = quaternion_at(rotation[parent], 0)
        x, y, z = rotate(q, _OFFSETS[body, 0], _OFFSETS[body, 1], _OFFSETS[body, 2])
        position[body, 0] = position[parent, 0] + x
        position[body, 1] = position[parent, 1] + y
        position[body, 2] = position[parent, 2] + z
        if _BODY_JOINT[body] >= 0:
            q = multiply(q, joint_quaternion(qpos, _BODY_JOINT[body]))
        for c in range(4):
            rotation[body, c] = q[c]


@njit(cache=True)
def forward_kinematics_batch(qpos, position, rotation):
    """`forward_kinematics` of every row: qpos (N, 47) into position (N, 17, 3) and rotation (N, 17, 4)."""
    for i in range(qpos.shape[0]):
        forward_kinematics(qpos[i], position[i], rotation[i])
