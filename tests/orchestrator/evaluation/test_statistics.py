"""Sums that add up shard by shard, columns as plain means, counts by group, rotation and moment."""

import math

import numpy as np
import pytest

from orchestrator.evaluation.statistics import Breakdown, all_reached, columns, sums
from workers.library import MotionLibrary
from workers.types import FELL, REACHED, REWARD_PARTS, TIMED_OUT, Outcomes, Thresholds


def outcomes_of(tasks, seed=0):
    """Random ends of tasks (M, 4)."""
    generator, count = np.random.default_rng(seed), len(tasks)
    return Outcomes(
        clock=np.zeros(count, np.int64), environment=np.arange(count), task=np.asarray(tasks, float),
        retained=np.zeros(count, bool), end=generator.choice([REACHED, FELL, TIMED_OUT], count).astype(np.int8),
        fell_on=np.full(count, -1, np.int16), tightenings=np.zeros(count, np.int64),
        steps=generator.integers(1, 61, count), trembles=generator.integers(0, 300, count),
        parts=generator.normal(size=(count, len(REWARD_PARTS))), deviations=generator.uniform(size=(count, 7)),
    )  # fmt: skip


LIBRARY = MotionLibrary(
    qpos=None, qvel=None, first=None, frames=np.array([9, 9]), fps=None, start=None,
    groups=np.array([[0, 0], [0, 1], [1, 0]]), cancel=np.array([[0.2, 0.75], [1.0, 1.0]]),
    rotation=np.array([-math.pi / 2, math.pi / 2]),
)  # fmt: skip
RUNGS = [Thresholds(0.9**n, 2 * 0.9**n, 3 * 0.9**n, tightenings=n) for n in range(5)]


def random_tasks(count, seed=1):
    generator = np.random.default_rng(seed)
    source, target = LIBRARY.groups[generator.integers(0, 3, count)].T
    low, high = LIBRARY.cancel[source].T
    moment, rotation = low + (high - low) * generator.choice([0, 0.3, 1], count), generator.uniform(*LIBRARY.rotation)
    return np.stack([source, moment, target, np.full(count, rotation)], axis=1)


def test_the_tables_columns_are_plain_means_over_the_episodes():
    episodes = outcomes_of(random_tasks(50))
    wanted = dict.fromkeys(("FRPD", "FRVD", "FRRD", "FKPD", "FJRD", "FJAD", "SURI", "TC", "TS", "TTAR", "Return"), 0.0)
    for i in range(50):
        rp, rv, rq, kp, q, _, qv = episodes.deviations[i]
        for name, value in zip(("FRPD", "FRVD", "FRRD", "FKPD", "FJRD", "FJAD"), (rp, rv, rq, kp, q, qv), strict=True):
            wanted[name] += value / 50
        wanted["SURI"] += episodes.parts[i][REWARD_PARTS.index("upper_body")] / 1.6 / 50
        wanted["TC"] += episodes.trembles[i] / 50
        wanted["TS"] += episodes.steps[i] / 50
        wanted["TTAR"] += (episodes.end[i] == REACHED) / 50
        wanted["Return"] += sum(episodes.parts[i]) / 50
    got = columns(sums(episodes))
    assert got.keys() == wanted.keys() and all(type(value) is float for value in got.values())
    for name, value in wanted.items():
        assert got[name] == pytest.approx(value, rel=1e-12), name
    parts = sum(sums(episodes.take(np.arange(a, a + 10))) for a in range(0, 50, 10))
    np.testing.assert_allclose(parts, sums(episodes), rtol=1e-12)
    assert not all_reached(sums(episodes))
    assert all_reached(sums(episodes.take(np.flatnonzero(episodes.end == REACHED))))


def test_counts_by_group_rotation_moment_and_accuracy_are_those_of_a_loop_over_the_tasks():
    tasks = random_tasks(300)
    tasks[:, 3] = np.random.default_rng(3).choice(np.radians(np.arange(-90, 91, 2)), 300)
    tight, loose = outcomes_of(tasks, 1), outcomes_of(tasks, 2)
    breakdown = Breakdown(LIBRARY)
    met = np.random.default_rng(4).integers(0, 6, 300)

    def count(part):
        return breakdown.count(tight.take(part), loose.take(part), met[part], len(RUNGS))

    halves = [count(np.arange(a, a + 150)) for a in (0, 150)]
    counts = {name: halves[0][name] + halves[1][name] for name in halves[0]}
    for name, array in count(np.arange(300)).items():
        np.testing.assert_array_equal(array, counts[name])
    lists = breakdown.lists(counts, RUNGS)
    for n, entry in enumerate(lists["by_accuracy"]):
        assert entry["tightenings"] == n and entry["thresholds"] == [0.9**n, 2 * 0.9**n, 3 * 0.9**n]
        assert entry["reached_by_source"] == [sum(met[tasks[:, 0] == source] > n) for source in (0, 1)]
        assert entry["reached"] == sum(entry["reached_by_source"])
    assert [(g["source"], g["target"]) for g in lists["groups"]] == [(0, 0), (0, 1), (1, 0)]
    for g in lists["groups"]:
        own = (tasks[:, 0] == g["source"]) & (tasks[:, 2] == g["target"])
        ends = loose.end[own]
        assert g["tasks"] == own.sum() > 0 and g["steps"] == pytest.approx(loose.steps[own].mean())
        assert (g["reached"], g["reached_trained"]) == ((tight.end[own] == REACHED).sum(), (ends == REACHED).sum())
        assert (g["fell"], g["timed_out"]) == ((ends == FELL).sum(), (ends == TIMED_OUT).sum())
        assert g["reached_trained"] + g["fell"] + g["timed_out"] == g["tasks"]
    rotations = lists["by_rotation"]
    assert len(rotations) == 12 and rotations[0]["low"] == -math.pi / 2 and rotations[-1]["high"] == math.pi / 2
    moments = lists["by_moment"]
    assert [m["source"] for m in moments] == [0] * 6 + [1] and moments[-1]["low"] == moments[-1]["high"] == 1.0
    for kind, column in ((rotations, 3), (moments, 1)):
        for b in kind:
            last = b["high"] == max(c["high"] for c in kind if c.get("source") == b.get("source"))
            own = (tasks[:, column] >= b["low"] - 1e-9) & (tasks[:, column] < b["high"] - 1e-9 + last)
            own &= tasks[:, 0] == b["source"] if "source" in b else True
            assert (b["tasks"], b["reached"], b["reached_trained"]) == (
                own.sum(), (tight.end[own] == REACHED).sum(), (loose.end[own] == REACHED).sum(),
            )  # fmt: skip
        assert sum(b["tasks"] for b in kind) == 300


def test_a_group_without_a_task_in_the_subset_has_no_mean():
    breakdown = Breakdown(LIBRARY)
    none = outcomes_of(np.zeros((0, 4)))
    assert breakdown.lists(breakdown.count(none, none, np.zeros(0, int), 5), RUNGS)["groups"][1]["steps"] is None
