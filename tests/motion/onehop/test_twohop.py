"""Two hops against plain enumeration: same objective, same choice."""

import enumeration
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from motion.onehop import search
from motion.onehop.search import SearchConfig


def check_two_hops(clips, pairs, config):
    result = search.solve(clips, pairs, config, threads=1)
    slow = enumeration.Enumeration(clips, config)
    row = twice = 0
    for source, destination, *offset in pairs:
        for t in range(clips.period(source)):
            one, two = (kind(source, destination, t, *offset) for kind in (slow.one_hop, slow.two_hop))
            assert result.one_hop[row] == pytest.approx(np.inf if one is None else one[0], abs=1e-9)
            if one is None and two is None:
                assert result.hop[row] == -1 and np.isinf(result.cost[row])
            elif two is None or (one is not None and one[:2] <= two[:2]):
                got = result.hop[row], result.hop_frame[row], result.stay_source[row], result.stay_hop[row]
                assert got == (one[2], one[3], one[4], one[7]) and result.second_hop[row] == -1
            else:
                twice += 1
                assert result.cost[row] == pytest.approx(two[0], abs=1e-9)
                got = (
                    result.stay_source[row] + result.stay_hop[row] + result.stay_second[row], result.hop[row],
                    result.hop_frame[row], result.stay_source[row], result.second_hop[row], result.second_frame[row],
                    result.stay_hop[row], result.stay_second[row],
                )  # fmt: skip
                assert got == two[1:]
            row += 1
    return twice


@settings(max_examples=60)
@given(st.data())
def test_two_hop_search_is_plain_enumeration(make_set, data):
    """Both regimes, loops, clip ends, infeasible triggers, ties; the better of one and two hops."""
    clips = make_set(data.draw(st.integers(0, 10**6)), frames=(3, 8), ties=data.draw(st.booleans()))
    config = SearchConfig(
        blend=data.draw(st.integers(1, 2)),
        max_stay=data.draw(st.integers(0, 2)),
        weight=data.draw(st.sampled_from([0.0, 1e-3, 0.02])),
        regime=data.draw(st.sampled_from(["start", "fixed"])),
        hops=2,
    )
    pairs = [(0, 1)] if config.regime == "start" else [(0, 1, data.draw(st.integers(-6, 6)))]
    check_two_hops(clips, pairs, config)


@settings(max_examples=15)
@given(st.integers(0, 10**6), st.booleans())
def test_two_hops_heed_beats_and_genres(make_set, seed, beats):
    clips = make_set(seed, frames=(3, 8), beats=True, genres=True)
    config = SearchConfig(blend=1, max_stay=1, weight=0.01, hops=2, beats=beats, genre_cost=0.02)
    check_two_hops(clips, [(0, 1), (2, 2)], config)


def test_two_hops_are_found_better_somewhere(make_set):
    """The enumeration's second hop is taken in part of these instances, so that the tests above compare something."""
    config = SearchConfig(blend=1, max_stay=1, weight=1e-3, hops=2)
    assert sum(check_two_hops(make_set(seed, frames=(4, 8)), [(0, 1)], config) for seed in range(4)) > 3
