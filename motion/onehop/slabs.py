"""Lower bounds of distances between all windows of a ClipSet, by slabs of rows: on all threads, in reused buffers."""

import os
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from motion.errors import InputError
from motion.onehop import kernels
from motion.onehop.distances import BIG, MEMORY, Workspace, fill, pool
from motion.onehop.features import ROWS, Layout, Windows
from motion.onehop.types import START


class Slabs:
    """Features of a ClipSet for a SearchConfig, slabs of distances, and the threads that compute them."""

    def __init__(self, clips, config, threads=None):
        self.clips, self.config = clips, config
        self.threads = max(1, threads or os.cpu_count() or 1)
        lengths = config.lengths
        if config.beats and clips.beats is None:
            raise InputError("beats: the clips have none; give their beats to ClipSet.from_clips, or search without")
        self.layout = Layout.of(clips, lengths, config.blend)
        if self.layout.columns >= 1 << 31:
            raise InputError("clips: are too long for one search; use fewer")
        self.windows = [
            Windows(self.layout, b, config.points, config.frame_weights_of(b), config.blend_scale(b)) for b in lengths
        ]
        x, y, z = self.layout.flat
        self.geometry = kernels.Geometry(
            self.layout.first.astype(np.int64), self.layout.period.astype(np.int64), self.layout.looping,
            self.layout.frame0.astype(np.int64), np.array([w.counts for w in self.windows], dtype=np.int64),
            self.layout.block_clip, np.array(lengths, dtype=np.int64), x, y, z,
            np.concatenate([w.weights for w in self.windows]),
            np.cumsum([0] + [len(w.weights) for w in self.windows]).astype(np.int64),
            np.array([w.scale for w in self.windows]), *np.full((2, len(lengths), len(self.layout.frames)), np.nan),
            len(config.points),
        )  # fmt: skip
        self._executor = ThreadPoolExecutor(self.threads) if self.threads > 1 else None
        self._local = threading.local()
        self._slabs, self._pooled = {}, {}
        # largest float32 error bound met so far, m^2
        self.error = 0.0

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self._executor:
            self._executor.shutdown()

    def run(self, function, tasks):
        """[function(*task) for each task], on all threads."""
        if self._executor is None or len(tasks) < 2:
            return [function(*task) for task in tasks]
        return list(self._executor.map(lambda task: function(*task), tasks))

    @property
    def space(self):
        """This thread's Workspace."""
        if not hasattr(self._local, "space"):
            self._local.space = Workspace()
        return self._local.space

    def slab(self, length, clip, first, last, beats=False, out=None, pooled=True):
        """(lower bounds, their pooled minima) of windows first..last - 1 of `clip`, of length index `length`.

        out: buffer of at least as many rows. pooled: False to leave the minima out (None).
        """
        layout = self.layout
        out = np.empty((last - first, layout.columns), np.float32) if out is None else out[: last - first]
        minima = np.empty((last - first, layout.blocks), np.float32) if pooled else None

        def strip(start, stop):
            part = slice(start - first, stop - first)
            self._fill(length, clip, start, out[part], beats, minima[part] if pooled else None)

        self.run(strip, self.parts(first, last))
        return out, minima

    def strip(self, length, clip, first, last):
        """Slab of at most ROWS windows that are left for a hop, in this thread's buffer, with pooled minima."""
        d, minima = (array[: last - first] for array in self.space.strip("distances", self.layout))
        self._fill(length, clip, first, d, self.config.beats, minima)
        return d, minima

    def strips(self, length, clips):
        """(clip, first, last) of all strips of the clips' windows."""
        counts = self.windows[length].counts
        return [(i, *part) for i in clips for part in self.parts(0, int(counts[i]))]

    def parts(self, first, last):
        """(first, last) of parts of at most ROWS rows, as many for each thread."""
        rounds = -(-(last - first) // (ROWS * self.threads))
        step = max(1, -(-(last - first) // max(1, rounds * self.threads)))
        return [(a, min(a + step, last)) for a in range(first, last, step)]

    def _fill(self, length, clip, first, out, beats, minima):
        error = fill(self.windows[length], clip, first, len(out), out, self.space, minima)
        # a larger one may be lost to another thread; it is a matter of speed only
        self.error = max(self.error, error)
        if beats:
            self._mask(out, clip, first)
            pool(out, minima)

    def _mask(self, part, clip, start):
        """BIG where the next beats of both windows do not coincide."""
        own = _next_beats(self.clips, clip)[start : start + len(part)]
        for hop in range(len(self.clips)):
            first, count = self.layout.first[hop], self.layout.windows[hop]
            next_ = _next_beats(self.clips, hop)[:count]
            part[:, first : first + count][(own[:, None] != next_) | (own[:, None] < 0)] = BIG

    def source_slab(self, length, clip):
        """(slab, pooled minima) of all windows of a source, beats heeded.

        One buffer per length in the regime "start"; kept while there is room in "fixed".
        """
        key = length, clip
        if key in self._slabs:
            return self._slabs[key][:2]
        count = int(self.windows[length].counts[clip])
        size = int(self.windows[length].counts.max(initial=0))
        buffer = None
        if self.config.regime == START:
            old = next((k for k in self._slabs if k[0] == length), None)
            buffer = self._slabs.pop(old)[2] if old else None
        elif len(self._slabs) >= max(MEMORY // max(1, 4 * size * self.layout.columns), len(self.windows) + 1):
            buffer = self._slabs.pop(next(iter(self._slabs)))[2]
        if buffer is None or buffer.shape[0] < count:
            buffer = np.empty((size, self.layout.columns), np.float32)
        out, pooled = self.slab(length, clip, 0, count, self.config.beats, buffer)
        self._slabs[key] = out, pooled, buffer
        if self.config.hops == 2:
            self._pooled[clip] = pooled
        return out, pooled

    def pooled_distances(self, clip):
        """The pooled minima of `source_slab` of the only length, which are kept where there are two hops."""
        if clip not in self._pooled:
            self.source_slab(0, clip)
        return self._pooled[clip]


def _next_beats(clips, i):
    """Frames from each frame 0..period - 1 of clip i to its next beat (0 on a beat), -1 after the last one."""
    period, beats = clips.period(i), clips.beats[i]
    if not len(beats):
        return np.full(period, -1)
    if clips.looping(i):
        beats = np.unique(beats % period)
        beats = np.append(beats, beats[0] + period)
    at = np.searchsorted(beats, np.arange(period))
    return np.where(at < len(beats), beats[np.minimum(at, len(beats) - 1)] - np.arange(period), -1)
