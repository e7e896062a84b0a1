"""The optimal one-hop transition (Koyama and Goto 2019; docs/onehop.md) to a task's target.

The player of `motion.onehop` plays the table's transition at 60 frames per second: the source for its stay, a blend
into the hop, the hop for its stay, a blend into the target, whose frame k is shown k frames after the trigger. Its
blends put every clip where it fits best, so the target would stand anywhere. A task asks for a place and a heading: the
rigid motion about the vertical that is missing is crossed over the whole transition, ease-in-ease-out (as games do it,
under the name of motion warping). What that costs in foot skate counts.
"""

from functools import lru_cache

import numpy as np

from motion import rotations
from motion.baselines.poses import blend, ease
from motion.baselines.scene import make_scene
from motion.errors import InputError

FPS = 60.0  # of the table


def one_hop(states, task, fps=30, placement=None):
    """Poses (T, 47) of the transition; see `motion.baselines`."""
    scene = make_scene(states, task, placement)
    clips, table = tables(tuple(states))
    source, target = states.index(scene.source), states.index(scene.target)
    # looping clips were resampled to a whole number of frames
    rate_a, rate_b = clips.clips[source].fps, clips.clips[target].fps
    frame = min(int(scene.moment * rate_a + 1e-6), clips.clips[source].frames - 1)
    played, arrival = _played(clips, table, source, frame, target)
    times = np.arange(int(np.ceil(arrival / FPS * fps - 1e-9)) + 1) / fps
    # played[0] is the source's frame at or before the moment, played[1 + k] shows the target's frame k, if at all
    first, last = scene.moment * rate_a - frame, 1 + times[-1] * rate_b
    at = first + times / times[-1] * (last - first)
    low = at.astype(np.int64)
    poses = blend(played[low], played[low + 1], at - low)
    begin, end = scene.source_poses([0.0])[0], scene.target_poses(times[-1:])[0]
    poses = _warped(poses, poses[0], begin, np.ones(len(times)))
    poses = _warped(poses, poses[-1], end, ease(times / times[-1]))
    # exact where resampling, and the player's share of 1/300 in its first frame, are not
    poses[0], poses[-1] = begin, end
    return poses


@lru_cache(maxsize=2)
def tables(states):
    """(ClipSet, LookupTable) of all pairs of states (a tuple) at 60 frames per second; InputError if there is none."""
    from motion.onehop.clips import ClipSet
    from motion.onehop.search import SearchConfig, build

    late = [state.name for state in states if state.start > 0]
    if late:
        raise InputError(f"one_hop: enters clips at frame 0, {late[0]} starts later; cut it at its start point")
    clips = ClipSet.from_clips([state.clip for state in states], fps=FPS)
    return clips, build(clips, "all", SearchConfig())


def _played(clips, table, source, frame, target):
    """(poses (n, 47) that the player shows from frame `frame` of `source` on, the trigger in the second; frames from
    the trigger until the target is shown alone)."""
    from motion.onehop.legs import arrival
    from motion.onehop.player import Player

    player = Player(clips, table, source, frame)
    poses = [player.step()]
    player.trigger(target)
    arrived = arrival(clips, player.playing)
    # to the next frame of the slowest output, and one more for rounding
    poses += [player.step() for _ in range(arrived + round(FPS))]
    return np.array(poses), arrived


def _warped(poses, start, end, share):
    """Poses (n, 47) after `share` (n,) of the rigid motion about the vertical that takes pose `start` to `end`.

    The turn is about the world's origin, where the transition begins.
    """
    turn = rotations.heading(end[3:7]) - rotations.heading(start[3:7])
    turn = (turn + np.pi) % (2 * np.pi) - np.pi
    shift = end[:2] - rotations.rotate(rotations.about_z(turn), start[:3])[:2]
    quaternion, out = rotations.about_z(share * turn), poses.copy()
    out[:, :3] = rotations.rotate(quaternion, poses[:, :3])
    out[:, :2] += share[:, None] * shift
    out[:, 3:7] = rotations.multiply(quaternion, poses[:, 3:7])
    return out
