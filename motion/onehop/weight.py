"""The default weight w of the paper: what stays gain in smoothness, spread over the longest stays."""

from dataclasses import dataclass, replace

import numpy as np

from motion.errors import InputError
from motion.onehop.search import Searcher
from motion.onehop.types import FIXED

DRAWS = 10_000  # conditions drawn for each one that is wanted


@dataclass(frozen=True)
class DefaultWeight:
    """weight: m^2 per frame. without, with_stays: mean smoothness S of the conditions without stays and with stays up
    to s_max at w = 0, m^2. conditions: (source, destination, trigger frame, o_sd) of each."""

    weight: float
    without: float
    with_stays: float
    conditions: tuple


def default_weight(clips, config, samples=100, seed=0, threads=None):
    """DefaultWeight of a ClipSet: (S_0 - S_smax) / (2 s_max) over random conditions (paper: "Default weight").

    samples: N, the paper's 100; its spread over seeds is what a larger N buys down (`spread`). config: all but its
    weight, hops and genre cost are used. Raises InputError if no condition has a candidate without stays.
    """
    return spread(clips, config, samples, (seed,), threads)[0]


def spread(clips, config, samples=100, seeds=range(10), threads=None):
    """[DefaultWeight of each seed], for less than computing each by itself."""
    config = replace(config, weight=0.0, hops=1, genre_cost=0.0)
    if config.max_stay == 0:
        return [DefaultWeight(0.0, 0.0, 0.0, ()) for _ in seeds]
    drawn = [_draw(clips, config, samples, seed) for seed in seeds]
    pairs = {}
    for conditions in drawn:
        for source, destination, _, offset in conditions:
            pairs.setdefault((source, destination), offset)
    triggers = {pair: set() for pair in pairs}
    for conditions in drawn:
        for source, destination, t, _ in conditions:
            triggers[source, destination].add(t)
    triggers = {pair: sorted(frames) for pair, frames in triggers.items()}
    costs = []
    for max_stay in (0, config.max_stay):
        with Searcher(clips, replace(config, max_stay=max_stay), threads) as searcher:
            costs.append(searcher.solve(pairs, triggers=triggers).cost)
    first = dict(zip(pairs, np.concatenate([[0], np.cumsum([clips.period(source) for source, _ in pairs])])))
    out = []
    for conditions in drawn:
        rows = np.array([first[source, destination] + t for source, destination, t, _ in conditions])
        # only beats can still leave a drawn condition without candidate
        rows = rows[np.isfinite(costs[0][rows])]
        if not len(rows):
            raise InputError("weight: no drawn condition has a candidate whose beats coincide; give a weight")
        # summed exactly, because costs are multiples of one quantum: the mean is the same in any order
        without, with_stays = (float(cost[rows].mean()) for cost in costs)
        out.append(DefaultWeight((without - with_stays) / (2 * config.max_stay), without, with_stays, conditions))
    return out


def _draw(clips, config, samples, seed):
    """Random (source, destination, trigger, o_sd) that have a candidate without stays; o_sd is one per pair."""
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(DRAWS * samples):
        source, destination = (int(i) for i in rng.integers(len(clips), size=2))
        t = int(rng.integers(clips.period(source)))
        offset = _offset(clips, source, destination) if config.regime == FIXED else 0
        if _feasible(clips, config, source, destination, t, offset):
            out.append((source, destination, t, offset))
        if len(out) == samples:
            return tuple(out)
    raise InputError(f"weight: no trigger has a candidate with blends of {min(config.lengths)} frames; give a weight")


def _offset(clips, source, destination):
    """A random offset of a pair, the same whenever and however often the pair is drawn."""
    rng = np.random.default_rng([source, destination, clips.period(source), clips.period(destination)])
    return int(rng.integers(1 - clips.period(destination), clips.period(source)))


def _feasible(clips, config, source, destination, t, offset):
    """Whether a candidate without stays exists (beats aside: they may leave fewer)."""
    b = min(config.lengths)
    v = t + b - offset if config.regime == FIXED else b
    hop = any(clips.looping(i) or clips.windows(i, b) > b for i in range(len(clips)))
    return (
        hop
        and (clips.looping(source) or t < clips.windows(source, b))
        and (clips.looping(destination) or 0 <= v < clips.windows(destination, b))
    )
