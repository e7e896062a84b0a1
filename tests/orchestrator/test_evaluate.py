"""The command: what it evaluates, what it writes, what it says of wrong input."""

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from learner import checkpoint
from learner.checkpoint import SCHEMA
from motion.errors import InputError
from orchestrator import settings
from orchestrator.evaluate import evaluate_run, main
from orchestrator.evaluation.replay import load_policy, record
from orchestrator.evaluation.subject import clips_of, load_file
from orchestrator.policy_file import main as policy_file
from orchestrator.run import train
from orchestrator.tasks import TaskGrid
from workers.types import Thresholds

SCHEMAS = sorted((Path(__file__).parents[1] / "learner/checkpoints").iterdir())


@pytest.fixture(scope="module")
def config(make_config):
    return make_config({
        "budget.iterations": 2, "checkpoint.every": 1, "evaluation.max_tasks": 20, "task.max_steps": 10,
        "evaluation.robustness_resolution": 1.0,
    })  # fmt: skip


@pytest.fixture(scope="module")
def trained(config, tmp_path_factory):
    """A run's folder with two checkpoints."""
    folder = tmp_path_factory.mktemp("run")
    train(config, folder)
    settings.save(config, folder / "config.yaml")
    return folder


@pytest.fixture
def run(trained, tmp_path):
    """A copy of it."""
    shutil.copytree(trained, tmp_path / "run")
    return tmp_path / "run"


def test_a_runs_evaluation_is_written_beside_its_checkpoint(run, config):
    content = evaluate_run(run, config)
    assert json.loads((run / "evaluation.json").read_text()) == content
    assert (content["checkpoint"], content["iterations"], content["samples"]) == ("00000002.pt", 2, 128)
    assert content["tasks"] == 20 and content["tightenings"] == 0 and content["final_tightenings"] == 34
    assert not list(run.glob("*.tmp"))


def test_a_checkpoints_file_is_evaluated_beside_it_and_leaves_the_runs_own_alone(run, config, capsys):
    evaluate_run(run, config)
    before = (run / "evaluation.json").read_bytes()
    assert main([str(run / "checkpoints/00000001.pt")]) == 0
    first = json.loads((run / "checkpoints/00000001-evaluation/evaluation.json").read_text())
    assert (first["checkpoint"], first["samples"]) == ("00000001.pt", 64)
    # without its run's folder it has most of the configuration in it; --config gives all
    elsewhere = run.parent / "00000002.pt"
    shutil.copy(run / "checkpoints/00000002.pt", elsewhere)
    assert main([str(elsewhere), "--config", str(run / "config.yaml")]) == 0
    assert (run.parent / "00000002-evaluation/evaluation.json").read_bytes() == before
    assert main([str(elsewhere), "evaluation.max_tasks=3", "evaluation.robustness_resolution=1.0"]) == 0
    assert json.loads((run.parent / "00000002-evaluation/evaluation.json").read_text())["tasks"] == 3
    assert (run / "evaluation.json").read_bytes() == before
    assert "20 tasks of the grid's 41,223" in capsys.readouterr().out


def test_a_checkpoint_without_any_configuration_asks_for_one(tmp_path):
    shutil.copy(next(path for path in SCHEMAS if "schema1" in path.name), tmp_path / "old.pt")
    with pytest.raises(InputError, match="old.pt: no configuration, neither in it nor .*--config FILE"):
        main([str(tmp_path / "old.pt")])


def test_a_policy_file_evaluates_as_the_run_that_it_is_of_and_cannot_be_continued(run, config, tmp_path, capsys):
    assert policy_file([str(run), str(tmp_path / "mine.pt")]) == 0
    assert (tmp_path / "mine.pt").stat().st_size < (run / "checkpoints/00000002.pt").stat().st_size / 2
    assert main([str(run)]) == main([str(tmp_path / "mine.pt")]) == 0
    folders = run, tmp_path / "mine-evaluation"
    of_run, of_file = (json.loads((folder / "evaluation.json").read_text()) for folder in folders)
    del of_run["checkpoint"], of_file["checkpoint"]
    assert of_run == of_file
    other = tmp_path / "other/checkpoints"
    other.mkdir(parents=True)
    shutil.copy(tmp_path / "mine.pt", other / "00000002.pt")
    with pytest.raises(InputError, match="00000002.pt: holds a policy to use, not the state of a run"):
        train(config, other.parent)


