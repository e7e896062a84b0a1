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

from dataclasses import dataclass, replace

import numpy as np

from motion.errors import InputError
from motion.onehop.alignment import align
from motion.onehop.pricing import on_grid
from motion.onehop.searcher import Searcher, SearchResult  # noqa: F401  (public names)
from motion.onehop.table import LookupTable
from motion.onehop.types import FIXED, START, Blend, SearchConfig, Transition  # noqa: F401  (public names)


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
