"""Two hops, exactly: source -> first hop -> second hop -> destination.

From the cost-to-go K[k, v] of entering the second hop (as for one hop), a min-plus product with all distances between
hops gives Q[k, x], the cost-to-go of leaving the first hop at window x while the destination's frame is k; a sliding
minimum over s_h gives H[k, u], that of entering the first hop. Only what can reach the best one-hop cost is kept.

Q and H are float32 lower bounds. The entries of Q that some trigger's candidates use are then made exact, together,
in a second pass over the distances; and the choice is among exact costs.
"""

from dataclasses import replace

import numpy as np
from numba import njit

from motion.onehop import kernels
from motion.onehop.distances import BIG, FEASIBLE, MEMORY, SHRINK, pool
from motion.onehop.features import BLOCK, ROWS
from motion.onehop.kernels import CHOICE, CHUNK, COLUMN, MEMO, R, above, any_below, finish, least, priced
from motion.onehop.types import FIXED


def add_second_hops(searcher, pairs, place, result, progress=None):
    """`result` of one hop, improved by two where that is better. `searcher`: of a config with hops = 2."""
    out = replace(
        result, cost=result.cost.copy(), hop=result.hop.copy(), hop_frame=result.hop_frame.copy(),
        stay_source=result.stay_source.copy(), stay_hop=result.stay_hop.copy(),
    )  # fmt: skip
    destinations = sorted({destination for _, destination in pairs})
    done = len(pairs)
    while destinations:
        plans, size = {}, 0
        # as many destinations at a time as fit into memory, because they share the distances between hops
        while destinations and (not plans or size + size // len(plans) < MEMORY // 2):
            destination = destinations.pop(0)
            goal, frames = searcher.goal(destination)
            if len(goal.e) and frames:
                limit = _limit(searcher, pairs, place, result, destination)
                plans[destination] = plan = _Plan(searcher, goal, frames, limit)
                size += plan.k.nbytes + 2 * plan.q.nbytes
        _improve(searcher, plans, pairs, place, result, out)
        done += sum(destination in plans for _, destination in pairs)
        if progress:
            progress(done if destinations else 2 * len(pairs), 2 * len(pairs))
    return out


def _improve(searcher, plans, pairs, place, result, out):
    """The two-hop transitions into the destinations of `plans`."""
    _products(searcher, plans)
    found = []
    for source in dict.fromkeys(source for source, _ in pairs):
        if not searcher.windows[0].counts[source]:
            continue
        mine = [destination for destination in plans if (source, destination) in pairs]
        if not mine:
            continue
        d, d_pooled, _ = searcher.source_slab(0, source)
        for destination in mine:
            at, offset = place[source, destination], pairs[source, destination]
            part = slice(at, at + searcher.clips.period(source))
            plan = plans[destination]
            found.append(
                (source, plan, offset, part, plan.candidates(source, offset, d, d_pooled, result.one_hop[part]))
            )
    _make_exact(searcher, plans)
    for source, plan, offset, part, candidates in found:
        plan.choose(source, offset, candidates, out, part)


def _limit(searcher, pairs, place, result, destination):
    """Largest one-hop cost into this destination: whatever exceeds it helps no trigger."""
    limit = 0.0
    for source, other in pairs:
        if other == destination:
            count = searcher.clips.period(source)
            if not searcher.clips.looping(source):
                count = int(searcher.windows[0].counts[source])
            at = place[source, destination]
            limit = max(limit, result.one_hop[at : at + count].max(initial=0.0))
    return min(limit, FEASIBLE)


class _Plan:
    """What belongs to one destination. q, column: (rows, columns) of Q and of the second hop that attains it."""

    def __init__(self, searcher, goal, frames, limit):
        self.searcher, self.goal = searcher, goal
        config, clips = searcher.config, searcher.clips
        b, stay = config.lengths[0], config.max_stay
        self.k, self.k_pooled = searcher.cost_to_go(goal, frames, 0)
        loop, period = clips.looping(goal.clip), clips.period(goal.clip)
        # q row 0 is row k0 of K; rows[k + s_h]: row of q, for row k of H
        if config.regime == FIXED:
            self.k0, count = 0, frames
            self.h_frames = frames if loop else frames + b + stay
            j = np.arange(self.h_frames + stay)
            rows = (j + b) % period if loop else j - (b + stay) + b
            charge = np.zeros(count)
        else:
            self.k0, count, self.h_frames = b, 2 * stay + 1, stay + 1
            rows = np.arange(self.h_frames + stay)
            # the frame k of the destination says how long the stays were so far
            charge = np.arange(count) * goal.weight
        self.rows = np.where((rows >= 0) & (rows < count), rows, -1)
        self.limits = ((limit - charge) * (1 + 2.0**-20) + 1e-9).astype(np.float32)
        self.q = np.full((count, searcher.layout.columns), BIG, np.float32)
        self.column = np.full(self.q.shape, -1, np.int32)
        self.needed = np.zeros(self.q.shape, np.uint8)
        self.h = None

    def k_rows(self, source, offset):
        """Row of H per frame of the source ("fixed"), or none ("start": it is the stay)."""
        searcher, config = self.searcher, self.searcher.config
        if config.regime != FIXED:
            return np.empty(0, np.int64)
        clips, clip = searcher.clips, self.goal.clip
        loop = clips.looping(source)
        count = clips.period(source) + config.max_stay if loop else int(searcher.windows[0].counts[source])
        v = np.arange(count) - offset
        if clips.looping(clip):
            return v % clips.period(clip)
        k = v + 2 * (config.lengths[0] + config.max_stay)
        return np.where((k >= 0) & (k < self.h_frames), k, -1)

    def cost_to_go(self):
        """(H, its pooled minima), lower bounds of the cost-to-go of entering the first hop."""
        if self.h is not None:
            return self.h
        searcher, layout, config = self.searcher, self.searcher.layout, self.searcher.config
        stay, weight = config.max_stay, np.float32(searcher.weight * SHRINK)
        h = np.empty((self.h_frames, layout.columns), np.float32)
        h_pooled = np.empty((self.h_frames, layout.blocks), np.float32)

        def clip_part(i):
            count = int(layout.windows[i])
            if not count:
                return
            part = np.empty((self.h_frames, count), np.float32)
            work = np.empty((self.h_frames + stay, count + stay), np.float32)
            kernels.slide(
                self.q, self.rows, layout.first[i], count, searcher.clips.period(i), searcher.clips.looping(i),
                config.lengths[0], weight, stay, np.float32(self.goal.hop_cost[i] * SHRINK), work, part,
            )  # fmt: skip
            h[:, layout.first[i] : layout.first[i] + count] = part

        searcher.run(clip_part, [(i,) for i in range(len(searcher.clips))])
        pool(h, searcher.windows[0].pads, h_pooled)
        self.h = h, h_pooled
        return self.h

    def candidates(self, source, offset, d, d_pooled, cost):
        """(n, 4) trigger, s_s, column of the first hop, s_h, of all that may be optimal; marks what they need of q."""
        searcher, goal = self.searcher, self.goal
        weight, k_rows = np.float32(searcher.weight * SHRINK), self.k_rows(source, offset)
        h, h_pooled = self.cost_to_go()

        def chunk(a, b):
            size = 64 * (b - a) + 1024
            while True:
                out = np.empty((size, 4), np.int32)
                count = _candidates(
                    searcher.geometry, goal, source, a, b, d, d_pooled, h, h_pooled, k_rows, self.k0, self.q,
                    self.column, self.rows, self.needed, weight, np.float32(3 * searcher.error), cost, out,
                )  # fmt: skip
                if count <= size:
                    return out[:count].copy()
                size = count

        return np.concatenate(searcher.run(chunk, searcher._chunks(len(cost))))

    def choose(self, source, offset, candidates, result, part):
        """Writes two-hop transitions into `result` where they come before what is there."""
        count = part.stop - part.start
        choice = np.full((count, 7), -1, np.int64)
        cost = np.full(count, np.inf)
        _choose(
            self.searcher.geometry, self.goal, source, candidates, self.keys, self.costs, self.choices, self.rows,
            self.searcher.layout.columns, self.k_rows(source, offset), cost, choice,
        )  # fmt: skip
        old = result.cost[part]
        r = result.stay_source[part] + result.stay_hop[part]
        better = (choice[:, 1] >= 0) & ((cost < old) | ((cost == old) & (choice[:, 0] < r)))
        at = part.start + np.flatnonzero(better)
        new, layout = choice[better], self.searcher.layout
        result.cost[at] = cost[better]
        for column, clip, frame in ((1, result.hop, result.hop_frame), (3, result.second_hop, result.second_frame)):
            clip[at] = layout.block_clip[new[:, column] // BLOCK]
            frame[at] = new[:, column] - layout.first[clip[at]]
        result.stay_source[at], result.stay_hop[at], result.stay_second[at] = new[:, 2], new[:, 4], new[:, 5]

def _strips(searcher):
    return [
        (clip, first, min(first + ROWS, int(count)))
        for clip, count in enumerate(searcher.windows[0].counts)
        for first in range(0, int(count), ROWS)
    ]


def _products(searcher, plans):
    """Q of all destinations, in one pass over the distances between hops."""

    def strip(clip, first, last):
        d, d_pooled = searcher.strip_slab(clip, first, last)
        column = int(searcher.layout.first[clip]) + first
        for plan in plans.values():
            _product(d, d_pooled, plan.k[plan.k0 :], plan.k_pooled[plan.k0 :], plan.limits, column, plan.q, plan.column)

    searcher.run(strip, _strips(searcher))


def _make_exact(searcher, plans):
    """Exact cost and choice of every needed entry of Q, in a second pass."""
    for plan in plans.values():
        plan.keys = np.flatnonzero(plan.needed.reshape(-1))
        plan.costs = np.empty(len(plan.keys))
        plan.choices = np.empty((len(plan.keys), CHOICE), np.int64)
    columns = searcher.layout.columns
    by_column = {}
    for destination, plan in plans.items():
        at = plan.keys % columns
        order = np.argsort(at, kind="stable")
        by_column[destination] = order, at[order]

    def strip(clip, first, last):
        low = int(searcher.layout.first[clip]) + first
        parts = []
        for destination, (order, at) in by_column.items():
            a, b = np.searchsorted(at, [low, low + last - first])
            if b > a:
                parts.append((plans[destination], order[a:b]))
        if not parts:
            return
        d, d_pooled = searcher.strip_slab(clip, first, last)
        for plan, indices in parts:
            _exact_entries(
                searcher.geometry, plan.goal, clip, first, low, d, d_pooled, plan.k, plan.k_pooled, plan.k0,
                plan.column, indices, plan.keys, plan.costs, plan.choices,
            )  # fmt: skip

    searcher.run(strip, _strips(searcher))


@njit(cache=True, nogil=True)
def _product(d, d_pooled, k, k_pooled, limits, column, q, at):
    """q[r, column + i] = min over columns c of d[i, c] + k[r, c], where that is below limits[r]; `at`: that c."""
    work = np.empty(d_pooled.shape[1] + 2 * BLOCK, np.float32)
    for r in range(len(limits)):
        guess = -1
        for i in range(len(d)):
            bound, start = limits[r], -1
            if guess >= 0:
                # a window further on both sides is often as good
                c = min(guess + 1, d.shape[1] - 1)
                value = np.float32(d[i, c] + k[r, c])
                if value < bound:
                    bound, start = value, c
            if r > 0 and at[r - 1, column + i] >= 0:
                c = np.int64(at[r - 1, column + i])
                value = np.float32(d[i, c] + k[r, c])
                if value < bound:
                    bound, start = value, c
            value, guess = least(d[i], d_pooled[i], k[r], k_pooled[r], bound, work)
            if guess < 0:
                guess, value = start, bound
            if guess >= 0:
                q[r, column + i], at[r, column + i] = value, guess


@njit(cache=True, nogil=True)
def _candidates(
    geometry, goal, source, t0, t1, d, d_pooled, h, h_pooled, k_rows, k0, q, q_column, rows, needed, weight, slack,
    cost, out,
):
    """Candidates of triggers t0..t1 - 1 whose lower bound does not exceed what is known to be reachable."""
    keys, values = np.full(MEMO, -1, np.int64), np.empty(MEMO)
    found = np.empty(CHOICE, np.int64)
    windows, period, looping = geometry.counts[0, source], geometry.period[source], geometry.looping[source]
    base, b, fixed, count = geometry.frame0[source], geometry.lengths[0], len(k_rows) > 0, 0
    work, row_low = np.empty(d_pooled.shape[1] + 2 * BLOCK, np.float32), np.empty(goal.max_stay + 1, np.float32)
    for t in range(t0, t1):
        row_low[:] = 0
        bound = np.float32(min(cost[t] * (1 + 2.0**-20) + 1e-9, FEASIBLE))
        stay_at, column_at = -1, -1
        for stay in range(goal.max_stay + 1):
            a = (t + stay) % period if looping else t + stay
            charge = np.float32(weight * np.float32(stay))
            if a >= windows or charge >= bound:
                break
            row = k_rows[t + stay] if fixed else stay
            if row < 0:
                continue
            row_low[stay], column = least(
                d[a], d_pooled[a], h[row], h_pooled[row], np.float32(bound - charge + slack), work
            )
            if column >= 0 and row_low[stay] + charge < bound:
                bound, stay_at, column_at = row_low[stay] + charge, stay, column
        if column_at < 0:
            continue
        limit = cost[t]
        # the exact cost of the candidate with the least lower bound, by the ways that attained the bounds
        clip = geometry.block_clip[column_at // BLOCK]
        u, first = column_at - geometry.first[clip], geometry.first[clip]
        row = k_rows[t + stay_at] if fixed else stay_at
        best, best_row, best_x, best_stay = np.float32(FEASIBLE), -1, -1, -1
        for stay in range(goal.max_stay + 1):
            x = u + b + stay
            if geometry.looping[clip]:
                x %= geometry.period[clip]
            elif x >= geometry.counts[0, clip]:
                break
            r = rows[row + stay]
            if r < 0:
                continue
            value = np.float32(q[r, first + x] + weight * np.float32(stay))
            if value < best:
                best, best_row, best_x, best_stay = value, r, x, stay
        if best_row >= 0:
            a = (t + stay_at) % period if looping else t + stay_at
            way = priced(geometry, 0, base + a, geometry.frame0[clip] + u, keys, values) + goal.hop_cost[clip]
            second = np.int64(q_column[best_row, first + best_x])
            other = geometry.block_clip[second // BLOCK]
            way += priced(
                geometry, 0, geometry.frame0[clip] + best_x, geometry.frame0[other] + second - geometry.first[other],
                keys, values,
            ) + goal.weight * (stay_at + best_stay)  # fmt: skip
            found[COLUMN] = -1
            way = finish(geometry, goal, 0, second, k0 + best_row, way, np.inf, found, keys, values)
            limit = min(limit, way)
        for stay in range(goal.max_stay + 1):
            a = (t + stay) % period if looping else t + stay
            if a >= windows or goal.weight * stay > limit:
                break
            row = k_rows[t + stay] if fixed else stay
            if row < 0 or row_low[stay] + goal.weight * stay > limit:
                continue
            rest = limit - goal.weight * stay
            for start in range(0, d_pooled.shape[1], CHUNK):
                a_part, h_part = d_pooled[a, start : start + CHUNK], h_pooled[row, start : start + CHUNK]
                if not any_below(a_part, h_part, above(rest)):
                    continue
                for block in range(start, min(start + CHUNK, d_pooled.shape[1])):
                    if d_pooled[a, block] + h_pooled[row, block] > rest:
                        continue
                    clip, at = geometry.block_clip[block], block * BLOCK
                    first = geometry.first[clip]
                    if not any_below(d[a, at : at + BLOCK], h[row, at : at + BLOCK], above(rest)):
                        continue
                    for column in range(at, at + BLOCK):
                        if np.float64(d[a, column]) + h[row, column] > rest:
                            continue
                        u = column - first
                        own = priced(geometry, 0, base + a, geometry.frame0[clip] + u, keys, values)
                        if own + h[row, column] > rest:
                            continue
                        own += goal.hop_cost[clip]
                        for stay_hop in range(goal.max_stay + 1):
                            x = u + b + stay_hop
                            if geometry.looping[clip]:
                                x %= geometry.period[clip]
                            elif x >= geometry.counts[0, clip]:
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
def _exact_entries(
    geometry, goal, clip, first, low, d, d_pooled, k, k_pooled, k0, q_column, indices, entry_keys, costs, choices
):
    """Exact optimum of entries of q whose columns lie in the strip of windows first.. of `clip` (columns low..)."""
    keys, values = np.full(MEMO, -1, np.int64), np.empty(MEMO)
    columns = q_column.shape[1]
    for index in indices:
        r, column = entry_keys[index] // columns, entry_keys[index] % columns
        i = column - low
        window = geometry.frame0[clip] + first + i
        second = np.int64(q_column[r, column])
        other = geometry.block_clip[second // BLOCK]
        own = priced(geometry, 0, window, geometry.frame0[other] + second - geometry.first[other], keys, values)
        choice = choices[index]
        choice[COLUMN] = -1
        limit = finish(geometry, goal, 0, second, k0 + r, own, np.inf, choice, keys, values)
        costs[index] = kernels.exact_entry(
            geometry, goal, 0, window, d[i], d_pooled[i], k[k0 + r], k_pooled[k0 + r], k0 + r, limit, choice, keys,
            values,
        )  # fmt: skip


@njit(cache=True, nogil=True)
def _choose(
    geometry, goal, source, candidates, entry_keys, costs, choices, rows, columns, k_rows, cost, choice
):
    """Least (cost, R, first column, s_s, second column, s_h) of the candidates; choice: those but cost, then s_2."""
    keys, values = np.full(MEMO, -1, np.int64), np.empty(MEMO)
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
        value = priced(geometry, 0, base + a, geometry.frame0[clip] + u, keys, values) + goal.hop_cost[clip]
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
