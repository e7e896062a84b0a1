"""Small random clips for the search: few frames, some looping, poses from a small pool so that costs tie."""

import sys
from pathlib import Path

import numpy as np
import pytest

from motion import builtin, skeleton
from motion.clip import Clip
from motion.onehop.clips import ClipSet

sys.path.insert(0, str(Path(__file__).resolve().parent))


def random_clip(rng, name, frames, looping=False, pool=None, spread=0.5, offset=(0.0, 0.0)):
    """A clip of random poses that turns and moves; with `pool`, of `pool` different poses in any order."""
    count = frames if pool is None else pool
    joints = rng.normal(size=(count, skeleton.NUM_DOF)) * spread
    turn = rng.uniform(-np.pi, np.pi, count)
    root = np.concatenate([rng.normal(size=(count, 2)), rng.uniform(0.7, 1.0, (count, 1))], axis=1)
    quaternion = np.stack([np.cos(turn / 2), np.zeros(count), np.zeros(count), np.sin(turn / 2)], axis=1)
    qpos = skeleton.assemble_qpos(root + [*offset, 0], quaternion, joints)
    if pool is not None:
        qpos = qpos[rng.integers(pool, size=frames)]
    return Clip.from_poses(name, qpos, 60.0, looping)


@pytest.fixture(scope="session")
def make_clip():
    return random_clip


@pytest.fixture(scope="session")
def make_set():
    """make_set(seed, count, frames, ties): ClipSet of small random clips, a third of them looping."""

    def make(seed, count=3, frames=(2, 9), ties=False, beats=False, genres=False):
        rng, pool = np.random.default_rng(seed), 2 if ties else None
        clips = [
            random_clip(rng, f"c{i}", int(rng.integers(frames[0], frames[1] + 1)), bool(rng.random() < 1 / 3), pool)
            for i in range(count)
        ]
        times = [
            np.flatnonzero(rng.random(clip.frames) < 0.5) / clip.fps if clip.frames else [] for clip in clips
        ] if beats else None
        words = [str(word) for word in rng.choice(["jazz", "pop"], count)] if genres else None
        return ClipSet.from_clips(clips, beats=times, genres=words)

    return make


@pytest.fixture(scope="session")
def builtin_set():
    """All built-in clips at 60 fps: walking, running and idle loop."""
    return ClipSet.from_clips([builtin.load(name) for name in builtin.NAMES], fps=60)
