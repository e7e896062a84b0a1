"""Distances of many windows: float32 lower bounds by strips of matrix products, float64 values one at a time.

A slab is (rows, columns) float32. An entry L of it satisfies L <= D <= L + 2 e, D being the exact distance on the grid
of QUANTUM and e the strip's error bound; columns without a window hold BIG.
"""

import math

import numpy as np
from numba import njit

from motion.onehop.features import BLOCK, ROWS, UNIT, error_bound

# costs are whole multiples of this (m^2), so that their float64 sums are exact and ties do not depend on rounding
QUANTUM = 2.0**-33
BIG = np.float32(1e9)  # no candidate; finite, because compiled code may assume that there is no infinity
FEASIBLE = 1e8  # anything above is BIG plus something
# bytes of slabs that are kept for reuse
MEMORY = 2_400_000_000
# terms are lowered by this factor, so that float32 sums of a few of them stay lower bounds
SHRINK = 1.0 - 32 * UNIT


def on_grid(value):
    """`value` (m^2) rounded to the grid."""
    return float(np.rint(value / QUANTUM) * QUANTUM)


class Workspace:
    """Buffers of one thread for `fill`."""

    def __init__(self):
        self.products = np.empty(0, np.float32)
        self.sums = np.empty((3, ROWS + 4096), np.float32)

    def take(self, size):
        if len(self.products) < size:
            self.products = np.empty(size, np.float32)
        return self.products


def fill(windows, clip, first, count, out, space):
    """Lower bounds of windows first..first + count - 1 of `clip` (count <= ROWS) against all columns into `out`.

    out: (count, columns) float32. Returns the largest error bound e of the strip, m^2 (0 without columns).
    """
    length, points = windows.length, len(windows.root)
    side = windows.side(clip, first, count)
    # uniform frame weights are folded into the product; the others are applied along the diagonal
    factor = 2.0 / length if windows.uniform else 2.0
    z = (side.z * factor).astype(np.float32)
    x, y = side.xy[:, :points] * factor, side.xy[:, points:] * factor
    xy = np.concatenate([np.concatenate([x, y], axis=1), np.concatenate([y, -x], axis=1)]).astype(np.float32)
    h, mean = side.h.astype(np.float32), np.ascontiguousarray(2 * side.mean.T, dtype=np.float32)
    taps = windows.frame_weights.astype(np.float32)
    rows, worst = len(z), 0.0
    for group in windows.groups:
        frames = group.z.shape[1]
        buffer = space.take(3 * rows * frames)
        gz = buffer[: rows * frames].reshape(rows, frames)
        gc = buffer[rows * frames : 3 * rows * frames].reshape(2 * rows, frames)
        np.dot(z, group.z, out=gz)
        np.dot(xy, group.xy, out=gc)
        error = error_bound(points, length, count, side.reach, group.reach, side.h.max(), group.bound)
        worst = max(worst, float(error.max()))
        low = (error * windows.scale * (1 + 2**-20) + QUANTUM).astype(np.float32)
        _windows(
            gz, gc, group.tiles, h, mean, group.h, group.mean, low, np.float32(windows.scale * SHRINK),
            taps, windows.uniform, space.sums, out,
        )  # fmt: skip
    return worst * windows.scale + QUANTUM


@njit(cache=True, nogil=True, fastmath=True)
def _windows(gz, gc, tiles, h, mean, col_h, col_mean, low, scale, taps, uniform, sums, out):
    """Sums along diagonals of a group's products, and from them the lower bounds."""
    count, length = len(h), len(taps)
    frames = gz.shape[0]
    offset = 0
    for tile in range(len(tiles)):
        f0, width, col0 = tiles[tile]
        for row in range(count):
            # the sum of the window pair (row, column) lives at column - row + count - 1: it moves along its diagonal
            base = count - 1 - row
            if uniform:
                _advance(gz, 0, sums[0], row, base, f0, width, length)
                _advance(gc, 0, sums[1], row, base, f0, width, length)
                _advance(gc, frames, sums[2], row, base, f0, width, length)
            else:
                _weighted(gz, 0, sums[0], row, base, f0, width, taps)
                _weighted(gc, 0, sums[1], row, base, f0, width, taps)
                _weighted(gc, frames, sums[2], row, base, f0, width, taps)
            _bound(
                sums[0][base : base + width], sums[1][base : base + width], sums[2][base : base + width],
                h[row], mean[0, row], mean[1, row], col_h[offset : offset + width],
                col_mean[0][offset : offset + width], col_mean[1][offset : offset + width], low[tile], scale,
                out[row][col0 : col0 + width],
            )  # fmt: skip
        offset += width


@njit(cache=True, nogil=True, fastmath=True)
def _bound(height, re, im, h, mx, my, col_h, col_x, col_y, low, scale, out):
    for c in range(len(out)):
        a = re[c] - mx * col_x[c] - my * col_y[c]
        b = im[c] - my * col_x[c] + mx * col_y[c]
        out[c] = max((h + col_h[c] - height[c] - math.sqrt(a * a + b * b)) * scale - low, np.float32(0))


