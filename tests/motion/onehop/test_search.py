"""One-hop search against plain enumeration: same objective, same choice."""

from dataclasses import replace

import enumeration
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from motion.errors import InputError
from motion.onehop import search
from motion.onehop.clips import ClipSet
from motion.onehop.search import SearchConfig


def configs(draw, hops=1):
    return SearchConfig(
        blend=draw(st.integers(1, 3)),
        max_stay=draw(st.integers(0, 3)),
        weight=draw(st.sampled_from([0.0, 1e-3, 0.02, 0.5])),
        regime=draw(st.sampled_from(["start", "fixed"])),
        hops=hops,
    )


def check_one_hop(clips, pairs, config):
    """Every trigger of every pair: cost, direct cost and choice are those of the enumeration."""
    result = search.solve(clips, pairs, config, threads=1)
    slow = enumeration.Enumeration(clips, config)
    row, feasible = 0, 0
    for source, destination, *offset in pairs:
        for t in range(clips.period(source)):
            expected = slow.one_hop(source, destination, t, *offset)
            direct = slow.direct(source, destination, t, *offset)
            assert result.direct[row] == pytest.approx(direct, abs=1e-9)
            if expected is None:
                assert result.hop[row] == -1 and np.isinf(result.cost[row])
            else:
                feasible += 1
                r = result.stay_source[row] + result.stay_hop[row] + sum(result.lengths[row]) - 2 * slow.shortest
                got = (
                    r, result.hop[row], result.hop_frame[row], result.stay_source[row], *result.lengths[row],
                    result.stay_hop[row],
                )  # fmt: skip
                assert result.cost[row] == pytest.approx(expected[0], abs=1e-9)
                assert got == expected[1:]
            row += 1
    assert row == len(result.cost)
    return feasible, row


@settings(max_examples=120)
@given(st.data())
def test_one_hop_search_is_plain_enumeration(make_set, data):
    """Both regimes, loops, clip ends, infeasible triggers, clips shorter than b, costs that tie."""
    clips = make_set(data.draw(st.integers(0, 10**6)), ties=data.draw(st.booleans()))
    config = configs(data.draw)
    pairs = [(0, 1), (2, 2)]
    if config.regime == "fixed":
        pairs = [(*pair, data.draw(st.integers(-6, 6))) for pair in pairs]
    check_one_hop(clips, pairs, config)


@settings(max_examples=25)
@given(st.integers(0, 10**6), st.sampled_from(["start", "fixed"]), st.sampled_from([(1, 2), (2, 3, 4), (2, 4)]))
def test_blend_lengths_are_searched_exactly(make_set, seed, regime, lengths):
    clips = make_set(seed, ties=seed % 2 == 0)
    config = SearchConfig(blend=3, blends=lengths, max_stay=2, weight=0.01, regime=regime)
    check_one_hop(clips, [(0, 1), (1, 1)], config)


@settings(max_examples=30)
@given(st.integers(0, 10**6), st.booleans(), st.sampled_from(["start", "fixed"]))
def test_beats_genres_and_weights_of_points_and_frames_are_searched_exactly(make_set, seed, beats, regime):
    clips = make_set(seed, beats=True, genres=True)
    rng = np.random.default_rng(seed)
    config = SearchConfig(
        blend=2, max_stay=2, weight=0.01, beats=beats, genre_cost=0.05, regime=regime,
        point_weights=tuple(rng.integers(0, 3, 17) + np.eye(17)[0]), frame_weights=tuple(rng.uniform(0.1, 1, 2)),
    )  # fmt: skip
    check_one_hop(clips, [(0, 1), (2, 0)], config)


def test_real_lengths_of_windows_and_stays(make_clip):
    """b = 30 over several strips and tiles of the fast path, on a few triggers against the enumeration's distances."""
    rng = np.random.default_rng(5)
    clips = ClipSet.from_clips([make_clip(rng, "a", 40), make_clip(rng, "b", 62), make_clip(rng, "c", 70, True)])
    for regime in ("start", "fixed"):
        config = SearchConfig(blend=30, max_stay=4, weight=2e-3, regime=regime)
        feasible, triggers = check_one_hop(clips, [(0, 2)], config)
        assert 0 < feasible < triggers


