"""Clips prepared for the search: one frame rate, world points, and motion that goes on across a loop's seam."""

from dataclasses import dataclass, replace

import numpy as np

from motion import rotations, skeleton
from motion.errors import InputError

# relative; a looping clip's rate is adjusted to a whole number of frames when it is resampled
RATE_TOLERANCE = 0.02


@dataclass(frozen=True, eq=False)
class ClipSet:
    """Clips of one frame rate. Make one with `ClipSet.from_clips`, which checks its input.

    A looping clip's last frame is its first one moved by the cycle's displacement, so it has `period` = frames - 1
    different frames; any integer is a frame of it, continued rigidly (turned and moved by whole cycles).

    points: per clip (F, P, 3) world positions, m. cycles: per clip (3,) yaw (rad), x, y (m) of one cycle: a point p
    of one cycle is at R(yaw) p + (x, y) in the next; zeros for clips that do not loop.
    beats: per clip sorted frames of its beats, or None. genres: per clip a word, or None.
    """

    clips: tuple
    fps: float
    points: tuple
    cycles: np.ndarray
    beats: tuple | None = None
    genres: tuple | None = None

    @classmethod
    def from_clips(cls, clips, fps=None, beats=None, genres=None):
        """A ClipSet of `motion.clip.Clip`s. fps: resample all to this rate; None keeps the one that they share.

        beats: None, or per clip a list of beat times in seconds. genres: None, or per clip a word.
        Raises InputError (naming the clip and the remedy) for no clips, repeated names, rates that differ, another
        skeleton, NaN, a beat outside its clip.
        """
        clips = tuple(clips)
        if not clips:
            raise InputError("clips: there are none; give at least one clip")
        names = [clip.name for clip in clips]
        for name in names:
            if names.count(name) > 1:
                raise InputError(f"{name}: two clips have this name; rename one of them")
        for clip in clips:
            _check(clip)
        if fps is not None:
            clips = tuple(clip if _same_rate(clip.fps, fps, 1e-9) else clip.resample(fps) for clip in clips)
        rate = float(fps if fps is not None else clips[0].fps)
        for clip in clips:
            if not _same_rate(clip.fps, rate, RATE_TOLERANCE if fps is not None and clip.looping else 1e-4):
                hint = "it is too short to loop at that rate" if fps is not None else "give fps=60 to resample all"
                raise InputError(f"{clip.name}: has {clip.fps:g} frames per second, the others {rate:g}; {hint}")
        points = tuple(np.ascontiguousarray(clip.bodies[0]) for clip in clips)
        for array in points:
            array.flags.writeable = False
        cycles = np.array([_cycle(clip) if clip.looping else (0.0, 0.0, 0.0) for clip in clips])
        return cls(clips, rate, points, cycles, _beats(clips, rate, beats), _genres(clips, genres))

    def __len__(self):
        return len(self.clips)

    @property
    def names(self):
        return tuple(clip.name for clip in self.clips)

    @property
    def hashes(self):
        """Content hash of every clip, as `motion.clip.Clip.content_hash`."""
        return tuple(clip.content_hash for clip in self.clips)

    def index(self, name):
        """Index of the clip called `name` (or of an index itself). Raises InputError for an unknown one."""
        if isinstance(name, (int, np.integer)):
            if not 0 <= name < len(self.clips):
                raise InputError(f"clip {name}: there are only clips 0..{len(self.clips) - 1}")
            return int(name)
        if name not in self.names:
            raise InputError(f"no clip is called {name!r}; give one of {', '.join(self.names)}")
        return self.names.index(name)

    def looping(self, i):
        return self.clips[i].looping

    def frames(self, i):
        """Number of frames of the clip (its last one repeats the first if it loops)."""
        return self.clips[i].frames

    def period(self, i):
        """Number of different frames: frames - 1 for a looping clip, else frames. Trigger frames are 0..period - 1."""
        return self.clips[i].frames - self.clips[i].looping

    def windows(self, i, length):
        """Number of windows of `length` frames: their first frames are 0..windows - 1 (modulo it, if it loops)."""
        return self.period(i) if self.clips[i].looping else max(0, self.clips[i].frames - length + 1)

    def wrap(self, i, frame):
        """`frame` modulo the period of a looping clip; unchanged for the others."""
        return int(frame) % self.period(i) if self.clips[i].looping else int(frame)

    def cycle_motion(self, i, count):
        """yaw (rad), x, y (m) of `count` (any integer) cycles of looping clip i."""
        yaw, x, y = self.cycles[i]
        turn, shift = np.exp(1j * yaw), complex(x, y)
        if count < 0:
            yaw, shift, turn, count = -yaw, -shift / turn, 1 / turn, -count
        total = shift * np.sum(turn ** np.arange(count)) if count else 0j
        return yaw * (count if count else 0), total.real, total.imag

    def window_points(self, i, first, count):
        """World positions (count, P, 3) of frames first..first + count - 1 of clip i, rigid across a loop's seam.

        Raises IndexError for frames outside a clip that does not loop.
        """
        points = self.points[i]
        frames = np.arange(first, first + count)
        if not self.clips[i].looping:
            if first < 0 or first + count > len(points):
                raise IndexError(
                    f"{self.names[i]}: frames {first}..{first + count - 1} lie outside 0..{len(points) - 1}"
                )
            return points[first : first + count]
        cycle, frame = np.divmod(frames, self.period(i))
        out = points[frame]
        for k in np.unique(cycle):
            if k:
                yaw, x, y = self.cycle_motion(i, int(k))
                part = out[cycle == k]
                out[cycle == k] = np.stack(
                    [
                        np.cos(yaw) * part[..., 0] - np.sin(yaw) * part[..., 1] + x,
                        np.sin(yaw) * part[..., 0] + np.cos(yaw) * part[..., 1] + y,
                        part[..., 2],
                    ],
                    axis=-1,
                )
        return out

    def root_pose(self, i, frame):
        """Pose qpos (47,) of any frame of a looping clip (continued rigidly), or of frames 0..frames - 1 of another.

        Raises IndexError for a frame outside a clip that does not loop.
        """
        clip = self.clips[i]
        if not clip.looping:
            if not 0 <= frame < clip.frames:
                raise IndexError(f"{clip.name}: frame {frame} lies outside 0..{clip.frames - 1}")
            return np.array(clip.qpos[frame])
        cycle, frame = divmod(int(frame), self.period(i))
        qpos = np.array(clip.qpos[frame])
        if cycle:
            yaw, x, y = self.cycle_motion(i, cycle)
            turn = rotations.about_z(yaw)
            qpos[:3] = rotations.rotate(turn, qpos[:3]) + [x, y, 0]
            qpos[3:7] = rotations.multiply(turn, qpos[3:7])
        return qpos

    def with_annotations(self, beats=None, genres=None):
        """The same clips with beats (s, per clip) and genres (a word per clip)."""
        beats, genres = _beats(self.clips, self.fps, beats), _genres(self.clips, genres)
        return replace(self, beats=beats or self.beats, genres=genres or self.genres)


