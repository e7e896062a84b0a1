"""Films: what they show, in which order, and that drawing never takes its caller down."""

import io
import math

import numpy as np
import pytest
from PIL import Image

from motion.baselines import METHODS, make_scene
from orchestrator.curriculum import thresholds
from orchestrator.evaluation import replay
from orchestrator.report import choice, films, render, sticks, takes
from orchestrator.report.phases import SOURCE, TARGET, TRANSITION
from orchestrator.tasks import TaskGrid
from workers.types import FELL, REACHED


@pytest.fixture(scope="module")
def scene(machine):
    return make_scene(machine.states, (2, 1.2, 1, 0.7))  # stab to run


@pytest.fixture(scope="module")
def take(machine, scene):
    return takes.of_method(scene, METHODS["interpolation"](machine.states, (2, 1.2, 1, 0.7)))


# ------------------------------------------------------------------------------------------------------------ the takes


def test_a_take_runs_through_its_seams_as_the_clips_do(machine, scene, take):
    """Source clip up to the moment, the transition, the target clip: no pose twice, none left out, heading +x at 0."""
    begin = int(np.argmax(take.time >= 0))
    assert take.phase.tolist() == sorted(take.phase) and set(take.phase) == {SOURCE, TRANSITION, TARGET}
    assert take.phase[begin] == TRANSITION and take.phase[begin - 1] == SOURCE
    np.testing.assert_allclose(take.qpos[begin, :2], 0, atol=1e-12)
    np.testing.assert_allclose(2 * np.arctan2(take.qpos[begin, 6], take.qpos[begin, 3]), 0, atol=0.5)
    joints = machine.states[2].clip.sample(1.2 + take.time[: begin + 1])[0][:, 7:]
    np.testing.assert_allclose(take.qpos[: begin + 1, 7:], joints, atol=1e-9)
    after = take.phase == TARGET
    played = take.time[after]  # a method's last pose is the target clip's after as long as it took
    joints = scene.target_poses(played)[:, 7:]
    np.testing.assert_allclose(take.qpos[after, 7:], joints, atol=1e-9)
    speed = np.linalg.norm(np.diff(take.qpos[:, :2], axis=0), axis=1) * takes.FPS
    assert speed.max() < 8  # m/s: nobody is carried across a seam


def test_a_policys_take_ends_with_its_fall_and_goes_on_after_an_arrival(make_config, library, make_policy, machine):
    config = make_config()
    task = np.array([0, 1.0, 2, 0.3])
    limits = thresholds(config.curriculum, config.reach, 0)
    motion = replay.record(config, library, make_policy(seed=3), task, limits, -math.inf)
    scene = make_scene(machine.states, task)
    for end, body, word in ((REACHED, -1, "reached"), (FELL, 14, "fell on left thigh"), (FELL, -1, "exploded")):
        changed = replay.Motion(**{**vars(motion), "end": end, "fell_on": body})
        made = takes.of_policy(scene, changed)
        assert made.end == word
        assert (TARGET in made.phase) == (end == REACHED)
        assert made.duration == pytest.approx((len(motion.qpos) - 1) / takes.FPS)
        inside = made.qpos[made.phase == TRANSITION]
        np.testing.assert_allclose(inside[:, 7:], motion.qpos[:, 7:])
        if end == REACHED:  # the target pose is where the environment has put it
            turn = takes.turned(motion.target_qpos, 0.0)
            np.testing.assert_allclose(made.target[2], turn[2], atol=1e-9)
            np.testing.assert_allclose(
                np.linalg.norm(made.target[:2] - inside[0, :2]),
                np.linalg.norm(motion.target_qpos[:2] - motion.qpos[0, :2]), atol=1e-9,
            )  # fmt: skip


# ----------------------------------------------------------------------------------------------------------- the choice


def test_candidates_are_tasks_of_the_grid_under_their_own_numbers(library, make_config):
    grid = TaskGrid(library, make_config({"evaluation.max_tasks": 50}).evaluation)
    numbers, tasks = choice.candidates(grid, 20)
    assert len(set(numbers.tolist())) == 20 and set(numbers.tolist()) <= set(grid.numbers(0, 50).tolist())
    np.testing.assert_array_equal(tasks, grid.tasks(numbers))
    again, _ = choice.candidates(grid, 20)
    np.testing.assert_array_equal(numbers, again)
    assert len(choice.candidates(grid, 500)[0]) == 50


def test_films_show_different_clips_before_they_show_the_same_again():
    tasks = np.array([[0, 0, 1, 0], [0, 0, 1, 0], [0, 0, 2, 0], [2, 0, 0, 0], [1, 0, 2, 0]], dtype=float)
    assert choice.different([0, 1, 2, 3, 4], tasks, 3) == [0, 3, 4]
    assert sorted(choice.different([0, 1, 2, 3, 4], tasks, 9)) == [0, 1, 2, 3, 4]
    assert choice.different([], tasks, 2) == []


