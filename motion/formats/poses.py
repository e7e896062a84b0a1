"""What every reader ends with: checked, sign-continuous poses, and closed cycles, as a `Clip`."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from motion import rotations, skeleton
from motion.clip import Clip
from motion.errors import InputError

CLOSING_TIME = 0.25  # s; shorter makes the seam's velocity a spike, longer changes more of the recorded motion
LARGEST_GAP = 0.7  # rad; the worst of DeepMimic's cyclic clips is 0.50 (walk, right ankle)
LARGEST_STEP = 0.1  # m, between the root heights of both ends
LARGEST_NUMBER = 1e6  # m or rad; beyond it there is no clip, only a damaged file
UNIT_TOLERANCE = 0.5  # of a quaternion's length; DeepMimic has 0.58 (kick), blended linearly between key frames

_QUATERNIONS = [("root", slice(3, 7))] + [
    (joint.name, slice(7 + start, 11 + start))
    for joint, start in zip(skeleton.JOINTS, skeleton.JOINT_QPOS, strict=True)
    if joint.dof == 3
]
_HINGES = [
    (joint.name, 7 + start) for joint, start in zip(skeleton.JOINTS, skeleton.JOINT_QPOS, strict=True) if joint.dof == 1
]


def make_clip(source, name, qpos, fps, looping, turning=True):
    """A clip of poses (T, 47) from `source` (the file, for messages), called `name` or else as the file is.

    Quaternion signs are made continuous over time (w >= 0 in the first frame); a looping clip's cycle is closed, with
    or without the change of heading over a cycle (`turning`). Raises InputError naming `source` for poses that
    `Clip.from_poses` refuses, for quaternions that are not of unit length, and for a cycle that cannot be closed.
    """
    qpos = np.array(qpos, dtype=np.float64)
    if qpos.ndim == 2 and qpos.shape[1] == skeleton.NQ:
        check_numbers(source, qpos)
        for part, columns in _QUATERNIONS:
            length = np.linalg.norm(qpos[:, columns], axis=1)
            if np.any(np.abs(length - 1) > UNIT_TOLERANCE):
                frame = int(np.argmax(np.abs(length - 1) > UNIT_TOLERANCE))
                raise InputError(
                    f"{source}: frame {frame}: the rotation of {part} is no unit quaternion"
                    f" (length {length[frame]:.3g}): is this the 31-DOF skeleton?"
                )
            qpos[:, columns] = continuous(qpos[:, columns])
        if looping and len(qpos) > 1 and 0 < fps < np.inf:
            qpos = close_cycle(source, qpos, fps, turning)
    return replace(Clip.from_poses(str(source), qpos, fps, looping), name=name or Path(source).stem)


def check_numbers(source, *arrays):
    """Raises InputError, naming the frame, where one of the arrays (T, ...) holds NaN, infinity or an absurd number."""
    for array in arrays:
        sound = np.abs(array) <= LARGEST_NUMBER  # False for NaN
        if not sound.all():
            frame = int(np.argwhere(~sound)[0][0])
            value = array[frame][~sound[frame]].flat[0]
            raise InputError(f"{source}: frame {frame} holds {value:.3g}; export the clip again")


def continuous(quaternions):
    """The same rotations (T, 4) with the signs that make neighbours close; w >= 0 in the first frame."""
    flips = np.where(np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0, -1.0, 1.0)
    first = np.where(quaternions[:1, 0] < 0, -1.0, 1.0)
    return quaternions * np.cumprod(np.concatenate([first, flips]))[:, None]


def close_cycle(source, qpos, fps, turning):
    """Poses (T, 47) whose last frame is exactly the first one, moved by the cycle's horizontal displacement.

    Captured cycles do not quite close. The difference is spread smoothly over the last quarter of a second, because a
    jump within one frame would become a velocity of up to 15 rad/s in the first pose. With `turning` the last heading
    is kept (a clip that runs in a curve), else it becomes the first one's. Raises InputError for ends that are too far
    apart to be one pose.
    """
    goal = np.array(qpos[0])
    goal[:2] = qpos[-1, :2]
    if turning:
        turn = rotations.heading(qpos[-1, 3:7]) - rotations.heading(qpos[0, 3:7])
        goal[3:7] = rotations.multiply(rotations.about_z(turn), goal[3:7])
    gaps = [(rotations.angle_between(goal[columns], qpos[-1, columns]), part) for part, columns in _QUATERNIONS]
    gaps += [(abs(goal[column] - qpos[-1, column]), part) for part, column in _HINGES]
    gap, part = max(gaps)
    step = abs(goal[2] - qpos[-1, 2])
    if gap > LARGEST_GAP or step > LARGEST_STEP:
        where = f"the rotation of {part} by {gap:.2f} rad" if gap > LARGEST_GAP else f"the root height by {step:.2f} m"
        raise InputError(f"{source}: does not end as it begins ({where}): set looping: false or cut it to whole cycles")

    count = max(1, min(round(CLOSING_TIME * fps), len(qpos) - 1))
    time = np.arange(1, count + 1) / count
    weight = time * time * (3 - 2 * time)
    out = np.array(qpos)
    out[-count:, 2] += weight * (goal[2] - qpos[-1, 2])
    for _, columns in _QUATERNIONS:
        error = rotations.to_exponential_map(rotations.multiply(rotations.conjugate(qpos[-1, columns]), goal[columns]))
        correction = rotations.from_exponential_map(weight[:, None] * error)
        out[-count:, columns] = rotations.multiply(qpos[-count:, columns], correction)
    for _, column in _HINGES:
        out[-count:, column] += weight * (goal[column] - qpos[-1, column])
    return out
