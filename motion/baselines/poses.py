"""Poses taken apart into what is blended linearly and what is a rotation."""

import numpy as np

from motion import rotations, skeleton

# columns of qpos and qvel: root position and hinges; then those of the root's and every ball joint's rotation
_HINGES = [j for j, joint in enumerate(skeleton.JOINTS) if joint.dof == 1]
_BALLS = [j for j, joint in enumerate(skeleton.JOINTS) if joint.dof == 3]
_LINEAR_Q = np.array([0, 1, 2, *(7 + skeleton.JOINT_QPOS[_HINGES])])
_LINEAR_V = np.array([0, 1, 2, *(6 + skeleton.JOINT_DOF[_HINGES])])
_TURN_Q = np.array([3, *(7 + skeleton.JOINT_QPOS[_BALLS])])[:, None] + np.arange(4)
_TURN_V = np.array([3, *(6 + skeleton.JOINT_DOF[_BALLS])])[:, None] + np.arange(3)


def split(qpos):
    """(linear (..., 7): root position in m and hinges in rad; rotations (..., 10, 4)) of poses (..., 47)."""
    qpos = np.asarray(qpos, dtype=np.float64)
    return qpos[..., _LINEAR_Q], qpos[..., _TURN_Q]


def split_velocity(qvel, turns):
    """(linear (..., 7), angular (..., 10, 3) in the parent's frame) of qvel (..., 37), whose rotations are `turns`."""
    return qvel[..., _LINEAR_V], rotations.rotate(turns, qvel[..., _TURN_V])


def join(linear, turns):
    """Poses (..., 47) of `split`'s parts; the rotations are scaled to unit length."""
    out = np.empty(linear.shape[:-1] + (skeleton.NQ,))
    out[..., _LINEAR_Q] = linear
    out[..., _TURN_Q] = rotations.normalize(turns)
    return out


def blend(a, b, share):
    """Poses (n, 47) between a (share 0) and b (share 1), both (n, 47): linear, and slerp by the shorter way."""
    (linear_a, turns_a), (linear_b, turns_b) = split(a), split(b)
    share = np.asarray(share, dtype=np.float64)[:, None]
    return join(linear_a + (linear_b - linear_a) * share, rotations.slerp(turns_a, turns_b, share))


def ease(s):
    """Ease-in-ease-out cubic of s in [0, 1]: 3 s^2 - 2 s^3, with zero slope at both ends."""
    return s * s * (3 - 2 * s)


def frames_of(duration, fps):
    """Times (n + 1,) in s of the frames of a transition that lasts `duration` s, to the nearest frame; n >= 1."""
    return np.arange(max(1, round(duration * fps)) + 1) / fps
