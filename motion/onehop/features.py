"""Columns of the search (all windows of all clips) and the float32 features whose products give their distances.

For windows a and c, with points p = (x, y, z), weights omega of points and phi of frames (sums 1), and zeta = x + i y,
the distance of Kovar et al. 2002 is

    D(a, c) = h(a) + h(c) - 2 H(a, c) - 2 |C(a, c)|
    h = sum phi omega (|zeta - mean|^2 + z^2),  H = sum phi omega z z',  C = sum phi omega (zeta - mean) conj(same of c)

With r the mean of a frame's points and zeta = r + rho, C = sum phi omega rho conj(rho') + sum phi (r - mean) conj(...).
H and the first part of C are sums along a diagonal of products of per-frame features, which are matrix products; rho
is small wherever the character stands, so float32 errs little. The second part is one of windows: of the coefficients
of the path r in polynomials, and what these leave out goes into the error bound.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit

BLOCK = 32  # columns whose minimum is kept for pruning
ROWS = 128  # rows of a strip: running sums restart in every strip
TILE = 256  # columns of a tile: its matrix products should stay in the second-level cache
DEGREE = 7  # of the polynomials for the path of a window
UNIT = 2.0**-24  # rounding unit of float32
LEFT = 1e-10  # m^2; above what float64 loses in the squared norm of a path


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


class Windows:
    """Windows of one blend length over a Layout, and their float32 features.

    z: (frames, P) and xy: (frames, 2 P), of rho, per frame of the layout. path: (columns, 2 n), coefficients of the
    path in x, then in y, h and tail: (columns,), per window; tail, rounded up, is the norm of what the coefficients
    leave out of the path. loss: what D loses by it for most pairs of windows, m^2. tiles: of the columns.
    """

    def __init__(self, layout, length, point_weights, frame_weights, scale=1.0):
        self.layout, self.length, self.scale = layout, length, float(scale)
        self.frame_weights = np.ascontiguousarray(frame_weights, dtype=np.float64)
        self.uniform = bool(np.ptp(self.frame_weights) == 0)
        self.counts = np.array([layout.clips.windows(i, length) for i in range(len(layout.clips))])
        self.weights = np.ascontiguousarray(self.frame_weights[:, None] * point_weights).reshape(-1)
        # one height for all clips may be taken off every point: it cancels in D and keeps float32 sums small
        count, points = len(layout.frames), len(point_weights)
        self.z, self.xy = np.empty((count, points), np.float32), np.empty((count, 2 * points), np.float32)
        middle, squares, heights = np.empty((2, count)), np.empty(count), np.empty(count)
        level = layout.frames[..., 2].mean(axis=0) if count else np.zeros(points)
        _frames(*layout.flat, point_weights, level, self.z, self.xy, middle, squares, heights)
        basis = _basis(self.frame_weights)
        self.path = np.zeros((layout.columns, 2 * basis.shape[1]), np.float32)
        self.h, self.tail = np.zeros(layout.columns, np.float32), np.zeros(layout.columns, np.float32)
        energy = np.zeros(layout.columns)
        for clip, count in enumerate(self.counts):
            if count:
                frames = slice(layout.frame0[clip], layout.frame0[clip] + count + length - 1)
                columns = slice(layout.first[clip], layout.first[clip] + count)
                energy[columns] = self._paths(middle[:, frames], basis, columns)
                sums = np.correlate((squares + heights)[frames], self.frame_weights)
                self.h[columns] = sums[:count] + energy[columns]
        self.norms = np.sqrt(squares), np.sqrt(heights), np.sqrt(energy)
        tails = self.tail[self.h > 0]
        self.loss = self.scale * 2 * float(np.quantile(tails, 0.9)) ** 2 if len(tails) else 0.0
        self.tiles = [
            _Tile.of(self, clip, first, min(TILE, int(count) - first))
            for clip, count in enumerate(self.counts)
            for first in range(0, int(count), TILE)
        ]
        self.reach = tuple(np.array([tile.reach[k] for tile in self.tiles]) for k in range(4))

    def _paths(self, middle, basis, columns):
        """Fills path and tail of the windows of one clip; middle: (2, frames). Returns their squared norms."""
        middle = middle - middle.mean(axis=1, keepdims=True)
        count, n = columns.stop - columns.start, basis.shape[1]
        path, norms = np.zeros((2 * n, count)), np.zeros((4, count))
        # the columns are orthogonal to constants, so the mean need not be taken off
        _sum_paths(middle, self.frame_weights, np.sqrt(self.frame_weights)[:, None] * basis, path, norms)
        self.path[columns] = path.T
        energy = norms[0] + norms[1] - norms[2] ** 2 - norms[3] ** 2
        # differences of numbers of some 1e4 m^2 at most: exact to LEFT
        self.tail[columns] = rounded_up(np.sqrt(np.maximum(energy - (path**2).sum(axis=0), 0) + LEFT))
        return np.maximum(energy, 0)

    def place(self, clip, first, count):
        """(slice of frames, slice of columns) of `count` windows of `clip` from window `first` on."""
        frame, column = int(self.layout.frame0[clip]) + first, int(self.layout.first[clip]) + first
        return slice(frame, frame + count + self.length - 1), slice(column, column + count)

    def reach_of(self, frames, columns):
        """Largest norms of rho of a frame, of its heights and of a window's path, and the largest h."""
        xy, z, path = self.norms
        return tuple(float(part.max()) for part in (xy[frames], z[frames], path[columns], self.h[columns]))

    @property
    def pads(self):
        """(n, 2) ranges of columns that hold no window of this length."""
        layout = self.layout
        ends = np.append(layout.first[1:], layout.columns)
        return np.stack([layout.first + self.counts, ends], axis=1)


