"""Deviations and the reward, Eq. 1-13 (section 3)."""

import math

import numpy as np
from numba import njit

from motion import skeleton
from workers.kinematics import (
    JOINT_DOF,
    JOINT_QPOS,
    JOINT_SIZE,
    NUM_DOF,
    NUM_JOINTS,
    about_z,
    conjugate,
    heading,
    logarithm,
    multiply,
    quaternion_at,
    rotate,
)  # fmt: skip
from workers.types import DEVIATIONS, REACHED, REWARD_PARTS

# Eq. 1
_W_ROOT_POSITION, _W_ROOT_VELOCITY, _W_ROOT_ROTATION, _W_KEY_BODIES, W_UPPER_BODY = 2.4, 0.1, 0.1, 0.3, 1.6
# Eq. 12
_W_TREMBLE, _TREMBLE_THRESHOLD = -0.05, 100

_WEIGHTS = skeleton.JOINT_WEIGHTS
_UPPER = np.array([joint.upper for joint in skeleton.JOINTS])
_NUM_UPPER = len(skeleton.UPPER_JOINTS)
_NUM_LOWER = len(skeleton.LOWER_JOINTS)
_KEY_BODIES = skeleton.KEY_BODIES
_NUM_KEYS = len(_KEY_BODIES)

# columns of a row of deviations
RP, RV, RQ, KP, Q, LQ, QV = range(len(DEVIATIONS))
# columns of a row of reward parts
_ROOT_POSITION, _ROOT_VELOCITY, _ROOT_ROTATION, _KEYS, _UPPER_BODY, END, TREMBLE = range(len(REWARD_PARTS))


@njit(cache=True)
def _distance(ax, ay, az, bx, by, bz):
    return math.sqrt((ax - bx) ** 2 + (ay - by) ** 2 + (az - bz) ** 2)


@njit(cache=True)
def joint_difference(qpos, target_qpos, joint):
    """L1 norm of the exponential map of q (-) q_tar of one joint; for hinges the angle's difference."""
    start = JOINT_QPOS[joint]
    if JOINT_SIZE[joint] == 1:
        return abs(qpos[start] - target_qpos[start])
    x, y, z = logarithm(multiply(conjugate(quaternion_at(target_qpos, start)), quaternion_at(qpos, start)))
    return abs(x) + abs(y) + abs(z)


@njit(cache=True)
def deviate(qpos, qvel, bodies, target_qpos, target_qvel, target_bodies, own_frame, out, joints):
    """The seven deviations of section 3 into out (7,) in `DEVIATIONS` order, and L1 of every joint into joints (13,).

    own_frame: compare each pose's key bodies in its own heading frame instead of both in that of p_t (`own`).
    """
    out[RP] = _distance(qpos[0], qpos[1], qpos[2], target_qpos[0], target_qpos[1], target_qpos[2])
    out[RV] = _distance(qvel[0], qvel[1], qvel[2], target_qvel[0], target_qvel[1], target_qvel[2])
    root, target_root = quaternion_at(qpos, 3), quaternion_at(target_qpos, 3)
    x, y, z = logarithm(multiply(conjugate(target_root), root))
    out[RQ] = math.sqrt(x * x + y * y + z * z)

    keys = 0.0
    frame, target_frame = conjugate(about_z(heading(root))), conjugate(about_z(heading(target_root)))
    for k in range(_NUM_KEYS):
        a, b = bodies[_KEY_BODIES[k]], target_bodies[_KEY_BODIES[k]]
        if own_frame:
            p = rotate(frame, a[0] - qpos[0], a[1] - qpos[1], a[2] - qpos[2])
            r = rotate(target_frame, b[0] - target_qpos[0], b[1] - target_qpos[1], b[2] - target_qpos[2])
            keys += _distance(p[0], p[1], p[2], r[0], r[1], r[2])
        else:
            # one frame for both: a rigid motion, which leaves the distance as it is in the world
            keys += _distance(a[0], a[1], a[2], b[0], b[1], b[2])
    out[KP] = keys

    rotation_sum, lower_sum, velocity_sum = 0.0, 0.0, 0.0
    for joint in range(NUM_JOINTS):
        difference = joint_difference(qpos, target_qpos, joint)
        joints[joint] = difference
        rotation_sum += _WEIGHTS[joint] * difference
        if not _UPPER[joint]:
            lower_sum += _WEIGHTS[joint] * difference
        rates = 0.0
        for c in range(JOINT_SIZE[joint]):
            dof = 6 + JOINT_DOF[joint] + c
            rates += abs(qvel[dof] - target_qvel[dof])
        velocity_sum += _WEIGHTS[joint] * rates
    out[Q] = rotation_sum / NUM_JOINTS
    out[LQ] = lower_sum / _NUM_LOWER
    out[QV] = velocity_sum / NUM_JOINTS


