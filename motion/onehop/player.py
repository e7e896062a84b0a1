"""Plays a character at run time: clips, and the transitions of a lookup table between them.

    player = Player(clips, table, "idle")
    player.trigger("stab")          # a button was pressed: before any step
    pose = player.step()            # once a frame: qpos (47,) in the world

**What is triggered.** The trigger frame t is the frame that the next `step` would have shown. The transition that the
table holds for it is played as it was scored: the source for s_s more frames, b frames of blend into the hop, the hop
alone for s_h frames, b frames of blend into the destination. Each blend places its second clip by the rigid motion
about the vertical that `alignment.align` found for the two windows, so the mean squared distance between both clips, as
played, is the D that was scored.

**What a trigger does while a transition runs.** A blend is never cut short. While one clip is played alone (in the
source's stay or the hop's), the character is in a frame of that clip like any other, so the transition is planned anew
from there: the table's optimum for that clip and frame. That keeps continuity with nothing to tune. During a blend the
trigger waits until the blend has ended; a later trigger replaces it. From a hop only a feasible entry of the table is
taken, and in the `fixed` regime none (a hop is not in step with the music that the offsets stand for): else the trigger
waits until the running transition has arrived. The trigger of the destination that is under way changes nothing.

**Where the table holds no transition** (no candidate, or the pair was not built), the direct one is played, as the
papers' baseline does it: the blend into the destination begins at once. `notice` says so.

**Ends.** A looping clip goes on rigidly over its seam, by its displacement and turn over a cycle; a clip that does not
loop holds its last pose.
"""

import time
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from motion.errors import InputError
from motion.onehop import blend
from motion.onehop.legs import Leg, align_legs, direct, legs_of


class Lane(NamedTuple):
    """A clip's share in what one step shows. leg: index in `Player.playing`. pose: (47,) in the world."""

    leg: int
    clip: int
    frame: int
    share: float
    pose: np.ndarray


