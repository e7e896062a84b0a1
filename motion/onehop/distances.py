"""Distances of many windows: float32 lower bounds by strips of matrix products.

A slab is (rows, columns) float32. An entry L of it satisfies L <= D <= L + 2 e, D being the exact distance on the grid
of `pricing` and e the error bound of that pair of windows; columns without a window hold BIG.
"""

import math

import numpy as np
from numba import njit

from motion.onehop.compiled import inner_fast
from motion.onehop.features import BLOCK, ROWS, TILE, UNIT, error_bound, rounded_up
from motion.onehop.pricing import QUANTUM

BIG = np.float32(1e9)  # no candidate; finite, because compiled code may assume that there is no infinity
FEASIBLE = 1e8  # anything above is BIG plus something
# bytes of slabs that are kept for reuse
MEMORY = 2_400_000_000
# terms are lowered by this factor, so that float32 sums of a few of them stay lower bounds
SHRINK = 1.0 - 32 * UNIT


class Workspace:
    """Buffers of one thread: for `fill`, and of strips."""

    def __init__(self):
        self.products = np.empty(0, np.float32)
        self.sums = np.empty((3, ROWS + TILE), np.float32)
        self.edge = np.empty((4, ROWS), np.float32)
        self._strips = {}

    def take(self, size):
        """`size` float32, valid until the next call."""
        if len(self.products) < size:
            self.products = np.empty(size, np.float32)
        return self.products[:size]

    def strip(self, name, layout):
        """(ROWS, columns) and (ROWS, blocks) float32 of that name, for a strip and its pooled minima."""
        if name not in self._strips:
            shapes = (ROWS, layout.columns), (ROWS, layout.blocks)
            self._strips[name] = tuple(np.empty(shape, np.float32) for shape in shapes)
        return self._strips[name]