def test_the_policy_that_comes_with_segue_reaches_what_its_training_reached(tmp_path, monkeypatch, capsys):
    """By name, from anywhere: at its own thresholds it reaches far more than one that does nothing."""
    monkeypatch.chdir(tmp_path)
    assert main(["builtin", "runtime=local", "evaluation.max_tasks=60", "evaluation.robustness_resolution=1.0"]) == 0
    content = json.loads((tmp_path / "runs/builtin-evaluation/evaluation.json").read_text())
    assert content["tightenings"] >= 5 and content["trained"]["TTAR"] > 0.7
    names = r"\(all, builtin, nine, quick, three\)"
    with pytest.raises(InputError, match=rf"buildin: no such folder, nor a policy .* {names}"):
        main(["buildin"])


def test_an_evaluation_may_be_made_again_with_other_settings(run, capsys):
    main([str(run)])
    main([str(run), "evaluation.max_tasks=5", "evaluation.log_sigma=-3"])
    content = json.loads((run / "evaluation.json").read_text())
    assert content["tasks"] == content["grid"]["max_tasks"] == 5 and content["log_sigma"] == -3.0
    out = capsys.readouterr().out
    assert "100%  5/5 tasks" in out and "exp(-3)" in out and "worst:" in out
    assert len(list((run / "evaluation").glob("*/"))) == 1


def test_a_failed_task_goes_the_same_way_again(run, config, library, capsys):
    main([str(run)])
    with open(run / "failures.csv", newline="") as file:
        line = next(line for line in csv.DictReader(file) if line["failed"] == "both")
    capsys.readouterr()
    assert main([str(run), "--replay", line["task"], "--save", str(run / "motion.npz")]) == 0
    printed = capsys.readouterr().out.splitlines()
    on = f" on {line['body']}" if line["body"] else ""
    assert printed[-2] == f"{line['end']}{on} after {line['steps']} steps"
    assert printed[0].startswith(f"task {line['task']}: {line['source']} at {float(line['moment']):.3f} s")
    policy, tightenings = load_policy(run, config)
    task = TaskGrid(library, config.evaluation).tasks([int(line["task"])])[0]
    motion = record(config, library, policy, task, Thresholds(0.3, 3.0, 1.0), -3.7, int(line["task"]))
    with np.load(run / "motion.npz") as saved:
        assert saved["fps"] == 30 and tightenings == 0
        for name, value in vars(motion).items():
            np.testing.assert_array_equal(saved[name], value)
    assert main([str(run), "--replay", line["task"], "--deterministic"]) == 0
    assert f"after {line['deterministic_steps']} steps" in capsys.readouterr().out
    assert main([str(run), "--replay", line["task"], "--final"]) == 0
    assert "thresholds 0.01 m, 0.09 m, 0.15 rad" in capsys.readouterr().out


@pytest.mark.parametrize(
    "arguments, words",
    [
        ([], "no run folder or checkpoint given"),
        (["runtime=local"], "no run folder or checkpoint given"),
        (["{run}/nothing"], "nothing: no such folder"),
        (["{run}/00000009.pt"], "00000009.pt: no such checkpoint"),
        (["{run}/checkpoints"], "checkpoints: no configuration there"),
        (["{run}", "--best"], "--best: no such option"),
        (["{run}", "--replay"], "--replay: needs a value"),
        (["{run}", "--save=x.npz"], "--save: goes with --replay N"),
        (["{run}", "--replay", "41223"], "numbers go from 0 to 41222"),
        (["{run}", "--replay", "one"], "--replay one: no task"),
        (["{run}", "evaluation.max_task=3"], "did you mean"),
        (["{run}", "evaluation.robustness_bracket=[-2,-5]"], "is reversed; use [-5.0,-2.0]"),
        (["{run}", "motions.clips.idle.cancel=[1.2,0.8]"], "motions.clips.idle.cancel: [1.2, 0.8] is reversed"),
        (["{run}", "motions.rotation=[0.5,-0.5]"], "motions.rotation: [0.5, -0.5] is reversed"),
        (["{run}", "motions.groups=[]"], "motions.groups: is empty"),
        (["{run}", "motions.clips.idle.file=builtin:run"], "trained with motions.clips.idle.file=builtin:idle"),
        (["{run}", "motions.clips.idle.start=0.5"], "trained with motions.clips.idle.start=0.0, asked for"),
        (["{run}", "action.mode=absolute"], "trained with action.mode=target, asked for action.mode=absolute"),
        (["{run}", "observation.target=difference"], "trained with observation.target=absolute, asked for"),
    ],
)
def test_wrong_input_is_one_line_that_names_it(arguments, words, run):
    with pytest.raises(InputError) as caught:
        main([argument.format(run=run) for argument in arguments])
    assert words in str(caught.value) and "\n" not in str(caught.value)