def test_good_transitions_are_reached_and_bad_ones_are_not(policy, make_config, tmp_path):
    config = make_config()
    found = choice.choose(config, tmp_path, 2, 2)
    assert 0 < found.reached < found.tried == choice.CANDIDATES  # a random policy reaches some at the first thresholds
    assert all(shown.ours.end == "reached" for shown in found.good) and len(found.good) == 2
    assert all(shown.ours.end != "reached" for shown in found.bad) and len(found.bad) == 2
    assert max(shown.deviation for shown in found.good) < found.limits.key_bodies


# ----------------------------------------------------------------------------------------------------------- the strips


def test_figures_of_strips_below_each_other_are_of_the_same_times(take, machine, scene):
    other = takes.of_method(scene, METHODS["crossfade"](machine.states, (2, 1.2, 1, 0.7)))
    rows = films.frames_of_strips([take, other])
    for one, at in zip((take, other), rows):
        assert len(at) <= films.MOST and (np.diff(at) == at[1] - at[0]).all()
        assert 0.0 in one.time[at]  # where the transition begins
    np.testing.assert_allclose(take.time[rows[0]], other.time[rows[1]])


def test_takes_side_by_side_begin_together(take):
    late = takes.Take(take.qpos[5:], take.phase[5:], take.time[5:], take.target, "")
    film = films.video([take, late])
    first = [int(np.argmax(phase == TRANSITION)) for phase in film.phase]
    assert first[0] == first[1]


def test_a_strip_of_stick_figures_has_every_figure(take):
    (at,) = films.frames_of_strips([take])
    svg = sticks.strip("s", take, at)
    assert "var(--source)" in svg and "var(--transition)" in svg and "#0102" not in svg
    assert svg == sticks.strip("s", take, at)


# ---------------------------------------------------------------------------------------------------------- the drawing


def colours(picture):
    """Per column of a picture: how many pixels are orange, and how many blue."""
    red, _, blue = np.moveaxis(np.asarray(picture.convert("RGB")).astype(int), -1, 0)
    return ((red > blue + 90) & (red > 150)).sum(axis=0), ((blue > red + 60) & (blue > 120)).sum(axis=0)


def test_strips_and_videos_are_drawn_in_the_phases_colours(opengl, take):
    (at,) = films.frames_of_strips([take])
    few = at[:: len(at) // 4]
    short = takes.Take(take.qpos[10:15], take.phase[10:15], take.time[10:15], take.target, "")
    with films.Drawing({"strip": films.strip(take, few), "video": films.video([short])}) as drawing:
        drawn, why = drawing.wait()
    assert why is None and set(drawn) == {"strip", "video"}
    strip = Image.open(io.BytesIO(drawn["strip"]))
    assert strip.size == (len(few) * render.CELL[0], render.CELL[1])
    for i, frame in enumerate(few):  # a figure's legs stay in its own cell
        middle = strip.crop((int((i + 0.3) * render.CELL[0]), 0, int((i + 0.7) * render.CELL[0]), render.CELL[1]))
        orange, blue = (counts.sum() for counts in colours(middle))
        assert (orange > 100 and orange > 5 * blue) if take.phase[frame] == TRANSITION else (
            blue > 100 and blue > 5 * orange)  # fmt: skip
    video = Image.open(io.BytesIO(drawn["video"]))
    assert video.size == render.PANE and video.n_frames == len(short.time) and video.info["loop"] == 0
    shown = []
    for i in range(video.n_frames):
        video.seek(i)
        shown.append(colours(video)[0].sum() > 300)
    assert shown == (short.phase == TRANSITION).tolist()


def test_without_opengl_there_are_no_pictures_but_a_reason(take, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "nonsense")
    (at,) = films.frames_of_strips([take])
    with films.Drawing({"strip": films.strip(take, at[:2])}) as drawing:
        drawn, why = drawing.wait()
    assert drawn == {} and "nonsense" in why and "\n" not in why


def test_drawing_that_does_not_end_is_given_up(take, monkeypatch):
    monkeypatch.setattr(films, "TIMEOUT", 0.2)
    (at,) = films.frames_of_strips([take])
    with films.Drawing({"strip": films.strip(take, at[:2])}) as drawing:
        drawn, why = drawing.wait()
        assert drawn == {} and "within 0.2 s" in why
        assert all(process.poll() is not None for process, _ in drawing._processes)


def test_a_film_survives_its_file(tmp_path, take):
    film = films.strip(take, np.array([0, 3]))
    render.save(film, tmp_path / "x.npz")
    back = render.load(tmp_path / "x.npz")
    assert back.kind == film.kind and back.chosen.tolist() == [0, 3]
    np.testing.assert_array_equal(back.qpos[0], film.qpos[0])
    np.testing.assert_array_equal(back.phase[0], film.phase[0])
