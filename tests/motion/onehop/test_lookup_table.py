"""The lookup table: it answers what the search found, in few bytes, and refuses files that are not its own."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from motion.errors import InputError
from motion.onehop import search
from motion.onehop.clips import ClipSet
from motion.onehop.search import SearchConfig, build, price
from motion.onehop.table import LookupTable


def check_table(table, clips, config):
    """Every entry is the search's row, and its price is the row's cost."""
    result, row, seen = table.result, 0, 0
    for (source, destination), offset in table.pairs.items():
        for t in range(clips.period(source)):
            found = table.query(source, destination, t)
            assert found.feasible == (result.hop[row] >= 0)
            assert found.destination_offset == (t if config.regime == "start" else offset)
            if found.feasible:
                seen += 1
                assert (found.hop, found.hop_frame) == (result.hop[row], result.hop_frame[row])
                assert found.offset == t + found.stay_source - found.hop_frame
                assert (found.stay_source, found.stay_hop, found.stay_second) == (
                    result.stay_source[row], result.stay_hop[row], result.stay_second[row],
                )  # fmt: skip
                assert found.second_hop == result.second_hop[row]
                assert found.hops == len(found.lengths) - 1
                assert price(clips, config, found).objective == pytest.approx(result.cost[row], abs=1e-9)
                assert found.cost == result.cost[row]
            row += 1
    assert row == table.triggers
    return seen


@settings(max_examples=40)
@given(st.data())
def test_every_query_is_what_the_search_found_and_has_its_price(make_set, data):
    clips = make_set(data.draw(st.integers(0, 10**6)), frames=(3, 12), genres=True)
    hops = data.draw(st.sampled_from([1, 2]))
    config = SearchConfig(
        blend=2, max_stay=data.draw(st.integers(0, 3)), weight=0.01, hops=hops, genre_cost=0.01,
        regime=data.draw(st.sampled_from(["start", "fixed"])),
        blends=data.draw(st.sampled_from([None, (1, 2, 3)])) if hops == 1 else None,
    )  # fmt: skip
    pairs = [(0, 1), ("c2", "c0")] if config.regime == "start" else [(0, 1, 2), ("c2", "c0", -3)]
    check_table(build(clips, pairs, config, threads=1), clips, config)


@pytest.fixture(scope="module")
def saved(builtin_set, tmp_path_factory):
    config = SearchConfig(blend=12, max_stay=6, weight=1e-3, hops=2)
    table = build(builtin_set, [("walk", "stab"), ("stab", "idle")], config)
    path = tmp_path_factory.mktemp("table") / "walk.onehop"
    table.save(path)
    return table, path


def test_a_file_answers_as_the_table_that_wrote_it(builtin_set, saved):
    table, path = saved
    opened = LookupTable.open(path, builtin_set)
    assert isinstance(opened.entries, np.memmap) and opened.config == table.config
    for (source, destination), frame in [(("walk", "stab"), 7), (("stab", "idle"), 30), (("stab", "idle"), 102)]:
        expected = table.query(source, destination, frame)._replace(cost=None)
        assert opened.query(source, destination, frame) == expected
    assert check_table(table, builtin_set, table.config) > 100


def test_entries_of_the_papers_size_take_4_bytes_and_with_two_hops_6(make_clip):
    """24,000 frames and stays up to 60 are the paper's. The last frame of the last clip and the longest stays fit."""
    rng = np.random.default_rng(0)
    clips = ClipSet.from_clips([make_clip(rng, "short", 3), make_clip(rng, "long", 24_000)])
    for hops, expected in ((1, 4), (2, 6)):
        config = SearchConfig(weight=1e-3, hops=hops)
        row = {key: np.full(3, 60) for key in ("stay_source", "stay_hop", "stay_second")}
        row |= {key: np.full(3, value) for key, value in (("hop", 1), ("second_hop", hops - 2), ("cost", 1.0))}
        row |= {"hop_frame": np.full(3, 23_999), "second_frame": np.full(3, 23_998)}
        result = search.SearchResult(
            **row, lengths=np.full((3, hops + 1), 30), direct=np.ones(3), one_hop=np.ones(3), weight=1e-3
        )
        result.hop[1] = -1
        if hops == 2:
            result.second_hop[:] = [1, 1, -1]
            result.stay_second[2] = result.second_frame[2] = 0
        table = LookupTable.pack(clips, config, {(0, 0): 0}, result)
        assert table.bytes_per_trigger == expected
        found = [table.query(0, 0, t) for t in range(3)]
        assert (found[0].hop, found[0].hop_frame, found[0].stay_source, found[0].stay_hop) == (1, 23_999, 60, 60)
        assert [f.feasible for f in found] == [True, False, True]
        assert [f.hops for f in found] == [hops, 0, 1]
        if hops == 2:
            assert (found[0].second_hop, found[0].blends[1].frame, found[0].stay_second) == (1, 23_998, 60)


