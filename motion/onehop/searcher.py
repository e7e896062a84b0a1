"""The search of `search.solve`, step by step: what is computed once, kept or streamed, and what runs on which thread.

In the regime "start" the costly part is a source's slab of distances to all columns, which serves all destinations: one
slab at a time, and all cost-to-go tables (small) are kept. In "fixed" it is a destination's cost-to-go, which serves
all sources: one of these at a time, and slabs are kept for sources of several pairs, else streamed by strips.
"""

import copy
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from motion.errors import InputError
from motion.onehop import kernels
from motion.onehop.distances import BIG, SHRINK
from motion.onehop.features import BLOCK
from motion.onehop.minplus import Lanes, lanes_of
from motion.onehop.pricing import direct_costs, on_grid
from motion.onehop.slabs import Slabs
from motion.onehop.types import FIXED, START


@dataclass(frozen=True, eq=False)
class SearchResult:
    """Optima of all triggers, pair after pair (`LookupTable.first` says where), triggers 0..period(source) - 1.

    cost: (T,) objective S + w R, m^2; inf without candidate. direct: (T,) D of the direct transition, m^2; inf if it
    runs past an end. hop: (T,) clip index, -1 without candidate. hop_frame: (T,) u. stay_source, stay_hop: (T,).
    second_hop: (T,) clip index, -1 for one hop; second_frame, stay_second: (T,). lengths: (T, hops + 1) of the
    blends (two hops allowed but one taken: columns 0 and 2). one_hop: (T,) cost of the best one-hop transition (equal
    to cost unless hops = 2). weight: the w that was used, m^2 per frame.
    """

    cost: np.ndarray
    direct: np.ndarray
    hop: np.ndarray
    hop_frame: np.ndarray
    stay_source: np.ndarray
    stay_hop: np.ndarray
    second_hop: np.ndarray
    second_frame: np.ndarray
    stay_second: np.ndarray
    lengths: np.ndarray
    one_hop: np.ndarray
    weight: float


class CostToGo(NamedTuple):
    """K of one destination, (frames, columns), its pooled minima, and the Lanes of its first max_stay + 1 frames (of
    none in the regime "fixed")."""

    k: np.ndarray
    pooled: np.ndarray
    lanes: Lanes


