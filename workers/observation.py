"""The state s_t = (p_t, p_tar), 282 numbers (section 2).

Everything is expressed in the heading frame of p_t: origin at its root, z up, x along its root's heading.
"""

from numba import njit

from motion import skeleton
from workers.kinematics import (
    NUM_DOF,
    NUM_JOINTS,
    about_z,
    conjugate,
    heading,
    joint_quaternion,
    multiply,
    quaternion_at,
    rotate,
)  # fmt: skip

POSE_SIZE = 140
TARGET_SIZE = 142
OBSERVATION_SIZE = POSE_SIZE + TARGET_SIZE
_ALIKE = POSE_SIZE - 1  # p_t and p_tar end with as many numbers of the same meaning
# where p_t has them; p_tar has all but the height two places later
ROOT_VELOCITY, ROOT_AXES, ROOT_SPIN = slice(1, 4), slice(4, 10), slice(10, 13)
JOINT_AXES = slice(13, 13 + 6 * NUM_JOINTS)
JOINT_RATES = slice(JOINT_AXES.stop, JOINT_AXES.stop + NUM_DOF)
KEY_PLACES = slice(JOINT_RATES.stop, POSE_SIZE)

_KEY_BODIES = skeleton.KEY_BODIES
_NUM_KEYS = len(_KEY_BODIES)


@njit(cache=True)
def _write3(out, at, vector):
    out[at], out[at + 1], out[at + 2] = vector
    return at + 3


@njit(cache=True)
def _write_tangent_normal(out, at, q):
    """6-D encoding: the turned x axis, then the turned z axis."""
    at = _write3(out, at, rotate(q, 1.0, 0.0, 0.0))
    return _write3(out, at, rotate(q, 0.0, 0.0, 1.0))


@njit(cache=True)
def _write_pose(out, at, frame, origin, qpos, qvel, bodies):
    """All of a pose but its root's place: orientation 6, angular velocity 3, joints 78 and 31, key bodies 18."""
    root = quaternion_at(qpos, 3)
    at = _write_tangent_normal(out, at, multiply(frame, root))
    # MuJoCo's angular velocity of a free joint is in the root's own frame
    spin = rotate(root, qvel[3], qvel[4], qvel[5])
    at = _write3(out, at, rotate(frame, spin[0], spin[1], spin[2]))
    for joint in range(NUM_JOINTS):
        at = _write_tangent_normal(out, at, joint_quaternion(qpos, joint))
    for dof in range(NUM_DOF):
        out[at + dof] = qvel[6 + dof]
    at += NUM_DOF
    for k in range(_NUM_KEYS):
        body = _KEY_BODIES[k]
        at = _write3(
            out,
            at,
            rotate(frame, bodies[body, 0] - origin[0], bodies[body, 1] - origin[1], bodies[body, 2] - origin[2]),
        )
    return at


@njit(cache=True)
def observe(qpos, qvel, bodies, target_qpos, target_qvel, target_bodies, difference, out):
    """s_t into out (282,), of a pose (47,), (37,) with body positions (17, 3), and a target likewise, in the world.

    Order of p_t: height 1, linear velocity 3, orientation 6, angular velocity 3, joint rotations 78, joint velocities
    31, key bodies 18. p_tar is the same with the root's position (3) instead of the height. difference: of p_tar's
    other 139 numbers, p_t's are taken off (`ObservationConfig`).
    """
    frame = conjugate(about_z(heading(quaternion_at(qpos, 3))))
    out[0] = qpos[2]
    at = _write3(out, 1, rotate(frame, qvel[0], qvel[1], qvel[2]))
    at = _write_pose(out, at, frame, qpos, qpos, qvel, bodies)
    at = _write3(
        out, at, rotate(frame, target_qpos[0] - qpos[0], target_qpos[1] - qpos[1], target_qpos[2] - qpos[2])
    )
    at = _write3(out, at, rotate(frame, target_qvel[0], target_qvel[1], target_qvel[2]))
    _write_pose(out, at, frame, qpos, target_qpos, target_qvel, target_bodies)
    if difference:
        for k in range(_ALIKE):
            out[OBSERVATION_SIZE - _ALIKE + k] -= out[POSE_SIZE - _ALIKE + k]


@njit(cache=True)
def observe_batch(qpos, qvel, bodies, target_qpos, target_qvel, target_bodies, difference, out):
    """`observe` of every row; out (N, 282) may be float32."""
    for i in range(qpos.shape[0]):
        observe(
            qpos[i], qvel[i], bodies[i], target_qpos[i], target_qvel[i], target_bodies[i], difference, out[i]
        )  # fmt: skip
