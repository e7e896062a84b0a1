"""What the paper names as extensions and only needs other arguments: body parts, several weights at once."""

from dataclasses import dataclass, replace

import numpy as np

from motion import skeleton
from motion.errors import InputError
from motion.onehop.search import Searcher, resolve_pairs, solve
from motion.onehop.types import SearchConfig

_LEGS = tuple(f"{side}_{part}" for side in ("right", "left") for part in ("thigh", "shin", "foot"))
PARTS = {
    "lower": ("pelvis", *_LEGS),
    "upper": tuple(name for name in skeleton.BODY_NAMES if name not in _LEGS),
    "feet": ("right_foot", "left_foot"),
    "weapons": ("sword", "shield"),
}


def body_weights(parts, others=0.0):
    """point_weights (17,): factors by the name of a body or of one of PARTS, `others` for the rest.

    A search for the legs alone: SearchConfig(point_weights=body_weights({"lower": 1})). Raises InputError for a name
    that is neither.
    """
    weights = np.full(skeleton.NUM_BODIES, float(others))
    for name, factor in parts.items():
        if name not in PARTS and name not in skeleton.BODY_INDEX:
            raise InputError(f"{name}: is no body part; give one of {', '.join((*PARTS, *skeleton.BODY_NAMES))}")
        for body in PARTS.get(name, (name,)):
            weights[skeleton.BODY_INDEX[body]] = factor
    return tuple(weights)


@dataclass(frozen=True)
class TradeOff:
    """Means over the feasible triggers of a search with one weight. smoothness: S, m^2. stays, duration: frames (from
    trigger to the end of the last blend). triggers: how many."""

    weight: float
    smoothness: float
    stays: float
    duration: float
    triggers: int


def trade_off(clips, pairs, config: SearchConfig, weights, progress=None, threads=None):
    """[TradeOff for each of `weights`], m^2 per frame, with distances computed once where they do not depend on it."""
    table, out = resolve_pairs(clips, pairs), []
    if config.hops == 2:
        results = [solve(clips, pairs, replace(config, weight=w), None, threads) for w in weights]
    else:
        results = []
        with Searcher(clips, replace(config, weight=float(weights[0])), threads) as searcher:
            for done, weight in enumerate(weights):
                with searcher.weighted(weight) as other:
                    results.append(other.solve(table))
                if progress:
                    progress(done + 1, len(weights))
    for result in results:
        inside = np.isfinite(result.cost)
        stays = (result.stay_source + result.stay_hop + result.stay_second)[inside]
        # with at most two hops, one hop uses the first length and the last
        used = result.lengths[inside]
        if config.hops == 2:
            used = used * np.stack([np.ones(len(used)), result.second_hop[inside] >= 0, np.ones(len(used))], axis=1)
        blends = used.sum(axis=1)
        r = stays + (used - config.lengths[0] * (used > 0)).sum(axis=1)
        smoothness = result.cost[inside] - result.weight * r
        out.append(
            TradeOff(result.weight, _mean(smoothness), _mean(stays), _mean(stays + blends), int(inside.sum()))
        )
    return out


def _mean(values):
    return float(np.mean(values)) if len(values) else float("nan")
