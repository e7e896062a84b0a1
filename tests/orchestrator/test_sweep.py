"""The command lines as a user runs them: `python -m orchestrator.sweep` and `python -m orchestrator.train`."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from orchestrator import mlflow_store
from orchestrator.model_registry import policy_of
from orchestrator.table import COLUMNS
from workers.inference import PolicyNetwork

PROJECT = Path(__file__).resolve().parents[2]
ROWS = ("ours", "no_sbc", "no_urp", "no_tr")
NAMED = (
    "return/mean",
    "return/upper_body",
    "achievement",
    "thresholds/root_position",
    "episode/steps",
    "loss/policy",
    "loss/value",
    "loss/sbc",
    "policy/kl",
    "perf/samples_per_second",
)


def start(module, folder, *arguments):
    """A command in a folder of its own, output into one pipe."""
    environment = {**os.environ, "PYTHONPATH": str(PROJECT)}
    for name in ("MLFLOW_TRACKING_URI", "RAY_ADDRESS"):
        environment.pop(name, None)
    command = [sys.executable, "-m", f"orchestrator.{module}", *arguments]
    return subprocess.Popen(
        command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


def run(module, folder, *arguments):
    """(exit status, output) of a command."""
    process = start(module, folder, *arguments)
    output, _ = process.communicate(timeout=500)
    return process.returncode, output


def lines_of(folder):
    """Iterations in a run's metrics file."""
    path = folder / "metrics.jsonl"
    return path.read_text().count("\n") if path.exists() else 0


def wait_for(condition, process, seconds=200):
    deadline = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, process.communicate()[0]
        assert time.monotonic() < deadline
        time.sleep(0.1)


def without_clock(path):
    """The lines of a metrics file without what depends on the clock."""
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    return [{key: value for key, value in line.items() if not key.startswith("perf/")} for line in lines]


# ------------------------------------------------------------------------------------------ bad input, before any actor


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "sweeps/ablation.yaml"),
        (["nowhere.yaml"], "nowhere.yaml"),
        (["sweeps/ablation.yaml", "scale=smoke", "sbc.enable=1"], "did you mean 'sbc.enabled'"),
        (["sweeps/ablation.yaml", "scale=smoke", "rows=[our]"], "did you mean 'ours'"),
        (["sweeps/ablation.yaml", "scale=smoke", "motions=reallusion", "motions.dir=nowhere"], "motions.dir"),
        (["sweeps/ablation.yaml", "scale=smoke", "motions.clips.stab.cancel=[0,99]"], "motions.clips.stab.cancel"),
        (["sweeps/ablation.yaml", "scale=smoke", "out=/proc/nowhere"], "choose another out="),
        (["sweeps/ablation.yaml", "scale=smoke", "num_workers=8", "worker_threads=64"], "lower num_workers"),
    ],
)
def test_bad_input_is_answered_with_one_line(tmp_path, arguments, words):
    status, output = run("sweep", tmp_path, *arguments)
    errors = [line for line in output.splitlines() if line.startswith("error: ")]
    assert status == 2 and len(errors) == 1 and words in errors[0], output
    assert "Traceback" not in output
    assert not list(tmp_path.rglob("metrics.jsonl"))


@pytest.mark.parametrize("module", ["sweep", "train"])
def test_help(tmp_path, module):
    status, output = run(module, tmp_path, "--help")
    assert status == 0 and "usage:" in output and "runs/" in output


