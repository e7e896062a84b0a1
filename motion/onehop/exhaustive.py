"""The paper's own strategy, compiled: exhaustive search with pruning. For the benchmark, and to check the fast one.

"We calculate w R first and then the other two"; "we visit smaller s_s and s_h first"; a candidate is given up as soon
as w R, D(source, hop) or their sum exceeds the best so far. D(source, hop) is computed once per s_s, not per s_h,
which is kinder to this strategy than the paper's text asks for.
"""

import numpy as np
from numba import njit

from motion.onehop.pricing import price_of
from motion.onehop.types import START


def optimum(searcher, source, destination, t, offset=0):
    """(cost, m^2, number of D that were computed) of the best one-hop transition; cost is inf without candidate.

    searcher: a `search.Searcher` with one blend length; beats are not heeded.
    """
    goal, _ = searcher.goal(destination)
    config, clips = searcher.config, searcher.clips
    start = t if config.regime == START else offset
    v = t - start + config.lengths[0] + np.arange(2 * config.max_stay + 1)
    rows = v % clips.period(destination) if clips.looping(destination) else v
    valid = (rows >= 0) & (rows < searcher.layout.windows[destination])
    rows = np.where(valid, searcher.layout.frame0[destination] + rows, -1)
    return _optimum(searcher.geometry, searcher.weight, config.max_stay, goal.hop_cost, source, t, rows)


@njit(cache=True, nogil=True)
def _optimum(geometry, weight, max_stay, hop_cost, source, t, rows):
    """rows: (2 max_stay + 1,) row of the frames of the destination's window after that many stays, -1 if none."""
    b, windows = geometry.lengths[0], geometry.counts[0, source]
    hops = np.sum(geometry.counts[0])
    # D(source, hop) of every window of every clip, by s_s; negative: not computed yet
    first = np.full((max_stay + 1, hops), -1.0)
    work = np.empty(len(geometry.weights))
    best, computed = np.inf, 0
    for r in range(2 * max_stay + 1):
        if weight * r > best:
            break
        if rows[r] < 0:
            continue
        for stay in range(max(0, r - max_stay), min(r, max_stay) + 1):
            a = t + stay
            if geometry.looping[source]:
                a %= geometry.period[source]
            if a >= windows:
                break
            n = 0
            for hop in range(len(geometry.period)):
                for u in range(geometry.counts[0, hop]):
                    x = u + b + r - stay
                    if geometry.looping[hop]:
                        x %= geometry.period[hop]
                    if x < geometry.counts[0, hop]:
                        if first[stay, n] < 0:
                            first[stay, n] = price_of(
                                geometry, 0, geometry.frame0[source] + a, geometry.frame0[hop] + u, work
                            )
                            computed += 1
                        cost = weight * r + first[stay, n] + hop_cost[hop]
                        if cost < best:
                            cost += price_of(geometry, 0, geometry.frame0[hop] + x, rows[r], work)
                            computed += 1
                            best = min(best, cost)
                    n += 1
    return best, computed
