"""Compiled kernels of the search: cost-to-go, pruned minima of lower bounds, exact choice among what is left.

A row of a slab is a window of the clip that is left, a column one of the clip that is entered (`features.Layout`).
K[k, u] is a lower bound of the cost-to-go of entering the hop at column u while the destination's frame is k:
min over s_h of D(hop, destination) + w s_h, plus the terms that depend on the hop alone. Entries with the same k + s_h
lie on diagonals, so the minimum is a sliding one.

Every choice is the least (cost, R, column, s_s, first length, second length): costs are exact multiples of QUANTUM,
so the order of evaluation does not matter.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from motion.onehop.distances import BIG, FEASIBLE, exact_on_grid, smallest
from motion.onehop.features import BLOCK

# columns of a choice
R, COLUMN, STAY_SOURCE, FIRST, SECOND, STAY_HOP = range(6)
CHOICE = 6
MEMO = 1 << 14
CHUNK = 32  # blocks that are looked at together


class Geometry(NamedTuple):
    """Of the layout. first, period, looping, frame0: (clips,). counts: (lengths, clips) windows. block_clip: (blocks,).
    lengths: (lengths,). x, y, z: flat frames. weights: of the windows of every length, one after the other, beginning
    at weight0: (lengths + 1,). scale: (lengths,). points: P."""

    first: np.ndarray
    period: np.ndarray
    looping: np.ndarray
    frame0: np.ndarray
    counts: np.ndarray
    block_clip: np.ndarray
    lengths: np.ndarray
    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    weights: np.ndarray
    weight0: np.ndarray
    scale: np.ndarray
    points: int


class Goal(NamedTuple):
    """Of one destination. clip: index. e: (rows, columns) lower bounds of D(destination window row0 + row, column).
    rows: (lengths, frames) row of e for k + s_h, by the length of the blend before; -1 without window.
    hop_cost: (clips,) G(i), m^2, on the grid. weight: w, on the grid. max_stay: s_max."""

    clip: int
    e: np.ndarray
    row0: int
    rows: np.ndarray
    hop_cost: np.ndarray
    weight: float
    max_stay: int


@njit(cache=True, nogil=True)
def priced(geometry, length, first, second, keys, values):
    """D, on the grid, of two windows (rows of the frames) of length index `length`; remembered in keys, values."""
    low, high = min(first, second), max(first, second)
    key = (np.int64(low) * len(geometry.x) + high) * 16 + length
    slot = (key * -7046029254386353131 >> 40) & (MEMO - 1)
    if keys[slot] != key:
        weights = geometry.weights[geometry.weight0[length] : geometry.weight0[length + 1]]
        values[slot] = exact_on_grid(
            geometry.x, geometry.y, geometry.z, weights, geometry.points, low, high, geometry.scale[length]
        )
        keys[slot] = key
    return values[slot]


@njit(cache=True, nogil=True, fastmath=True)
def slide(e, rows, first, count, period, looping, length, weight, max_stay, extra, work, out):
    """Cost-to-go of the columns of one clip: out[k, u] = extra + min over s of e[rows[k + s], u + length + s] + w s.

    out: (frames, count) part of K. rows: (frames + max_stay,). work: (frames + max_stay, count + max_stay) scratch.
    """
    total, width = out.shape[0] + max_stay, count + max_stay
    for j in range(total):
        line = work[j]
        if rows[j] < 0:
            for c in range(width):
                line[c] = BIG
            continue
        source = e[rows[j]]
        for c in range(width):
            at = c + length
            if looping:
                line[c] = source[first + at % period]
            elif at < count:
                line[c] = source[first + at]
            else:
                line[c] = BIG
    span, stays = 1, max_stay + 1
    while span * 2 <= stays:
        _fold(work, total, width, span, weight)
        span *= 2
    if span < stays:
        _fold(work, total, width, stays - span, weight)
    for k in range(out.shape[0]):
        line, target = work[k], out[k]
        for c in range(count):
            target[c] = line[c] + extra


@njit(cache=True, nogil=True, fastmath=True)
def _fold(work, total, width, span, weight):
    """Minimum with the entry `span` further down the diagonal, at `span` stays more."""
    extra = np.float32(weight * span)
    for j in range(total - span):
        line, later = work[j], work[j + span][span:]
        for c in range(width - span):
            line[c] = min(line[c], later[c] + extra)


@njit(cache=True, nogil=True, fastmath=True)
def any_below(a, b, bound):
    """Whether a + b <= bound anywhere."""
    hit = np.int32(0)
    for i in range(len(a)):
        hit |= np.int32(a[i] + b[i] <= bound)
    return hit != 0


@njit(cache=True, nogil=True, fastmath=True)
def least(d, d_pooled, k, k_pooled, bound, work):
    """(value, column) of the least d + k below `bound`; column -1 if there is none. Looks only into blocks that may.

    work: (blocks + 2 BLOCK,) float32 scratch.
    """
    best, blocks = -1, len(d_pooled)
    sums, part, half = work[:blocks], work[blocks : blocks + BLOCK], work[blocks + BLOCK :]
    for i in range(blocks):
        sums[i] = d_pooled[i] + k_pooled[i]
    for start in range(0, blocks, CHUNK):
        stop, hit = min(start + CHUNK, blocks), np.int32(0)
        for i in range(start, stop):
            hit |= np.int32(sums[i] < bound)
        if hit == 0:
            continue
        for i in range(start, stop):
            if sums[i] < bound:
                at = i * BLOCK
                p, q = d[at : at + BLOCK], k[at : at + BLOCK]
                for c in range(BLOCK):
                    part[c] = p[c] + q[c]
                low = smallest(part, half)
                if low < bound:
                    bound = low
                    for c in range(BLOCK):
                        if part[c] == low:
                            best = at + c
                            break
    return bound, best


@njit(cache=True, nogil=True)
def above(limit):
    """A float32 that is not less than `limit` (m^2)."""
    return np.float32(min(limit * (1 + 2.0**-22) + 1e-30, FEASIBLE))


@njit(cache=True, nogil=True)
def finish(geometry, goal, length, column, k, start, best, choice, keys, values):
    """Best exact way on from entering the hop at `column`, with the costs so far in `start` (D + what else).

    Replaces `best` and `choice` (its R without s_s, which is not known here) if it is better; returns `best`.
    """
    clip = geometry.block_clip[column // BLOCK]
    u, first = column - geometry.first[clip], geometry.first[clip]
    shortest = geometry.lengths[0]
    paid = start + goal.hop_cost[clip] + goal.weight * (geometry.lengths[length] - shortest)
    for stay in range(goal.max_stay + 1):
        if paid + goal.weight * stay > best:
            break
        row = goal.rows[length, k + stay]
        x = u + geometry.lengths[length] + stay
        if geometry.looping[clip]:
            x %= geometry.period[clip]
        elif x >= geometry.counts[0, clip]:
            break
        if row < 0 or paid + goal.weight * stay + goal.e[row, first + x] > best:
            continue
        for second in range(len(geometry.lengths)):
            v = goal.row0 + row
            if x >= geometry.counts[second, clip] or v >= geometry.counts[second, goal.clip]:
                continue
            extra = geometry.lengths[second] - shortest
            if paid + goal.weight * (stay + extra) > best:
                continue
            d = priced(
                geometry, second, geometry.frame0[clip] + x, geometry.frame0[goal.clip] + v, keys, values
            )
            cost = paid + d + goal.weight * (stay + extra)
            r = stay + extra + geometry.lengths[length] - shortest
            if cost < best or (cost == best and _before(r, column, length, second, choice)):
                best = cost
                choice[R], choice[COLUMN], choice[FIRST] = r, column, length
                choice[SECOND], choice[STAY_HOP] = second, stay
    return best


@njit(cache=True, nogil=True)
def _before(r, column, first, second, choice):
    """Whether a way comes before `choice`, which has the same cost and the same s_s."""
    if choice[COLUMN] < 0 or r != choice[R]:
        return choice[COLUMN] < 0 or r < choice[R]
    if column != choice[COLUMN]:
        return column < choice[COLUMN]
    if first != choice[FIRST]:
        return first < choice[FIRST]
    return second < choice[SECOND]


@njit(cache=True, nogil=True)
def direct_costs(geometry, weights, first, second, out):
    """out[i]: D on the grid of the windows at rows first[i], second[i] of the frames; infinity where one is -1."""
    for i in range(len(out)):
        out[i] = np.inf
        if first[i] >= 0 and second[i] >= 0:
            out[i] = exact_on_grid(
                geometry.x, geometry.y, geometry.z, weights, geometry.points, first[i], second[i], 1.0
            )


@njit(cache=True, nogil=True)
def earlier(a, b):
    """Whether choice `a` comes before choice `b` at the same cost; an empty one (column -1) comes last."""
    if b[COLUMN] < 0:
        return True
    for field in range(STAY_HOP):
        if a[field] != b[field]:
            return a[field] < b[field]
    return False


@njit(cache=True, nogil=True)
def exact_entry(geometry, goal, length, window, d, d_pooled, k_row, k_pooled, k, limit, choice, keys, values):
    """Least exact cost up to `limit` of leaving at `window` (row of the frames) while the destination's frame is k.

    Writes its choice (R without s_s) and returns its cost, or returns infinity and leaves column -1.
    """
    choice[COLUMN] = -1
    best = limit
    for start in range(0, len(d_pooled), CHUNK):
        if not any_below(d_pooled[start : start + CHUNK], k_pooled[start : start + CHUNK], above(best)):
            continue
        for block in range(start, min(start + CHUNK, len(d_pooled))):
            if d_pooled[block] + k_pooled[block] > best:
                continue
            at = block * BLOCK
            if not any_below(d[at : at + BLOCK], k_row[at : at + BLOCK], above(best)):
                continue
            clip = geometry.block_clip[block]
            for column in range(at, at + BLOCK):
                # in float64, so that the comparison itself rounds nothing up
                if np.float64(d[column]) + k_row[column] > best:
                    continue
                u = column - geometry.first[clip]
                cost = priced(geometry, length, window, geometry.frame0[clip] + u, keys, values)
                if cost + k_row[column] > best:
                    continue
                best = finish(geometry, goal, length, column, k, cost, best, choice, keys, values)
    return best if choice[COLUMN] >= 0 else np.inf


@njit(cache=True, nogil=True)
def start_regime(
    geometry, goal, length, source, t0, t1, d, d_pooled, k, k_pooled, weight, slack, cost, choice
):
    """Optimum of triggers t0..t1 - 1 of clip `source` in the regime "start", where k = s_s.

    d: (windows, columns) of the source. k: (max_stay + 1 or more, columns). weight: w as a float32 lower bound.
    slack: about how far exact costs lie above their lower bounds, m^2 (for speed only). cost: (triggers,), choice:
    (triggers, CHOICE): improved in place (other first lengths were there before).
    """
    keys, values = np.full(MEMO, -1, np.int64), np.empty(MEMO)
    windows, period, looping = geometry.counts[length, source], geometry.period[source], geometry.looping[source]
    found = np.empty(CHOICE, np.int64)
    work, row_low = np.empty(d_pooled.shape[1] + 2 * BLOCK, np.float32), np.empty(goal.max_stay + 1, np.float32)
    last_stay, last_column = -1, -1
    for t in range(t0, t1):
        row_low[:] = 0
        # a candidate to begin with: that of the trigger before, one stay less or one frame on
        bound, stay_at, column_at = np.float32(FEASIBLE), -1, -1
        if last_column >= 0:
            stay = max(last_stay - 1, 0)
            column = last_column if last_stay > 0 else min(last_column + 1, d.shape[1] - 1)
            a = t + stay
            if looping:
                a %= period
            if a < windows:
                value = np.float32(d[a, column] + k[stay, column] + weight * np.float32(stay))
                if value < bound:
                    bound, stay_at, column_at = value, stay, column
        for stay in range(goal.max_stay + 1):
            charge = np.float32(weight * np.float32(stay))
            a = t + stay
            if looping:
                a %= period
            if a >= windows or charge >= bound:
                break
            # a little above the bound, so that the row's own minimum is known if it may matter below
            row_low[stay], column = least(
                d[a], d_pooled[a], k[stay], k_pooled[stay], np.float32(bound - charge + slack), work
            )
            if column >= 0 and row_low[stay] + charge < bound:
                bound, stay_at, column_at = row_low[stay] + charge, stay, column
        last_stay, last_column = stay_at, column_at
        if column_at < 0:
            continue
        a = t + stay_at
        if looping:
            a %= period
        # its exact cost bounds the optimum from above; all that might be below is then priced exactly too
        clip = geometry.block_clip[column_at // BLOCK]
        base = geometry.frame0[source]
        own = priced(
            geometry, length, base + a, geometry.frame0[clip] + column_at - geometry.first[clip], keys, values
        )
        found[COLUMN] = -1
        limit = goal.weight * stay_at + finish(
            geometry, goal, length, column_at, stay_at, own, np.inf, found, keys, values
        )
        limit = min(limit, cost[t])
        for stay in range(goal.max_stay + 1):
            a = t + stay
            if looping:
                a %= period
            if a >= windows or goal.weight * stay > limit:
                break
            if row_low[stay] + goal.weight * stay > limit:
                continue
            value = goal.weight * stay + exact_entry(
                geometry, goal, length, base + a, d[a], d_pooled[a], k[stay], k_pooled[stay], stay,
                limit - goal.weight * stay, found, keys, values,
            )  # fmt: skip
            if found[COLUMN] >= 0:
                found[R] += stay
                found[STAY_SOURCE] = stay
                if value < cost[t] or (value == cost[t] and earlier(found, choice[t])):
                    cost[t] = value
                    choice[t] = found
                    limit = min(limit, value)


@njit(cache=True, nogil=True)
def fixed_lower(first, last, period, k_rows, d, d_pooled, k, k_pooled, low, at):
    """Least lower bound low[a] and its column at[a] of row a % period of d with row k_rows[a] of k, -1 if none."""
    column = -1
    work = np.empty(d_pooled.shape[1] + 2 * BLOCK, np.float32)
    for i in range(first, last):
        low[i], at[i] = BIG, -1
        a, b = i % period, k_rows[i]
        if b < 0:
            column = -1
            continue
        bound, guess = np.float32(FEASIBLE), -1
        if column >= 0:
            guess = min(column + 1, d.shape[1] - 1)
            value = np.float32(d[a, guess] + k[b, guess])
            if value < bound:
                bound = value
            else:
                guess = -1
        value, column = least(d[a], d_pooled[a], k[b], k_pooled[b], bound, work)
        if column < 0:
            column, value = guess, bound
        if column >= 0:
            low[i], at[i] = value, column


@njit(cache=True, nogil=True)
def fixed_regime(
    geometry, goal, length, source, t0, t1, k_rows, low, at, d, d_pooled, k, k_pooled, cost, choice
):
    """Optimum of triggers t0..t1 - 1 in the regime "fixed", where the row of k depends on the source's frame only.

    k_rows, low, at: per frame of the source, for a looping one also beyond its period. cost, choice: as there.
    """
    keys, values = np.full(MEMO, -1, np.int64), np.empty(MEMO)
    period = geometry.period[source]
    # the exact optimum of a frame serves all triggers before it
    known = np.full(len(at), -1.0)
    entries = np.empty((len(at), CHOICE), np.int64)
    found = np.empty(CHOICE, np.int64)
    base = geometry.frame0[source]
    for t in range(t0, t1):
        last = min(t + goal.max_stay, len(at) - 1)
        limit, best, best_at = cost[t], np.inf, -1
        for a in range(t, last + 1):
            if at[a] >= 0 and low[a] + goal.weight * (a - t) < best:
                best, best_at = low[a] + goal.weight * (a - t), a
        if best_at < 0:
            continue
        # the frame with the least lower bound first: its exact cost leaves few of the others
        for step in range(-1, last - t + 1):
            a = best_at if step < 0 else t + step
            stay = a - t
            if at[a] < 0 or low[a] + goal.weight * stay > limit or (step >= 0 and a == best_at):
                continue
            if known[a] < 0:
                row = a % period
                known[a] = _fixed_entry(
                    geometry, goal, length, base + row, d[row], d_pooled[row], k, k_pooled, k_rows[a], at[a],
                    entries[a], keys, values,
                )  # fmt: skip
            value = known[a] + goal.weight * stay
            if value > cost[t]:
                continue
            found[:] = entries[a]
            found[R] += stay
            found[STAY_SOURCE] = stay
            if value < cost[t] or earlier(found, choice[t]):
                cost[t] = value
                choice[t] = found
                limit = min(limit, value)


@njit(cache=True, nogil=True)
def _fixed_entry(
    geometry, goal, length, window, d, d_pooled, k, k_pooled, k_row, column, choice, keys, values
):
    """Exact optimum of one window of the source; `column` has the least lower bound."""
    clip = geometry.block_clip[column // BLOCK]
    own = priced(
        geometry, length, window, geometry.frame0[clip] + column - geometry.first[clip], keys, values
    )
    choice[COLUMN] = -1
    limit = finish(geometry, goal, length, column, k_row, own, np.inf, choice, keys, values)
    return exact_entry(
        geometry, goal, length, window, d, d_pooled, k[k_row], k_pooled[k_row], k_row, limit, choice, keys, values
    )
