"""The comparison: the contract of baselines.json, the same tasks for every method, one clear line for bad input."""

import json

import numpy as np
import pytest

from motion import baselines as kinematic
from motion.errors import InputError
from motion.state_machine import build_state_machine
from orchestrator import settings
from orchestrator.baselines import CHECKED, _clip_alone, _physics_rate, _run_of, _summary, compare, main
from orchestrator.transition_scores import CONTEXT, METRICS, score, shown
from workers.plausibility import Judge
from workers.types import Thresholds

NAMES = [*kinematic.METHODS, "clips"]


@pytest.fixture(scope="module")
def few(make_config):
    """A configuration whose grid has some tasks of three clips, 20 policy steps at most."""
    return make_config({"task.max_steps": 20, "evaluation.max_tasks": 40})


@pytest.fixture(scope="module")
def content(few, make_policy, tmp_path_factory):
    """(baselines.json's content of a policy that holds its target, the folder)."""
    folder = tmp_path_factory.mktemp("baselines")
    return compare(folder, few, make_policy(gain=0.0), Thresholds(0.3, 2.0, 0.6), 8), folder


def test_the_files_hold_what_is_returned(content):
    content, folder = content
    assert json.loads((folder / "baselines.json").read_text()) == content
    text = (folder / "baselines.md").read_text()
    for row in content["methods"]:
        assert f"| {row['label']} |" in text


def test_every_method_has_every_metric_of_the_same_tasks(content):
    content, _ = content
    assert [row["method"] for row in content["methods"]] == ["ours", *NAMES]
    assert content["tasks"] == 8 and content["fps"] == pytest.approx(30) and content["skipped"] == []
    ours = content["methods"][0]
    assert content["compared"] == round(ours["reached_share"] * 8) and 0 < content["compared"] < 8
    for row in content["methods"]:
        assert row["metrics"].keys() == row["metrics_all"].keys() == content["units"].keys() == METRICS.keys()
        assert content["descriptions"].keys() == METRICS.keys() and content["about"][row["method"]]
        for values in row["metrics"].values():
            assert values.keys() == {"mean", "median", "p95"}
            assert values["mean"] is None or values["median"] <= values["p95"] + 1e-12
        if row is not ours:
            assert row["reached_share"] is None
    durations = {row["method"]: row["duration"] for row in content["methods"]}
    assert durations["interpolation"] == pytest.approx(0.4) and durations["crossfade"] == pytest.approx(0.5)


def test_kinematic_methods_hand_over_exactly_and_the_simulation_is_more_plausible(content):
    content, _ = content
    rows = {row["method"]: row["metrics"] for row in content["methods"]}
    for name in kinematic.METHODS:
        assert rows[name]["handover"]["p95"] < 1e-9
    assert rows["ours"]["handover"]["mean"] > 0.01
    assert rows["ours"]["residual_force"]["mean"] < 0.5 * rows["interpolation"]["residual_force"]["mean"]
    check = content["differentiation"]
    assert 0 < check["tasks"] <= min(CHECKED, content["compared"])
    assert check["model"] < 1e-4 and check["physics_rate"] < 0.05 and check["frame_rate"] < 0.05


def test_without_a_reached_task_all_tasks_are_compared(few, make_policy, tmp_path):
    steps = []

    class Bar:
        def __init__(self, total):
            self.total = total

        def __enter__(self):
            return self

        def __exit__(self, *_):
            assert sum(steps) == self.total

        def advance(self, count):
            steps.append(count)

    content = compare(tmp_path, few, make_policy(), Thresholds(0.0, 0.0, 0.0), 2, Bar)
    assert content["compared"] == content["tasks"] == 2
    assert content["methods"][0]["reached_share"] == 0 and content["differentiation"] is None
    assert content["methods"][0]["metrics"]["handover"]["mean"] is None
    assert sum(steps) == 2 * 2 * (len(NAMES) + 1)