def test_a_trigger_without_candidate_is_marked_and_falls_back_to_direct(builtin_set, saved):
    table, _ = saved
    last = builtin_set.frames(builtin_set.index("stab")) - 1
    found = table.query("stab", "idle", last)
    assert not found.feasible and found.hops == 0 and found.cost is None
    assert found.blends == found.direct
    assert (found.direct[0].time, found.direct[0].frame, found.direct[0].length) == (0, 0, 12)


def test_a_looping_source_answers_for_any_cycle(builtin_set, saved):
    table, _ = saved
    period = builtin_set.period(builtin_set.index("walk"))
    near, far = table.query("walk", "stab", 5), table.query("walk", "stab", 5 + 3 * period)
    assert near.blends == far.blends


def test_bad_queries_are_clear(builtin_set, saved):
    table, _ = saved
    with pytest.raises(InputError, match="stab -> walk"):
        table.query("stab", "walk", 0)
    with pytest.raises(InputError, match="nowhere"):
        table.query("nowhere", "walk", 0)
    with pytest.raises(IndexError, match="stab"):
        table.query("stab", "idle", 103)


def test_other_clips_foreign_and_damaged_files_are_one_clear_line(builtin_set, saved, tmp_path):
    _, path = saved
    data = path.read_bytes()
    other = ClipSet.from_clips([replace(clip, looping=False) for clip in builtin_set.clips], fps=60)
    slower = ClipSet.from_clips(builtin_set.clips, fps=30)
    fewer = ClipSet.from_clips(builtin_set.clips[:3], fps=60)
    for clips, message in ((other, "another clip"), (slower, "fps"), (fewer, "clips")):
        with pytest.raises(InputError, match=message):
            LookupTable.open(path, clips)
    version = bytearray(data)
    version[12] += 1
    bad = {
        "foreign": (b"PNG" + data, "not a one-hop table"), "empty": (b"", "not a one-hop table"),
        "short": (data[:-1], "bytes"), "long": (data + b"x", "bytes"), "header": (data[:40], "header"),
        "version": (bytes(version), "version"), "text": (data[:20] + b"\xff\xff" + data[22:], "header"),
    }  # fmt: skip
    for name, (content, message) in bad.items():
        file = tmp_path / name
        file.write_bytes(content)
        with pytest.raises(InputError, match=message) as error:
            LookupTable.open(file, builtin_set)
        assert "\n" not in str(error.value) and str(file) in str(error.value)
    with pytest.raises(InputError, match="cannot be read"):
        LookupTable.open(tmp_path / "missing", builtin_set)


def test_costs_are_the_arrays_of_the_result(builtin_set):
    config = SearchConfig(blend=12, max_stay=2, weight=1e-3)
    kinds = search.costs(builtin_set, [(0, 1), (3, 4)], config)
    result = search.solve(builtin_set, [(0, 1), (3, 4)], config)
    assert set(kinds) == {"direct", "one_hop"}
    assert np.array_equal(np.concatenate(list(kinds["one_hop"].values())), result.cost)
    assert [len(values) for values in kinds["direct"].values()] == [builtin_set.period(0), builtin_set.period(3)]