# -------------------------------------------------------------------------------------------------------- real sweeps


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    """A sweep of four rows at scale=smoke that is killed in its second row and then continued."""
    folder = tmp_path_factory.mktemp("sweep")
    arguments = ["sweeps/ablation.yaml", "scale=smoke", "budget.iterations=4"]
    process = start("sweep", folder, *arguments)
    out = folder / "runs" / "ablation"
    wait_for(lambda: lines_of(out / "no_sbc-seed0") >= 1, process)
    process.send_signal(signal.SIGKILL)
    process.wait()
    first = without_clock(out / "ours-seed0" / "metrics.jsonl")
    evaluated = (out / "ours-seed0" / "evaluation.json").stat().st_mtime_ns
    status, output = run("sweep", folder, *arguments)
    assert status == 0, output
    return {
        "folder": folder,
        "out": out,
        "output": output,
        "first": first,
        "evaluated": evaluated,
        "arguments": arguments,
    }


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_sweep_makes_the_table_and_every_file(sweep):
    out, output = sweep["out"], sweep["output"]
    for row in ROWS:
        folder = out / f"{row}-seed0"
        assert (folder / "config.yaml").exists() and (folder / "evaluation.json").exists()
        assert len(list((folder / "checkpoints").iterdir())) >= 1
        assert [line["iteration"] for line in without_clock(folder / "metrics.jsonl")] == [1, 2, 3, 4]
    table = json.loads((out / "table.json").read_text())
    assert [row["row"] for row in table["rows"]] == list(ROWS)
    assert all(set(row["measured"]) == set(COLUMNS) for row in table["rows"])
    assert (out / "table.md").read_text().strip() in output
    assert "rows ours, no_sbc, no_urp, no_tr" in output and f"folder {out}" in output
    assert f"mlflow ui --backend-store-uri sqlite:///{sweep['folder']}/mlflow.db" in output
    assert "\x1b" not in output


@pytest.mark.timeout(900)
@pytest.mark.slow
def test_the_killed_sweep_was_continued(sweep):
    ours = sweep["out"] / "ours-seed0"
    assert "finished before: ours-seed0" in sweep["output"]
    assert (ours / "evaluation.json").stat().st_mtime_ns == sweep["evaluated"]  # finished rows are not run again
    assert without_clock(ours / "metrics.jsonl") == sweep["first"]


@pytest.mark.timeout(900)
@pytest.mark.slow
def test_mlflow_has_four_children_under_one_parent(sweep):
    client = mlflow_store.make_client(f"sqlite:///{sweep['folder']}/mlflow.db")
    experiment = client.get_experiment_by_name("ablation")
    runs = {run.info.run_name: run for run in client.search_runs([experiment.experiment_id])}
    assert set(runs) == {"ablation", *(f"{row}-seed0" for row in ROWS)}
    parent = runs.pop("ablation")
    files = {file.path for file in client.list_artifacts(parent.info.run_id)}
    assert files >= {f"table.{suffix}" for suffix in ("md", "csv", "tex", "html", "json")}
    assert parent.data.tags["mlflow.note.content"].startswith("| Method ")
    for run in runs.values():
        assert run.data.tags["mlflow.parentRunId"] == parent.info.run_id
        assert run.info.status == "FINISHED"
        assert run.data.params["num_envs"] == "8" and run.data.params["budget.iterations"] == "4"
        assert (run.data.tags["row"], run.data.tags["seed"]) == tuple(run.info.run_name.split("-seed"))
        assert run.data.tags["scale"] == "smoke"
        assert [m.step for m in client.get_metric_history(run.info.run_id, "iteration")] == [1, 2, 3, 4]
        assert not [name for name in NAMED if name not in run.data.metrics]
        assert "eval/FRPD" in run.data.metrics and "trained/TTAR" in run.data.metrics
        assert "system/cpu_utilization_percentage" in run.data.metrics
        files = {file.path for file in client.list_artifacts(run.info.run_id)}
        assert {"config.yaml", "evaluation.json", "checkpoints"} <= files


LOAD = """
import mlflow, numpy as np, sys, torch
mlflow.set_tracking_uri(sys.argv[1])
policy = mlflow.pytorch.load_model("models:/ablation-no_tr@seed0")
np.save(sys.argv[3], policy(torch.from_numpy(np.load(sys.argv[2]))).detach().numpy())
assert not {"learner", "workers", "orchestrator", "motion"} & set(sys.modules)
"""