def test_a_method_that_cannot_run_is_left_out_with_its_reason(few, make_config, tmp_path):
    config = make_config({"evaluation.max_tasks": 40})
    config.motions.clips["stab"].start = 0.5
    try:
        content = compare(tmp_path, config, None, None, 2)
    finally:
        config.motions.clips["stab"].start = 0.0
    assert [row["method"] for row in content["methods"]] == [name for name in NAMES if name != "one_hop"]
    (skipped,) = content["skipped"]
    assert skipped["method"] == "one_hop" and "stab starts later" in skipped["reason"]
    assert "Left out: one_hop" in (tmp_path / "baselines.md").read_text()
    assert content["thresholds"] is None and content["differentiation"] is None


# ----------------------------------------------------------------------------------------------------------- scoring


def test_a_seam_counts_as_part_of_the_transition(machine):
    """A clip that goes on is smooth at the seam; one that starts a metre aside jumps by that metre."""
    judge, states = Judge(settings.Config().physics), machine.states
    scene = kinematic.make_scene(states, (0, 1.0, 0, 0.0))
    whole = _clip_alone(scene, 30)
    assert len(whole.before) == CONTEXT and len(whole.after) == 0 and whole.duration == pytest.approx(0.4)
    qpos = scene.target_poses(np.arange(5) / 30)
    aside = shown(scene, qpos + np.eye(47)[0], 30, 4 / 30)
    inside = shown(scene, qpos, 30, 4 / 30)
    near, far = score(inside, judge), score(aside, judge)
    assert far["handover"] == pytest.approx(1) and near["handover"] == pytest.approx(0, abs=1e-12)
    assert far["root_velocity_jump"] > 25 and far["root_velocity_jump_inside"] > 25
    # the jump back at the end is only in the whole one
    late = shown(scene, np.concatenate([scene.source_poses([0.0]), qpos[1:]]), 30, 10 / 30)
    scores = score(late, judge)
    assert scores["root_velocity_jump"] >= scores["root_velocity_jump_inside"]


def test_one_step_transitions_have_no_dynamics_and_no_number_is_made_up(machine):
    judge = Judge(settings.Config().physics)
    scene = kinematic.make_scene(machine.states, (2, 1.0, 0, 0.0))
    values = score(shown(scene, scene.source_poses([0.0, 1 / 30]), 30), judge)
    assert np.isnan(values["residual_force"]) and np.isnan(values["handover"])
    summary = _summary([values, {**values, "handover": 0.5}], np.array([True, True]))
    assert summary["residual_force"] == {"mean": None, "median": None, "p95": None}
    assert summary["handover"] == {"mean": 0.5, "median": 0.5, "p95": 0.5}
    assert _physics_rate(settings.Config().physics, judge, [], 30) is None


# ------------------------------------------------------------------------------------------------------ command line


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "gives no folder"),
        (["nowhere"], "nowhere: no such folder"),
        (["."], "holds no run"),
        (["a", "b"], "a and b are two folders; give one"),
        (["motions=nonsense", "out=x"], "motions=nonsense is not known"),
        (["motions=builtin", "out=file"], "file: cannot be made (File exists); give another folder"),
        (["motions=builtin", "out=x", "report.tasks=0"], "report.tasks: is 0; give at least 1"),
    ],
)
def test_bad_input_gives_one_clear_line(arguments, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(InputError) as caught:
        main(arguments)
    assert words in str(caught.value) and "\n" not in str(caught.value)
    assert not list(tmp_path.glob("**/baselines.json"))


def test_of_a_sweep_the_row_ours_is_compared(tmp_path):
    for name in ("no_sbc-seed0", "ours-seed0", "ours-seed1"):
        (tmp_path / name / "checkpoints").mkdir(parents=True)
        (tmp_path / name / "config.yaml").touch()
    assert _run_of(tmp_path).name == "ours-seed0"
    assert _run_of(tmp_path / "no_sbc-seed0").name == "no_sbc-seed0"


def test_the_clips_alone_need_no_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("orchestrator.baselines.METHODS", {"crossfade": kinematic.METHODS["crossfade"]})
    assert main(["motions=builtin", f"out={tmp_path / 'out'}", "report.tasks=2"]) == 0
    printed = capsys.readouterr().out
    assert "| Crossfade |" in printed and "written: " in printed and "comparing [" in printed
    written = json.loads((tmp_path / "out/baselines.json").read_text())
    assert [row["method"] for row in written["methods"]] == ["crossfade", "clips"]
    assert written["clips"] == [s.name for s in build_state_machine(settings.build([]).motions).states]