def test_the_table_does_not_depend_on_the_number_of_threads(builtin_set):
    config = SearchConfig(blend=10, max_stay=8, weight=1e-3)
    one = search.build(builtin_set, "all", config, threads=1)
    two = search.build(builtin_set, "all", config, threads=2)
    assert np.array_equal(one.entries, two.entries)
    assert np.array_equal(one.result.cost, two.result.cost)


def test_optimum_is_never_worse_than_direct(builtin_set):
    """The direct transition is in the search space wherever the destination has b frames more."""
    config = SearchConfig(weight=1e-3, max_stay=10)
    result = search.solve(builtin_set, "all", config)
    both = np.isfinite(result.direct) & np.isfinite(result.cost)
    assert both.sum() > 1000
    assert (result.cost[both] <= result.direct[both]).all()


def test_far_from_the_origin_nothing_changes(make_clip):
    """300 m away: the same choice, and a cost that differs by rounding of the points alone."""
    sets = []
    for offset in ((0.0, 0.0), (300.0, -200.0)):
        rng = np.random.default_rng(3)
        sets.append(ClipSet.from_clips([make_clip(rng, f"c{i}", 90, i == 1, offset=offset) for i in range(3)]))
    config = SearchConfig(weight=1e-3, max_stay=5)
    near, far = (search.solve(clips, "all", config) for clips in sets)
    np.testing.assert_allclose(near.cost, far.cost, rtol=0, atol=1e-9)
    assert np.array_equal(near.hop, far.hop) and np.array_equal(near.hop_frame, far.hop_frame)


def test_constant_clips_cost_nothing_and_tie_canonically(make_clip):
    """All costs are 0: no stays, the first clip, its first frame."""
    rng = np.random.default_rng(0)
    still = make_clip(rng, "still", 80, pool=1)
    clips = ClipSet.from_clips([still, replace(still, name="again"), replace(still, name="loop", looping=True)])
    for weight in (0.0, 1e-3):
        result = search.solve(clips, [(1, 2), (2, 2)], SearchConfig(weight=weight, max_stay=3, blend=10))
        inside = np.isfinite(result.cost)
        assert inside.sum() == 71 + 79
        assert (result.cost[inside] == 0).all()
        assert (result.hop[inside] == 0).all() and (result.hop_frame[inside] == 0).all()
        assert (result.stay_source[inside] == 0).all() and (result.stay_hop[inside] == 0).all()


def test_clips_shorter_than_a_blend_have_no_candidates(make_clip):
    rng = np.random.default_rng(0)
    clips = ClipSet.from_clips([make_clip(rng, "a", 5), make_clip(rng, "b", 9)])
    result = search.solve(clips, "all", SearchConfig(weight=1e-3))
    assert np.isinf(result.cost).all() and (result.hop == -1).all() and np.isinf(result.direct).all()


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"blend": 0}, "blend"), ({"max_stay": -1}, "max_stay"), ({"weight": float("nan")}, "weight"),
        ({"regime": "end"}, "regime"), ({"hops": 3}, "hops"), ({"genre_cost": -1.0}, "genre_cost"),
        ({"point_weights": (1.0,)}, "point_weights"), ({"frame_weights": (0.0,) * 30}, "frame_weights"),
        ({"beats": True}, "beats"), ({"genre_cost": 1.0}, "genre_cost"), ({"blends": (10, 30), "hops": 2}, "blends"),
    ],
)  # fmt: skip
def test_values_out_of_range_are_one_clear_line(builtin_set, change, key):
    with pytest.raises(InputError, match=f"^{key}") as error:
        search.solve(builtin_set, [(0, 1)], replace(SearchConfig(weight=1e-3), **change))
    assert "\n" not in str(error.value)


def test_pairs_are_checked(builtin_set):
    config = SearchConfig(weight=1e-3)
    for pairs in ([], [(0, 99)], [("idle", "nowhere")], [(0, 1), (0, 1)], "some", [(0,)]):
        with pytest.raises(InputError):
            search.solve(builtin_set, pairs, config)
