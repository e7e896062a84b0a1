"""Columns of the search (all windows of all clips) and the float32 features whose products give their distances.

For windows a and c, with points p = (x, y, z) taken relative to any fixed point of their tile, weights omega of points
and phi of frames (sums 1), and zeta = x + i y, the distance of Kovar et al. 2002 is

    D(a, c) = h(a) + h(c) - 2 H(a, c) - 2 |C(a, c) - mean(a) conj(mean(c))|
    h = sum phi omega (|zeta|^2 + z^2) - |mean|^2,  H = sum phi omega z z',  C = sum phi omega zeta conj(zeta')

H and C are sums along a diagonal of products of per-frame features, which are matrix products.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

BLOCK = 32  # columns whose minimum is kept for pruning
ROWS = 64  # rows of a strip: running sums restart, and points are centred, in every strip
TILE = 256  # columns of a tile, centred likewise
GROUP = 4  # tiles of one matrix product: its output should stay in the second-level cache
UNIT = 2.0**-24  # rounding unit of float32


@dataclass(frozen=True, eq=False)
class Layout:
    """Columns: the windows of clip i start at column first[i]; clips are padded to whole blocks.

    windows: per clip, of the shortest blend. frame0: row of each clip's frame 0 in `frames`, which go on for `longest`
    - 1 frames beyond the period of looping clips. frames: (all, P, 3), m; each clip moved to begin at the origin.
    """

    clips: object
    first: np.ndarray
    windows: np.ndarray
    columns: int
    block_clip: np.ndarray
    frame0: np.ndarray
    frames: np.ndarray
    period: np.ndarray
    looping: np.ndarray

    @classmethod
    def of(cls, clips, lengths, longest=0):
        """The layout of a ClipSet for these blend lengths. longest: of windows that are no columns, if that is more."""
        count = len(clips)
        looping = np.array([clips.looping(i) for i in range(count)])
        period = np.array([clips.period(i) for i in range(count)])
        windows = np.array([clips.windows(i, min(lengths)) for i in range(count)])
        padded = -(-windows // BLOCK) * BLOCK
        parts = []
        for i in range(count):
            part = clips.window_points(i, 0, int(period[i]) + (max(*lengths, longest) - 1) * int(looping[i]))
            parts.append(part - part[0, 0] * [1, 1, 0])
        lengths_of_parts = [len(part) for part in parts]
        return cls(
            clips,
            np.concatenate([[0], np.cumsum(padded)[:-1]]),
            windows,
            int(padded.sum()),
            np.repeat(np.arange(count), padded // BLOCK).astype(np.int32),
            np.concatenate([[0], np.cumsum(lengths_of_parts)[:-1]]),
            np.concatenate(parts),
            period,
            looping,
        )

    @property
    def blocks(self):
        return self.columns // BLOCK

    def column_of(self, clip, frame):
        return int(self.first[clip]) + int(frame)

    @cached_property
    def flat(self):
        """x, y, z of all frames, each (frames * P,), for the float64 distance."""
        return tuple(np.ascontiguousarray(self.frames[..., k]).reshape(-1) for k in range(3))


@dataclass(frozen=True, eq=False)
class Side:
    """Features of the frames of one tile, and constants of its windows, on one side of the products.

    z: (frames, P). xy: (frames, 2 P). mean: (windows, 2), h: (windows,) float64. reach: largest norm of a frame's
    horizontal and vertical features.
    """

    z: np.ndarray
    xy: np.ndarray
    mean: np.ndarray
    h: np.ndarray
    reach: tuple


class Windows:
    """Windows of one blend length over a Layout: the columns' features, and those of strips of rows on demand."""

    def __init__(self, layout, length, point_weights, frame_weights, scale=1.0):
        self.layout, self.length, self.scale = layout, length, float(scale)
        self.root = np.sqrt(point_weights)
        self.frame_weights = np.ascontiguousarray(frame_weights, dtype=np.float64)
        self.uniform = bool(np.ptp(self.frame_weights) == 0)
        self.counts = np.array([layout.clips.windows(i, length) for i in range(len(layout.clips))])
        # one height for all clips may be taken off every point: it cancels in D and keeps float32 sums small
        self.height = layout.frames[..., 2].mean(axis=0) if len(layout.frames) else 0.0
        self.weights = np.ascontiguousarray(self.frame_weights[:, None] * point_weights).reshape(-1)
        self.groups = self._groups()

    def side(self, clip, first, count):
        """The Side of `count` windows of `clip` from window `first` on."""
        at = self.layout.frame0[clip] + first
        points = self.layout.frames[at : at + count + self.length - 1]
        centre = points[..., :2].mean(axis=(0, 1))
        x, y = ((points[..., k] - centre[k]) * self.root for k in range(2))
        z = (points[..., 2] - self.height) * self.root
        squares, heights = (x * x + y * y).sum(axis=1), (z * z).sum(axis=1)
        reach = float(np.sqrt(squares.max())), float(np.sqrt(heights.max()))
        parts = x @ self.root, y @ self.root, squares + heights
        mean_x, mean_y, h = (np.correlate(part, self.frame_weights)[:count] for part in parts)
        mean = np.stack([mean_x, mean_y], axis=1)
        h = h - (mean**2).sum(axis=1)
        return Side(z, np.concatenate([x, y], axis=1), mean, h, reach)

    def _groups(self):
        """Column tiles, GROUP at a time."""
        tiles = []
        for clip, count in enumerate(self.counts):
            for first in range(0, int(count), TILE):
                tiles.append((clip, first, min(TILE, int(count) - first)))
        return [_Group.of(self, tiles[k : k + GROUP]) for k in range(0, len(tiles), GROUP)]

    @property
    def pads(self):
        """(n, 2) ranges of columns that hold no window of this length."""
        layout = self.layout
        ends = np.append(layout.first[1:], layout.columns)
        return np.stack([layout.first + self.counts, ends], axis=1)


