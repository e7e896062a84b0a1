"""Distances of single pairs of windows in float64, on the grid of costs: what the choice is made by.

Fixed order of operations without fused or reordered ones: the same bits on every machine.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from motion.onehop.compiled import inner

# costs are whole multiples of this (m^2), so that their float64 sums are exact and ties do not depend on rounding
QUANTUM = 2.0**-33
MEMO = 1 << 14


def on_grid(value):
    """`value` (m^2) rounded to the grid."""
    return float(np.rint(value / QUANTUM) * QUANTUM)


@inner
def exact(x, y, z, weights, points, first, second, mean_x, mean_y, work):
    """D, m^2, of the windows that begin at rows `first` and `second` of the frames x, y, z; not yet on the grid.

    weights: (frames of a window * points,). mean_x, mean_y: (rows,) weighted means of the windows at these rows, NaN
    where they are not known yet (threads may share them: all write the same). work: (len(weights),) scratch.
    """
    count = len(weights)
    a, c = first * points, second * points
    xa, ya, za, xc, yc, zc = (
        x[a : a + count], y[a : a + count], z[a : a + count], x[c : c + count], y[c : c + count], z[c : c + count],
    )  # fmt: skip
    ax, ay = _mean(xa, weights, mean_x, first, work), _mean(ya, weights, mean_y, first, work)
    cx, cy = _mean(xc, weights, mean_x, second, work), _mean(yc, weights, mean_y, second, work)
    # one array written per loop: the compiler turns only those with few arrays into vector code
    for j in range(count):
        px, py, qx, qy = xa[j] - ax, ya[j] - ay, xc[j] - cx, yc[j] - cy
        work[j] = weights[j] * (px * qx + py * qy)
    re = _total(work)
    for j in range(count):
        px, py, qx, qy = xa[j] - ax, ya[j] - ay, xc[j] - cx, yc[j] - cy
        work[j] = weights[j] * (py * qx - px * qy)
    im = _total(work)
    for j in range(count):
        px, py, qx, qy = xa[j] - ax, ya[j] - ay, xc[j] - cx, yc[j] - cy
        work[j] = weights[j] * (px * px + py * py + qx * qx + qy * qy)
    spread = _total(work)
    for j in range(count):
        dz = za[j] - zc[j]
        work[j] = weights[j] * (dz * dz)
    height = _total(work)
    return height + max(spread - 2.0 * math.sqrt(re * re + im * im), 0.0)


@inner
def _mean(values, weights, means, row, work):
    """The weighted mean, taken relative to the first value, so that far from the origin nothing is lost."""
    if math.isnan(means[row]):
        first = values[0]
        for j in range(len(values)):
            work[j] = weights[j] * (values[j] - first)
        means[row] = first + _total(work)
    return means[row]


@inner
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


@inner
def exact_on_grid(x, y, z, weights, points, first, second, scale, mean_x, mean_y, work):
    """`exact` times `scale`, rounded to the grid (a tie of rounding to even); 0 for a window and itself."""
    if first == second:
        return 0.0
    # the order of the two windows must not show in the last bit
    low, high = min(first, second), max(first, second)
    d = exact(x, y, z, weights, points, low, high, mean_x, mean_y, work)
    return np.rint(d * scale / QUANTUM) * QUANTUM


class Memo(NamedTuple):
    """What one thread remembers of `priced`. keys, values: (MEMO,). work: as in `exact`."""

    keys: np.ndarray
    values: np.ndarray
    work: np.ndarray


@njit(cache=True, nogil=True)
def new_memo(geometry):
    """An empty Memo for a `kernels.Geometry`."""
    longest = geometry.lengths.max() * geometry.points
    return Memo(np.full(MEMO, -1, np.int64), np.empty(MEMO), np.empty(longest))


@inner
def priced(geometry, length, first, second, memo):
    """D, on the grid, of two windows (rows of the frames) of length index `length`."""
    low, high = min(first, second), max(first, second)
    key = (np.int64(low) * len(geometry.x) + high) * 16 + length
    slot = (key * -7046029254386353131 >> 40) & (MEMO - 1)
    if memo.keys[slot] != key:
        memo.values[slot] = price_of(geometry, length, low, high, memo.work)
        memo.keys[slot] = key
    return memo.values[slot]


@inner
def price_of(geometry, length, first, second, work):
    """`priced` without a memo. work: at least as long as the weights."""
    weights = geometry.weights[geometry.weight0[length] : geometry.weight0[length + 1]]
    return exact_on_grid(
        geometry.x, geometry.y, geometry.z, weights, geometry.points, first, second, geometry.scale[length],
        geometry.mean_x[length], geometry.mean_y[length], work[: len(weights)],
    )  # fmt: skip


@njit(cache=True, nogil=True)
def direct_costs(geometry, weights, first, second, out):
    """out[i]: D on the grid of the windows at rows first[i], second[i] of the frames; infinity where one is -1."""
    means = np.full((2, len(geometry.x) // geometry.points), np.nan)
    work = np.empty(len(weights))
    for i in range(len(out)):
        out[i] = np.inf
        if first[i] >= 0 and second[i] >= 0:
            out[i] = exact_on_grid(
                geometry.x, geometry.y, geometry.z, weights, geometry.points, first[i], second[i], 1.0,
                means[0], means[1], work,
            )  # fmt: skip
