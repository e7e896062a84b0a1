"""The runtime player: what D scored is what is played, and nothing jumps, whatever is triggered when.

The tables hold arbitrary feasible transitions, not optimal ones: the player must play any table.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from motion import builtin, rotations, skeleton
from motion.clip import Clip
from motion.errors import InputError
from motion.onehop.alignment import align
from motion.onehop.clips import ClipSet
from motion.onehop.player import Player, measure_step
from motion.onehop.search import SearchResult
from motion.onehop.table import LookupTable
from motion.onehop.types import SearchConfig

FPS, BLEND, MAX_STAY = 30, 7, 12


def curve(name="curve", turn=0.6):
    """A looping clip that walks in a curve: `turn` rad a cycle."""
    walk = builtin.load("walk")
    yaw = turn * np.arange(walk.frames) / (walk.frames - 1)
    qpos = np.array(walk.qpos)
    qpos[:, :3] = rotations.rotate(rotations.about_z(yaw), qpos[:, :3] + [0.3, -2.0, 0])
    qpos[:, 3:7] = rotations.multiply(rotations.about_z(yaw), qpos[:, 3:7])
    return Clip.from_poses(name, qpos, walk.fps, looping=True)


@pytest.fixture(scope="module")
def clips():
    return ClipSet.from_clips([*map(builtin.load, ("idle", "run", "stab", "dodge_back")), curve()], FPS)


def random_table(clips, seed, config=None, pairs=None, infeasible=0.1):
    """A table of random feasible transitions, a share of the triggers without candidate."""
    config = config or SearchConfig(blend=BLEND, max_stay=MAX_STAY)
    generator, rows = np.random.default_rng(seed), []
    if pairs is None:
        pairs = {(s, d): int(generator.integers(-20, 20)) for s in range(len(clips)) for d in range(len(clips))}
    for (source, destination), offset in pairs.items():
        for t in range(clips.period(source)):
            start = 0 if config.regime == "start" else t - offset
            found = random_transition(clips, generator, config, source, t, destination, start)
            rows.append(found if found is not None and generator.random() >= infeasible else [-1] + [0] * 6)
    columns = np.array(rows).T
    columns[4][columns[0] < 0] = -1
    lengths = np.full((len(rows), config.hops + 1), config.blend)
    cost = np.where(columns[0] < 0, np.inf, 1.0)
    names = ("hop", "hop_frame", "stay_source", "stay_hop", "second_hop", "second_frame", "stay_second")
    result = SearchResult(
        cost=cost, direct=cost, one_hop=cost, lengths=lengths, weight=0.0, **dict(zip(names, columns))
    )  # fmt: skip
    return LookupTable.pack(clips, config, pairs, result)


def random_transition(clips, generator, config, source, t, destination, start):
    """(hop, u, s_s, s_h, second hop, v, s_2) that fits into the clips, or None if these numbers do not."""
    b = config.blend
    stays = generator.integers(0, config.max_stay + 1, size=3)
    hops = generator.integers(0, len(clips), size=2)
    two = config.hops == 2 and generator.random() < 0.6
    time = stays[0] + b + stays[1] + (b + stays[2] if two else 0)
    frames = [generator.integers(0, clips.period(hop)) for hop in hops]
    needed = [(source, t + stays[0], b), (hops[0], frames[0], 2 * b + stays[1]), (destination, start + time, b)]
    needed += [(hops[1], frames[1], 2 * b + stays[2])] if two else []
    for clip, first, count in needed:
        if not clips.looping(clip) and not 0 <= first <= clips.frames(clip) - count:
            return None
    return [hops[0], frames[0], *stays[:2], *((hops[1], frames[1], stays[2]) if two else (-1, 0, 0))]


def record(player, steps):
    """[(lanes, pose)] of `steps` steps."""
    return [(player.lanes(), player.step()) for _ in range(steps)]


def points(poses):
    return skeleton.forward_kinematics(np.array(poses))[0]


def feasible(table, generator, source=None):
    """A random (source, destination, frame, Transition) of the table that is feasible."""
    pairs = [pair for pair in table.pairs if source in (None, pair[0])]
    while True:
        s, d = pairs[generator.integers(len(pairs))]
        t = int(generator.integers(table.clips.period(s)))
        if (found := table.query(s, d, t)).feasible:
            return s, d, t, found


CONFIGS = {
    "start": SearchConfig(blend=BLEND, max_stay=MAX_STAY),
    "fixed": SearchConfig(blend=BLEND, max_stay=MAX_STAY, regime="fixed"),
    "two hops": SearchConfig(blend=BLEND, max_stay=MAX_STAY, hops=2),
    "weights": SearchConfig(
        blend=BLEND, max_stay=MAX_STAY, point_weights=tuple(range(1, 18)), frame_weights=tuple(range(1, BLEND + 1))
    ),
}


@pytest.fixture(scope="module")
def tables(clips):
    return {name: random_table(clips, 3, config) for name, config in CONFIGS.items()}


# ------------------------------------------------------------------------------------------ what D scored is played


@pytest.mark.parametrize("name", CONFIGS)
@given(seed=st.integers(0, 2**32 - 1))
def test_mean_squared_distance_of_the_two_clips_as_played_is_the_distance_that_was_scored(clips, tables, name, seed):
    table, generator = tables[name], np.random.default_rng(seed)
    source, destination, frame, found = feasible(table, generator)
    player = Player(clips, table, source, frame, place=generator.normal(size=3) * [1, 100, 100])
    assert player.trigger(destination) == found and player.notice == ""
    played = record(player, found.duration)

    config, before = table.config, (source, frame, 0)  # clip, its frame, at time
    weights = np.outer(config.frame_weights_of(BLEND), config.points)
    for k, blend in enumerate(found.blends):
        clip, at, time = before
        windows = [
            clips.window_points(clip, at + blend.time - time, BLEND),
            clips.window_points(blend.clip, blend.frame, BLEND),
        ]
        lanes = [lanes for lanes, _ in played[blend.time : blend.time + BLEND]]
        assert all(len(pair) == 2 and [lane.leg for lane in pair] == [k, k + 1] for pair in lanes)
        a, b = (points([pair[lane].pose for pair in lanes]) for lane in (0, 1))
        as_played = np.sum(weights * np.sum((a - b) ** 2, axis=-1))
        assert as_played == pytest.approx(align(*windows, weights)[0], rel=1e-9, abs=1e-9)
        before = (blend.clip, blend.frame, blend.time)
    assert player.arrived and player.clip == clips.names[destination]


@pytest.mark.parametrize("name", CONFIGS)
@given(seed=st.integers(0, 2**32 - 1))
def test_every_clip_shows_the_frames_that_the_definition_names(clips, tables, name, seed):
    table = tables[name]
    source, destination, t, found = feasible(table, np.random.default_rng(seed))
    player = Player(clips, table, source, t)
    player.trigger(destination)
    played = record(player, found.duration + 1)
    first, second = found.blends[0], found.blends[1]
    # onehop.md: times of the first blend, and what each clip shows at time tau
    assert first.time == found.stay_source and second.time == found.stay_source + BLEND + found.stay_hop
    for tau, (lanes, _) in enumerate(played):
        shown = {lane.leg: (lane.clip, lane.frame) for lane in lanes}
        last = max(shown)
        assert (0 in shown) == (tau < found.stay_source + BLEND)
        assert (1 in shown) == (first.time <= tau < second.time + BLEND)
        if 0 in shown:
            assert shown[0] == (source, clips.wrap(source, t + tau))
        if 1 in shown:
            assert shown[1] == (found.hop, clips.wrap(found.hop, t + tau - found.offset))
        if last == len(found.blends):
            frame = clips.wrap(destination, t + tau - found.destination_offset)
            if not clips.clips[destination].looping:  # one frame past the arrival may be past the clip's end: it holds
                frame = min(frame, clips.clips[destination].frames - 1)
            assert shown[last] == (destination, frame)
        assert (len(lanes) == 2) == any(b.time <= tau < b.time + BLEND for b in found.blends)
    assert played[-1][0][0].leg == len(found.blends)


def test_a_clip_alone_is_the_clip_moved_rigidly_about_the_vertical(clips, tables):
    table = tables["start"]
    source, destination, t, found = feasible(table, np.random.default_rng(5))
    player = Player(clips, table, source, t)
    player.trigger(destination)
    alone = [(lanes[0], pose) for lanes, pose in record(player, found.duration + 20) if len(lanes) == 1]
    assert {lane.leg for lane, _ in alone} >= {2}
    for lane, pose in alone:
        original = clips.clips[lane.clip].qpos[lane.frame]
        np.testing.assert_array_equal(pose[7:], original[7:])
        assert pose[2] == original[2]
        tilt = [rotations.rotate(rotations.conjugate(q[3:7]), np.array([0.0, 0, 1])) for q in (pose, original)]
        np.testing.assert_allclose(*tilt, atol=1e-12)


# ------------------------------------------------------------------------------------------------------- continuity


def largest_steps(clips):
    """Largest move of the root between frames (m) and largest turn (rad), over all clips, seams included."""
    poses = [
        np.array([clips.root_pose(i, f) for f in range(clips.frames(i) + clips.looping(i))]) for i in range(len(clips))
    ]
    return (
        max(np.linalg.norm(np.diff(q[:, :3], axis=0), axis=1).max() for q in poses),
        max(rotations.angle_between(q[1:, 3:7], q[:-1, 3:7]).max() for q in poses),
    )


@given(
    seed=st.integers(0, 200),
    triggers=st.lists(st.tuples(st.integers(0, 30), st.integers(0, 4)), min_size=1, max_size=12),
    hops=st.sampled_from([1, 2]),
    regime=st.sampled_from(["start", "fixed"]),
)
def test_the_root_never_moves_faster_than_the_clips_do_whatever_is_triggered(clips, seed, triggers, hops, regime):
    config = SearchConfig(blend=BLEND, max_stay=MAX_STAY, hops=hops, regime=regime)
    pairs = {(s, d): (7 * s - 3 * d) % 11 for s in range(5) for d in range(5) if (s + 2 * d) % 5}  # not all pairs
    player = Player(clips, random_table(clips, seed, config, pairs), "idle")
    shift, turn = largest_steps(clips)
    rows = [(player.lanes(), player.step())]
    for wait, destination in [*triggers, (100, 0)]:
        rows += record(player, wait)
        player.trigger(destination)
    poses = np.array([pose for _, pose in rows])
    assert np.isfinite(poses).all()
    ends = np.array([[lanes[0].pose, lanes[-1].pose] for lanes, _ in rows])
    share = np.array([lanes[1].share if len(lanes) == 2 else 0.0 for lanes, _ in rows])
    # a crossfade adds only what it crosses, in this frame, of the distance between both clips; none where one is alone
    crossed = np.where(share[1:] > 0, share[1:] - np.where(share[:-1] < 1, share[:-1], 0), 0)
    gap = np.linalg.norm(ends[:, 0, :3] - ends[:, 1, :3], axis=-1)[1:]
    moved = np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=-1)
    assert (moved <= shift + crossed * gap + 1e-9).all()
    gap = rotations.angle_between(ends[:, 0, 3:7], ends[:, 1, 3:7])[1:]
    turned = rotations.angle_between(poses[1:, 3:7], poses[:-1, 3:7])
    assert (turned <= 1.3 * turn + crossed * gap + 1e-9).all()  # slerp between moving ends: up to a little faster


@pytest.mark.parametrize("name", ["run", "curve", "idle"])
def test_a_looping_clip_goes_on_rigidly_over_its_seam(clips, tables, name):
    player = Player(clips, tables["start"], name, 3)
    index = clips.index(name)
    expected = [clips.root_pose(index, frame) for frame in range(3, 3 + 4 * clips.period(index))]
    np.testing.assert_allclose(points([player.step() for _ in expected]), points(expected), atol=1e-9)


def test_a_clip_that_does_not_loop_holds_its_last_pose(clips, tables):
    last = clips.frames(2) - 1
    player = Player(clips, tables["start"], "stab", last - 2)
    poses = [player.step() for _ in range(6)]
    for pose in poses[2:]:
        np.testing.assert_allclose(pose, clips.clips[2].qpos[last], atol=1e-12)
    assert player.frame == last


@given(seed=st.integers(0, 2**32 - 1))
def test_where_the_character_stands_changes_nothing_but_the_place(clips, tables, seed):
    generator = np.random.default_rng(seed)
    source, destination, t, found = feasible(tables["start"], generator)
    place = generator.uniform(-1, 1, 3) * [np.pi, 300, 300]
    players = [Player(clips, tables["start"], source, t, where) for where in ((0, 0, 0), place)]
    for player in players:
        player.trigger(destination)
    here, there = (points([player.step() for _ in range(found.duration + 3)]) for player in players)
    moved = rotations.rotate(rotations.about_z(place[0]), here) + [*place[1:], 0]
    np.testing.assert_allclose(there, moved, atol=1e-9)


# --------------------------------------------------------------------------------------------------- chained triggers


def stepped_until(player, condition, limit=500):
    for _ in range(limit):
        if condition(player):
            return
        player.step()
    raise AssertionError("never happened")


def staying(clips, table, hop_stay, seed=0):
    """A player with a triggered transition whose source stay is >= 4 and hop stay >= `hop_stay`, no self-transition."""
    generator = np.random.default_rng(seed)
    while True:
        source, destination, t, found = feasible(table, generator)
        if found.stay_source >= 4 and found.stay_hop >= hop_stay and destination != source:
            player = Player(clips, table, source, t)
            player.trigger(destination)
            return player, found


def test_a_trigger_in_the_sources_stay_is_planned_anew_from_the_frame_that_is_played(clips):
    table = random_table(clips, 1, infeasible=0)
    player, found = staying(clips, table, 0)
    player.step(), player.step()
    assert player.frame == clips.wrap(found.source, found.frame + 2)
    other = next(
        d for d in range(5) if d != found.destination and table.query(found.source, d, player.frame).feasible
    )  # fmt: skip
    expected = table.query(found.source, other, player.frame)
    assert player.trigger(other) == expected and player.notice == ""
    assert player.destination == clips.names[other]
    stepped_until(player, lambda p: p.arrived)
    assert player.clip == clips.names[other]


def test_a_trigger_in_a_blend_waits_for_its_end_and_the_last_one_counts(clips):
    table = random_table(clips, 1, infeasible=0)
    player, found = staying(clips, table, 4)
    stepped_until(player, lambda p: p.blending)
    hop = found.hop
    after = clips.wrap(hop, found.hop_frame + BLEND)
    other = next(d for d in range(5) if d != found.destination and table.query(hop, d, after).feasible)
    first = next(d for d in range(5) if d not in (other, found.destination))
    assert player.trigger(first) is None and "waits" in player.notice
    assert player.trigger(other) is None and player.waiting == clips.names[other]
    stepped_until(player, lambda p: not p.blending)
    assert player.clip == clips.names[hop] and player.frame == after
    player.step()
    assert player.waiting is None and player.notice == "" and player.destination == clips.names[other]
    assert player.playing[0][:2] == (hop, after)
    assert player.playing[0].stay == table.query(hop, other, after).stay_source


def test_a_trigger_in_a_hop_that_has_no_entry_waits_until_the_destination_is_reached(clips):
    full = random_table(clips, 1, infeasible=0)
    _, found = staying(clips, full, 4)
    pairs = {(found.source, found.destination): 0}
    table = LookupTable.pack(clips, full.config, pairs, sliced(full, pairs))
    player = Player(clips, table, found.source, found.frame)
    assert player.trigger(found.destination).feasible
    stepped_until(player, lambda p: not p.blending and p.clip == clips.names[found.hop] and p.playing[0].stay >= 0)
    stepped_until(player, lambda p: p.blending)
    other = next(d for d in range(5) if d not in (found.destination, found.source))
    player.trigger(other)
    stepped_until(player, lambda p: p.waiting is None or p.arrived)
    assert player.clip == clips.names[found.destination]
    player.step()
    assert "played directly" in player.notice and player.destination == clips.names[other]


def sliced(table, pairs):
    """The rows of `pairs` of a table's SearchResult."""
    rows = np.concatenate([table.first[p] + np.arange(table.clips.period(p[0])) for p in pairs])
    fields = {name: value if name == "weight" else value[rows] for name, value in vars(table.result).items()}
    return SearchResult(**fields)


