"""Two-bone inverse kinematics of legs and arms, in closed form."""

import numpy as np

from motion import rotations, skeleton
from motion.builtin import frames

THIGH, SHIN = 0.421546, 0.40987
UPPER_ARM, FOREARM = 0.274788, 0.258947
LEG_REACH = (0.30, 0.999 * (THIGH + SHIN))
ARM_REACH = (0.275, 0.985 * (UPPER_ARM + FOREARM))  # elbow flexion 0.35..2.06 rad


def two_bones(start, end, bend, first, second, reach):
    """A limb of bones `first`, `second` (m) from `start` to `end` (..., 3), its middle joint towards `bend` (..., 3).

    Returns the upper bone's direction (..., 3), the direction at right angles to the limb that the middle joint moves
    in (..., 3) and the bend angle (...,) >= 0. The distance is held within `reach` (m), so that the limb never locks.
    """
    line = end - start
    distance = np.clip(np.linalg.norm(line, axis=-1), *reach)
    line = frames.unit(line)
    out = frames.across(bend, line)
    cosine = (distance**2 - first**2 - second**2) / (2 * first * second)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    lean = np.arctan2(second * np.sin(angle), first + second * np.cos(angle))[..., None]
    bone = np.cos(lean) * line + np.sin(lean) * out
    return bone, out, angle


def leg(pelvis, pelvis_rotation, side, ankle, foot_rotation):
    """Hip (N, 4), knee (N,) and ankle (N, 4) local rotations that put a foot in place.

    pelvis (N, 3), pelvis_rotation (N, 4): the root; side: "right" or "left"; ankle (N, 3), foot_rotation (N, 4): world
    pose of the foot. The knee points between the pelvis's and the foot's forward.
    """
    offset = skeleton.OFFSETS[skeleton.BODY_INDEX[f"{side}_thigh"]]
    hip = pelvis + rotations.rotate(pelvis_rotation, offset)
    yaw = rotations.heading(foot_rotation)
    toward = rotations.rotate(pelvis_rotation, [1.0, 0.0, 0.0]) + np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw], axis=-1)
    bone, out, knee = two_bones(hip, ankle, toward, THIGH, SHIN, LEG_REACH)
    axis = np.cross(out, frames.unit(ankle - hip))  # y: with z up and x forward, the knee folds the shin back
    thigh = frames.from_axes(axis, -bone)
    shin = rotations.multiply(thigh, rotations.about_y(knee))
    return (
        rotations.multiply(rotations.conjugate(pelvis_rotation), thigh),
        knee,
        rotations.multiply(rotations.conjugate(shin), foot_rotation),
    )


def arm(torso, torso_rotation, side, hand, elbow):
    """Shoulder local rotation (..., 4), elbow angle (...,) <= 0 and forearm world rotation (..., 4) for a hand.

    torso (..., 3), torso_rotation (..., 4): the torso's world pose; hand (..., 3): the wrist; elbow (..., 3): where the
    elbow points.
    """
    offset = skeleton.OFFSETS[skeleton.BODY_INDEX[f"{side}_upper_arm"]]
    shoulder = torso + rotations.rotate(torso_rotation, offset)
    bone, out, flexion = two_bones(shoulder, hand, elbow, UPPER_ARM, FOREARM, ARM_REACH)
    axis = np.cross(frames.unit(hand - shoulder), out)
    upper = frames.from_axes(axis, -bone)
    forearm = rotations.multiply(upper, rotations.about_y(-flexion))
    return rotations.multiply(rotations.conjugate(torso_rotation), upper), -flexion, forearm
