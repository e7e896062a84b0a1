"""The plain values of the package: what is searched (`SearchConfig`) and what is found (`Transition`, `Blend`).

Frame bookkeeping, with time in frames from the trigger: the source shows frame t + time. Each blend starts at a time,
in a frame of the clip that it blends into, and lasts `length` frames; afterwards that clip plays alone for its stay.
The destination shows frame time + t - o_sd.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from motion import skeleton
from motion.errors import InputError

START, FIXED = "start", "fixed"


@dataclass(frozen=True)
class SearchConfig:
    """What is searched. Frames unless stated; costs in m^2.

    blend: length b of a blend. max_stay: largest stay s_max. weight: w, m^2 per frame; None is the default weight of
    these clips (`weight.default_weight`). regime: "start" (destination frame 0 at the trigger) or "fixed" (one offset
    o_sd per pair). hops: 1, or 2 for at most two.
    point_weights: (17,) per body, or None for equal ones. frame_weights: (blend,) per frame of a window, or None.
    blends: blend lengths to choose from, instead of `blend` alone; see `blend_scale` for what makes short ones pay.
    blend_power: gamma of `blend_scale`.
    beats: only hops whose beats coincide with those of the clip they follow; needs ClipSet.beats.
    genre_cost: c of the genre term G(i), paid by a hop whose genre is not the destination's; needs ClipSet.genres.
    """

    blend: int = 30
    max_stay: int = 60
    weight: float | None = None
    regime: str = START
    hops: int = 1
    point_weights: tuple | None = None
    frame_weights: tuple | None = None
    blends: tuple | None = None
    blend_power: float = 2.0
    beats: bool = False
    genre_cost: float = 0.0

    @property
    def lengths(self):
        """Blend lengths to choose from, ascending."""
        return (self.blend,) if self.blends is None else tuple(sorted(set(int(b) for b in self.blends)))

    def blend_scale(self, length):
        """Factor of D for a blend of `length` frames, (blend / length)^gamma; 1 for `blend` itself.

        A cross-fade over b frames adds (B - A) / b to the velocity, whose mean square is D / b^2: with gamma = 2 a
        short blend pays for that, while R counts its frames, so that being quick is worth something too.
        """
        return (self.blend / length) ** self.blend_power

    @property
    def points(self):
        """Weights (17,) of the bodies, summing to 1."""
        return _weights("point_weights", self.point_weights, skeleton.NUM_BODIES)

    def frame_weights_of(self, length):
        """Weights (length,) of a window's frames, summing to 1."""
        return _weights("frame_weights", self.frame_weights, length)

    def check(self):
        """Raises InputError, one line with the key and the remedy, for values out of range."""
        if any(length < 1 for length in self.lengths) or not self.lengths or self.blend < 1:
            raise InputError(f"blend: is {self.blends or self.blend}; give at least 1 frame")
        if self.max_stay < 0:
            raise InputError(f"max_stay: is {self.max_stay}; give 0 or more frames")
        if self.weight is not None and not (np.isfinite(self.weight) and self.weight >= 0):
            raise InputError(f"weight: is {self.weight}; give a number >= 0, or none for the default weight")
        if self.regime not in (START, FIXED):
            raise InputError(f"regime: is {self.regime!r}; give {START} or {FIXED}")
        if self.hops not in (1, 2):
            raise InputError(f"hops: is {self.hops}; give 1 or 2")
        if not (np.isfinite(self.genre_cost) and self.genre_cost >= 0):
            raise InputError(f"genre_cost: is {self.genre_cost}; give a number >= 0")
        if self.frame_weights is not None and len(self.lengths) > 1:
            raise InputError("frame_weights: need one blend length; leave out blends or frame_weights")
        self.points  # noqa: B018  (checks)
        for length in self.lengths:
            self.frame_weights_of(length)


def _weights(key, values, count):
    if values is None:
        return np.full(count, 1.0 / count)
    out = np.asarray(values, dtype=np.float64)
    if out.shape != (count,):
        raise InputError(f"{key}: has {out.size} values; give {count}")
    if not np.isfinite(out).all() or (out < 0).any() or out.sum() <= 0:
        raise InputError(f"{key}: give numbers >= 0, at least one above 0")
    return out / out.sum()


@dataclass(frozen=True)
class Blend:
    """One blend: from `time` (frames after the trigger) on, over `length` frames, into `clip` at its frame `frame`."""

    time: int
    clip: int
    frame: int
    length: int


class Transition(NamedTuple):
    """What the table answers for one (source, destination, trigger frame).

    feasible: False where no candidate exists; then the runtime falls back to `direct`. hop: clip index. offset: o_sh =
    (t + s_s) - u. stay_source, stay_hop: s_s, s_h. destination_offset: o_sd. lengths: frames of each blend (2, or 3
    with a second hop; the last is also that of the direct one). second_hop: clip index of a second hop, or -1;
    second_offset: (t + time of its blend) - its first frame; stay_second: its stay. cost: objective S + w R, m^2,
    where the answerer keeps it.
    """

    feasible: bool
    source: int
    destination: int
    frame: int
    hop: int
    offset: int
    stay_source: int
    stay_hop: int
    destination_offset: int
    lengths: tuple
    second_hop: int = -1
    second_offset: int = 0
    stay_second: int = 0
    cost: float | None = None

    @property
    def hop_frame(self):
        """u: the hop's frame at which the first blend starts."""
        return self.frame + self.stay_source - self.offset

    @property
    def stays(self):
        """R without blend lengths: all stays together."""
        return self.stay_source + self.stay_hop + self.stay_second

    @property
    def hops(self):
        """Number of hops: 0 where there is no candidate."""
        return 0 if not self.feasible else 1 + (self.second_hop >= 0)

    @property
    def blends(self):
        """The blends in order, the last into the destination; the direct one alone where there is no candidate."""
        if not self.feasible:
            return self.direct
        out = [Blend(self.stay_source, self.hop, self.hop_frame, self.lengths[0])]
        time = self.stay_source + self.lengths[0] + self.stay_hop
        if self.second_hop >= 0:
            out.append(Blend(time, self.second_hop, self.frame + time - self.second_offset, self.lengths[1]))
            time += self.lengths[1] + self.stay_second
        out.append(Blend(time, self.destination, self.frame + time - self.destination_offset, self.lengths[-1]))
        return tuple(out)

    @property
    def direct(self):
        """The direct approach: one blend at once, into the destination."""
        return (Blend(0, self.destination, self.frame - self.destination_offset, self.lengths[-1]),)

    @property
    def duration(self):
        """Frames from the trigger to the end of the last blend."""
        return self.blends[-1].time + self.blends[-1].length
