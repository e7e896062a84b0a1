"""The paper's baseline (section 4.2): ease-in-ease-out cubic blend with time warping, 12 frames.

Blended are the next 0.4 s of the source clip and the first 0.4 s of the target clip, in full or, where a clip that does
not loop ends before, what is left of it, stretched. The time warp (Bruderlin and Williams 1995, "Motion signal
processing", section 4.2: dynamic programming over the frames of both) pairs moments of both parts in which the bodies
are posed alike, and keeps each part's speed between 2/3 and 4/3 of its own. First and last frames are paired.
"""

import numpy as np

from motion import rotations, skeleton
from motion.baselines.poses import blend, ease, frames_of
from motion.baselines.scene import make_scene

DURATION = 0.4  # s, the paper's 12 frames at 30 per second
_STEPS = ((1, 1), (1, 2), (2, 1))  # no part stands still, as it would with (0, 1)
_SMOOTHINGS = 4  # passes of a binomial filter


def interpolation(states, task, fps=30, placement=None):
    """Poses (T, 47) of the transition; see `motion.baselines`."""
    scene, times = make_scene(states, task, placement), frames_of(DURATION, fps)
    share = times / times[-1]
    source = scene.source_poses(share * _left(scene.source.clip, scene.moment, times[-1]))
    target = scene.target_poses(share * _left(scene.target.clip, scene.target.start, times[-1]))
    first, second = warp(distances(source, target))
    return blend(_at(source, first), _at(target, second), ease(share))


def _left(clip, time, duration):
    """Seconds of the clip that can be played from `time` on, at most `duration`."""
    return duration if clip.looping else min(duration, clip.duration - time)


def distances(a, b):
    """(n, m) mean squared distance (m^2) of the bodies of poses a (n, 47) and b (m, 47), each in its heading frame."""
    points_a, points_b = _own_frame(a), _own_frame(b)
    return ((points_a[:, None] - points_b[None]) ** 2).sum(-1).mean(-1)


def _own_frame(qpos):
    position, _ = skeleton.forward_kinematics(qpos)
    turn = rotations.about_z(-rotations.heading(qpos[:, 3:7]))
    return rotations.rotate(turn[:, None], position - qpos[:, None, :3] * [1, 1, 0])


def warp(cost):
    """(2, n) frame numbers, not whole, that belong together, of cost (n, n); both rows run from 0 to n - 1.

    The pairs of `path` are read off at equal distances of the mean of both frame numbers, so that each part plays at
    2/3 to 4/3 of its speed, and smoothed, so that this speed does not change from frame to frame.
    """
    pairs = path(cost).astype(np.float64)
    middle, wanted = pairs.mean(axis=1), np.arange(len(cost))
    out = np.array([np.interp(wanted, middle, part) for part in pairs.T])
    for _ in range(_SMOOTHINGS):
        out[:, 1:-1] = (out[:, :-2] + 2 * out[:, 1:-1] + out[:, 2:]) / 4
    return out


def path(cost):
    """(m, 2) frames that belong together, by dynamic programming: from corner to corner of cost (n, n) in `_STEPS`, for
    the least sum of the costs of the frames that are stepped to, each times the step's length."""
    count = len(cost)
    total, back = np.full((count, count), np.inf), {}
    total[0, 0] = 0.0
    for i in range(1, count):
        for j in range(1, count):
            for step in _STEPS:
                k, m = i - step[0], j - step[1]
                # a long step pays for the time that it covers, else two of them would be cheaper than three short ones
                if k >= 0 and m >= 0 and total[k, m] + cost[i, j] * sum(step) / 2 < total[i, j]:
                    total[i, j], back[i, j] = total[k, m] + cost[i, j] * sum(step) / 2, (k, m)
    pairs = [(count - 1, count - 1)]
    while pairs[-1] in back:
        pairs.append(back[pairs[-1]])
    return np.array(pairs[::-1])


def _at(qpos, frames):
    """Poses (n, 47) between the frames of qpos."""
    low = np.minimum(frames.astype(np.int64), len(qpos) - 2)
    return blend(qpos[low], qpos[low + 1], frames - low)
