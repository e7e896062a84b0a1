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

from motion.onehop.compiled import inner, inner_fast
from motion.onehop.distances import BIG, FEASIBLE, pool_row
from motion.onehop.features import BLOCK
from motion.onehop.minplus import LANES, TOGETHER, rows_minima
from motion.onehop.pricing import new_memo, priced

# columns of a choice
R, COLUMN, STAY_SOURCE, FIRST, SECOND, STAY_HOP = range(6)
CHOICE = 6
CHUNK = 32  # blocks that are looked at together
COARSE = 4  # triggers and stays per one that gives a first bound


class Geometry(NamedTuple):
    """Of the layout. first, period, looping, frame0: (clips,). counts: (lengths, clips) windows. block_clip: (blocks,).
    lengths: (lengths,). x, y, z: flat frames. weights: of the windows of every length, one after the other, beginning
    at weight0: (lengths + 1,). scale: (lengths,). mean_x, mean_y: (lengths, frames), see `pricing.exact`. points: P."""

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
    mean_x: np.ndarray
    mean_y: np.ndarray
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


@njit(cache=True, nogil=True, fastmath=True)
def slide(e, rows, k0, k1, first, count, period, looping, length, weight, max_stay, extra, buffer, out, minima):
    """Cost-to-go of one clip for frames k0..k1 - 1 of the destination: out[k, first + u] = extra + the least of
    e[rows[k + s], first + u + length + s] + w s over s.

    first, count: the clip's first column and its columns. rows: (frames + max_stay,). out: (frames, columns). buffer:
    (k1 - k0 + max_stay) * (count + max_stay) float32 of scratch. minima: (frames, blocks), of blocks of columns; the
    columns that fill up the last one get BIG.
    """
    total, width = k1 - k0 + max_stay, count + max_stay
    # few rows at a time, so that what is folded stays in the cache
    work = buffer.reshape(total, width)
    for j in range(total):
        line, row = work[j], rows[k0 + j]
        if row < 0:
            for c in range(width):
                line[c] = BIG
            continue
        source = e[row]
        if looping:
            for c in range(width):
                line[c] = source[first + (c + length) % period]
        else:
            inside = max(count - length, 0)
            part = source[first + count - inside : first + count]
            for c in range(inside):
                line[c] = part[c]
            for c in range(inside, width):
                line[c] = BIG
    # a line of `work` covers n stays, four times as many after each pass
    n, stays = 1, max_stay + 1
    while 4 * n < stays:
        for j in range(total - 3 * n):
            at_n, at_2n, at_3n = work[j + n][n:], work[j + 2 * n][2 * n :], work[j + 3 * n][3 * n :]
            _fold(work[j][: width - 3 * n], at_n, at_2n, at_3n, n, weight)
        # what is left at the ends covers less, but is not needed
        total, width = total - 3 * n, width - 3 * n
        n *= 4
    block, last = first // BLOCK, -(-(first + count) // BLOCK)
    scratch = np.empty(BLOCK, np.float32)
    p, q, r = min(n, stays - n), min(2 * n, stays - n), min(3 * n, stays - n)
    wp, wq, wr = np.float32(weight * p), np.float32(weight * q), np.float32(weight * r)
    for j in range(k1 - k0):
        target, line = out[k0 + j][first : first + count], work[j]
        at_p, at_q, at_r = work[j + p][p:], work[j + q][q:], work[j + r][r:]
        for c in range(count):
            target[c] = min(min(line[c], at_p[c] + wp), min(at_q[c] + wq, at_r[c] + wr)) + extra
        out[k0 + j, first + count : last * BLOCK] = BIG
        pool_row(out, k0 + j, block, last, minima, scratch)


@inner_fast
def _fold(line, at_n, at_2n, at_3n, n, weight):
    """Minimum with the entries at n, 2 n and 3 n stays more, which lie as much further down the diagonal."""
    w1, w2, w3 = np.float32(weight * n), np.float32(weight * (2 * n)), np.float32(weight * (3 * n))
    for c in range(len(line)):
        line[c] = min(min(line[c], at_n[c] + w1), min(at_2n[c] + w2, at_3n[c] + w3))