class Searcher(Slabs):
    """Features and buffers of one search; a context manager. `solve` may be called several times."""

    def __init__(self, clips, config, threads=None):
        config.check()
        if config.weight is None:
            raise InputError("weight: is not given; use solve or build, which choose the default")
        if config.genre_cost and clips.genres is None:
            raise InputError("genre_cost: the clips have no genres; give them to ClipSet.from_clips, or leave it 0")
        if config.hops == 2 and len(config.lengths) > 1:
            raise InputError("blends: cannot be chosen with hops=2; give one blend length, or hops=1")
        super().__init__(clips, config, threads)
        self.weight = on_grid(config.weight)
        self._targets, self._costs_to_go, self._buffers = {}, {}, {}

    def weighted(self, weight):
        """The same search with another weight, m^2 per frame; what does not depend on it is shared."""
        other = copy.copy(self)
        other.config, other.weight = replace(self.config, weight=float(weight)), on_grid(weight)
        other._costs_to_go, other._buffers = {}, {}
        if len(self.windows) > 1 or self.config.regime == FIXED:
            other._targets = {}
        other._executor = ThreadPoolExecutor(self.threads) if self.threads > 1 else None
        return other

    # -- destinations ------------------------------------------------------------------------------------------------

    def rows_of(self, destination):
        """(first, last) windows of the destination that a transition may end in, with the shortest blend."""
        config, count = self.config, int(self.layout.windows[destination])
        if config.regime == FIXED:
            return 0, count
        low = min(config.lengths)
        high = config.hops * max(config.lengths) + (config.hops + 1) * config.max_stay + 1
        if self.clips.looping(destination):
            return (low, high) if high <= count else (0, count)
        return min(low, count), min(high, count)

    def target(self, destination):
        """(e, row0) of a destination: lower bounds of D of its windows, least over the lengths of the last blend."""
        if destination in self._targets:
            return self._targets[destination]
        fixed = self.config.regime == FIXED
        if fixed:
            self._targets.clear()
        first, last = self.rows_of(destination)
        shortest = self.config.lengths[0]
        best = None
        for length in range(len(self.windows)):
            stop = min(last, int(self.windows[length].counts[destination]))
            if stop <= first:
                continue
            charge = np.float32(SHRINK * self.weight * (self.config.lengths[length] - shortest))
            if fixed and len(self.windows) == 1 and not self.config.beats and (length, destination) in self._slabs:
                part = self.source_slab(length, destination)[0]
            else:
                out = self._buffer("target", stop - first) if fixed and best is None else None
                part, _ = self.slab(length, destination, first, stop, out=out, pooled=False)
            if charge:
                part += charge
            if best is None:
                best = part if stop == last else np.concatenate([part, np.full((last - stop, part.shape[1]), BIG)])
            else:
                np.minimum(best[: stop - first], part, out=best[: stop - first])
        if best is None:
            best = np.empty((0, self.layout.columns), np.float32)
        self._targets[destination] = np.ascontiguousarray(best, dtype=np.float32), first
        return self._targets[destination]

    def _buffer(self, name, rows):
        """(rows, columns) float32 whose memory serves again, because the first touch of memory costs much; with two
        hops a new one, because several destinations are treated together."""
        if self.config.hops == 2:
            return np.empty((rows, self.layout.columns), np.float32)
        buffer = self._buffers.get(name)
        if buffer is None or len(buffer) < rows:
            buffer = self._buffers[name] = np.empty((rows, self.layout.columns), np.float32)
        return buffer[:rows]

    def goal(self, destination):
        """The kernels' Goal, and the number of its rows of the destination's frame k."""
        e, row0 = self.target(destination)
        config, clips = self.config, self.clips
        longest, stay = max(config.lengths), config.max_stay
        count, period = int(self.layout.windows[destination]), clips.period(destination)
        loop = clips.looping(destination)
        if config.regime == START:
            frames, shift = (stay + 1 if config.hops == 1 else longest + 2 * stay + 1), 0
        else:
            frames, shift = (period, 0) if loop else (count + longest - min(config.lengths) + stay, -longest - stay)
        rows = np.full((len(config.lengths), max(frames, 0) + stay), -1, np.int64)
        for i, b in enumerate(config.lengths):
            v = np.arange(rows.shape[1]) + shift + b
            v = v % period if loop else v
            row = v - row0
            rows[i] = np.where((row >= 0) & (row < len(e)) & (v >= 0) & (v < count), row, -1)
        hop_cost = np.zeros(len(clips))
        if config.genre_cost:
            hop_cost[[genre != clips.genres[destination] for genre in clips.genres]] = on_grid(config.genre_cost)
        goal = kernels.Goal(destination, e, row0, rows, hop_cost, self.weight, stay)
        return goal, max(frames, 0)

    def cost_to_go(self, goal, frames, length):
        """CostToGo of a destination for a first blend of length index `length`; `frames` as `goal` gives it.

        All destinations' are kept in the regime "start", where they are small, and one destination's in "fixed".
        """
        key = goal.clip, length
        if key not in self._costs_to_go:
            out = None
            if self.config.regime == FIXED:
                self._costs_to_go = {k: v for k, v in self._costs_to_go.items() if k[0] == goal.clip}
                out = self._buffer(f"cost to go {length}", frames)
            rows = goal.rows[length, : frames + self.config.max_stay]
            k, pooled = self.slide(goal.e, rows, self.config.lengths[length], self._extra(goal, length), frames, out)
            stays = 0 if self.config.regime == FIXED else self.config.max_stay + 1
            self._costs_to_go[key] = CostToGo(k, pooled, lanes_of(k[:stays]))
        return self._costs_to_go[key]

    def _extra(self, goal, length):
        """(clips,) what K adds for a hop's genre and the length of the blend into it."""
        return goal.hop_cost + self.weight * (self.config.lengths[length] - self.config.lengths[0])

    def slide(self, e, rows, length, extra, frames, out=None):
        """(k, its pooled minima): least e[rows[k + s], u + length + s] + w s over stays s, plus `extra` of the clip."""
        k = np.empty((frames, self.layout.columns), np.float32) if out is None else out
        pooled = np.empty((frames, self.layout.blocks), np.float32)
        strips = self.parts(0, frames)
        clips = [i for i in range(len(self.clips)) if self.layout.windows[i]]
        self.run(self._slide_part, [(e, rows, length, extra, i, *strip, k, pooled) for strip in strips for i in clips])
        return k, pooled

    def _slide_part(self, e, rows, length, extra, i, first, last, k, pooled):
        layout, stay = self.layout, self.config.max_stay
        buffer = self.space.take((last - first + stay) * int(layout.windows[i] + stay))
        kernels.slide(
            e, rows, first, last, layout.first[i], layout.windows[i], self.clips.period(i), self.clips.looping(i),
            length, np.float32(self.weight * SHRINK), stay, np.float32(extra[i] * SHRINK), buffer, k, pooled,
        )  # fmt: skip

    def slide_strip(self, e, rows, length, extra):
        """`slide` of at most ROWS frames, in this thread and its buffer."""
        frames = len(rows) - self.config.max_stay
        k, pooled = (array[:frames] for array in self.space.strip("cost to go", self.layout))
        for i in range(len(self.clips)):
            if self.layout.windows[i]:
                self._slide_part(e, rows, length, extra, i, 0, frames, k, pooled)
        return k, pooled

    # -- search ------------------------------------------------------------------------------------------------------

    def solve(self, pairs, progress=None, triggers=None):
        """SearchResult of {(source, destination): o_sd}.

        triggers: {pair: frames} to search only these (one hop); the others are as if they had no candidate.
        """
        clips, config = self.clips, self.config
        first = np.concatenate([[0], np.cumsum([clips.period(source) for source, _ in pairs])])
        total = int(first[-1])
        cost, direct = np.full(total, np.inf), np.empty(total)
        choice = np.zeros((total, kernels.CHOICE), np.int64)
        choice[:, kernels.COLUMN] = -1
        place = {pair: int(first[k]) for k, pair in enumerate(pairs)}
        parts = {pair: slice(at, at + clips.period(pair[0])) for pair, at in place.items()}

        def direct_of(pair):
            direct[parts[pair]] = self.direct(*pair, pairs[pair])

        self.run(direct_of, [(pair,) for pair in pairs])
        side, search = (1, self._fixed) if config.regime == FIXED else (0, self._start)
        results = {pair: (cost[part], choice[part]) for pair, part in parts.items()}
        groups, done = {}, 0
        for pair in pairs:
            groups.setdefault(pair[side], []).append(pair)
        for group in groups.values():
            for count in search(group, pairs, triggers, results):
                done += count
                if progress:
                    progress(done, len(pairs) * config.hops)
        result = self._result(cost, direct, choice)
        if config.hops == 2:
            from motion.onehop.twohop import add_second_hops

            result = add_second_hops(self, pairs, place, result, progress)
        return result

    def _start(self, group, pairs, triggers, results):
        """Solves pairs of one source in the regime "start"; yields how many at a time."""
        source, weight = group[0][0], np.float32(self.weight * SHRINK)
        goals = {pair: self.goal(pair[1]) for pair in group}
        for length in range(len(self.windows)):
            if not self.windows[length].counts[source]:
                continue
            slab, tasks = self.source_slab(length, source), []
            scales = weight, np.float32(2 * self.error)
            for pair, (goal, frames) in goals.items():
                if not len(goal.e) or not frames:
                    continue
                to_go = self.cost_to_go(goal, frames, length)
                if triggers is None:
                    chunks = self.chunks(self.clips.period(source), len(group))
                else:
                    chunks = [(int(t), int(t) + 1) for t in triggers[pair]]
                tasks += [
                    (self.geometry, goal, length, source, *chunk, *slab, *to_go, *scales, *results[pair])
                    for chunk in chunks
                ]
            self.run(kernels.start_regime, tasks)
        yield len(group)

    def chunks(self, count, pairs=1):
        """Parts (first, last) of a pair's triggers that keep all threads busy if so many pairs are solved at once."""
        parts = 1 if self.threads == 1 else max(1, -(-4 * self.threads // pairs))
        step = max(1, -(-count // parts))
        return [(a, min(a + step, count)) for a in range(0, count, step)]

    def _fixed(self, group, pairs, triggers, results):
        """Solves pairs of one destination in the regime "fixed"; yields how many at a time."""
        goal, frames = self.goal(group[0][1])
        sources = [source for source, _ in pairs]
        for pair in group:
            wanted = None if triggers is None else triggers[pair]
            for length in range(len(self.windows)):
                if len(goal.e) and frames and self.windows[length].counts[pair[0]]:
                    slab, to_go = None, None
                    if self.config.hops == 2 or sources.count(pair[0]) > 1:
                        slab = self.source_slab(length, pair[0])
                    if self.config.hops == 2 or len(group) > 1:
                        to_go = self.cost_to_go(goal, frames, length)
                    self._fixed_pair(
                        goal, frames, length, pair[0], pairs[pair], slab, to_go, wanted, *results[pair]
                    )
            yield 1

    def _fixed_pair(self, goal, frames, length, source, offset, slab, to_go, triggers, cost, choice):
        """One pair and first length. slab, to_go: `source_slab` and `cost_to_go`, or None to stream them by strips."""
        config, clips, stay = self.config, self.clips, self.config.max_stay
        period, windows = clips.period(source), int(self.windows[length].counts[source])
        count = period + stay if clips.looping(source) else windows
        # by frame of the source: row of K, and row of e beyond it; -1 where there is none
        k_rows = np.arange(count + stay) - offset
        if clips.looping(goal.clip):
            k_rows = k_rows % clips.period(goal.clip)
        else:
            k_rows = k_rows + max(config.lengths) + stay
        e_rows = np.where((k_rows >= 0) & (k_rows < frames + stay), k_rows, -1)
        e_rows = np.where(e_rows >= 0, goal.rows[length, e_rows], -1)
        k_rows = np.where((k_rows >= 0) & (k_rows < frames), k_rows, -1)[:count]
        if triggers is None:
            triggers = np.arange(period)
        else:
            wanted = np.unique(np.add.outer(triggers, np.arange(stay + 1)))
            k_rows[np.setdiff1d(np.arange(count), wanted)] = -1
        entry_cost, entries = np.full(count, np.inf), np.full((count, kernels.CHOICE), -1)

        def strip(clip, first, last):
            d = None
            # the frames of the first cycle, then of those that follow
            for cycle in range(0, count, period):
                part = slice(cycle + first, min(cycle + last, count))
                rows = k_rows[part]
                if (rows < 0).all():
                    continue
                if d is None:
                    d = self.strip(length, clip, first, last) if slab is None else [x[first:last] for x in slab]
                k, at = to_go, rows
                if to_go is None:
                    around = e_rows[part.start : part.stop + stay]
                    k = self.slide_strip(goal.e, around, config.lengths[length], self._extra(goal, length))
                    at = np.where(rows >= 0, np.arange(len(rows)), -1)
                kernels.fixed_entries(
                    self.geometry, goal, length, clip, first, *d, *k[:2], at, rows, entry_cost[part], entries[part]
                )

        self.run(strip, self.strips(length, [source]))
        kernels.fixed_regime(np.asarray(triggers), stay, self.weight, entry_cost, entries, cost, choice)

    def direct(self, source, destination, offset):
        """D of the direct transition at every trigger, m^2; inf where a window runs past an end."""
        config, clips, layout = self.config, self.clips, self.layout
        t = np.arange(clips.period(source))
        v = t - offset if config.regime == FIXED else np.zeros_like(t)
        rows = []
        for clip, frame in ((source, t), (destination, v)):
            frame = frame % clips.period(clip) if clips.looping(clip) else frame
            valid = (frame >= 0) & (frame < clips.windows(clip, config.blend))
            rows.append(np.where(valid, layout.frame0[clip] + frame, -1))
        frame_weights = np.full(config.blend, 1.0 / config.blend)
        if config.frame_weights is not None:
            frame_weights = config.frame_weights_of(config.blend)
        out = np.empty(len(t))
        weights = np.ascontiguousarray(frame_weights[:, None] * config.points).reshape(-1)
        direct_costs(self.geometry, weights, rows[0], rows[1], out)
        return out

    def _result(self, cost, direct, choice):
        column, found = choice[:, kernels.COLUMN], choice[:, kernels.COLUMN] >= 0
        hop = np.full(len(cost), -1)
        frame = np.zeros(len(cost), np.int64)
        if found.any():
            hop[found] = self.layout.block_clip[column[found] // BLOCK]
            frame[found] = column[found] - self.layout.first[hop[found]]
        lengths = np.array(self.config.lengths)[choice[:, [kernels.FIRST, kernels.SECOND]]]
        if self.config.hops == 2:
            lengths = lengths[:, [0, 0, 1]]
        none = np.zeros(len(cost), np.int64)
        return SearchResult(
            cost, direct, hop, frame, choice[:, kernels.STAY_SOURCE], choice[:, kernels.STAY_HOP],
            np.full(len(cost), -1), none, none.copy(), lengths, cost.copy(), self.weight,
        )  # fmt: skip