@dataclass(frozen=True, eq=False)
class _Group:
    """z: (P, frames), xy: (2 P, frames) float32. tiles: (n, 3) first frame, windows, first column; first constant is
    the running sum of windows. h, mean: float32 constants of all windows. reach: (n, 2). bound: (n,) largest h."""

    z: np.ndarray
    xy: np.ndarray
    tiles: np.ndarray
    h: np.ndarray
    mean: np.ndarray
    reach: np.ndarray
    bound: np.ndarray

    @classmethod
    def of(cls, windows, tiles):
        sides = [windows.side(*tile) for tile in tiles]
        frames = np.cumsum([0] + [len(side.z) for side in sides])
        table = [(frames[k], count, windows.layout.first[c] + first) for k, (c, first, count) in enumerate(tiles)]
        return cls(
            np.ascontiguousarray(np.concatenate([side.z for side in sides]).T, dtype=np.float32),
            np.ascontiguousarray(np.concatenate([side.xy for side in sides]).T, dtype=np.float32),
            np.array(table, dtype=np.int64),
            np.concatenate([side.h for side in sides]).astype(np.float32),
            np.ascontiguousarray(np.concatenate([side.mean for side in sides]).T, dtype=np.float32),
            np.array([side.reach for side in sides]),
            np.array([side.h.max() for side in sides]),
        )


def error_bound(points, length, rows, reach_a, reach_b, h_a, h_b):
    """Largest error of a float32 D of a tile, m^2, by standard forward analysis (Higham 2002, section 3.1).

    Products of K terms err by (K + 3) u |a| |b| (features are rounded too); the first window's sum by `length` u, and
    each of `rows` steps of the running sum by (1 + 2 / length) u times the sum's bound |a| |b|; both parts of C.
    """
    steps = length + rows * (1 + 2 / length)
    horizontal = 2 * np.sqrt(2) * (2 * points + 3 + steps + 8) * reach_a[0] * reach_b[..., 0]
    vertical = 2 * (points + 3 + steps) * reach_a[1] * reach_b[..., 1]
    return 1.1 * UNIT * (horizontal + vertical + 6 * (h_a + h_b))
