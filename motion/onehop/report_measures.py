"""A played transition, and what it does to feet and root."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from motion import skeleton
from motion.measures import horizontal_speed, velocity_change
from motion.onehop.legs import arrival
from motion.onehop.player import Player

BEFORE, AFTER = 0.25, 0.4  # s that are played before the trigger and after the arrival
JUMP_TIME = 0.1  # s; shorter measures the capture's jitter, longer what the clips themselves do


@dataclass(frozen=True, eq=False)
class Played:
    """A transition as the player played it.

    poses: (N, 47). share: (N, K), each leg's share in each frame, rows add up to 1. gap: (N, 3) m, from the root of the
    clip that is blended out to that of the one that comes in, 0 outside of blends. planted: (N, 2), right and left.
    time: (N,) s, 0 at the trigger. legs: K `legs.Leg`s. names: (K,) clips. fps. arrival: s, from when on only the
    destination is shown (`legs.arrival`).
    """

    poses: np.ndarray
    share: np.ndarray
    gap: np.ndarray
    planted: np.ndarray
    time: np.ndarray
    legs: tuple
    names: tuple
    fps: float
    arrival: float

    @property
    def blending(self):
        """(N,) whether a frame shows two clips."""
        return np.count_nonzero(self.share, axis=1) > 1


@lru_cache(maxsize=256)
def contacts(clip):
    """`Clip.contacts` (T, 2), kept: it takes forward kinematics of the whole clip."""
    return clip.contacts()


def play(clips, table, source, frame, destination, legs=None, until=0.0):
    """The `Played` transition triggered in frame `frame` of clip `source` (names); legs: play these, not the table's.

    It goes on to AFTER seconds past its arrival, at least to `until` seconds after the trigger.
    """
    clip = clips.clips[clips.names.index(source)]
    lead = round(BEFORE * clips.fps)
    lead = lead if clip.looping else min(frame, lead)
    start = (frame - lead) % (clip.frames - 1) if clip.looping else frame - lead
    player = Player(clips, table, source, start)
    rows, end = [], None
    for k in range(100_000):
        if k == lead:
            player.trigger(destination) if legs is None else player.play(legs)
            played = player.playing
        rows.append((player.lanes(), player.step()))
        if k >= lead and end is None and player.arrived:
            end = max(k + 1 + round(AFTER * clips.fps), lead + round(until * clips.fps))
        if end is not None and k >= end:
            break
    share, planted = np.zeros((len(rows), len(played))), np.zeros((len(rows), 2), bool)
    for row, marks, (lanes, _) in zip(share, planted, rows):
        for lane in lanes:
            row[lane.leg] = lane.share
        most = max(lanes, key=lambda lane: lane.share)
        marks[:] = contacts(clips.clips[most.clip])[most.frame]
    return Played(
        poses=np.array([pose for _, pose in rows]),
        share=share,
        gap=np.array([lanes[-1].pose[:3] - lanes[0].pose[:3] for lanes, _ in rows]),
        planted=planted,
        time=(np.arange(len(rows)) - lead) / clips.fps,
        legs=tuple(played),
        names=tuple(clips.names[leg.clip] for leg in played),
        fps=clips.fps,
        arrival=arrival(clips, played) / clips.fps,
    )


def foot_speed(played):
    """(N - 1, 2) horizontal speed (m/s) of right and left ankle from each frame to the next; NaN where not planted.

    A foot is planted where the clip with the larger share says so (`Clip.contacts`) at both frames.
    """
    position = skeleton.forward_kinematics(played.poses)[0][:, skeleton.FOOT_BODIES]
    speed = horizontal_speed(position, played.fps)
    return np.where(played.planted[1:] & played.planted[:-1], speed, np.nan)


def foot_skate(played):
    """(mean speed of planted feet in the blends, m/s; how far they slide there in all, m). Zeros if none is planted."""
    speed = foot_speed(played)[played.blending[1:]]
    if not np.isfinite(speed).any():
        return 0.0, 0.0
    return float(np.nanmean(speed)), float(np.nansum(speed) / played.fps)


def root_jump(played):
    """Largest change (m/s) of the root's velocity between frames JUMP_TIME apart that touch a blend."""
    apart = max(1, round(JUMP_TIME * played.fps))
    change = velocity_change(played.poses[:, :3], played.fps, apart)
    touched = np.flatnonzero(played.blending)
    first, last = max(0, touched[0] - apart), min(len(change), touched[-1] + 1)
    return float(change[first:last].max())


def root_added(played):
    """Largest speed (m/s) of the root that comes from neither clip: how fast the crossfade crosses their distance.

    The root is at (1 - s) a + s b, so its velocity is that mix of the clips' velocities, and s' (b - a).
    """
    change = np.abs(np.diff(played.share, axis=0)).max(axis=1)
    return float((change * np.linalg.norm(played.gap[1:], axis=-1)).max() * played.fps)
