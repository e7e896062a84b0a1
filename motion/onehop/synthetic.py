"""Long clips made of the built-in ones, so that the search can be timed at the paper's size without any data."""

import numpy as np

from motion import builtin, rotations, skeleton
from motion.clip import Clip
from motion.onehop.clips import ClipSet

SWAY = 0.05  # rad; amplitude of the slow change that makes no two clips alike


def clips_of_length(count=20, seconds=20.0, fps=60.0, seed=0):
    """ClipSet of `count` clips of `seconds` s that do not loop: built-in clips one after the other, slightly varied.

    Each piece goes on where the last one ended; every joint sways slowly by up to SWAY. A function of its arguments.
    """
    frames = int(round(seconds * fps))
    return ClipSet.from_clips(
        [_clip(f"clip{i:02d}", frames, fps, np.random.default_rng([seed, i])) for i in range(count)]
    )


def _clip(name, frames, fps, rng):
    pieces, total = [], 0
    while total < frames:
        clip = builtin.load(builtin.NAMES[rng.integers(len(builtin.NAMES))]).resample(fps)
        piece = np.array(clip.qpos[:-1])
        if pieces:
            last = pieces[-1][-1]
            turn = rotations.about_z(rotations.heading(last[3:7]) - rotations.heading(piece[0, 3:7]))
            root = piece[:, :3] - piece[0, :3] * [1, 1, 0]
            piece[:, :3] = rotations.rotate(turn, root) + last[:3] * [1, 1, 0]
            piece[:, 3:7] = rotations.multiply(turn, piece[:, 3:7])
        pieces.append(piece)
        total += len(piece)
    qpos = np.concatenate(pieces)[:frames]
    rate, phase = rng.uniform(0.1, 0.5, skeleton.NUM_DOF), rng.uniform(0, 2 * np.pi, skeleton.NUM_DOF)
    sway = SWAY * np.sin(2 * np.pi * np.arange(frames)[:, None] / fps * rate + phase)
    joints = skeleton.joint_coordinates(qpos) + sway
    return Clip.from_poses(name, skeleton.assemble_qpos(qpos[:, :3], qpos[:, 3:7], joints), fps)