@inner_fast
def any_below(a, b, start, count, bound):
    """Whether a + b <= bound anywhere in start..start + count - 1."""
    hit = np.int32(0)
    for i in range(count):
        # unsigned, else a check for negative indices hinders vector code
        j = np.uint64(start) + np.uint64(i)
        hit |= np.int32(a[j] + b[j] <= bound)
    return hit != 0


@inner_fast
def least(d, d_pooled, k, k_pooled, bound, work):
    """(value, column) of the least d + k below `bound`; column -1 if there is none. Looks only into blocks that may.

    work: (BLOCK,) float32 scratch.
    """
    best, blocks = -1, len(d_pooled)
    for start in range(0, blocks, CHUNK):
        count, hit = min(CHUNK, blocks - start), np.int32(0)
        for i in range(count):
            j = np.uint64(start) + np.uint64(i)
            hit |= np.int32(d_pooled[j] + k_pooled[j] < bound)
        if hit == 0:
            continue
        for block in range(start, start + count):
            if d_pooled[block] + k_pooled[block] >= bound:
                continue
            at = np.uint64(block * BLOCK)
            for i in range(BLOCK):
                c = np.uint64(i)
                work[i] = d[at + c] + k[at + c]
            # by halves: the compiler makes vector code of that but not of a running minimum
            for i in range(BLOCK // 2):
                work[i] = min(work[i], work[i + BLOCK // 2])
            for i in range(8):
                work[i] = min(work[i], work[i + 8])
            low = min(
                min(min(work[0], work[1]), min(work[2], work[3])), min(min(work[4], work[5]), min(work[6], work[7]))
            )
            if low < bound:
                bound, best = low, column_of(d, k, block, low)
    return bound, best


@inner
def above(limit):
    """A float32 that is not less than `limit` (m^2)."""
    return np.float32(min(limit * (1 + 2.0**-22) + 1e-30, FEASIBLE))


@inner
def finish(geometry, goal, length, column, k, start, best, choice, memo):
    """Best exact way on from entering the hop at `column`, with the costs so far in `start` (D + what else).

    Replaces `best` and `choice` (its R without s_s, which is not known here) if it is better; returns `best`.
    """
    # arrays of tuples are taken out before a loop: each access would count a reference up and down, atomically
    e, rows, weight = goal.e, goal.rows, goal.weight
    clip, b = geometry.block_clip[column // BLOCK], geometry.lengths[length]
    first, looping, period = geometry.first[clip], geometry.looping[clip], geometry.period[clip]
    u, windows = column - first, geometry.counts[0, clip]
    charge = b - geometry.lengths[0]
    paid = start + goal.hop_cost[clip] + weight * charge
    # the stay with the least lower bound first: its exact cost leaves few of the others
    likely, bound = -1, np.inf
    for stay in range(goal.max_stay + 1):
        if paid + weight * stay > min(best, bound):
            break
        row = rows[length, k + stay]
        x = (u + b + stay) % period if looping else u + b + stay
        if not looping and x >= windows:
            break
        if row >= 0 and paid + weight * stay + e[row, first + x] < bound:
            likely, bound = stay, paid + weight * stay + e[row, first + x]
    if likely < 0 or bound > best:
        return best
    for turn in range(-1, goal.max_stay + 1):
        stay = likely if turn < 0 else turn
        if paid + weight * stay > best:
            if turn < 0:
                continue
            break
        row = rows[length, k + stay]
        x = (u + b + stay) % period if looping else u + b + stay
        if not looping and x >= windows:
            break
        if row >= 0 and turn != likely and paid + weight * stay + e[row, first + x] <= best:
            best = _arrive(geometry, goal, length, column, clip, x, row, stay, charge, paid, best, choice, memo)
    return best


@inner
def _arrive(geometry, goal, length, column, clip, x, row, stay, charge, paid, best, choice, memo):
    """Best of leaving the hop at its window x after `stay` frames, by all lengths of the last blend; see `finish`."""
    v = goal.row0 + row
    for second in range(len(geometry.lengths)):
        if x >= geometry.counts[second, clip] or v >= geometry.counts[second, goal.clip]:
            continue
        extra = stay + geometry.lengths[second] - geometry.lengths[0]
        if paid + goal.weight * extra > best:
            continue
        d = priced(geometry, second, geometry.frame0[clip] + x, geometry.frame0[goal.clip] + v, memo)
        cost, r = paid + d + goal.weight * extra, extra + charge
        if cost < best or (cost == best and _before(r, column, length, second, choice)):
            best = cost
            choice[R], choice[COLUMN], choice[FIRST] = r, column, length
            choice[SECOND], choice[STAY_HOP] = second, stay
    return best


@inner
def _before(r, column, first, second, choice):
    """Whether a way comes before `choice`, which has the same cost and the same s_s."""
    if choice[COLUMN] < 0 or r != choice[R]:
        return choice[COLUMN] < 0 or r < choice[R]
    if column != choice[COLUMN]:
        return column < choice[COLUMN]
    if first != choice[FIRST]:
        return first < choice[FIRST]
    return second < choice[SECOND]


@inner
def earlier(a, b):
    """Whether choice `a` comes before choice `b` at the same cost; an empty one (column -1) comes last."""
    if b[COLUMN] < 0:
        return True
    for field in range(STAY_HOP):
        if a[field] != b[field]:
            return a[field] < b[field]
    return False


@inner
def exact_entry(geometry, goal, length, window, d, d_pooled, k_row, k_pooled, k, limit, choice, memo):
    """Least exact cost up to `limit` of leaving at `window` (row of the frames) while the destination's frame is k.

    Writes its choice (R without s_s) and returns its cost, or returns infinity and leaves column -1.
    """
    choice[COLUMN] = -1
    best, blocks = limit, len(d_pooled)
    for start in range(0, blocks, CHUNK):
        count = min(CHUNK, blocks - start)
        if not any_below(d_pooled, k_pooled, start, count, above(best)):
            continue
        for block in range(start, start + count):
            if d_pooled[block] + k_pooled[block] > best:
                continue
            if not any_below(d, k_row, block * BLOCK, BLOCK, above(best)):
                continue
            clip = geometry.block_clip[block]
            for column in range(block * BLOCK, block * BLOCK + BLOCK):
                # in float64, so that the comparison itself rounds nothing up
                if np.float64(d[column]) + k_row[column] > best:
                    continue
                u = column - geometry.first[clip]
                cost = priced(geometry, length, window, geometry.frame0[clip] + u, memo)
                if cost + k_row[column] > best:
                    continue
                best = finish(geometry, goal, length, column, k, cost, best, choice, memo)
    return best if choice[COLUMN] >= 0 else np.inf


@njit(cache=True, nogil=True)
def reachable(t0, t1, period, looping, max_stay, d, d_pooled, k, k_pooled, weight, upper):
    """upper[t - t0]: a d + k + w s that trigger t can reach with s_s = s, near the least; FEASIBLE if none is known.

    Every COARSE-th trigger is searched, at every COARSE-th stay; what it finds is tried, one frame further on both
    sides or with another stay, for those beside it.
    """
    work = np.empty(BLOCK, np.float32)
    stays, columns = np.empty(t1 - t0, np.int64), np.empty(t1 - t0, np.int64)
    for step in range(2):
        # forth, and back for the triggers before a searched one
        for i in range(t1 - t0):
            t, other = (t0 + i, i - 1) if step == 0 else (t1 - 1 - i, t1 - t0 - i)
            at = t - t0
            if step == 0:
                upper[at], stays[at], columns[at] = FEASIBLE, -1, -1
            if 0 <= other < t1 - t0 and stays[other] >= 0:
                for guess in range(2):
                    stay = stays[other] + (guess if step else -guess)
                    column = columns[other] + (1 - guess) * (1 - 2 * step)
                    a = (t + stay) % period if looping else t + stay
                    if 0 <= stay <= max_stay and 0 <= column < d.shape[1] and a < len(d):
                        value = np.float32(d[a, column] + k[stay, column] + weight * np.float32(stay))
                        if value < upper[at]:
                            upper[at], stays[at], columns[at] = value, stay, column
            if step == 0 and i % COARSE == 0:
                for stay in range(0, max_stay + 1, COARSE):
                    charge = np.float32(weight * np.float32(stay))
                    a = (t + stay) % period if looping else t + stay
                    if a >= len(d) or charge >= upper[at]:
                        break
                    value, column = least(
                        d[a], d_pooled[a], k[stay], k_pooled[stay], np.float32(upper[at] - charge), work
                    )
                    if column >= 0:
                        upper[at], stays[at], columns[at] = value + charge, stay, column


@njit(cache=True, nogil=True)
def stay_minima(t0, t1, period, looping, max_stay, d, d_pooled, lanes, weight, slack, upper, low, block):
    """low[r, s]: lower bound of the d + k of trigger t0 + r - s with s_s = s, attained in block[r, s] (-1: nowhere).

    It is their minimum wherever that, with its w s, lies within `slack` of the least of the trigger. upper: (t1 - t0,)
    of `reachable`, lowered to that least.
    """
    limits, given = np.empty((TOGETHER, low.shape[1]), np.float32), np.empty((TOGETHER, low.shape[1]), np.float32)
    rows, count = np.empty(TOGETHER, np.int64), t1 - t0
    low[:], block[:] = BIG, -1
    for start in range(0, len(low), TOGETHER):
        stop = min(start + TOGETHER, len(low))
        for r in range(start, stop):
            a = (t0 + r) % period if looping else t0 + r
            if a >= len(d):
                stop = r
                break
            rows[r - start], limits[r - start] = a, -1
            for s in range(max(0, r - (count - 1)), min(max_stay, r) + 1):
                limits[r - start, s] = upper[r - s] + slack - weight * np.float32(s)
        if stop == start:
            break
        given[:] = limits
        rows_minima(
            d, d_pooled, rows[: stop - start], lanes, limits[: stop - start], low[start:stop], block[start:stop]
        )
        for r in range(start, stop):
            for s in range(max(0, r - (count - 1)), min(max_stay, r) + 1):
                upper[r - s] = min(upper[r - s], np.float32(low[r, s] + weight * np.float32(s)))
                low[r, s] = max(min(low[r, s], given[r - start, s]), np.float32(0))


@inner
def column_of(d, k, block, value):
    """The first column of `block` in which d + k is `value`; -1 if none is."""
    for c in range(block * BLOCK, block * BLOCK + BLOCK):
        if d[c] + k[c] == value:
            return c
    return -1


@njit(cache=True, nogil=True)
def start_regime(
    geometry, goal, length, source, t0, t1, d, d_pooled, k, k_pooled, lanes, weight, slack, cost, choice
):
    """Optimum of triggers t0..t1 - 1 of clip `source` in the regime "start", where k = s_s.

    d: (windows, columns) of the source. k: (max_stay + 1 or more, columns). weight: w as a float32 lower bound.
    slack: about how far exact costs lie above their lower bounds, m^2 (for speed only). cost: (triggers,), choice:
    (triggers, CHOICE): improved in place (other first lengths were there before).
    """
    memo = new_memo(geometry)
    period, looping = geometry.period[source], geometry.looping[source]
    found = np.empty(CHOICE, np.int64)
    upper = np.empty(t1 - t0, np.float32)
    low = np.empty((t1 - t0 + goal.max_stay, lanes.pooled.shape[1] * LANES), np.float32)
    block = np.empty(low.shape, np.int32)
    reachable(t0, t1, period, looping, goal.max_stay, d, d_pooled, k, k_pooled, weight, upper)
    stay_minima(t0, t1, period, looping, goal.max_stay, d, d_pooled, lanes, weight, slack, upper, low, block)
    base = geometry.frame0[source]
    for t in range(t0, t1):
        bound, stay_at = np.float32(FEASIBLE), -1
        for stay in range(goal.max_stay + 1):
            if block[t - t0 + stay, stay] >= 0:
                value = np.float32(low[t - t0 + stay, stay] + weight * np.float32(stay))
                if value < bound:
                    bound, stay_at = value, stay
        if stay_at < 0:
            continue
        r = t - t0 + stay_at
        a = (t + stay_at) % period if looping else t + stay_at
        column_at = column_of(d[a], k[stay_at], block[r, stay_at], low[r, stay_at])
        # its exact cost bounds the optimum from above; all that might be below is then priced exactly too
        clip = geometry.block_clip[column_at // BLOCK]
        own = priced(
            geometry, length, base + a, geometry.frame0[clip] + column_at - geometry.first[clip], memo
        )
        found[COLUMN] = -1
        limit = goal.weight * stay_at + finish(
            geometry, goal, length, column_at, stay_at, own, np.inf, found, memo
        )
        limit = min(limit, cost[t])
        for stay in range(goal.max_stay + 1):
            a = (t + stay) % period if looping else t + stay
            if a >= len(d) or goal.weight * stay > limit:
                break
            if low[t - t0 + stay, stay] + goal.weight * stay > limit:
                continue
            value = goal.weight * stay + exact_entry(
                geometry, goal, length, base + a, d[a], d_pooled[a], k[stay], k_pooled[stay], stay,
                limit - goal.weight * stay, found, memo,
            )  # fmt: skip
            if found[COLUMN] >= 0:
                found[R] += stay
                found[STAY_SOURCE] = stay
                if value < cost[t] or (value == cost[t] and earlier(found, choice[t])):
                    cost[t] = value
                    choice[t] = found
                    limit = min(limit, value)


@njit(cache=True, nogil=True)
def fixed_entries(geometry, goal, length, source, first, d, d_pooled, k, k_pooled, at, k_rows, cost, entries):
    """Exact optimum of leaving `source` at its windows first.. in the regime "fixed", where it serves all triggers.

    d: (rows, columns) of these windows. at, k_rows: (frames,) of these windows or of the first of them, a cycle later:
    row of k, and of K as a whole; -1 where there is none. cost: (frames,), entries: (frames, CHOICE), without s_s:
    written where there is a candidate.
    """
    memo = new_memo(geometry)
    work = np.empty(BLOCK, np.float32)
    base = geometry.frame0[source]
    column = -1
    for j in range(len(at)):
        row = at[j]
        if row < 0:
            continue
        bound, guess = np.float32(FEASIBLE), -1
        if column >= 0:
            # a window further on both sides is often as good
            guess = min(column + 1, d.shape[1] - 1)
            value = np.float32(d[j, guess] + k[row, guess])
            if value < bound:
                bound = value
            else:
                guess = -1
        _, column = least(d[j], d_pooled[j], k[row], k_pooled[row], bound, work)
        if column < 0:
            column = guess
        if column < 0:
            continue
        window, clip = base + first + j, geometry.block_clip[column // BLOCK]
        own = priced(geometry, length, window, geometry.frame0[clip] + column - geometry.first[clip], memo)
        limit = finish(geometry, goal, length, column, k_rows[j], own, np.inf, entries[j], memo)
        cost[j] = exact_entry(
            geometry, goal, length, window, d[j], d_pooled[j], k[row], k_pooled[row], k_rows[j], limit, entries[j], memo
        )


@njit(cache=True, nogil=True)
def fixed_regime(triggers, max_stay, weight, entry_cost, entries, cost, choice):
    """Optimum of the triggers from those of `fixed_entries`. cost, choice: improved in place, as in `start_regime`."""
    found = np.empty(CHOICE, np.int64)
    for t in triggers:
        for i in range(t, min(t + max_stay + 1, len(entries))):
            value = entry_cost[i] + weight * (i - t)
            if entries[i, COLUMN] < 0 or value > cost[t]:
                continue
            found[:] = entries[i]
            found[R] += i - t
            found[STAY_SOURCE] = i - t
            if value < cost[t] or earlier(found, choice[t]):
                cost[t] = value
                choice[t] = found