@njit(cache=True)
def deviate_batch(qpos, qvel, bodies, target_qpos, target_qvel, target_bodies, own_frame, out, joints):
    """`deviate` of every row."""
    for i in range(qpos.shape[0]):
        deviate(
            qpos[i], qvel[i], bodies[i], target_qpos[i], target_qvel[i], target_bodies[i], own_frame, out[i], joints[i]
        )


@njit(cache=True)
def upper_body_improvement(before, after, penalty):
    """I^uq (Eq. 6) of the joints' L1 norms (13,) before and after; `penalty` doubles negative terms (Eq. 8)."""
    total = 0.0
    for joint in range(NUM_JOINTS):
        if _UPPER[joint]:
            change = before[joint] - after[joint]
            if penalty and change < 0.0:
                change *= 2.0
            total += _WEIGHTS[joint] * change
    return total / _NUM_UPPER


@njit(cache=True)
def sign_changes(before, after):
    """O_t (Eq. 12): how many of the 31 joint velocities of qvel (37,) have a sign other than the last frame's."""
    count = 0
    for dof in range(6, 6 + NUM_DOF):
        if before[dof] * after[dof] < 0.0:
            count += 1
    return count


def tremble_share(config, tightenings):
    """Share (0 to 1) of the tremble term's weight after so many tightenings, both (N,); config: `RewardConfig`."""
    if not config.tremble:
        return np.zeros(len(tightenings))
    return np.minimum(1.0, tightenings / config.tremble_ramp) if config.tremble_ramp else np.ones(len(tightenings))


@njit(cache=True)
def reward(before, after, joints_before, joints_after, changes, trembles, end, penalty, tremble, failure, parts):
    """The parts of r_t (Eq. 13) into parts (7,), in `REWARD_PARTS` order; r_t is their sum.

    before, after: deviations (7,) of the last and this frame; joints_*: L1 norms (13,). changes: O_t; trembles: C_t,
    this frame's changes included. end: how the episode ended with this frame. penalty: the switch of Eq. 8. tremble:
    share of the tremble term's weight, 0 to 1.
    """
    parts[_ROOT_POSITION] = _W_ROOT_POSITION * (before[RP] - after[RP])
    parts[_ROOT_VELOCITY] = _W_ROOT_VELOCITY * (before[RV] - after[RV])
    parts[_ROOT_ROTATION] = _W_ROOT_ROTATION * (before[RQ] - after[RQ])
    parts[_KEYS] = _W_KEY_BODIES * (before[KP] - after[KP])
    parts[_UPPER_BODY] = W_UPPER_BODY * upper_body_improvement(joints_before, joints_after, penalty)
    if end == REACHED:
        parts[END] = 3.0 + math.exp(-4.0 * after[LQ]) + math.exp(-0.2 * after[QV])  # Eq. 9
    elif end != 0:
        parts[END] = failure
    else:
        parts[END] = 0.0
    parts[TREMBLE] = tremble * _W_TREMBLE * changes if trembles > _TREMBLE_THRESHOLD else 0.0
