"""Transitions as the clips to be played in turn, and where each of them is put on the ground."""

from typing import NamedTuple

import numpy as np

from motion.onehop.alignment import align
from motion.onehop.types import Blend


class Leg(NamedTuple):
    """A clip's part in a transition: `blend` frames in which it is blended in, beginning with the clip's (unwrapped)
    frame `first`, then `stay` frames in which it is played alone (None: for good). clip: index."""

    clip: int
    first: int
    stay: int | None
    blend: int = 0


def legs_of(clips, source, frame, blends):
    """The `Leg`s of a trigger in `frame` of clip `source` (index), by the `types.Blend`s of its transition."""
    ends = [0] + [blend.time + blend.length for blend in blends]
    stays = [blend.time - end for blend, end in zip(blends, ends)] + [None]
    legs = [Leg(source, int(frame), int(stays[0]))]
    return legs + [Leg(b.clip, _entry(clips, b), stay, b.length) for b, stay in zip(blends, stays[1:])]


def _entry(clips, blend):
    """The clip's first frame in a blend: in the first cycle of a looping clip (the same poses, moved rigidly), inside
    any other (only a direct transition that is no candidate would begin outside)."""
    if clips.looping(blend.clip):
        return clips.wrap(blend.clip, blend.frame)
    return min(max(int(blend.frame), 0), clips.frames(blend.clip) - 1)


def direct(clips, config, source, frame, destination):
    """The `Leg`s of the direct transition of a pair (indices) that is not in the table: the blend enters at frame 0.

    That is the `start` regime's direct transition; in `fixed` such a pair has no offset that would say otherwise.
    """
    return legs_of(clips, source, frame, (Blend(0, destination, 0, config.blend),))


def window(clips, clip, first, count):
    """Body points (count, P, 3) of frames first .. first + count - 1; a clip that does not loop holds its last pose."""
    last = clips.frames(clip) - 1
    if clips.looping(clip) or first + count - 1 <= last:
        return clips.window_points(clip, first, count)
    return np.concatenate([clips.window_points(clip, min(k, last), 1) for k in range(first, first + count)])


def align_legs(clips, legs, config):
    """[(D, Alignment)] of every leg's blend: both windows, and the rigid motion of the leg against the one before."""
    out = []
    for leg, following in zip(legs, legs[1:]):
        first = leg.first + leg.blend + leg.stay
        windows = [window(clips, *at, following.blend) for at in ((leg.clip, first), following[:2])]
        weights = np.outer(config.frame_weights_of(following.blend), config.points)
        out.append(align(*windows, weights))
    return out


def arrival(clips, legs):
    """Frames from the trigger until nothing but the destination is shown, from the legs of a whole transition.

    A hop that is the destination in step with itself counts as it: then the last blend mixes equal poses. That is how
    the direct transition is found among those with a hop.
    """
    last = len(legs) - 1
    while last > 1 and _in_step(clips, legs[last - 1], legs[last]):
        last -= 1
    return sum(leg.blend + leg.stay for leg in legs[:last]) + legs[last].blend


def _in_step(clips, leg, following):
    shift = leg.first + leg.blend + leg.stay - following.first
    return leg.clip == following.clip and (shift % clips.period(leg.clip) if clips.looping(leg.clip) else shift) == 0