class Player:
    """One character. Not for several threads at once; many players may share clips and table.

    notice: "" or what became of the last trigger, if it was not simply played: waits, or no entry in the table.
    """

    def __init__(self, clips, table, state, frame=0, place=(0.0, 0.0, 0.0)):
        """Plays clip `state` (name) from `frame`; place: yaw (rad), x, y (m) of the clip's own frame in the world."""
        self.clips, self.table, self.notice = clips, table, ""
        self._bank = _bank(clips)
        self._state, self._now = np.zeros(blend.STATE_SIZE, np.int64), np.zeros((2, 3))
        self._waiting = None
        index = clips.index(state)
        if not 0 <= frame < clips.clips[index].frames:
            raise InputError(f"{state}: has no frame {frame}; give one of 0 .. {clips.clips[index].frames - 1}")
        self._start([Leg(index, int(frame), None)], np.asarray(place, dtype=np.float64))

    # ------------------------------------------------------------------------------------------------- what is played

    @property
    def clip(self):
        """Name of the clip that is played; during a blend, the one that is blended out."""
        return self.clips.names[self._state[blend.CLIP_A]]

    @property
    def frame(self):
        """Frame of `clip` that the next `step` shows: the trigger frame of a `trigger` now."""
        return int(self._state[blend.FRAME_A])

    @property
    def destination(self):
        """Name of the clip that the running transition leads to, or of the clip that is played for good."""
        return self.clips.names[self._legs[-1, 0]]

    @property
    def arrived(self):
        """Whether the destination is played alone: no transition is running."""
        return self._state[blend.LEG] == len(self._legs) - 1

    @property
    def blending(self):
        """Whether a blend has begun: the last `step` showed a frame of it, and the next one will."""
        return bool(self._state[blend.SHOWN] > 0)

    @property
    def waiting(self):
        """Name of the destination that waits for its trigger to be served, or None."""
        return self._waiting

    @property
    def playing(self):
        """The `Leg`s of the running transition, the source's first; one that is played for good after none."""
        return self._playing

    def lanes(self):
        """The `Lane`s of what the next `step` shows: one clip, or both clips of a blend."""
        self._serve()
        bank, clips, cycles = self._bank
        blend.begin_if_due(clips, cycles, self._legs, self._places, self._state, self._now)
        poses = np.empty((2, bank.shape[1]))
        leg, _, shown, clip_a, frame_a, clip_b, frame_b = self._state.tolist()
        for lane in range(1 + (shown != blend.NOT_BLENDING)):
            blend.show(bank, clips, self._now, self._state, lane, poses[lane])
        if shown == blend.NOT_BLENDING:
            return [Lane(leg, clip_a, frame_a, 1.0, poses[0])]
        share = blend.weight(shown, self._playing[leg + 1].blend)
        return [Lane(leg, clip_a, frame_a, 1 - share, poses[0]), Lane(leg + 1, clip_b, frame_b, share, poses[1])]

    def step(self):
        """The pose (47,) of this frame in the world, a new array; the player moves on by one frame of `clips.fps`."""
        if self._waiting is not None:
            self._serve()
        return blend.step(*self._bank, self._legs, self._places, self._state, self._now)

    # ---------------------------------------------------------------------------------------------------- transitions

    def trigger(self, destination):
        """Asks for a transition to the clip `destination` (name) now; InputError if there is no such clip.

        Returns the table's `Transition`, which is played if it is feasible, else directly. None: the pair is not in the
        table, or the trigger waits or is under way already. `notice` says what happened.
        """
        destination = self.clips.names[self.clips.index(destination)]
        self.notice, self._waiting = "", None
        if not self.arrived and destination == self.destination:
            self.notice = f"{destination} is already under way"
            return None
        self._waiting = destination
        return self._serve()

    def _serve(self):
        """Plans the transition that waits, where that can be done in this frame."""
        if self._waiting is None:
            return None
        destination, clip = self._waiting, int(self._state[blend.CLIP_A])
        if self.blending:
            self.notice = f"{destination} waits for the end of the blend"
            return None
        in_hop = 0 < self._state[blend.LEG] < len(self._legs) - 1
        found = None if in_hop and self.table.config.regime == "fixed" else self._query(clip, destination)
        playable = found is not None and found.feasible
        if in_hop and not playable:
            self.notice = f"{destination} waits until {self.destination} is reached: no transition from here"
            return None
        self._waiting, self.notice = None, ""
        if not playable:
            self.notice = f"no transition from {self.clip}, frame {self.frame}, to {destination}: played directly"
        if found is None:
            legs = direct(self.clips, self.table.config, clip, self.frame, self.clips.index(destination))
        else:
            legs = legs_of(self.clips, clip, self.frame, found.blends)
        self._start(legs, self._now[0])
        return found

    def play(self, legs):
        """Plays `legs` from this frame on; the first one must be that of the running clip and its frame.

        For other transitions than the table's, e.g. `direct(...)`. Not during a blend.
        """
        if self.blending or legs[0][:2] != (self._state[blend.CLIP_A], self._state[blend.FRAME_A]):
            raise ValueError("the first leg must go on where the player stands, outside of a blend")
        self._waiting, self.notice = None, ""
        self._start(list(legs), self._now[0])

    def _query(self, clip, destination):
        """The table's entry, or None where it has none for the pair."""
        pair = (clip, self.clips.index(destination))
        return self.table.query(*pair, self.frame) if pair in self.table.pairs else None

    def _start(self, legs, place):
        """Plays `legs` from now on, the first one placed at `place` (3,), which is that of its frame's own cycle."""
        _, clips, cycles = self._bank
        self._playing = tuple(legs)
        stays = (blend.FOREVER if leg.stay is None else leg.stay for leg in legs)
        self._legs = np.array([(leg.clip, leg.first, stay, leg.blend) for leg, stay in zip(legs, stays)], np.int64)
        self._places = np.empty((len(legs), 3))
        self._places[0] = place
        for k, (_, motion) in enumerate(align_legs(self.clips, legs, self.table.config)):
            blend.compose(self._places[k], np.array([motion.yaw, motion.x, motion.y]), self._places[k + 1])
        self._state[:] = 0
        self._now[0] = self._places[0]
        self._state[blend.CLIP_A] = legs[0].clip
        self._state[blend.FRAME_A] = blend.enter(clips[legs[0].clip], cycles[legs[0].clip], legs[0].first, self._now[0])
        self._state[blend.LEFT] = self._legs[0, 2]
        self._state[blend.SHOWN] = blend.NOT_BLENDING


@lru_cache(maxsize=8)
def _bank(clips):
    """(bank, clips, cycles) of `blend.step` for a ClipSet."""
    lengths = np.array([clip.frames for clip in clips.clips])
    table = np.stack([np.cumsum(lengths) - lengths, lengths, [clip.looping for clip in clips.clips]], axis=1)
    return np.concatenate([clip.qpos for clip in clips.clips]), table, np.asarray(clips.cycles)


def measure_step(clips, table, transitions=1000):
    """Seconds per `Player.step` of one character within blends, which cost twice what a clip alone does.

    The median over `transitions` direct transitions of their mean step, warm, without the triggers: on a busy machine
    some of them are interrupted.
    """
    length = table.config.blend
    legs = direct(clips, table.config, 0, 0, len(clips) - 1)
    spent = []
    for _ in range(transitions + 1):
        player = Player(clips, table, 0)
        player.play(legs)
        start = time.perf_counter()
        for _ in range(length):
            player.step()
        spent.append((time.perf_counter() - start) / length)
    return float(np.median(spent[1:]))  # the first one may compile
