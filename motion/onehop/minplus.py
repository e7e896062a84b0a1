"""Min-plus products of lower bounds, pruned by minima of blocks: low[i, r] = min over columns c of d[i, c] + k[r, c].

All rows r of k are treated together, as the lanes of vector instructions: what a block of columns holds for LANES rows
lies side by side. A row and a block whose pooled minima do not fall below any lane's limit are not looked at.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from motion.onehop.distances import BIG
from motion.onehop.features import BLOCK

LANES = 16
TOGETHER = 4  # rows that are pruned together


class Lanes(NamedTuple):
    """k (rows, columns) regrouped. values: (blocks, groups, BLOCK, LANES). pooled: (blocks, groups,
    LANES) minima over the columns of a block. least: (groups, blocks) those of `pooled`. Lanes beyond the rows of k
    hold BIG."""

    values: np.ndarray
    pooled: np.ndarray
    least: np.ndarray


def lanes_of(k):
    """The Lanes of k (rows, columns) float32; columns is a multiple of BLOCK."""
    rows, columns = k.shape
    blocks, groups = columns // BLOCK, -(-rows // LANES)
    out = Lanes(
        np.empty((blocks, groups, BLOCK, LANES), np.float32),
        np.empty((blocks, groups, LANES), np.float32),
        np.empty((groups, blocks), np.float32),
    )
    _regroup(k, *out)
    return out


@njit(cache=True, nogil=True, fastmath=True)
def _regroup(k, values, pooled, least):
    rows = k.shape[0]
    for b in range(values.shape[0]):
        for g in range(values.shape[1]):
            bottom = BIG
            for lane in range(LANES):
                r, low = g * LANES + lane, BIG
                for c in range(BLOCK):
                    value = k[r, b * BLOCK + c] if r < rows else BIG
                    values[b, g, c, lane] = value
                    low = min(low, value)
                pooled[b, g, lane] = low
                bottom = min(bottom, low)
            least[g, b] = bottom


@njit(cache=True, nogil=True, fastmath=True)
def rows_minima(d, d_pooled, rows, lanes, limits, low, block):
    """Lowers low[i, r] to the least d + k that is below it and not above limits[i, r]; its block into block[i, r].

    d: (all, columns), d_pooled: (all, blocks). rows: (n,) the rows of d to look at, n a few that are alike: what none
    of them needs is left out together. limits, low, block: (n, groups * LANES); lanes with a limit below 0 are left
    out. Limits are lowered to `low`. No d + k lies below min(low[i, r], the limit that was given).

    One function without calls or slices, each of which would count references up and down, atomically.
    """
    values, pooled, least = lanes.values, lanes.pooled, lanes.least
    blocks, n = d_pooled.shape[1], len(rows)
    alike, found = np.empty(blocks, np.float32), np.empty(blocks, np.int32)
    part, limit = np.empty(LANES, np.float32), np.empty(LANES, np.float32)
    # a number that the compiler does not know: of loops of sixteen it makes sixteen branches
    width = pooled.shape[2]
    for b in range(blocks):
        alike[b] = d_pooled[rows[0], b]
    for i in range(1, n):
        row = rows[i]
        for b in range(blocks):
            alike[b] = min(alike[b], d_pooled[row, b])
    for g in range(least.shape[0]):
        first = g * LANES
        top = np.float32(-1)
        for lane in range(LANES):
            limit[lane] = limits[0, first + lane]
            for i in range(1, n):
                limit[lane] = max(limit[lane], limits[i, first + lane])
            top = max(top, limit[lane])
        if top < 0:
            continue
        count = 0
        for b in range(blocks):
            x = alike[b]
            if x + least[g, b] <= top:
                hit = np.int32(0)
                for lane in range(width):
                    hit |= np.int32(x + pooled[b, g, lane] <= limit[lane])
                if hit != 0:
                    found[count] = b
                    count += 1
        for index in range(count):
            b = found[index]
            for i in range(n):
                row = rows[i]
                x, hit = d_pooled[row, b], np.int32(0)
                for lane in range(width):
                    hit |= np.int32(x + pooled[b, g, lane] <= limits[i, first + lane])
                if hit == 0:
                    continue
                for lane in range(LANES):
                    part[lane] = BIG
                # eight columns at a time, so that `part` is seldom touched
                for c in range(0, BLOCK, 8):
                    at = b * BLOCK + c
                    d0, d1, d2, d3 = d[row, at], d[row, at + 1], d[row, at + 2], d[row, at + 3]
                    d4, d5, d6, d7 = d[row, at + 4], d[row, at + 5], d[row, at + 6], d[row, at + 7]
                    for lane in range(LANES):
                        p = min(
                            min(d0 + values[b, g, c, lane], d1 + values[b, g, c + 1, lane]),
                            min(d2 + values[b, g, c + 2, lane], d3 + values[b, g, c + 3, lane]),
                        )
                        q = min(
                            min(d4 + values[b, g, c + 4, lane], d5 + values[b, g, c + 5, lane]),
                            min(d6 + values[b, g, c + 6, lane], d7 + values[b, g, c + 7, lane]),
                        )
                        part[lane] = min(part[lane], min(p, q))
                for lane in range(width):
                    block[i, first + lane] = b if part[lane] < low[i, first + lane] else block[i, first + lane]
                for lane in range(width):
                    low[i, first + lane] = min(low[i, first + lane], part[lane])
                for lane in range(width):
                    limits[i, first + lane] = min(limits[i, first + lane], part[lane])
