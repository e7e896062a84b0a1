"""A sweep as a user runs it, killed on the way: rows, table, MLflow and models."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from commands import lines_of, run, start, wait_for
from training import lines

from orchestrator import mlflow_store
from orchestrator.model_registry import policy_of
from orchestrator.table import COLUMNS
from workers.inference import PolicyNetwork

ROWS = ("ours", "no_tr")
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


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    """A sweep of two rows at scale=smoke that is killed in its second row and then continued."""
    folder = tmp_path_factory.mktemp("sweep")
    arguments = ["sweeps/ablation.yaml", "scale=smoke", "rows=[ours,no_tr]", "budget.iterations=4"]
    process = start("sweep", folder, *arguments)
    out = folder / "runs" / "ablation"
    wait_for(lambda: lines_of(out / "no_tr-seed0") >= 1, process)
    process.send_signal(signal.SIGKILL)
    process.wait()
    first = lines(out / "ours-seed0")
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
        assert [line["iteration"] for line in lines(folder)] == [1, 2, 3, 4]
    table = json.loads((out / "table.json").read_text())
    assert [row["row"] for row in table["rows"]] == list(ROWS)
    assert all(set(row["measured"]) == set(COLUMNS) for row in table["rows"])
    assert (out / "table.md").read_text().strip() in output
    assert "rows ours, no_tr;" in output and f"folder {out}" in output
    assert f"mlflow ui --backend-store-uri sqlite:///{sweep['folder']}/mlflow.db" in output
    assert "\x1b" not in output


@pytest.mark.timeout(900)
@pytest.mark.slow
def test_the_killed_sweep_was_continued(sweep):
    ours = sweep["out"] / "ours-seed0"
    assert "finished before: ours-seed0" in sweep["output"]
    assert (ours / "evaluation.json").stat().st_mtime_ns == sweep["evaluated"]  # finished rows are not run again
    assert lines(ours) == sweep["first"]


@pytest.mark.timeout(900)
@pytest.mark.slow
def test_mlflow_has_the_rows_as_children_under_one_parent(sweep):
    client = mlflow_store.make_client(f"sqlite:///{sweep['folder']}/mlflow.db")
    experiment = client.get_experiment_by_name("ablation")
    runs = {run.info.run_name: run for run in client.search_runs([experiment.experiment_id])}
    assert set(runs) == {"ablation", *(f"{row}-seed0" for row in ROWS)}
    parent = runs.pop("ablation")
    files = {file.path for file in client.list_artifacts(parent.info.run_id)}
    assert files >= {f"table.{suffix}" for suffix in ("md", "csv", "tex", "html", "json")}
    assert parent.data.tags["mlflow.note.content"].startswith("| Method ")
    for child in runs.values():
        assert child.data.tags["mlflow.parentRunId"] == parent.info.run_id
        assert child.info.status == "FINISHED"
        assert child.data.params["num_envs"] == "8" and child.data.params["budget.iterations"] == "4"
        assert (child.data.tags["row"], child.data.tags["seed"]) == tuple(child.info.run_name.split("-seed"))
        assert child.data.tags["scale"] == "smoke"
        assert [m.step for m in client.get_metric_history(child.info.run_id, "iteration")] == [1, 2, 3, 4]
        assert not [name for name in NAMED if name not in child.data.metrics]
        assert "eval/FRPD" in child.data.metrics and "trained/TTAR" in child.data.metrics
        assert "system/cpu_utilization_percentage" in child.data.metrics
        files = {file.path for file in client.list_artifacts(child.info.run_id)}
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