def fill(windows, clip, first, count, out, space, minima=None):
    """Lower bounds of windows first..first + count - 1 of `clip` (count <= ROWS) against all columns into `out`.

    out: (count, columns) float32. minima: (count, blocks) for the minima of blocks of columns, or None.
    Returns an error bound e, m^2, that holds for most of the strip.
    """
    minima = np.empty((0, 0), np.float32) if minima is None else minima
    for a, b in windows.pads:
        out[:, a:b] = BIG
        minima[:, -(-a // BLOCK) : b // BLOCK] = BIG
    length, points = windows.length, windows.z.shape[1]
    frames, columns = windows.place(clip, first, count)
    # uniform frame weights are folded into the product; the others are applied along the diagonal
    factor = np.float32(2.0 / length if windows.uniform else 2.0)
    z, xy = windows.z[frames] * factor, _complex_rows(windows.xy[frames] * factor)
    path = _complex_rows(windows.path[columns] * np.float32(2.0))
    h, tail = windows.h[columns], rounded_up(2 * windows.tail[columns])
    taps, scale = windows.frame_weights.astype(np.float32), np.float32(windows.scale * SHRINK)
    rows = len(z)
    errors = error_bound(points, length, count, windows.reach_of(frames, columns), windows.reach)
    lows = (errors * windows.scale * (1 + 2**-20) + QUANTUM).astype(np.float32)
    for tile, low in zip(windows.tiles, lows):
        width, count_h = tile.z.shape[1], rows * tile.z.shape[1]
        # one after the other: heights, both parts of rho, both parts of the path
        buffer = space.take(3 * count_h + 2 * count * len(tile.h))
        gz = buffer[:count_h].reshape(rows, width)
        gc = buffer[count_h : 3 * count_h].reshape(2 * rows, width)
        gp = buffer[3 * count_h :].reshape(2 * count, len(tile.h))
        np.dot(z, tile.z, out=gz)
        np.dot(xy, tile.xy, out=gc)
        np.dot(path, tile.path, out=gp)
        _windows(
            gz, gc, gp, h, tile.h, tail, tile.tail, low, scale, taps, windows.uniform, space.sums, space.edge,
            tile.column, out, minima,
        )  # fmt: skip
    return float(errors.max(initial=0.0)) * windows.scale + QUANTUM + windows.loss


def _complex_rows(features):
    """Rows that give the real parts of products with conjugates, then rows that give the imaginary parts."""
    half = features.shape[1] // 2
    x, y = features[:, :half], features[:, half:]
    return np.concatenate([features, np.concatenate([y, -x], axis=1)])


@njit(cache=True, nogil=True, fastmath=True)
def _windows(gz, gc, gp, h, col_h, tail, col_tail, low, scale, taps, uniform, sums, edge, column, out, minima):
    """Sums along diagonals of a tile's products, and from them the lower bounds. edge: (4, ROWS) scratch."""
    count, length, frames, width = len(h), len(taps), gz.shape[0], len(col_h)
    if uniform:
        _edge(gz, 0, count, length, edge[3], edge[0])
        _edge(gc, 0, count, length, edge[3], edge[1])
        _edge(gc, frames, count, length, edge[3], edge[2])
    for row in range(count):
        # the sum of the window pair (row, column) lives at column - row + count - 1: it moves along its diagonal
        base = count - 1 - row
        if uniform:
            _advance(gz, 0, sums[0], row, base, width, length, edge[0, row])
            _advance(gc, 0, sums[1], row, base, width, length, edge[1, row])
            _advance(gc, frames, sums[2], row, base, width, length, edge[2, row])
        else:
            _weighted(gz, 0, sums[0], row, base, width, taps)
            _weighted(gc, 0, sums[1], row, base, width, taps)
            _weighted(gc, frames, sums[2], row, base, width, taps)
        _bound(
            sums[0][base : base + width], sums[1][base : base + width], sums[2][base : base + width],
            gp[row], gp[count + row], h[row], col_h, tail[row], col_tail, low, scale,
            out[row][column : column + width],
        )  # fmt: skip
        if len(minima):
            pool_row(out, row, column // BLOCK, -(-(column + width) // BLOCK), minima, edge[3])


@inner_fast
def _edge(g, top, count, length, line, out):
    """out[row]: sum of the window pair (row, 0), where no running sum comes in."""
    for row in range(count):
        out[row] = 0
    for k in range(length):
        for row in range(count):
            line[row] = g[top + k + row, k]
        for row in range(count):
            out[row] += line[row]


@inner_fast
def _bound(height, re, im, path_re, path_im, h, col_h, tail, col_tail, low, scale, out):
    for c in range(len(out)):
        a, b = re[c] + path_re[c], im[c] + path_im[c]
        value = h + col_h[c] - height[c] - math.sqrt(a * a + b * b) - tail * col_tail[c]
        out[c] = max(value * scale - low, np.float32(0))


@inner_fast
def _advance(g, top, total, row, base, width, length, edge):
    """Running sums of one row: all from the row before, but the first column (in the first row, all) afresh."""
    part = total[base : base + width]
    if row == 0:
        for c in range(width):
            part[c] = 0
        for k in range(length):
            line = g[top + k][k : k + width]
            for c in range(width):
                part[c] += line[c]
    else:
        new, old = g[top + row + length - 1][length : length + width - 1], g[top + row - 1]
        rest = part[1:]
        for c in range(width - 1):
            rest[c] += new[c] - old[c]
        part[0] = edge


@inner_fast
def _weighted(g, top, total, row, base, width, taps):
    part = total[base : base + width]
    for c in range(width):
        part[c] = 0
    for k in range(len(taps)):
        line, tap = g[top + row + k][k : k + width], taps[k]
        for c in range(width):
            part[c] += tap * line[c]


@njit(cache=True, nogil=True, fastmath=True)
def pool(slab, out):
    """Writes the minimum of each block of columns of `slab` into `out`."""
    work = np.empty(BLOCK, np.float32)
    for row in range(slab.shape[0]):
        pool_row(slab, row, 0, out.shape[1], out, work)


@inner_fast
def pool_row(slab, row, first, last, out, work):
    """out[row, block]: minimum of the columns of blocks first..last - 1. By halves, because the compiler makes vector
    code of that but not of a running minimum. work: (BLOCK,) scratch or more."""
    half = BLOCK // 2
    for block in range(first, last):
        at = block * BLOCK
        low, high = slab[row][at : at + half], slab[row][at + half : at + BLOCK]
        for c in range(half):
            work[c] = min(low[c], high[c])
        for c in range(8):
            work[c] = min(work[c], work[c + 8])
        out[row, block] = min(
            min(min(work[0], work[1]), min(work[2], work[3])), min(min(work[4], work[5]), min(work[6], work[7]))
        )
