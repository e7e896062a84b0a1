"""What the films show: a source clip up to a moment, the transition, the target clip from there on."""

from dataclasses import dataclass

import numpy as np

from motion import rotations
from motion.skeleton import BODY_NAMES
from orchestrator.report.phases import SOURCE, TARGET, TRANSITION
from workers.types import FELL, REACHED, TIMED_OUT

FPS = 30  # poses per second
BEFORE, AFTER = 0.4, 1.0  # s of the source clip before the transition and of the target clip after it


@dataclass(frozen=True)
class Take:
    """T poses of one transition, FPS a second; the source faces +x when it begins, there above the origin.

    qpos: (T, 47). phase: (T,), SOURCE, TRANSITION or TARGET. time: (T,), s since the transition began.
    target: (47,), the pose that it is to reach, in its place. end: how it ended, in words.
    """

    qpos: np.ndarray
    phase: np.ndarray
    time: np.ndarray
    target: np.ndarray
    end: str

    @property
    def duration(self):
        """Seconds that the transition itself takes."""
        return (np.count_nonzero(self.phase == TRANSITION) - 1) / FPS


def of_policy(scene, motion):
    """The `Take` of a recorded episode, a `replay.Motion`, of a task whose `Scene` is `motion.baselines.make_scene`'s.

    The target's clip goes on from the target pose in its place, so that what the transition missed it by is seen as a
    jump; after a fall or a time-out nothing follows.
    """
    words = {
        REACHED: "reached",
        TIMED_OUT: "out of time",
        FELL: f"fell on {BODY_NAMES[motion.fell_on].replace('_', ' ')}" if motion.fell_on >= 0 else "exploded",
    }
    return _compose(scene, motion.qpos, 0.0, motion.end == REACHED, words[motion.end])


def of_method(scene, qpos):
    """The `Take` of a kinematic transition (M, 47), whose last pose is the target clip's after as many frames."""
    return _compose(scene, qpos, (len(qpos) - 1) / FPS, True, "by construction")


def _compose(scene, middle, played, arrived, words):
    """The `Take` of a transition's poses (M, 47); played: s of the target clip that they hold already."""
    source, target = scene.source.clip, scene.target
    earlier = np.arange(-round(BEFORE * FPS), 0) / FPS
    if not source.looping:
        earlier = earlier[earlier >= -scene.moment]
    later = played + np.arange(1, round(AFTER * FPS) + 1) / FPS
    if not target.clip.looping:
        later = later[target.start + later <= target.clip.duration]
    before = scene.source_poses(earlier)
    before[:, 2] += middle[0][2] - scene.source_poses([0.0])[0][2]  # a task lifts its source out of the floor
    parts = [(SOURCE, before), (TRANSITION, np.asarray(middle))]
    if arrived:
        parts.append((TARGET, scene.target_poses(later)))
    qpos = np.concatenate([poses for _, poses in parts])
    phase = np.concatenate([np.full(len(poses), phase) for phase, poses in parts])
    turn = -rotations.heading(np.asarray(middle)[0, 3:7])
    time = (np.arange(len(qpos)) - len(earlier)) / FPS
    return Take(turned(qpos, turn), phase, time, turned(scene.target_poses([0.0])[0], turn), words)


def turned(qpos, angle):
    """Poses (..., 47) turned about the world's vertical axis by `angle` rad."""
    out, turn = np.array(qpos, dtype=np.float64), rotations.about_z(np.float64(angle))
    out[..., :3] = rotations.rotate(turn, out[..., :3])
    out[..., 3:7] = rotations.multiply(turn, out[..., 3:7])
    return out
