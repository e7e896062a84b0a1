"""The numbers of the report: costs of all triggers, and a sample of them played."""

from dataclasses import dataclass, replace

import numpy as np

from motion.onehop.alignment import align
from motion.onehop.legs import align_legs, arrival, legs_of, window
from motion.onehop.report_measures import foot_skate, play, root_added, root_jump
from motion.onehop.search import build

KINDS = ("direct", "one-hop", "two-hop")
SAMPLE = 60  # triggers that are played, evenly spread over all triggers of all pairs
BARS = 15  # of them in Fig. 10, as many as in the paper
WEIGHTS = (0.01, 0.1, 1.0, 10.0, 100.0)  # factors of w in the trade-off
TRADE_OFF_PAIRS = 12
MAP_FRAMES = 100  # of each clip in the colour map


@dataclass(frozen=True, eq=False)
class Trigger:
    """One trigger of the sample. cost: m^2, of "direct", "one-hop", "two-hop"; parts: [D ..., w R] of each. played:
    {kind: `Played`}."""

    source: str
    destination: str
    frame: int
    cost: dict
    parts: dict
    played: dict

    def measure(self, function):
        """{kind: function(played)}."""
        return {kind: function(played) for kind, played in self.played.items()}


@dataclass(frozen=True, eq=False)
class Study:
    """All that the report shows. tables: {"one-hop", "two-hop"}. summary: the cost table, by kind. effects: means over
    all triggers, as `effects`. cases: [(what for, Trigger)] of the film strips, as `cases`."""

    clips: object
    tables: dict
    weight: float
    summary: dict
    triggers: tuple
    effects: dict
    cases: list
    trade_off: tuple


def study(clips, pairs, config, progress=None):
    """The `Study` of pairs (see `search.build`). progress(label, done, total) is called now and then."""
    report = progress or (lambda *_: None)

    def built(label, chosen, **changes):
        return build(clips, chosen, replace(config, **changes), lambda done, total: report(label, done, total))

    one = built("one hop", pairs, hops=1)
    weight = float(one.result.weight)
    tables = {"one-hop": one, "two-hop": built("two hops", pairs, hops=2, weight=weight)}
    triggers, rows = [], sample(one)
    for k, row in enumerate(rows):
        report("playing", k, len(rows))
        triggers.append(trigger(clips, tables, *row, weight))
    some = [pair for pair in one.pairs if pair[0] != pair[1]] or list(one.pairs)
    some = [some[i] for i in np.unique(np.linspace(0, len(some) - 1, TRADE_OFF_PAIRS).astype(int))]
    chosen = [(*pair, one.pairs[pair]) if config.regime == "fixed" else pair for pair in some]
    trade_off = []
    for factor in WEIGHTS:
        table = built("weights", chosen, hops=1, weight=factor * weight)
        trade_off.append((f"{factor:g} w", *means(table, factor * weight, clips.fps)))
    result = table.result
    valid = np.isfinite(result.direct) & np.isfinite(result.cost)
    trade_off.append(("direct", config.blend / clips.fps, float(result.direct[valid].mean())))
    totals = summary(tables, weight, config.blend, clips.fps)
    report("playing", len(rows), len(rows))
    played = (effects(triggers), cases(triggers)) if triggers else ({}, [])
    return Study(clips, tables, weight, totals, tuple(triggers), *played, tuple(trade_off))


def stays(result):
    """(T,) R of every trigger: all frames that a clip is played alone."""
    return result.stay_source + result.stay_hop + np.where(result.second_hop >= 0, result.stay_second, 0)


def arrivals(table):
    """(T,) frames from trigger to arrival (`legs.arrival`), inf without candidate."""
    out = np.full(table.triggers, np.inf)
    for (source, destination), first in table.first.items():
        for t in range(table.clips.period(source)):
            found = table.query(source, destination, t)
            if found.feasible:
                out[first + t] = arrival(table.clips, legs_of(table.clips, source, t, found.blends))
    return out


def means(table, weight, fps):
    """(mean s from trigger to arrival, mean S in m^2) over the triggers with a direct and a one-hop transition."""
    result = table.result
    valid = np.isfinite(result.direct) & np.isfinite(result.cost)
    smooth = result.cost - weight * stays(result)
    return float(arrivals(table)[valid].mean() / fps), float(smooth[valid].mean())


