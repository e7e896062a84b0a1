"""The default weight is the paper's formula; several weights and body parts are plain searches."""

from dataclasses import replace

import enumeration
import numpy as np
import pytest

from motion.errors import InputError
from motion.onehop import search, weight
from motion.onehop.clips import ClipSet
from motion.onehop.search import SearchConfig
from motion.onehop.variants import body_weights, trade_off


@pytest.mark.parametrize("regime", ["start", "fixed"])
def test_default_weight_is_the_papers_formula(make_set, regime):
    """Means over the drawn conditions, found by enumeration, without stays and with them at no charge."""
    clips = make_set(3, frames=(5, 9))
    config = SearchConfig(blend=2, max_stay=2, regime=regime)
    found = weight.default_weight(clips, config, samples=12, seed=1)
    means = []
    for max_stay in (0, 2):
        slow = enumeration.Enumeration(clips, replace(config, max_stay=max_stay, weight=0.0))
        means.append(np.mean([slow.one_hop(s, d, t, offset)[0] for s, d, t, offset in found.conditions]))
    assert len(found.conditions) == 12
    assert found.weight == pytest.approx((means[0] - means[1]) / 4, abs=1e-9)
    assert (found.without, found.with_stays) == pytest.approx(tuple(means), abs=1e-9)


def test_default_weight_is_a_function_of_its_seed(builtin_set):
    config = SearchConfig(blend=10, max_stay=5)
    one, two, again = (weight.default_weight(builtin_set, config, 20, seed) for seed in (0, 1, 0))
    assert one == again and one.conditions != two.conditions
    together = weight.spread(builtin_set, config, 20, (0, 1))
    assert together == [one, two]


def test_no_weight_means_the_default_one(make_set):
    clips = make_set(3, frames=(5, 9))
    config = SearchConfig(blend=2, max_stay=2)
    table = search.build(clips, [(0, 1)], config)
    expected = weight.default_weight(clips, config).weight
    assert table.result.weight == table.config.weight == pytest.approx(expected, abs=2.0**-33)


def test_no_condition_is_a_clear_line(make_clip):
    clips = ClipSet.from_clips([make_clip(np.random.default_rng(0), "short", 9)])
    with pytest.raises(InputError, match="^weight"):
        weight.default_weight(clips, SearchConfig(blend=5), samples=2)


def test_trade_off_is_one_search_per_weight_and_monotone(builtin_set):
    """A larger weight gives shorter stays and costs smoothness."""
    config = SearchConfig(blend=12, max_stay=8)
    curve = trade_off(builtin_set, [(1, 4), (4, 0)], config, (1e-4, 1e-3, 1e-2))
    for point in curve:
        alone = search.solve(builtin_set, [(1, 4), (4, 0)], replace(config, weight=point.weight))
        inside = np.isfinite(alone.cost)
        r = (alone.stay_source + alone.stay_hop)[inside]
        assert (point.triggers, point.stays) == (inside.sum(), pytest.approx(r.mean()))
        assert point.smoothness == pytest.approx((alone.cost[inside] - alone.weight * r).mean())
        assert point.duration == pytest.approx(r.mean() + 24)
    assert [p.stays for p in curve] == sorted([p.stays for p in curve], reverse=True)
    assert [p.smoothness for p in curve] == sorted(p.smoothness for p in curve)


def test_body_parts_select_their_bodies():
    legs = body_weights({"lower": 1.0})
    assert sum(legs) == 7
    both = np.array(body_weights({"feet": 2.0}, others=0.5))
    assert sorted(set(both)) == [0.5, 2.0] and (both == 2).sum() == 2
    assert sum(body_weights({"upper": 1.0})) + sum(legs) == 18  # the pelvis belongs to both
    with pytest.raises(InputError, match="wings"):
        body_weights({"wings": 1.0})
