"""The report: its numbers are the tables' and what is played; its page stands alone."""

import re
from html.parser import HTMLParser

import numpy as np
import pytest

from motion import builtin, rotations, skeleton
from motion.onehop import figures, render
from motion.onehop.clips import ClipSet
from motion.onehop.report import STYLE, page
from motion.onehop.report_data import KINDS, distance_map, means, study
from motion.onehop.report_measures import JUMP_TIME, Played, foot_skate, foot_speed, play, root_added, root_jump
from motion.onehop.types import SearchConfig

FPS = 20


@pytest.fixture(scope="module")
def found():
    """The study of three clips, a pair that is too short to be left late among them."""
    clips = ClipSet.from_clips([builtin.load(name) for name in ("idle", "run", "stab")], FPS)
    return study(clips, "all", SearchConfig(blend=6, max_stay=6))


# ------------------------------------------------------------------------------------------------------- the numbers


def test_parts_of_a_played_transition_add_up_to_the_cost_that_the_search_found(found):
    assert len(found.triggers) > 20
    for case in found.triggers:
        source, destination = (found.clips.index(name) for name in (case.source, case.destination))
        for kind, table in found.tables.items():
            row = table.first[source, destination] + case.frame
            assert case.cost[kind] == pytest.approx(table.result.cost[row], rel=1e-6, abs=1e-9)
            assert case.cost["direct"] == pytest.approx(table.result.direct[row], rel=1e-6, abs=1e-9)
            played = case.played[kind]
            assert played.arrival <= table.query(source, destination, case.frame).duration / FPS + 1e-12
            # from the arrival on, what is shown is the destination, and not before
            alone = played.time >= played.arrival - 1e-9
            last = found.clips.clips[destination]
            frames = np.round(played.time * FPS).astype(int)
            frames = frames % (last.frames - 1) if last.looping else np.minimum(frames, last.frames - 1)
            same = np.abs(played.poses[:, 7:] - last.qpos[frames, 7:]).max(axis=1) < 1e-9
            assert same[alone].all() and not same[np.flatnonzero(alone)[0] - 2]


def test_summary_is_the_mean_over_the_triggers_that_can_be_compared(found):
    costs, better, charged = ({kind: [] for kind in KINDS} for _ in range(3))
    weight, table = found.weight, found.tables["one-hop"]
    for row in range(table.triggers):
        direct = table.result.direct[row]
        if not (np.isfinite(direct) and np.isfinite(table.result.cost[row])):
            continue
        one, two = table.result.cost[row], found.tables["two-hop"].result.cost[row]
        extra = 2 if found.tables["two-hop"].result.second_hop[row] >= 0 else 1
        for kind, cost, fee in (("direct", direct, 0), ("one-hop", one, 1), ("two-hop", two, extra)):
            costs[kind].append(cost)
            better[kind].append(cost < direct - 1e-12)
            options = {"direct": [direct], "one-hop": [direct, one + 6 * weight]}.get(kind)
            charged[kind].append(min(options or [direct, one + 6 * weight, two + fee * 6 * weight]))
    for kind in KINDS:
        assert found.summary[kind]["cost"] == pytest.approx(np.mean(costs[kind]))
        assert found.summary[kind]["charged"] == pytest.approx(np.mean(charged[kind]))
        assert found.summary[kind].get("better", 0) == pytest.approx(np.mean(better[kind]))
    assert found.summary["compared"] == len(costs["direct"])
    assert found.summary["one-hop"]["cost"] <= found.summary["direct"]["cost"]
    assert found.summary["two-hop"]["cost"] <= found.summary["one-hop"]["cost"] + 1e-12


def test_a_larger_weight_arrives_sooner_and_a_smaller_one_is_smoother(found):
    weighted = found.trade_off[:-1]
    times, smooth = [row[1] for row in weighted], [row[2] for row in weighted]
    assert times == sorted(times, reverse=True) and smooth == sorted(smooth)
    assert times[0] > times[-1]
    one = found.tables["one-hop"]
    assert means(one, found.weight, FPS)[0] == pytest.approx(found.summary["one-hop"]["time"])