@pytest.mark.timeout(900)
@pytest.mark.slow
def test_a_model_per_run_that_computes_the_same_where_segue_is_not_installed(sweep, tmp_path):
    """By a process whose path holds nothing of this project; the killed and continued runs have one version each."""
    uri = f"sqlite:///{sweep['folder']}/mlflow.db"
    client = mlflow_store.make_client(uri)
    for row in ROWS:
        (version,) = client.search_model_versions(f"name = 'ablation-{row}'")
        assert client.get_run(version.run_id).info.run_name == f"{row}-seed0"
    policy = policy_of(sweep["out"] / "no_tr-seed0")
    observation = np.random.default_rng(0).normal(size=(3, 282)).astype(np.float32)
    np.save(tmp_path / "observation.npy", observation)
    environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "MLFLOW_TRACKING_URI")}
    files = (tmp_path / "observation.npy", tmp_path / "action.npy")
    command = [sys.executable, "-P", "-c", LOAD, uri, *map(str, files)]
    result = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stderr
    action = np.load(tmp_path / "action.npy")
    np.testing.assert_allclose(action, PolicyNetwork(policy, 3).mean(observation), rtol=1e-4, atol=1e-4)


@pytest.mark.timeout(900)
@pytest.mark.slow
def test_the_same_command_again_runs_nothing_and_another_configuration_is_refused(sweep):
    start_time = time.monotonic()
    before = (sweep["out"] / "table.json").read_text()
    status, output = run("sweep", sweep["folder"], *sweep["arguments"])
    assert status == 0 and "ours-seed0  training" not in output and (sweep["out"] / "table.json").read_text() == before
    assert time.monotonic() - start_time < 60
    status, output = run("sweep", sweep["folder"], *sweep["arguments"], "ppo.clip=0.3")
    assert status == 2 and "ppo.clip=0.2, asked for ppo.clip=0.3" in output


@pytest.mark.timeout(600)
@pytest.mark.slow
def test_a_failing_row_does_not_stop_the_others(tmp_path):
    broken = tmp_path / "out" / "ours-seed0" / "checkpoints"
    broken.mkdir(parents=True)
    (broken / "00000001.pt").write_text("not a checkpoint")
    arguments = ["sweeps/ablation.yaml", "scale=smoke", "out=out", "rows=[ours,no_tr]", "runtime=local"]
    arguments += ["report.enabled=false", "tracking.register_model=false"]
    status, output = run("sweep", tmp_path, *arguments, "tracking.uri=http://127.0.0.1:9")
    assert status == 1
    assert "does not answer; training goes on" in output
    assert "* ours-seed0: failed: InputError" in (tmp_path / "out" / "table.md").read_text()
    assert "Traceback" in (tmp_path / "out" / "ours-seed0" / "error.txt").read_text()
    assert (tmp_path / "out" / "no_tr-seed0" / "evaluation.json").exists()


@pytest.mark.timeout(600)
@pytest.mark.slow
def test_a_stopped_run_says_how_to_continue_and_does(tmp_path):
    arguments = ["scale=smoke", "runtime=local", "out=run", "budget.iterations=300", "checkpoint.every=20"]
    arguments += ["tracking.register_model=false"]
    process = start("train", tmp_path, *arguments)
    wait_for(lambda: lines_of(tmp_path / "run") >= 50, process)
    process.send_signal(signal.SIGTERM)
    began = time.monotonic()
    output, _ = process.communicate(timeout=30)
    assert process.returncode == 143 and time.monotonic() - began < 10
    assert "the same command continues: python -m orchestrator.train scale=smoke" in output
    assert not (tmp_path / "run" / "error.txt").exists()
    assert lines_of(tmp_path / "run") == int(sorted((tmp_path / "run" / "checkpoints").glob("*.pt"))[-1].stem)
    status, output = run("train", tmp_path, "resume=run")
    assert status == 0 and lines_of(tmp_path / "run") == 300
    assert run("train", tmp_path, *arguments)[0] == 0  # the same command finds it finished
    assert "at the final accuracy: FRPD" in output
    client = mlflow_store.make_client(f"sqlite:///{tmp_path}/mlflow.db")
    (logged,) = client.search_runs([client.get_experiment_by_name("train").experiment_id])
    assert [m.step for m in client.get_metric_history(logged.info.run_id, "iteration")] == list(range(1, 301))
