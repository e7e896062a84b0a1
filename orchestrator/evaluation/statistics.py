"""From episodes to the table's columns and to where a policy fails, through sums that add up shard by shard."""

import math

import numpy as np

from workers.reward import W_UPPER_BODY
from workers.types import DEVIATIONS, FELL, REACHED, REWARD_PARTS, TIMED_OUT

ROTATION_BIN = math.pi / 12  # rad
MOMENT_BIN = 0.1  # s

_NUM_DEVIATIONS = len(DEVIATIONS)
_PARTS = slice(_NUM_DEVIATIONS, _NUM_DEVIATIONS + len(REWARD_PARTS))
_TREMBLES, _STEPS, _REACHED, _COUNT = range(_PARTS.stop, _PARTS.stop + 4)


def sums(episodes):
    """(18,) float64 of `Outcomes`: sums of deviations, reward parts, sign changes, steps, reached ones, and the count.

    Added in the order of the episodes, so that the same episodes give the same bits.
    """
    numbers = [episodes.trembles, episodes.steps, episodes.end == REACHED, np.ones(len(episodes))]
    return np.concatenate([episodes.deviations, episodes.parts, np.stack(numbers, axis=1)], axis=1).sum(axis=0)


def columns(total):
    """Columns of Table 1 (section 6) of `sums`, as floats: all but MS and IRFA."""
    m = total / total[_COUNT]
    parts = m[_PARTS]
    return {
        **{name: float(m[DEVIATIONS.index(deviation)]) for name, deviation in (
            ("FRPD", "root_position"), ("FRVD", "root_velocity"), ("FRRD", "root_rotation"), ("FKPD", "key_bodies"),
            ("FJRD", "joint_rotation"), ("FJAD", "joint_velocity"),
        )},
        # the reward's part without its weight in Eq. 1
        "SURI": float(parts[REWARD_PARTS.index("upper_body")] / W_UPPER_BODY),
        "TC": float(m[_TREMBLES]),
        "TS": float(m[_STEPS]),
        "TTAR": float(m[_REACHED]),
        "Return": float(parts.sum()),
    }  # fmt: skip


def all_reached(total):
    """Whether every episode of `sums` reached its target."""
    return bool(total[_REACHED] == total[_COUNT])


class Breakdown:
    """Counts of what became of tasks by group, by rotation, by the moment of the source clip and by the accuracy."""

    def __init__(self, library):
        """library: `workers.library.MotionLibrary`."""
        self._library, self._groups = library, np.asarray(library.groups)
        self._rotation = np.array([library.rotation], dtype=np.float64)
        self._rotation_bins = _bins(self._rotation, ROTATION_BIN)
        self._cancel = np.asarray(library.cancel, dtype=np.float64)
        self._moment_bins = _bins(self._cancel, MOMENT_BIN)

    def count(self, tight, loose, met, rungs):
        """{name: int64 array} of the same episodes judged at two accuracies; counts of shards are added.

        met: (M,), as of an `episodes.Ladder` of so many rungs.
        groups: (G, 6), columns tasks, reached (tight), reached, steps, fell, timed out (loose). rotation, moment: a row
        per bin, columns tasks, reached (tight), reached (loose). accuracy: (rungs, S), tasks that reached each rung by
        source clip.
        """
        tasks = tight.task
        source = tasks[:, 0].astype(np.int64)
        group = self._library.group_of(tasks)
        rotation = _bin(tasks[:, 3], self._rotation, self._rotation_bins, np.zeros(len(tasks), dtype=np.int64))
        moment = _bin(tasks[:, 1], self._cancel, self._moment_bins, source)
        reached = [np.ones(len(tasks), dtype=np.int64), tight.end == REACHED, loose.end == REACHED]
        ends = [loose.steps, loose.end == FELL, loose.end == TIMED_OUT]
        return {
            "groups": _count(group, len(self._groups), [*reached, *ends]),
            "rotation": _count(rotation, int(self._rotation_bins.sum()), reached),
            "moment": _count(moment, int(self._moment_bins.sum()), reached),
            "accuracy": _count(source, len(self._cancel), (met > np.arange(rungs)[:, None]).astype(np.int64)).T,
        }

    def lists(self, counts, rungs):
        """The lists `groups`, `by_rotation`, ... of evaluation.json (see docs/evaluation.md). rungs: `Thresholds`."""
        names = ("tasks", "reached", "reached_trained", "steps", "fell", "timed_out")
        groups = []
        for (source, target), row in zip(self._groups.tolist(), counts["groups"].tolist(), strict=True):
            entry = {"source": source, "target": target, **dict(zip(names, row, strict=True))}
            groups.append({**entry, "steps": entry["steps"] / entry["tasks"] if entry["tasks"] else None})
        by_rotation = [
            {"low": low, "high": high, **dict(zip(names, row))}
            for (_, low, high), row in zip(
                _edges(self._rotation, self._rotation_bins), counts["rotation"].tolist(), strict=True
            )
        ]
        by_moment = [
            {"source": source, "low": low, "high": high, **dict(zip(names, row))}
            for (source, low, high), row in zip(
                _edges(self._cancel, self._moment_bins), counts["moment"].tolist(), strict=True
            )
        ]
        by_accuracy = [
            {
                "tightenings": rung.tightenings, "reached": sum(row), "reached_by_source": row,
                "thresholds": [rung.root_position, rung.key_bodies, rung.joint_rotation],
            }
            for rung, row in zip(rungs, counts["accuracy"].tolist(), strict=True)
        ]  # fmt: skip
        return {"groups": groups, "by_rotation": by_rotation, "by_moment": by_moment, "by_accuracy": by_accuracy}


def _bins(ranges, width):
    """How many equal bins, of at most `width`, each of ranges (n, 2) is cut into; at least one."""
    return np.maximum(1, np.ceil((ranges[:, 1] - ranges[:, 0]) / width - 1e-9)).astype(np.int64)


def _bin(values, ranges, bins, which):
    """Bin of each value, which lies in range which[i]; bins of all ranges are counted through."""
    low, high = ranges[which].T
    share = (values - low) / np.where(high > low, high - low, 1.0)
    own = np.clip(np.floor(share * bins[which] + 1e-9).astype(np.int64), 0, bins[which] - 1)
    return (np.cumsum(bins) - bins)[which] + own


def _edges(ranges, bins):
    """(range, low, high) of every bin."""
    for which, ((low, high), count) in enumerate(zip(ranges.tolist(), bins.tolist(), strict=True)):
        edges = np.linspace(low, high, count + 1).tolist()
        yield from ((which, a, b) for a, b in zip(edges, edges[1:]))


def _count(where, size, values):
    """(size, k) int64: each of k values summed by row `where`."""
    out = np.zeros((size, len(values)), dtype=np.int64)
    np.add.at(out, where, np.stack(values, axis=1).astype(np.int64))
    return out