@njit(cache=True, nogil=True, fastmath=True)
def _advance(g, top, total, row, base, f0, width, length):
    """Running sums of one row: all from the row before, but the first column (in the first row, all) afresh."""
    part = total[base : base + width]
    if row == 0:
        for c in range(width):
            part[c] = 0
        for k in range(length):
            line = g[top + k][f0 + k : f0 + k + width]
            for c in range(width):
                part[c] += line[c]
    else:
        new, old = g[top + row + length - 1][f0 + length : f0 + length + width - 1], g[top + row - 1][f0:]
        rest = part[1:]
        for c in range(width - 1):
            rest[c] += new[c] - old[c]
        # four sums at once: additions that wait for each other would cost more than all the rest
        s0 = s1 = s2 = s3 = np.float32(0)
        at, whole = top + row, length - length % 4
        for k in range(0, whole, 4):
            s0 += g[at + k, f0 + k]
            s1 += g[at + k + 1, f0 + k + 1]
            s2 += g[at + k + 2, f0 + k + 2]
            s3 += g[at + k + 3, f0 + k + 3]
        for k in range(whole, length):
            s0 += g[at + k, f0 + k]
        part[0] = (s0 + s1) + (s2 + s3)


@njit(cache=True, nogil=True, fastmath=True)
def _weighted(g, top, total, row, base, f0, width, taps):
    part = total[base : base + width]
    for c in range(width):
        part[c] = 0
    for k in range(len(taps)):
        line, tap = g[top + row + k][f0 + k : f0 + k + width], taps[k]
        for c in range(width):
            part[c] += tap * line[c]


@njit(cache=True, nogil=True, fastmath=True)
def pool(slab, pads, out):
    """Writes BIG into the padding columns of `slab`, then the minimum of each block of columns into `out`."""
    work = np.empty(BLOCK, np.float32)
    for row in range(slab.shape[0]):
        line = slab[row]
        for k in range(len(pads)):
            for c in range(pads[k, 0], pads[k, 1]):
                line[c] = BIG
        for block in range(out.shape[1]):
            out[row, block] = smallest(line[block * BLOCK : block * BLOCK + BLOCK], work)


@njit(cache=True, nogil=True, fastmath=True)
def smallest(values, work):
    """Minimum of BLOCK values. By halves, because the compiler makes vector code of that but not of a running min."""
    half = BLOCK // 2
    low, high = values[:half], values[half:]
    for c in range(half):
        work[c] = min(low[c], high[c])
    for c in range(8):
        work[c] = min(work[c], work[c + 8])
    return min(
        min(min(work[0], work[1]), min(work[2], work[3])), min(min(work[4], work[5]), min(work[6], work[7]))
    )


@njit(cache=True, nogil=True)
def exact(x, y, z, weights, points, first, second):
    """D, m^2, of the windows that begin at rows `first` and `second` of the frames x, y, z; not yet on the grid.

    Fixed order of operations without fused or reordered ones: the same bits on every machine.
    """
    count = len(weights)
    a, c = first * points, second * points
    xa, ya, za, xc, yc, zc = (
        x[a : a + count], y[a : a + count], z[a : a + count], x[c : c + count], y[c : c + count], z[c : c + count],
    )  # fmt: skip
    work = np.empty((5, count))
    px, py, qx, qy, term = work[0], work[1], work[2], work[3], work[4]
    _centre(xa, weights, term, px)
    _centre(ya, weights, term, py)
    _centre(xc, weights, term, qx)
    _centre(yc, weights, term, qy)
    # one array written per loop: the compiler turns only those with few arrays into vector code
    for j in range(count):
        term[j] = weights[j] * (px[j] * qx[j] + py[j] * qy[j])
    re = _total(term)
    for j in range(count):
        term[j] = weights[j] * (py[j] * qx[j] - px[j] * qy[j])
    im = _total(term)
    for j in range(count):
        term[j] = weights[j] * (px[j] * px[j] + py[j] * py[j] + qx[j] * qx[j] + qy[j] * qy[j])
    spread = _total(term)
    for j in range(count):
        dz = za[j] - zc[j]
        term[j] = weights[j] * (dz * dz)
    height = _total(term)
    return height + max(spread - 2.0 * math.sqrt(re * re + im * im), 0.0)


@njit(cache=True, nogil=True)
def _centre(values, weights, work, out):
    """`values` less their weighted mean, taken relative to the first, so that far from the origin nothing is lost."""
    first = values[0]
    for j in range(len(out)):
        work[j] = weights[j] * (values[j] - first)
    mean = first + _total(work)
    for j in range(len(out)):
        out[j] = values[j] - mean


@njit(cache=True, nogil=True)
def _total(values):
    """Sum, by halves in place: a fixed order that is vector code as it stands."""
    count = len(values)
    while count > 1:
        half = (count + 1) // 2
        low, high = values[: count - half], values[half:count]
        for i in range(len(low)):
            low[i] += high[i]
        count = half
    return values[0]


@njit(cache=True, nogil=True)
def exact_on_grid(x, y, z, weights, points, first, second, scale):
    """`exact` times `scale`, rounded to the grid (a tie of rounding to even)."""
    # the order of the two windows must not show in the last bit
    low, high = min(first, second), max(first, second)
    return np.rint(exact(x, y, z, weights, points, low, high) * scale / QUANTUM) * QUANTUM