def summary(tables, weight, length, fps):
    """{kind: {quantity: number}} over the triggers that have both a direct and a one-hop transition.

    Charged: every further blend costs w b, as if its frames were a stay; then the direct transition is taken where it
    is cheaper. That stays exact: the charge is the same for all transitions with as many hops, and the direct one is
    in the choice.
    """
    one, two = (tables[kind].result for kind in ("one-hop", "two-hop"))
    valid = np.isfinite(one.direct) & np.isfinite(one.cost)
    direct = one.direct[valid]
    charged_one = np.minimum(direct, one.cost[valid] + weight * length)
    further = np.where(two.second_hop[valid] >= 0, 2, 1)
    charged_two = np.minimum(charged_one, two.cost[valid] + weight * length * further)
    out = {
        "triggers": len(one.cost),
        "without": int((~np.isfinite(one.cost)).sum()),
        "compared": int(valid.sum()),
        "direct": {"cost": direct.mean(), "smooth": direct.mean(), "time": length / fps, "charged": direct.mean()},
    }
    for kind, result, charged in (("one-hop", one, charged_one), ("two-hop", two, charged_two)):
        cost = result.cost[valid]
        time, smooth = means(tables[kind], weight, fps)
        out[kind] = {
            "cost": cost.mean(),
            "smooth": smooth,
            "time": time,
            "better": np.mean(cost < direct - 1e-12),
            "charged": charged.mean(),
            "charged_better": np.mean(charged < direct - 1e-12),
        }
    out["two-hop"]["second"] = np.mean(two.second_hop[valid] >= 0)
    return out


def sample(table):
    """[(source, destination, frame)]: every k-th trigger that has a direct and a one-hop transition, SAMPLE in all."""
    result, rows = table.result, []
    valid = np.isfinite(result.direct) & np.isfinite(result.cost)
    for pair, first in table.first.items():
        if pair[0] != pair[1] or len(table.pairs) == 1:
            rows += [(*pair, t) for t in range(table.clips.period(pair[0])) if valid[first + t]]
    if not rows:
        return []
    return [rows[i] for i in np.unique(np.linspace(0, len(rows) - 1, SAMPLE).astype(int))]


def trigger(clips, tables, source, destination, frame, weight):
    """The `Trigger` of one row of the sample, played in all ways over the same time."""
    found = {kind: table.query(source, destination, frame) for kind, table in tables.items()}
    legs = {kind: legs_of(clips, source, frame, row.blends) for kind, row in found.items()}
    legs["direct"] = legs_of(clips, source, frame, found["one-hop"].direct)
    config = tables["one-hop"].config
    parts = {}
    for kind in KINDS:
        wait = weight * sum(leg.stay for leg in legs[kind][:-1])
        parts[kind] = [distance for distance, _ in align_legs(clips, legs[kind], config)]
        parts[kind] += [] if kind == "direct" else [wait]
    names = (clips.names[source], frame, clips.names[destination])
    until = max(row.duration for row in found.values()) / clips.fps
    played = {kind: play(clips, tables["one-hop"], *names, legs[kind], until) for kind in parts}
    cost = {kind: float(sum(values)) for kind, values in parts.items()}
    return Trigger(names[0], names[2], frame, cost, parts, played)


def effects(triggers):
    """{kind: means of (foot skate m/s, slide m, root jump m/s, root's added speed m/s)} over a sample."""
    out = {}
    for kind in KINDS:
        played = [row.played[kind] for row in triggers]
        rows = [(*foot_skate(one), root_jump(one), root_added(one)) for one in played]
        out[kind] = tuple(np.mean(rows, axis=0))
    return out


def cases(triggers):
    """The two triggers of the film strips: where the one-hop transition spares the root's velocity the largest jump
    (Fig. 7), and of another pair, planted feet the longest slide (Fig. 8)."""

    def best(rows, function):
        gains = [row.measure(function) for row in rows]
        return rows[int(np.argmax([gain["direct"] - gain["one-hop"] for gain in gains]))]

    jump = best(triggers, root_jump)
    rest = [row for row in triggers if (row.source, row.destination) != (jump.source, jump.destination)]
    return [("root", jump)] + ([("feet", best(rest, lambda played: foot_skate(played)[1]))] if rest else [])


def distance_map(clips, first, second, config):
    """(D (m, n) of windows of clips `first` (rows) and `second`, starting frames of rows, of columns)."""
    rows, columns = (starts(clips, clip, config.blend) for clip in (first, second))
    weights = np.outer(config.frame_weights_of(config.blend), config.points)
    windows = [window(clips, second, frame, config.blend) for frame in columns]
    values = [[align(window(clips, first, row, config.blend), other, weights)[0] for other in windows] for row in rows]
    return np.array(values), rows, columns


def starts(clips, clip, length):
    """First frames of the windows that the colour map shows: every k-th."""
    count = clips.windows(clip, length)
    return np.arange(0, count, max(1, -(-count // MAP_FRAMES)))
