"""Stick figures of the sword & shield skeleton as lines, without any drawing library."""

import numpy as np

from motion import rotations, skeleton

# in the frames of their bodies, m
NECK, HEAD_TOP, HEAD_RADIUS = (0.0, 0.0, 0.2239), (0.0, 0.0, 0.175), 0.1025
NOSE = ((0.09, 0.0, 0.175), (0.17, 0.0, 0.175))
FOOT = ((-0.04, 0.0, -0.045), (0.13, 0.0, -0.045))  # heel and toe
SWORD, SHIELD_RADIUS = ((0.0, 0.0, 0.0), (1.04, 0.0, 0.0)), 0.3
PARTS = ("trunk", "right", "left", "sword", "shield")


def projector(azimuth, elevation):
    """Function from world points (..., 3) to picture coordinates (..., 2), parallel projection; degrees."""
    a, e = np.radians([azimuth, elevation])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    up = np.array([-np.sin(e) * np.cos(a), -np.sin(e) * np.sin(a), np.cos(e)])
    return lambda points: np.asarray(points) @ np.stack([right, up], axis=-1)


def strokes(qpos):
    """Lines of one pose (47,) in the world, m: {part: [points (n, 3), ...]}, and the head's centre (3,)."""
    position, rotation = skeleton.forward_kinematics(np.asarray(qpos))

    def at(name):
        return position[skeleton.BODY_INDEX[name]]

    def local(name, points):
        return at(name) + rotations.rotate(rotation[skeleton.BODY_INDEX[name]], np.asarray(points, dtype=np.float64))

    neck, turn = local("torso", NECK), np.linspace(0, 2 * np.pi, 17)
    circle = np.stack([np.cos(turn), 0 * turn, np.sin(turn)], axis=-1)
    out = {"trunk": [np.array([at("pelvis"), at("torso"), neck]), local("head", NOSE)]}
    for side in ("right", "left"):
        leg = [at(f"{side}_{part}") for part in ("thigh", "shin", "foot")]
        arm = [at(f"{side}_{part}") for part in ("upper_arm", "lower_arm", "hand")]
        heel, toe = local(f"{side}_foot", FOOT)
        out[side] = [np.array([at("pelvis"), *leg, toe, heel, leg[-1]]), np.array([neck, *arm])]
    out["sword"] = [local("right_hand", SWORD)]
    out["shield"] = [local("shield", SHIELD_RADIUS * circle)]
    return out, local("head", HEAD_TOP)


def flat_strokes(poses, view, offsets):
    """{part: (n, 2)} of poses (m, 47) seen by `view`, each moved by its row of `offsets` (m, 2) in the picture.

    All lines of a part are one array with rows of NaN between them, which drawing libraries read as gaps: a strip of
    figures is then a handful of paths.
    """
    out = {part: [] for part in PARTS}
    gap, turn = np.full((1, 2), np.nan), np.linspace(0, 2 * np.pi, 17)
    circle = HEAD_RADIUS * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    for pose, offset in zip(poses, offsets):
        parts, head = strokes(pose)
        out["trunk"] += [view(head) + circle + offset, gap]
        for part, lines in parts.items():
            for line in lines:
                out[part] += [view(line) + offset, gap]
    return {part: np.concatenate(lines) for part, lines in out.items()}