def test_in_the_fixed_regime_a_trigger_in_a_hop_waits_until_the_destination_is_reached(clips):
    config = SearchConfig(blend=BLEND, max_stay=MAX_STAY, regime="fixed")
    table = random_table(clips, 2, config, infeasible=0)
    player, found = staying(clips, table, 4)
    stepped_until(player, lambda p: p.blending)
    stepped_until(player, lambda p: not p.blending)
    other = next(d for d in range(5) if d != found.destination)
    assert player.trigger(other) is None and player.destination in player.notice
    stepped_until(player, lambda p: p.waiting is None)
    assert player.playing[0].clip == found.destination


def test_the_trigger_of_the_destination_under_way_changes_nothing(clips, tables):
    _, found = staying(clips, tables["start"], 0)
    players = [staying(clips, tables["start"], 0)[0] for _ in range(2)]
    for k in range(found.duration + 5):
        if k < found.duration:
            assert players[1].trigger(found.destination) is None and "under way" in players[1].notice
        np.testing.assert_array_equal(players[0].step(), players[1].step())


# ---------------------------------------------------------------------------------------------- fallbacks, bad input


def test_a_trigger_without_candidate_is_played_directly_and_says_so(clips):
    table = random_table(clips, 1, infeasible=1.0)
    player = Player(clips, table, "run", 4)
    found = player.trigger("stab")
    assert not found.feasible and "run, frame 4, to stab" in player.notice and "directly" in player.notice
    played = record(player, BLEND + 1)
    assert [[(lane.clip, lane.frame) for lane in lanes] for lanes, _ in played[:2]] == [
        [(1, 4), (2, 0)], [(1, 5), (2, 1)]
    ]  # fmt: skip
    assert player.arrived and player.clip == "stab"


