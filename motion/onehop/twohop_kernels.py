"""Compiled kernels of two hops; see `twohop`. Named as in `kernels`; Q[r, x] and H[k, u] as there."""

import numpy as np
from numba import njit

from motion.onehop import kernels
from motion.onehop.compiled import inner
from motion.onehop.distances import BIG, FEASIBLE
from motion.onehop.features import BLOCK
from motion.onehop.kernels import CHOICE, CHUNK, COLUMN, R, above, any_below, column_of, finish, least, stay_minima
from motion.onehop.minplus import LANES, TOGETHER, rows_minima
from motion.onehop.pricing import new_memo, priced


@njit(cache=True, nogil=True)
def product(d, d_pooled, k, lanes, limits, charge, column, q, at):
    """q[r, column + i] = min over columns c of d[i, c] + k[r, c], where that is below a limit; `at`: that c.

    limits: (rows of d,), less charge[r]. lanes: those of k.
    """
    count, width = len(charge), lanes.pooled.shape[1] * LANES
    limit, low = np.empty((TOGETHER, width), np.float32), np.empty((TOGETHER, width), np.float32)
    block, rows = np.empty((TOGETHER, width), np.int32), np.empty(TOGETHER, np.int64)
    guess = np.full(lanes.pooled.shape[1], -1, np.int64)
    for start in range(0, len(d), TOGETHER):
        n = min(TOGETHER, len(d) - start)
        low[:], block[:], limit[:] = BIG, -1, -1
        for i in range(n):
            rows[i] = start + i
            for r in range(count):
                limit[i, r] = limits[start + i] - charge[r]
            for g in range(len(guess)):
                # a window further on both sides is often as good
                c = guess[g] + 1 + i
                if guess[g] < 0 or c >= d.shape[1]:
                    continue
                for r in range(g * LANES, min((g + 1) * LANES, count)):
                    value = np.float32(d[start + i, c] + k[r, c])
                    if value <= limit[i, r]:
                        limit[i, r], low[i, r], block[i, r] = value, value, c // BLOCK
        rows_minima(d, d_pooled, rows[:n], lanes, limit[:n], low[:n], block[:n])
        guess[:] = -1
        for i in range(n):
            for r in range(count):
                if block[i, r] >= 0:
                    c = column_of(d[start + i], k[r], block[i, r], low[i, r])
                    q[r, column + start + i], at[r, column + start + i] = low[i, r], c
                    guess[r // LANES] = c + n - 1 - i


@njit(cache=True, nogil=True)
def _frame_minima(t0, t1, period, looping, max_stay, d, d_pooled, h, h_pooled, k_rows, weight, slack, cost, low, block):
    """`stay_minima` where the row of H depends on the source's frame only; one column of low and block."""
    work = np.empty(BLOCK, np.float32)
    for r in range(len(low)):
        low[r, 0], block[r, 0] = BIG, -1
        a = (t0 + r) % period if looping else t0 + r
        if a >= len(d) or k_rows[t0 + r] < 0:
            continue
        limit = np.float32(-1)
        for stay in range(max(0, r - (t1 - t0 - 1)), min(max_stay, r) + 1):
            limit = max(limit, np.float32(min(cost[t0 + r - stay], FEASIBLE) + slack - weight * np.float32(stay)))
        low[r, 0], column = least(d[a], d_pooled[a], h[k_rows[t0 + r]], h_pooled[k_rows[t0 + r]], limit, work)
        if column >= 0:
            block[r, 0] = column // BLOCK
        low[r, 0] = max(low[r, 0], np.float32(0))


@njit(cache=True, nogil=True)
def candidates(
    geometry, goal, source, t0, t1, d, d_pooled, h, h_pooled, h_lanes, k_rows, k0, q, q_column, rows, needed, weight,
    slack, cost, out,
):
    """Candidates of triggers t0..t1 - 1 whose lower bound does not exceed what is known to be reachable: their number,
    and in `out` (as far as there is room) trigger, s_s, column of the first hop, s_h. Marks what they need of q."""
    memo, found = new_memo(geometry), np.empty(CHOICE, np.int64)
    period, looping = geometry.period[source], geometry.looping[source]
    base, b, fixed, count = geometry.frame0[source], geometry.lengths[0], len(k_rows) > 0, 0
    size = min(t1 - t0 + goal.max_stay, len(k_rows) - t0) if fixed else t1 - t0 + goal.max_stay
    low = np.empty((max(size, 0), 1 if fixed else h_lanes.pooled.shape[1] * LANES), np.float32)
    block = np.empty(low.shape, np.int32)
    if fixed:
        _frame_minima(
            t0, t1, period, looping, goal.max_stay, d, d_pooled, h, h_pooled, k_rows, weight, slack, cost, low, block
        )
    else:
        upper = np.empty(t1 - t0, np.float32)
        for t in range(t0, t1):
            upper[t - t0] = min(cost[t] * (1 + 2.0**-20) + 1e-9, FEASIBLE)
        stay_minima(t0, t1, period, looping, goal.max_stay, d, d_pooled, h_lanes, weight, slack, upper, low, block)
    for t in range(t0, t1):
        bound, stay_at = np.float32(min(cost[t] * (1 + 2.0**-20) + 1e-9, FEASIBLE)), -1
        for stay in range(min(goal.max_stay + 1, len(low) - (t - t0))):
            lane = 0 if fixed else stay
            if block[t - t0 + stay, lane] >= 0:
                value = np.float32(low[t - t0 + stay, lane] + weight * np.float32(stay))
                if value < bound:
                    bound, stay_at = value, stay
        if stay_at < 0:
            continue
        limit = cost[t]
        # the exact cost of the candidate with the least lower bound, by the ways that attained the bounds
        a = (t + stay_at) % period if looping else t + stay_at
        row, lane = (k_rows[t + stay_at], 0) if fixed else (stay_at, stay_at)
        column_at = column_of(d[a], h[row], block[t - t0 + stay_at, lane], low[t - t0 + stay_at, lane])
        clip = geometry.block_clip[column_at // BLOCK]
        u, first = column_at - geometry.first[clip], geometry.first[clip]
        best, best_row, best_x, best_stay = np.float32(FEASIBLE), -1, -1, -1
        for stay in range(goal.max_stay + 1):
            x = _left(geometry, clip, u + b + stay)
            if x < 0:
                break
            r = rows[row + stay]
            if r < 0:
                continue
            value = np.float32(q[r, first + x] + weight * np.float32(stay))
            if value < best:
                best, best_row, best_x, best_stay = value, r, x, stay
        if best_row >= 0:
            way = priced(geometry, 0, base + a, geometry.frame0[clip] + u, memo) + goal.hop_cost[clip]
            second = np.int64(q_column[best_row, first + best_x])
            other = geometry.block_clip[second // BLOCK]
            way += priced(
                geometry, 0, geometry.frame0[clip] + best_x, geometry.frame0[other] + second - geometry.first[other],
                memo,
            ) + goal.weight * (stay_at + best_stay)  # fmt: skip
            found[COLUMN] = -1
            limit = min(limit, finish(geometry, goal, 0, second, k0 + best_row, way, np.inf, found, memo))
        for stay in range(min(goal.max_stay + 1, len(low) - (t - t0))):
            a = (t + stay) % period if looping else t + stay
            if a >= len(d) or goal.weight * stay > limit:
                break
            row, lane = (k_rows[t + stay], 0) if fixed else (stay, stay)
            if row < 0 or low[t - t0 + stay, lane] + goal.weight * stay > limit:
                continue
            count = _candidates_of_row(
                geometry, goal, t, stay, base + a, d[a], d_pooled[a], h[row], h_pooled[row], row,
                limit - goal.weight * stay, q, rows, needed, out, count, memo,
            )  # fmt: skip
    return count


@inner
def _left(geometry, clip, frame):
    """Window of `clip` at `frame`, or -1 if it has none there."""
    if geometry.looping[clip]:
        return frame % geometry.period[clip]
    return frame if frame < geometry.counts[0, clip] else -1


@inner
def _candidates_of_row(
    geometry, goal, t, stay, window, d, d_pooled, h, h_pooled, row, rest, q, rows, needed, out, count, memo
):
    """Those of trigger t with s_s = stay: they leave the source at `window` (row of the frames) and may cost `rest`."""
    for start in range(0, len(d_pooled), CHUNK):
        size = min(CHUNK, len(d_pooled) - start)
        if not any_below(d_pooled, h_pooled, start, size, above(rest)):
            continue
        for block in range(start, start + size):
            if d_pooled[block] + h_pooled[block] > rest:
                continue
            clip, at = geometry.block_clip[block], block * BLOCK
            first = geometry.first[clip]
            if not any_below(d, h, at, BLOCK, above(rest)):
                continue
            for column in range(at, at + BLOCK):
                if np.float64(d[column]) + h[column] > rest:
                    continue
                u = column - first
                own = priced(geometry, 0, window, geometry.frame0[clip] + u, memo)
                if own + h[column] > rest:
                    continue
                own += goal.hop_cost[clip]
                for stay_hop in range(goal.max_stay + 1):
                    x = _left(geometry, clip, u + geometry.lengths[0] + stay_hop)
                    if x < 0:
                        break
                    r = rows[row + stay_hop]
                    if r < 0 or own + goal.weight * stay_hop + q[r, first + x] > rest:
                        continue
                    needed[r, first + x] = 1
                    if count < len(out):
                        out[count, 0], out[count, 1], out[count, 2], out[count, 3] = t, stay, column, stay_hop
                    count += 1
    return count


@njit(cache=True, nogil=True)
def exact_entries(
    geometry, goal, clip, first, low, d, d_pooled, k, k_pooled, k0, q_column, indices, entry_keys, costs, choices
):
    """Exact optimum of entries of q whose columns lie in the strip of windows first.. of `clip` (columns low..)."""
    memo = new_memo(geometry)
    columns = q_column.shape[1]
    for index in indices:
        r, column = entry_keys[index] // columns, entry_keys[index] % columns
        i = column - low
        window = geometry.frame0[clip] + first + i
        second = np.int64(q_column[r, column])
        other = geometry.block_clip[second // BLOCK]
        own = priced(geometry, 0, window, geometry.frame0[other] + second - geometry.first[other], memo)
        choice = choices[index]
        choice[COLUMN] = -1
        limit = finish(geometry, goal, 0, second, k0 + r, own, np.inf, choice, memo)
        costs[index] = kernels.exact_entry(
            geometry, goal, 0, window, d[i], d_pooled[i], k[k0 + r], k_pooled[k0 + r], k0 + r, limit, choice, memo,
        )  # fmt: skip


@njit(cache=True, nogil=True)
def choose(
    geometry, goal, source, candidates, entry_keys, costs, choices, rows, columns, k_rows, cost, choice
):
    """Least (cost, R, first column, s_s, second column, s_h) of the candidates; choice: those but cost, then s_2."""
    memo = new_memo(geometry)
    period, looping, base = geometry.period[source], geometry.looping[source], geometry.frame0[source]
    b, fixed = geometry.lengths[0], len(k_rows) > 0
    new = np.empty(7, np.int64)
    for n in range(len(candidates)):
        t, stay, column, stay_hop = candidates[n, 0], candidates[n, 1], candidates[n, 2], candidates[n, 3]
        a = (t + stay) % period if looping else t + stay
        clip = geometry.block_clip[column // BLOCK]
        u = column - geometry.first[clip]
        x = u + b + stay_hop
        if geometry.looping[clip]:
            x %= geometry.period[clip]
        row = k_rows[t + stay] if fixed else np.int64(stay)
        key = rows[row + stay_hop] * columns + geometry.first[clip] + x
        index = np.searchsorted(entry_keys, key)
        value = priced(geometry, 0, base + a, geometry.frame0[clip] + u, memo) + goal.hop_cost[clip]
        value += goal.weight * (stay + stay_hop) + costs[index]
        if value > cost[t]:
            continue
        new[0] = stay + stay_hop + choices[index, R]
        new[1], new[2], new[3], new[4], new[5] = column, stay, choices[index, COLUMN], stay_hop, choices[index, R]
        better = value < cost[t]
        if not better:
            for field in range(5):
                if new[field] != choice[t, field]:
                    better = new[field] < choice[t, field]
                    break
        if better:
            cost[t] = value
            choice[t] = new