def test_the_distance_map_is_zero_where_a_clip_meets_itself_and_symmetric(found):
    values, rows, columns = distance_map(found.clips, 1, 1, found.tables["one-hop"].config)
    np.testing.assert_array_equal(rows, columns)
    np.testing.assert_allclose(np.diag(values), 0, atol=1e-15)
    np.testing.assert_allclose(values, values.T, atol=1e-12)
    assert values.max() > 1e-3


# ------------------------------------------------------------------------------------------------------- the measures


def sliding(velocity, fps=50.0, frames=40):
    """A `Played` of one pose whose root moves with `velocity` (N, 2) m/s, both feet planted, all of it a blend."""
    pose = builtin.load("idle").qpos[0]
    poses = np.repeat(pose[None], frames, axis=0)
    poses[1:, :2] += np.cumsum(np.broadcast_to(velocity, (frames - 1, 2)), axis=0) / fps
    share, planted, gap = np.full((frames, 2), 0.5), np.ones((frames, 2), bool), np.zeros((frames, 3))
    return Played(poses, share, gap, planted, np.arange(frames) / fps, (), ("a", "b"), fps, 0.0)


def test_foot_skate_is_the_speed_and_the_length_of_a_slide():
    still, slide = sliding((0.0, 0.0)), sliding((0.3, -0.4))
    assert foot_skate(still) == pytest.approx((0, 0), abs=1e-9)
    speed, length = foot_skate(slide)
    assert speed == pytest.approx(0.5) and length == pytest.approx(2 * 0.5 * 39 / 50)  # both feet
    slide.planted[:, 0] = False
    assert foot_skate(slide)[1] == pytest.approx(0.5 * 39 / 50)
    assert np.isnan(foot_speed(slide)[:, 0]).all()
    slide.planted[:] = False
    assert foot_skate(slide) == (0, 0)


def test_root_jump_is_the_change_of_velocity():
    assert root_jump(sliding((1.0, 2.0))) == pytest.approx(0, abs=1e-9)
    velocity = np.zeros((39, 2))
    velocity[20:] = (0.6, 0.8)
    assert root_jump(sliding(velocity)) == pytest.approx(1.0)
    ramp = np.zeros((39, 2))
    ramp[:, 0] = np.arange(39) / 50 * 3.0  # 3 m/s^2
    assert root_jump(sliding(ramp)) == pytest.approx(3.0 * JUMP_TIME)


def test_what_a_crossfade_adds_to_the_roots_velocity_is_what_comes_from_neither_clip():
    """Two clips whose roots move with (1, 0) and (0, 2) m/s, 0.2 m apart in height, crossed at 5 % a frame."""
    played = sliding((0.0, 0.0))
    share = np.clip(0.05 * np.arange(40)[:, None], 0, 1)
    time = played.time[:, None]
    a, b = np.hstack([time, 0 * time, 0 * time]), np.hstack([0 * time, 2 * time, 0 * time + 0.2])
    played.share[:], played.gap[:], played.poses[:, :3] = (
        np.hstack([1 - share, share]),
        b - a,
        (1 - share) * a + share * b,
    )
    velocity = np.diff(played.poses[:, :3], axis=0) * played.fps
    own = (1 - share[:-1]) * [1, 0, 0] + share[:-1] * [0, 2, 0]  # the mix of the clips' own velocities
    assert root_added(played) == pytest.approx(np.linalg.norm(velocity - own, axis=1).max())
    assert root_added(sliding((1.0, 2.0))) == 0