def test_a_direct_transition_from_the_end_of_a_clip_blends_out_of_its_last_pose(clips):
    table = random_table(clips, 1, infeasible=1.0)
    last = clips.frames(2) - 1
    player = Player(clips, table, "stab", last)
    player.trigger("idle")
    held = clips.window_points(2, last, 1).repeat(BLEND, axis=0)
    lanes = [lanes for lanes, _ in record(player, BLEND)]
    a, b = (points([pair[lane].pose for pair in lanes]) for lane in (0, 1))
    distance = align(held, clips.window_points(0, 0, BLEND))[0]
    assert np.mean(np.sum((a - b) ** 2, axis=-1)) == pytest.approx(distance, rel=1e-9, abs=1e-9)


def test_unknown_names_and_frames_are_one_clear_line(clips, tables):
    with pytest.raises(InputError, match="no clip is called 'fly'"):
        Player(clips, tables["start"], "fly")
    with pytest.raises(InputError, match="stab: has no frame 1000"):
        Player(clips, tables["start"], "stab", 1000)
    player = Player(clips, tables["start"], "idle")
    with pytest.raises(InputError, match="no clip is called 'fly'"):
        player.trigger("fly")


def test_a_step_is_measured_and_takes_well_under_a_frame(clips, tables):
    assert 0 < measure_step(clips, tables["start"], transitions=5) < 1e-3
