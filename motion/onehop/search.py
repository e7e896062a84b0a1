"""Exact search of one-hop and two-hop transitions.

`solve(clips, pairs, config)` -> SearchResult: for every trigger of every pair the optimum, its cost, and the cost of
the direct transition, as arrays. `build` packs it into a LookupTable (whose `.result` is the SearchResult).
`costs` -> {"direct", "one_hop", "two_hop"}: {(source, destination): (triggers,) float64, inf where infeasible}.

The objective, m^2, with D of `alignment.align` and the frame bookkeeping of `types`:

    sum over blends of blend_scale(length) D + sum over hops of G(hop) + w R,  R = stays + (lengths - shortest length)

Costs are whole multiples of `distances.QUANTUM`. Equal ones are told apart by smallest R, then fewest hops, then hop
clip, hop frame, s_s, then index of the first and the second length (two hops: then second clip, its frame, s_h).

How: float32 lower bounds of all D (matrix products, sums along diagonals), cost-to-go by sliding minima, minima over
columns pruned by minima of blocks; then all candidates whose lower bound does not exceed the exact cost of the best
one are priced in float64. So the optimum is exact whatever float32 rounds.
"""

import copy
import os
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from motion.errors import InputError
from motion.onehop import kernels
from motion.onehop.alignment import align
from motion.onehop.distances import BIG, MEMORY, SHRINK, Workspace, fill, on_grid, pool
from motion.onehop.features import BLOCK, ROWS, Layout, Windows
from motion.onehop.table import LookupTable
from motion.onehop.types import FIXED, START, Blend, SearchConfig, Transition  # noqa: F401  (public names)


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


def build(clips, pairs, config, progress=None, threads=None) -> LookupTable:
    """Table of the optimal transitions of `pairs` of a ClipSet for every trigger frame of their sources.

    pairs: "all", or a list of (source, destination) indices or names, or of (source, destination, o_sd) in the regime
    "fixed" (o_sd defaults to 0; for a looping source it holds for triggers in its first cycle).
    progress: called with (done, total) now and then. threads: None for all cores; the table does not depend on it.
    """
    table = resolve_pairs(clips, pairs)
    result = solve(clips, pairs, config, progress, threads)
    return LookupTable.pack(clips, replace(config, weight=result.weight), table, result)


def costs(clips, pairs, config, progress=None, threads=None):
    """Costs of the direct, one-hop and two-hop optimum: {kind: {(source, destination): (triggers,) m^2}}.

    "two_hop" (at most two hops) is there if config.hops is 2; inf where there is no candidate.
    """
    table = resolve_pairs(clips, pairs)
    result = solve(clips, pairs, config, progress, threads)
    kinds = {"direct": result.direct, "one_hop": result.one_hop}
    if config.hops == 2:
        kinds["two_hop"] = result.cost
    ends = np.cumsum([clips.period(source) for source, _ in table])
    return {kind: dict(zip(table, np.split(values, ends[:-1]))) for kind, values in kinds.items()}


def resolve_pairs(clips, pairs):
    """{(source, destination): o_sd} of the `pairs` argument of `build`, in its order.

    Raises InputError for an unknown clip, a pair given twice, or no pair.
    """
    if isinstance(pairs, str):
        if pairs != "all":
            raise InputError(f"pairs: is {pairs!r}; give all, or a list of (source, destination)")
        pairs = [(s, d) for s in range(len(clips)) for d in range(len(clips))]
    out = {}
    for pair in pairs:
        if len(pair) not in (2, 3):
            raise InputError(f"pairs: {pair!r} is not (source, destination) or (source, destination, offset)")
        key = clips.index(pair[0]), clips.index(pair[1])
        if key in out:
            raise InputError(f"pairs: {clips.names[key[0]]} -> {clips.names[key[1]]} is given twice; give it once")
        out[key] = int(pair[2]) if len(pair) == 3 else 0
    if not out:
        raise InputError("pairs: is empty; give at least one (source, destination)")
    return out


def solve(clips, pairs, config, progress=None, threads=None):
    """SearchResult of `pairs`; arguments as those of `build`."""
    config.check()
    if config.weight is None:
        from motion.onehop.weight import default_weight

        config = replace(config, weight=default_weight(clips, config, threads=threads).weight)
    with Searcher(clips, config, threads) as searcher:
        return searcher.solve(resolve_pairs(clips, pairs), progress)


