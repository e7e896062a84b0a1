"""Two hops, exactly: source -> first hop -> second hop -> destination.

From the cost-to-go K[k, v] of entering the second hop (as for one hop), a min-plus product with all distances between
hops gives Q[k, x], the cost-to-go of leaving the first hop at window x while the destination's frame is k; a sliding
minimum over s_h gives H[k, u], that of entering the first hop. Only what can reach the best one-hop cost is kept.

Q and H are float32 lower bounds. The entries of Q that some trigger's candidates use are then made exact, together,
in a second pass over the distances; and the choice is among exact costs.
"""

from dataclasses import replace

import numpy as np

from motion.onehop.distances import BIG, FEASIBLE, MEMORY, SHRINK
from motion.onehop.features import BLOCK
from motion.onehop.kernels import CHOICE
from motion.onehop.minplus import lanes_of
from motion.onehop.searcher import CostToGo
from motion.onehop.twohop_kernels import candidates, choose, exact_entries, product
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
                limits = _limits(searcher, pairs, place, result, destination)
                plans[destination] = plan = _Plan(searcher, goal, frames, limits)
                size += plan.k.nbytes + plan.lanes.values.nbytes + 2 * plan.q.nbytes
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
        d, d_pooled = searcher.source_slab(0, source)
        for destination in mine:
            at, offset = place[source, destination], pairs[source, destination]
            part = slice(at, at + searcher.clips.period(source))
            plan = plans[destination]
            found.append(
                (source, plan, offset, part, plan.candidates(source, offset, d, d_pooled, result.one_hop[part]))
            )
    _make_exact(searcher, plans)
    for source, plan, offset, part, ways in found:
        plan.choose(source, offset, ways, out, part)


def _limits(searcher, pairs, place, result, destination):
    """(columns,) what the way on from leaving the first hop at a window may cost, R included, to help any trigger.

    It is the best one-hop cost of a trigger less the distance between source and first hop: the largest over all
    triggers, frames of the source and stays that lead to this window. By blocks of columns, which is near enough.
    """
    layout, stay, b = searcher.layout, searcher.config.max_stay, searcher.config.lengths[0]
    reach = np.full(layout.blocks, -1.0, np.float32)
    for source, other in pairs:
        if other != destination or not searcher.windows[0].counts[source]:
            continue
        period, windows = searcher.clips.period(source), int(searcher.windows[0].counts[source])
        at = place[source, destination]
        cost = np.minimum(result.one_hop[at : at + period], FEASIBLE)
        # the largest cost of the triggers that may leave the source in a frame
        before = np.arange(windows)[:, None] - np.arange(stay + 1)
        before = before % period if searcher.clips.looping(source) else np.maximum(before, 0)
        largest = cost[before].max(axis=1)
        largest = np.nextafter(largest.astype(np.float32), np.float32(np.inf))
        for a, row in enumerate(searcher.pooled_distances(source)):
            np.maximum(reach, largest[a] - row, out=reach)
    columns = np.repeat(reach, BLOCK)
    limits = np.full(layout.columns, -1.0)
    for i, first in enumerate(layout.first):
        count = int(layout.windows[i])
        part = limits[first : first + count]
        for s in range(stay + 1):
            u = np.arange(count) - b - s
            if searcher.clips.looping(i):
                np.maximum(part, columns[first + u % searcher.clips.period(i)], out=part)
            else:
                np.maximum(part[b + s :], columns[first : first + max(count - b - s, 0)], out=part[b + s :])
    return limits


class _Plan:
    """What belongs to one destination. q, column: (rows, columns) of Q and of the second hop that attains it."""

    def __init__(self, searcher, goal, frames, limits):
        self.searcher, self.goal = searcher, goal
        config, clips = searcher.config, searcher.clips
        b, stay = config.lengths[0], config.max_stay
        self.k, self.k_pooled, _ = searcher.cost_to_go(goal, frames, 0)
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
        self.charge = (charge * SHRINK).astype(np.float32)
        self.limits = (limits * (1 + 2.0**-20) + 1e-9).astype(np.float32)
        self.lanes = lanes_of(self.k[self.k0 : self.k0 + count])
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
        """CostToGo of H, lower bounds of the cost-to-go of entering the first hop."""
        if self.h is not None:
            return self.h
        searcher, config = self.searcher, self.searcher.config
        h, pooled = searcher.slide(self.q, self.rows, config.lengths[0], self.goal.hop_cost, self.h_frames)
        self.h = CostToGo(h, pooled, lanes_of(h[:0] if config.regime == FIXED else h))
        return self.h

    def candidates(self, source, offset, d, d_pooled, cost):
        """(n, 4) trigger, s_s, column of the first hop, s_h, of all that may be optimal; marks what they need of q."""
        searcher, goal = self.searcher, self.goal
        weight, k_rows = np.float32(searcher.weight * SHRINK), self.k_rows(source, offset)
        h, h_pooled, h_lanes = self.cost_to_go()

        def chunk(a, b):
            size = 64 * (b - a) + 1024
            while True:
                out = np.empty((size, 4), np.int32)
                count = candidates(
                    searcher.geometry, goal, source, a, b, d, d_pooled, h, h_pooled, h_lanes, k_rows, self.k0, self.q,
                    self.column, self.rows, self.needed, weight, np.float32(3 * searcher.error), cost, out,
                )  # fmt: skip
                if count <= size:
                    return out[:count].copy()
                size = count

        return np.concatenate(searcher.run(chunk, searcher.chunks(len(cost))))

    def choose(self, source, offset, candidates, result, part):
        """Writes two-hop transitions into `result` where they come before what is there."""
        count = part.stop - part.start
        choice = np.full((count, 7), -1, np.int64)
        cost = np.full(count, np.inf)
        choose(
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


def _products(searcher, plans):
    """Q of all destinations, in one pass over the distances between hops."""

    def strip(clip, first, last):
        d, d_pooled = searcher.strip(0, clip, first, last)
        column = int(searcher.layout.first[clip]) + first
        for plan in plans.values():
            product(
                d, d_pooled, plan.k[plan.k0 :], plan.lanes, plan.limits[column : column + len(d)], plan.charge, column,
                plan.q, plan.column,
            )  # fmt: skip

    searcher.run(strip, searcher.strips(0, range(len(searcher.clips))))


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
        d, d_pooled = searcher.strip(0, clip, first, last)
        for plan, indices in parts:
            exact_entries(
                searcher.geometry, plan.goal, clip, first, low, d, d_pooled, plan.k, plan.k_pooled, plan.k0,
                plan.column, indices, plan.keys, plan.costs, plan.choices,
            )  # fmt: skip

    searcher.run(strip, searcher.strips(0, range(len(searcher.clips))))