def test_a_played_transition_is_shown_from_before_the_trigger_until_after_the_arrival(found):
    case = found.triggers[len(found.triggers) // 2]
    played = play(found.clips, found.tables["one-hop"], case.source, case.frame, case.destination)
    np.testing.assert_allclose(played.share.sum(axis=1), 1)
    assert played.time[0] <= 0 < played.arrival < played.time[-1]
    assert played.share[played.time < 0, 0].all() and played.share[-1, -1] == 1
    assert played.names[0] == case.source and played.names[-1] == case.destination


def test_stick_figures_join_the_skeletons_bodies_and_carry_sword_and_shield():
    pose = builtin.load("stab").qpos[40]
    position, rotation = skeleton.forward_kinematics(pose)
    parts, head = render.strokes(pose)
    assert set(parts) == set(render.PARTS)
    for side in ("right", "left"):
        drawn = np.concatenate(parts[side])
        for name in ("thigh", "shin", "foot", "upper_arm", "lower_arm", "hand"):
            at = position[skeleton.BODY_INDEX[f"{side}_{name}"]]
            assert np.linalg.norm(drawn - at, axis=1).min() < 1e-12
    tip = parts["sword"][0][-1] - parts["sword"][0][0]
    forward = rotations.rotate(rotation[skeleton.BODY_INDEX["right_hand"]], np.array([1.0, 0, 0]))
    np.testing.assert_allclose(tip / np.linalg.norm(tip), forward, atol=1e-12)
    assert head[2] > position[:, 2].max() - 0.6
    flat = render.flat_strokes([pose, pose], render.projector(-90, 0), [np.zeros(2), np.array([2.0, 0])])
    half = (len(flat["trunk"])) // 2
    np.testing.assert_allclose(flat["trunk"][half:] - [2, 0], flat["trunk"][:half], atol=1e-12)
    # seen from its right (azimuth -90 degrees), x points right and z up
    np.testing.assert_allclose(render.projector(-90, 0)([[1.0, 5.0, 2.0]]), [[1, 2]], atol=1e-12)


# ----------------------------------------------------------------------------------------------------------- the page

VOID = {"meta", "link", "br", "img", "hr", "input"}


class Checker(HTMLParser):
    """Collects ids and references, and fails where tags do not match."""

    def __init__(self):
        super().__init__()
        self.open, self.ids, self.references, self.count = [], [], [], {}

    def handle_starttag(self, tag, attributes):
        self.handle_startendtag(tag, attributes)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.count[tag] = self.count.get(tag, 0) + 1
        for key, value in attributes:
            if key == "id":
                self.ids.append(value)
            if key in ("src", "href", "xlink:href", "action", "data"):
                self.references.append(value)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


@pytest.fixture(scope="module")
def text(found):
    return page(found, "a <b> & c")


def test_the_page_is_one_well_formed_file_without_anything_from_outside(text):
    checker = Checker()
    checker.feed(text)
    checker.close()
    assert not checker.open
    assert len(checker.ids) == len(set(checker.ids))
    assert checker.references and all(value.startswith(("#", "data:")) for value in checker.references)
    assert {value[1:] for value in checker.references if value.startswith("#")} <= set(checker.ids)
    assert "script" not in checker.count and "@import" not in text
    assert not re.search(r"url\((?!#)", text)
    assert checker.count["svg"] >= 9
    assert "a &lt;b&gt; &amp; c" in text and "<b>" not in text


def test_every_colour_of_the_page_has_a_light_and_a_dark_value(text):
    light, dark = STYLE.split("@media (prefers-color-scheme: dark)")
    used = set(re.findall(r"var\(--([\w-]+)\)", text)) - {"width"}
    for theme in (light, dark):
        assert used <= set(re.findall(r"--(\w+): #", theme))
    # placeholders are all replaced, and nothing is drawn in a colour that only suits one theme
    assert "#0102" not in text
    drawn = set(re.findall(r"(?:fill|stroke): (#\w+)", text))
    assert drawn <= {"#ffffff", "#000000"} and len(used) > 8


def test_a_picture_is_the_same_every_time(found):
    played = found.triggers[0].played["direct"]
    for draw in (lambda: figures.film_strip("strip", [("x", played)], 0.3), lambda: figures.speeds("s", {"direct": (
        played.time[1:], foot_speed(played))})):  # fmt: skip
        assert draw() == draw()