@dataclass(frozen=True)
class Price:
    """A transition taken apart. distances: D of each blend times its scale, m^2. responsiveness: R, frames.
    genre: G of all hops, m^2. objective: m^2."""

    distances: tuple
    responsiveness: int
    genre: float
    objective: float


def price(clips, config, transition):
    """Price of a Transition (of its direct transition, if it is not feasible), straight from the definition.

    config: with its weight. Raises IndexError where a window lies outside its clip.
    """
    blends = transition.blends
    clip, frame, time = transition.source, transition.frame, 0
    distances = []
    for blend in blends:
        weights = config.frame_weights_of(blend.length)[:, None] * config.points
        a = clips.window_points(clip, frame + blend.time - time, blend.length)
        d, _ = align(a, clips.window_points(blend.clip, blend.frame, blend.length), weights)
        distances.append(on_grid(d * (config.blend_scale(blend.length) if transition.feasible else 1.0)))
        clip, frame, time = blend.clip, blend.frame, blend.time
    r, genre = 0, 0.0
    if transition.feasible:
        r = transition.stays + sum(blend.length - config.lengths[0] for blend in blends)
        if config.genre_cost:
            target = clips.genres[transition.destination]
            genre = on_grid(config.genre_cost) * sum(clips.genres[blend.clip] != target for blend in blends[:-1])
    return Price(tuple(distances), r, genre, sum(distances) + genre + on_grid(config.weight) * r)