@njit(cache=True, nogil=True)
def _frames(x, y, z, weights, level, out_z, out_xy, middle, squares, heights):
    """Features of all frames: heights above `level` and rho, times the root of the weights, and their squared norms."""
    points = len(weights)
    root = np.sqrt(weights)
    for f in range(len(out_z)):
        mx = my = sum_xy = sum_z = 0.0
        for p in range(points):
            mx += weights[p] * x[f * points + p]
            my += weights[p] * y[f * points + p]
        for p in range(points):
            a, b = (x[f * points + p] - mx) * root[p], (y[f * points + p] - my) * root[p]
            c = (z[f * points + p] - level[p]) * root[p]
            out_xy[f, p], out_xy[f, points + p], out_z[f, p] = a, b, c
            sum_xy += a * a + b * b
            sum_z += c * c
        middle[0, f], middle[1, f], squares[f], heights[f] = mx, my, sum_xy, sum_z


@njit(cache=True, nogil=True)
def _sum_paths(middle, weights, basis, path, norms):
    """Adds the coefficients of all windows to path (2 n, windows), and to norms the weighted sums of squares, then the
    means, of x and y."""
    n, count = basis.shape[1], path.shape[1]
    for k in range(len(weights)):
        weight = weights[k]
        for axis in range(2):
            line = middle[axis][k : k + count]
            square, mean = norms[axis], norms[2 + axis]
            for i in range(count):
                square[i] += weight * line[i] * line[i]
            for i in range(count):
                mean[i] += weight * line[i]
            for c in range(n):
                factor, out = basis[k, c], path[axis * n + c]
                for i in range(count):
                    out[i] += factor * line[i]


def _basis(frame_weights):
    """(length, n) orthonormal columns that span polynomials in time, times the root of the weights, but constants."""
    length = len(frame_weights)
    powers = np.linspace(-1, 1, length)[:, None] ** np.arange(min(DEGREE + 1, length))
    return np.linalg.qr(np.sqrt(frame_weights)[:, None] * powers)[0][:, 1:]


@dataclass(frozen=True, eq=False)
class _Tile:
    """Some columns of a clip. z: (P, frames), xy: (2 P, frames), path: (2 n, windows), h, tail: (windows,), as in
    Windows. column: the first. reach: of `Windows.reach_of`."""

    z: np.ndarray
    xy: np.ndarray
    path: np.ndarray
    h: np.ndarray
    tail: np.ndarray
    column: int
    reach: tuple

    @classmethod
    def of(cls, windows, clip, first, count):
        frames, columns = windows.place(clip, first, count)
        features = (windows.z[frames], windows.xy[frames], windows.path[columns])
        return cls(
            *(np.ascontiguousarray(part.T) for part in features), windows.h[columns], windows.tail[columns],
            columns.start, windows.reach_of(frames, columns),
        )  # fmt: skip


def rounded_up(values):
    """float32 that are not less than `values` >= 0."""
    return (values * (1 + 2.0**-20) + 1e-30).astype(np.float32)


def error_bound(points, length, rows, a, c):
    """Largest error of a float32 D of a tile but for what paths leave out, m^2, by standard forward analysis.

    a, c: `Windows.reach_of` of both sides (numbers or arrays). Products of K terms err by (K + 3) u |a| |c| (features
    are rounded too); the first window's sum by `length` u, and each of `rows` steps of the running sum by
    (1 + 2 / length) u times the sum's bound |a| |c|; both parts of C (Higham 2002, section 3.1).
    Coefficients leave out no more than 2 tail tail' of D, because what they leave out is orthogonal to the polynomials.
    """
    steps = length + rows * (1 + 2 / length)
    horizontal = 2 * np.sqrt(2) * (2 * points + 3 + steps + 8) * a[0] * c[0]
    vertical = 2 * (points + 3 + steps) * a[1] * c[1]
    path = 2 * np.sqrt(2) * (2 * DEGREE + 3 + 8) * a[2] * c[2]
    return 1.1 * UNIT * (horizontal + vertical + path + 6 * (a[3] + c[3]))