def _check(clip):
    if clip.qpos.ndim != 2 or clip.qpos.shape[1] != skeleton.NQ:
        raise InputError(f"{clip.name}: poses have shape {clip.qpos.shape}, not (frames, {skeleton.NQ}): retarget it")
    if len(clip.qpos) < 2:
        raise InputError(f"{clip.name}: has {len(clip.qpos)} frame(s); give at least two")
    if not np.isfinite(clip.qpos).all():
        frame = int(np.argwhere(~np.isfinite(clip.qpos))[0][0])
        raise InputError(f"{clip.name}: frame {frame} holds NaN or infinity; export the clip again")


def _same_rate(a, b, tolerance):
    return abs(a - b) <= tolerance * b


def _cycle(clip):
    """yaw, x, y of one cycle: from the first frame's root to the last one's, heading and horizontal position."""
    first, last = clip.qpos[0], clip.qpos[-1]
    yaw = float(rotations.heading(last[3:7]) - rotations.heading(first[3:7]))
    yaw = (yaw + np.pi) % (2 * np.pi) - np.pi
    shift = complex(*last[:2]) - np.exp(1j * yaw) * complex(*first[:2])
    return yaw, shift.real, shift.imag


def _beats(clips, fps, beats):
    if beats is None:
        return None
    if len(beats) != len(clips):
        raise InputError(f"beats: are given for {len(beats)} clips; there are {len(clips)}")
    out = []
    for clip, times in zip(clips, beats):
        frames = np.unique(np.rint(np.asarray(times, dtype=np.float64) * fps).astype(np.int64))
        if len(frames) and not 0 <= frames[0] <= frames[-1] < clip.frames:
            raise InputError(f"{clip.name}: beats lie outside the clip's 0..{clip.duration:.3f} s; give times in it")
        out.append(frames)
    return tuple(out)


def _genres(clips, genres):
    if genres is None:
        return None
    if len(genres) != len(clips):
        raise InputError(f"genres: are given for {len(genres)} clips; there are {len(clips)}")
    return tuple(str(genre) for genre in genres)