class Searcher:
    """Features and buffers of one search; a context manager. `solve` may be called several times."""

    def __init__(self, clips, config, threads=None):
        config.check()
        if config.weight is None:
            raise InputError("weight: is not given; use solve or build, which choose the default")
        self.clips, self.config = clips, config
        self.threads = max(1, threads or os.cpu_count() or 1)
        lengths = config.lengths
        if config.beats and clips.beats is None:
            raise InputError("beats: the clips have none; give their beats to ClipSet.from_clips, or search without")
        if config.genre_cost and clips.genres is None:
            raise InputError("genre_cost: the clips have no genres; give them to ClipSet.from_clips, or leave it 0")
        if config.hops == 2 and len(lengths) > 1:
            raise InputError("blends: cannot be chosen with hops=2; give one blend length, or hops=1")
        self.layout = Layout.of(clips, lengths, config.blend)
        if self.layout.columns >= 1 << 31:
            raise InputError("clips: are too long for one search; use fewer")
        self.windows = [
            Windows(self.layout, b, config.points, config.frame_weights_of(b), config.blend_scale(b)) for b in lengths
        ]
        x, y, z = self.layout.flat
        self.geometry = kernels.Geometry(
            self.layout.first.astype(np.int64), self.layout.period.astype(np.int64), self.layout.looping,
            self.layout.frame0.astype(np.int64), np.array([w.counts for w in self.windows], dtype=np.int64),
            self.layout.block_clip, np.array(lengths, dtype=np.int64), x, y, z,
            np.concatenate([w.weights for w in self.windows]),
            np.cumsum([0] + [len(w.weights) for w in self.windows]).astype(np.int64),
            np.array([w.scale for w in self.windows]), len(config.points),
        )  # fmt: skip
        self.weight = on_grid(config.weight)
        self._executor = ThreadPoolExecutor(self.threads) if self.threads > 1 else None
        self._local = threading.local()
        self._free, self._slabs, self._targets = [], {}, {}
        # largest float32 error bound met so far, m^2
        self.error = 0.0

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self._executor:
            self._executor.shutdown()

    def weighted(self, weight):
        """The same search with another weight, m^2 per frame; what does not depend on it is shared."""
        other = copy.copy(self)
        other.config, other.weight, other._free = replace(self.config, weight=float(weight)), on_grid(weight), []
        if len(self.windows) > 1:
            other._targets = {}
        other._executor = ThreadPoolExecutor(self.threads) if self.threads > 1 else None
        return other

    # -- distances ---------------------------------------------------------------------------------------------------

    def run(self, function, tasks):
        """[function(*task) for each task], on all threads."""
        if self._executor is None or len(tasks) < 2:
            return [function(*task) for task in tasks]
        return list(self._executor.map(lambda task: function(*task), tasks))

    def _space(self):
        if not hasattr(self._local, "space"):
            self._local.space = Workspace()
        return self._local.space

    def slab(self, length, clip, first, last, beats=False, out=None):
        """(lower bounds, their pooled minima) of windows first..last - 1 of `clip`, of length index `length`."""
        windows, layout = self.windows[length], self.layout
        out = np.empty((last - first, layout.columns), np.float32) if out is None else out[: last - first]
        pooled = np.empty((last - first, layout.blocks), np.float32)

        def strip(start):
            stop = min(start + ROWS, last)
            part = out[start - first : stop - first]
            error = fill(windows, clip, start, stop - start, part, self._space())
            if beats:
                self._mask(part, clip, start, stop)
            pool(part, windows.pads, pooled[start - first : stop - first])
            return error

        self.error = max(self.error, *self.run(strip, [(start,) for start in range(first, last, ROWS)]), 0.0)
        return out, pooled

    def strip_slab(self, clip, first, last):
        """Slab of at most ROWS windows that are left for another hop, in this thread's buffer, with pooled minima."""
        space, layout, windows = self._space(), self.layout, self.windows[0]
        if not hasattr(space, "strip"):
            space.strip = np.empty((ROWS, layout.columns), np.float32), np.empty((ROWS, layout.blocks), np.float32)
        d, d_pooled = (array[: last - first] for array in space.strip)
        fill(windows, clip, first, last - first, d, space)
        if self.config.beats:
            self._mask(d, clip, first, last)
        pool(d, windows.pads, d_pooled)
        return d, d_pooled

    def _mask(self, part, clip, start, stop):
        """BIG where the next beats of both windows do not coincide."""
        own = _next_beats(self.clips, clip)[start:stop]
        for hop in range(len(self.clips)):
            first, count = self.layout.first[hop], self.layout.windows[hop]
            next_ = _next_beats(self.clips, hop)[:count]
            part[:, first : first + count][(own[:, None] != next_) | (own[:, None] < 0)] = BIG

    def source_slab(self, length, clip):
        """Slab of all windows of a source; one buffer per length in "start", kept while there is room in "fixed"."""
        key = length, clip, self.config.beats
        if key in self._slabs:
            return self._slabs[key]
        count = int(self.windows[length].counts[clip])
        size = int(self.windows[length].counts.max(initial=0))
        keep = MEMORY // max(1, 4 * size * self.layout.columns) if self.config.regime == FIXED else len(self.windows)
        buffer = None
        if len(self._slabs) >= max(keep, len(self.windows) + 1):
            buffer = self._slabs.pop(next(iter(self._slabs)))[2]
        elif self.config.regime == START:
            old = next((k for k in self._slabs if k[0] == length), None)
            buffer = self._slabs.pop(old)[2] if old else None
        if buffer is None or buffer.shape[0] < count:
            buffer = np.empty((size, self.layout.columns), np.float32)
        out, pooled = self.slab(length, clip, 0, count, self.config.beats, buffer)
        self._slabs[key] = out, pooled, buffer
        return self._slabs[key]

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
        if self.config.regime == FIXED:
            self._targets.clear()
        first, last = self.rows_of(destination)
        shortest = self.config.lengths[0]
        best = None
        for length in range(len(self.windows)):
            stop = min(last, int(self.windows[length].counts[destination]))
            if stop <= first:
                continue
            charge = np.float32(SHRINK * self.weight * (self.config.lengths[length] - shortest))
            if self.config.regime == FIXED and len(self.windows) == 1 and not self.config.beats:
                part = self.source_slab(length, destination)[0]
            else:
                part, _ = self.slab(length, destination, first, stop)
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
        """(K, its pooled minima) for a first blend of length index `length`."""
        layout, stay = self.layout, self.config.max_stay
        k = np.empty((frames, layout.columns), np.float32)
        pooled = np.empty((frames, layout.blocks), np.float32)
        weight, charge = np.float32(self.weight * SHRINK), self.config.lengths[length] - self.config.lengths[0]

        def clip_part(i):
            count = int(layout.windows[i])
            if not count:
                return
            part = np.empty((frames, count), np.float32)
            work = np.empty((frames + stay, count + stay), np.float32)
            extra = np.float32((goal.hop_cost[i] + self.weight * charge) * SHRINK)
            kernels.slide(
                goal.e, goal.rows[length, : frames + stay], layout.first[i], count, self.clips.period(i),
                self.clips.looping(i), self.config.lengths[length], weight, stay, extra, work, part,
            )  # fmt: skip
            k[:, layout.first[i] : layout.first[i] + count] = part

        self.run(clip_part, [(i,) for i in range(len(self.clips))])
        pads = self.windows[0].pads
        step = max(ROWS, -(-frames // (4 * self.threads)))
        self.run(lambda a: pool(k[a : a + step], pads, pooled[a : a + step]), [(a,) for a in range(0, frames, step)])
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
        for (source, destination), offset in pairs.items():
            at = place[source, destination]
            direct[at : at + clips.period(source)] = self.direct(source, destination, offset)
        done = 0
        for group in self._order(pairs):
            for pair in group:
                at, count = place[pair], clips.period(pair[0])
                chunks = self._chunks(count) if triggers is None else [(int(t), int(t) + 1) for t in triggers[pair]]
                self._pair(*pair, pairs[pair], chunks, cost[at : at + count], choice[at : at + count])
                done += 1
                if progress:
                    progress(done, len(pairs) * config.hops)
        result = self._result(cost, direct, choice)
        if config.hops == 2:
            from motion.onehop.twohop import add_second_hops

            result = add_second_hops(self, pairs, place, result, progress)
        return result

    def _order(self, pairs):
        """Pairs grouped by what is costly to compute: the source's slab ("start"), the destination's K ("fixed")."""
        side = 1 if self.config.regime == FIXED else 0
        groups = {}
        for pair in pairs:
            groups.setdefault(pair[side], []).append(pair)
        return groups.values()

    def _pair(self, source, destination, offset, chunks, cost, choice):
        goal, frames = self.goal(destination)
        if not len(goal.e) or not frames:
            return
        for length in range(len(self.windows)):
            if not self.windows[length].counts[source]:
                continue
            k, k_pooled = self._kept_cost_to_go(goal, frames, length)
            d, d_pooled, _ = self.source_slab(length, source)
            if self.config.regime == START:
                self._start(goal, length, source, chunks, d, d_pooled, k, k_pooled, cost, choice)
            else:
                self._fixed(goal, length, source, offset, chunks, d, d_pooled, k, k_pooled, cost, choice)

    def _kept_cost_to_go(self, goal, frames, length):
        kept = self._free
        for entry in kept:
            if entry[0] == (goal.clip, length):
                return entry[1]
        # "start": small, all destinations are kept; "fixed": one at a time
        if self.config.regime == FIXED:
            kept[:] = [entry for entry in kept if entry[0][0] == goal.clip]
        kept.append(((goal.clip, length), self.cost_to_go(goal, frames, length)))
        return kept[-1][1]

    def _chunks(self, count):
        step = max(1, -(-count // (2 * self.threads)) if self.threads > 1 else count)
        return [(a, min(a + step, count)) for a in range(0, count, step)]

    def _start(self, goal, length, source, chunks, d, d_pooled, k, k_pooled, cost, choice):
        weight, slack = np.float32(self.weight * SHRINK), np.float32(2 * self.error)
        self.run(
            lambda a, b: kernels.start_regime(
                self.geometry, goal, length, source, a, b, d, d_pooled, k, k_pooled, weight, slack, cost, choice
            ),
            chunks,
        )

    def _fixed(self, goal, length, source, offset, chunks, d, d_pooled, k, k_pooled, cost, choice):
        config, clips = self.config, self.clips
        count = clips.period(source) + config.max_stay if clips.looping(source) else len(d)
        v = np.arange(count) - offset
        if clips.looping(goal.clip):
            k_rows = v % clips.period(goal.clip)
        else:
            k_rows = v + max(config.lengths) + config.max_stay
            k_rows = np.where((k_rows >= 0) & (k_rows < len(k)), k_rows, -1)
        low, at = np.empty(count, np.float32), np.empty(count, np.int64)
        self.run(
            lambda a, b: kernels.fixed_lower(a, b, len(d), k_rows, d, d_pooled, k, k_pooled, low, at),
            self._chunks(count),
        )
        self.run(
            lambda a, b: kernels.fixed_regime(
                self.geometry, goal, length, source, a, b, k_rows, low, at, d, d_pooled, k, k_pooled, cost, choice
            ),
            chunks,
        )

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
        kernels.direct_costs(self.geometry, weights, rows[0], rows[1], out)
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


def _next_beats(clips, i):
    """Frames from each frame 0..period - 1 of clip i to its next beat (0 on a beat), -1 after the last one."""
    period, beats = clips.period(i), clips.beats[i]
    if not len(beats):
        return np.full(period, -1)
    if clips.looping(i):
        beats = np.unique(beats % period)
        beats = np.append(beats, beats[0] + period)
    at = np.searchsorted(beats, np.arange(period))
    return np.where(at < len(beats), beats[np.minimum(at, len(beats) - 1)] - np.arange(period), -1)