def test_a_run_without_a_checkpoint_says_so(run):
    shutil.rmtree(run / "checkpoints")
    with pytest.raises(InputError, match="holds no checkpoint; train it first"):
        main([str(run)])


def test_a_policy_is_not_evaluated_with_otherclips_of(run, config, make_config):
    other = make_config()
    other.motions.clips["walk"] = other.motions.clips.pop("run")
    settings.save(other, run / "config.yaml")
    with pytest.raises(InputError, match=r"trained with the clips idle, run, stab, asked for idle, stab, walk"):
        main([str(run)])
    with pytest.raises(InputError, match=r"00000002.pt: trained with the clips"):
        load_policy(run, other)


def test_other_clips_have_to_be_asked_for_and_are_played_by_the_same_rules(run, config, tmp_path):
    """With its own clips as `--motions` a run does what it does without; with others, those."""
    own = evaluate_run(run, config)
    before = (run / "evaluation.json").read_bytes()
    motions = yaml.safe_load((run / "config.yaml").read_text())["motions"]
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump({**motions, "name": "mine"}))
    assert main([str(run), "--motions", str(path)]) == 0
    assert json.loads((run / "on-mine/evaluation.json").read_text()) == own
    clips = {"idle": motions["clips"]["idle"], "walk": {"file": "builtin:walk", "looping": True}}
    path.write_text(yaml.safe_dump({"name": "other", "clips": clips}))
    assert main([str(run / "checkpoints/00000002.pt"), "--motions", str(path)]) == 0
    other = json.loads((run / "checkpoints/00000002-evaluation/on-other/evaluation.json").read_text())
    assert other["states"] == ["idle", "walk"] and other["tasks"] == 20 and len(other["groups"]) == 4
    assert (run / "evaluation.json").read_bytes() == before
    for where, words in (("nowhere.yaml", "--motions: motions=nowhere.yaml: no such file"), ("walks", "not known")):
        with pytest.raises(InputError, match=words):
            main([str(run), "--motions", where])


def test_a_policy_of_another_character_is_not_evaluated(run, make_policy, config):
    path = run / "checkpoints/00000002.pt"
    content = checkpoint.load(path)
    policy = content["policies"][-1]
    policy["weights"][0], policy["biases"][-1] = policy["weights"][0][:200], policy["biases"][-1][:28]
    policy["weights"][-1] = policy["weights"][-1][:, :28]
    checkpoint.save(run / "checkpoints", 3, content, keep=9)
    with pytest.raises(InputError, match=r"00000003.pt: of another character: .* 200 numbers into 28, .* 282 into 31"):
        main([str(run)])


@pytest.mark.parametrize("path", SCHEMAS, ids=lambda path: path.stem)
def test_checkpoints_of_every_schema_are_evaluated(path, make_config, tmp_path):
    config = make_config({"network.hidden": [4], "task.max_steps": 4, "evaluation.max_tasks": 3})
    if len(clips_of(checkpoint.load(path).get("config", {}))) == 9:
        config.motions = settings.build([settings.command_line(["scale=smoke"])]).motions
    settings.save(config, tmp_path / "config.yaml")
    shutil.copy(path, tmp_path / "00000002.pt")
    assert load_file(tmp_path / "00000002.pt", config).iteration == 2
    assert main([str(tmp_path / "00000002.pt"), f"--config={tmp_path / 'config.yaml'}"]) == 0
    assert json.loads((tmp_path / "00000002-evaluation/evaluation.json").read_text())["tasks"] == 3


def test_a_checkpoint_of_a_schema_to_come_or_with_a_turned_bit_is_one_line(run):
    path = run / "checkpoints/00000002.pt"
    data = path.read_bytes()
    for broken, words in (
        (data.replace(b"schema %d" % SCHEMA, b"schema 9", 1), "schema 9; this version reads up to"),
        (data[:-1] + bytes([data[-1] ^ 1]), "wrong checksum"),
        (b"", "not a readable checkpoint"),
    ):
        path.write_bytes(broken)
        with pytest.raises(InputError) as caught:
            main([str(path)])
        assert words in str(caught.value) and "\n" not in str(caught.value)
