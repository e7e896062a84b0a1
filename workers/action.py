"""From the policy's 31 numbers to PD targets and back (section 2).

A PD target is given in joint coordinates: an exponential map per spherical joint, an angle per hinge. In the mode
`absolute` it is the action itself (times the scale); in `target` and `current` it is the rotation of the target's or
the current pose, followed by the action as a rotation in the joint's own frame.
"""

import math

from numba import njit

from workers.kinematics import (
    JOINT_DOF,
    JOINT_QPOS,
    JOINT_SIZE,
    NUM_JOINTS,
    conjugate,
    exponential,
    logarithm,
    multiply,
    quaternion_at,
)  # fmt: skip

ABSOLUTE, TARGET, CURRENT = range(3)
MODES = {"absolute": ABSOLUTE, "target": TARGET, "current": CURRENT}


@njit(cache=True)
def decode(action, base_qpos, scale, absolute, out):
    """PD targets into out (31,) of an action (31,) around base_qpos (47,); the base is not read if `absolute`."""
    for joint in range(NUM_JOINTS):
        dof, start = JOINT_DOF[joint], JOINT_QPOS[joint]
        if JOINT_SIZE[joint] == 1:
            out[dof] = scale * action[dof] + (0.0 if absolute else base_qpos[start])
            continue
        x, y, z = scale * action[dof], scale * action[dof + 1], scale * action[dof + 2]
        if not absolute:
            x, y, z = logarithm(multiply(quaternion_at(base_qpos, start), exponential(x, y, z)))
        out[dof], out[dof + 1], out[dof + 2] = x, y, z


@njit(cache=True)
def encode(pd_target, base_qpos, scale, absolute, out):
    """The action into out (31,) that `decode` turns into pd_target (31,) around base_qpos (47,): its inverse.

    Self-Behavior Cloning needs it: an offset action that was taken around one target is another number around the
    retargeted pose.
    """
    for joint in range(NUM_JOINTS):
        dof, start = JOINT_DOF[joint], JOINT_QPOS[joint]
        if JOINT_SIZE[joint] == 1:
            out[dof] = (pd_target[dof] - (0.0 if absolute else base_qpos[start])) / scale
            continue
        x, y, z = pd_target[dof], pd_target[dof + 1], pd_target[dof + 2]
        if not absolute:
            x, y, z = logarithm(multiply(conjugate(quaternion_at(base_qpos, start)), exponential(x, y, z)))
        out[dof], out[dof + 1], out[dof + 2] = x / scale, y / scale, z / scale


@njit(cache=True)
def control(pd_target, qpos, out):
    """Actuator targets into out (31,): pd_target with every spherical joint on the branch of the current pose (47,).

    The exponential map jumps at pi, the position actuator compares it with the joint's own map in [0, pi]; of all maps
    of the wanted rotation the nearest one turns the shorter way.
    """
    for joint in range(NUM_JOINTS):
        dof, start = JOINT_DOF[joint], JOINT_QPOS[joint]
        if JOINT_SIZE[joint] == 1:
            out[dof] = pd_target[dof]
            continue
        x, y, z = pd_target[dof], pd_target[dof + 1], pd_target[dof + 2]
        angle = math.sqrt(x * x + y * y + z * z)
        if angle > 1e-9:
            cx, cy, cz = logarithm(quaternion_at(qpos, start))
            along = (x * cx + y * cy + z * cz) / angle
            turns = 2.0 * math.pi * round((along - angle) / (2.0 * math.pi))
            factor = (angle + turns) / angle
            x, y, z = factor * x, factor * y, factor * z
        out[dof], out[dof + 1], out[dof + 2] = x, y, z


@njit(cache=True, nogil=True)
def act_batch(action, mode, scale, qpos, target_qpos, pd_target, ctrl):
    """PD targets (N, 31) and actuator targets ctrl (N, 31) of actions (N, 31), for poses and targets (N, 47)."""
    for i in range(action.shape[0]):
        base = target_qpos[i] if mode == TARGET else qpos[i]
        decode(action[i], base, scale, mode == ABSOLUTE, pd_target[i])
        control(pd_target[i], qpos[i], ctrl[i])
