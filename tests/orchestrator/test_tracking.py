"""Logging to a real MLflow store, and to one that does not answer."""

import http.server
import json
import math
import sqlite3
import threading
import time
from dataclasses import asdict
from pathlib import Path

import pytest

from docs import make_curves
from motion.errors import InputError
from orchestrator import mlflow_store
from orchestrator.folder import prepare
from orchestrator.mlflow_store import RunSpec
from orchestrator.settings import build, command_line, flatten
from orchestrator.tracking import Tracker, commit_tag, run_spec


@pytest.fixture(scope="module")
def uri(tmp_path_factory):
    """A SQLite store; making its tables takes seconds, so that tests share it under experiments of their own."""
    return f"sqlite:///{tmp_path_factory.mktemp('mlflow')}/mlflow.db"


def spec_of(folder, name="ours-seed0", parent=None, **params):
    folder.mkdir(exist_ok=True)
    return RunSpec(folder, name, {"row": "ours"}, params or {"seed": "0"}, parent)


def write_lines(folder, first, last):
    with open(folder / "metrics.jsonl", "a") as file:
        for step in range(first, last + 1):
            line = {"iteration": step, "return/mean": None if step == 2 else step / 2, "perf/time": 1000.0 + step}
            file.write(json.dumps(line) + "\n")


def runs_of(uri, experiment):
    client = mlflow_store.make_client(uri)
    found = client.get_experiment_by_name(experiment)
    return client, {run.info.run_name: run for run in client.search_runs([found.experiment_id])}


def steps_of(client, run, key="iteration"):
    return [metric.step for metric in client.get_metric_history(run.info.run_id, key)]


def test_a_child_run_under_its_parent_with_metrics_and_files(tmp_path, uri):
    parent = spec_of(tmp_path / "sweep", "sweep")
    spec = spec_of(tmp_path / "run", parent=parent, **{"ppo.clip": "0.2"})
    top = Tracker(uri, "tree", parent)
    assert top.wait_ready(60) is None
    tracker = Tracker(uri, "tree", spec)
    write_lines(spec.folder, 1, 5)
    tracker.wake()
    (spec.folder / "config.yaml").write_text("a: 1\n")
    (spec.folder / "figures").mkdir()
    (spec.folder / "figures" / "a.svg").touch()
    files = [spec.folder / name for name in ("config.yaml", "figures/a.svg", "gone.txt")]
    assert tracker.finish("FINISHED", {"eval/FRPD": 0.5, "eval/IRFA": None}, files)
    (parent.folder / "table.md").write_text("| Method |")
    assert top.finish("FAILED", files=[parent.folder / "table.md"])
    client, runs = runs_of(uri, "tree")
    child = runs["ours-seed0"]
    assert child.data.tags["mlflow.parentRunId"] == runs["sweep"].info.run_id
    assert (child.info.status, runs["sweep"].info.status) == ("FINISHED", "FAILED")
    assert child.data.params == {"ppo.clip": "0.2"} and child.data.tags["row"] == "ours"
    assert steps_of(client, child) == [1, 2, 3, 4, 5]
    assert steps_of(client, child, "return/mean") == [1, 3, 4, 5]  # null is no value
    assert child.data.metrics["eval/FRPD"] == 0.5 and "eval/IRFA" not in child.data.metrics
    assert [file.path for file in client.list_artifacts(child.info.run_id)] == ["config.yaml", "figures"]
    assert [file.path for file in client.list_artifacts(child.info.run_id, "figures")] == ["figures/a.svg"]
    assert runs["sweep"].data.tags["mlflow.note.content"] == "| Method |"


def test_a_continued_run_has_every_step_once(tmp_path, uri):
    spec = spec_of(tmp_path / "run")
    tracker = Tracker(uri, "resume", spec)
    write_lines(spec.folder, 1, 40)
    tracker.wake()
    assert tracker.finish("KILLED")
    # a continued run repeats what lies behind its checkpoint, and its file is cut back to there first
    lines = (spec.folder / "metrics.jsonl").read_text().splitlines(keepends=True)
    (spec.folder / "metrics.jsonl").write_text("".join(lines[:30]))
    again = Tracker(uri, "resume", spec)
    write_lines(spec.folder, 31, 400)  # more values than fit in one batch
    again.wake()
    assert again.finish("FINISHED")
    client, runs = runs_of(uri, "resume")
    assert len(runs) == 1
    run = runs["ours-seed0"]
    assert steps_of(client, run) == list(range(1, 401))
    assert run.info.status == "FINISHED"


def test_figures_read_what_was_logged(tmp_path, uri):
    keys = [key for key, _ in make_curves.PANELS]
    lines = [{"samples": 64 * step, **dict.fromkeys(keys, step / 2)} for step in range(1, 301)]
    lines[6]["achievement"] = None
    spec = spec_of(tmp_path / "run")
    with open(spec.folder / "metrics.jsonl", "w") as file:
        for step, line in enumerate(lines, 1):
            file.write(json.dumps({"iteration": step, "perf/time": 1000.0 + step, **line}) + "\n")
    evaluation = {"tasks": 4, "by_accuracy": [{"reached": 3}, {"reached": 1}]}
    (spec.folder / "evaluation.json").write_text(json.dumps(evaluation))
    tracker = Tracker(uri, "figures", spec)
    tracker.wake()
    assert tracker.finish("FINISHED", files=[spec.folder / "evaluation.json"])
    Tracker(uri, "figures", spec_of(tmp_path / "again")).finish("FAILED")  # of the same name, without a step
    for chosen, label in (((), "ours-seed0"), (["ours-seed0=Ours"], "Ours")):
        (curves,) = make_curves.read(uri, "figures", chosen)
        assert (curves.label, curves.shares) == (label, [0.75, 0.25])
        assert curves.samples.tolist() == [line["samples"] for line in lines]
        for key in keys:
            wanted = [math.nan if line[key] is None else line[key] for line in lines]
            assert curves.values[key].tolist() == pytest.approx(wanted, abs=0, rel=0, nan_ok=True)
    with pytest.raises(InputError, match="no training run 'no_sbc-seed0'; there are: ours-seed0$"):
        make_curves.read(uri, "figures", ["no_sbc-seed0"])
    with pytest.raises(InputError, match="no experiment 'figure'; there are: .*figures"):
        make_curves.read(uri, "figure")
    with pytest.raises(InputError, match="no such database"):
        make_curves.read(f"sqlite:///{tmp_path}/none.db", "figures")
    assert not (tmp_path / "none.db").exists()


def test_a_run_whose_id_was_not_noted_is_found_again(tmp_path, uri):
    spec = spec_of(tmp_path / "run")
    client = mlflow_store.make_client(uri)
    experiment = mlflow_store.ensure_experiment(client, uri, "found")
    run_id = mlflow_store.ensure_run(client, uri, experiment, spec)
    note = mlflow_store.read_note(spec.folder)
    del note["run_id"]  # as if the process had died between making the run and noting it
    mlflow_store.write_note(spec.folder, note)
    assert mlflow_store.ensure_run(client, uri, experiment, spec) == run_id


def test_a_changed_parameter_becomes_a_tag(tmp_path, uri):
    Tracker(uri, "params", spec_of(tmp_path / "run", **{"budget.samples": "10"})).finish("FINISHED")
    Tracker(uri, "params", spec_of(tmp_path / "run", **{"budget.samples": "20", "new": "1"})).finish("FINISHED")
    run = runs_of(uri, "params")[1]["ours-seed0"]
    assert run.data.params == {"budget.samples": "10", "new": "1"}
    assert run.data.tags["changed.budget.samples"] == "20"


def test_several_trials_share_a_locked_database(tmp_path, uri):
    specs = [spec_of(tmp_path / f"run{i}", f"run{i}") for i in range(3)]
    trackers = [Tracker(uri, "shared", spec) for spec in specs]
    for spec, tracker in zip(specs, trackers, strict=True):
        assert tracker.wait_ready(60) is None
        write_lines(spec.folder, 1, 50)
    path = mlflow_store.sqlite_path(uri)
    with sqlite3.connect(path, isolation_level=None) as other:
        other.execute("BEGIN IMMEDIATE")
        for tracker in trackers:
            tracker.wake()
        time.sleep(2)
        other.execute("ROLLBACK")
    assert all(tracker.finish("FINISHED", timeout=60) for tracker in trackers)
    client, runs = runs_of(uri, "shared")
    assert all(steps_of(client, runs[f"run{i}"]) == list(range(1, 51)) for i in range(3))


def test_a_dead_server_costs_nothing_and_is_said_once(tmp_path):
    said = []
    spec = spec_of(tmp_path / "run")
    start = time.monotonic()
    tracker = Tracker("http://127.0.0.1:9", "dead", spec, said.append)
    write_lines(spec.folder, 1, 3)
    for _ in range(1000):
        tracker.wake()
    assert time.monotonic() - start < 0.5
    assert "127.0.0.1" in tracker.wait_ready(30)
    start = time.monotonic()
    assert tracker.finish("FINISHED") is False
    assert time.monotonic() - start < 8
    assert len(said) == 1 and "metrics.jsonl" in said[0]


def test_a_server_that_hangs_is_bounded_too(tmp_path, monkeypatch):
    class Hang(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            time.sleep(30)

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Hang)
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        tracker = Tracker(f"http://127.0.0.1:{server.server_port}", "hang", spec_of(tmp_path / "run"))
        start = time.monotonic()
        tracker.wake()
        assert "no answer" in tracker.wait_ready(1)
        assert tracker.finish("FINISHED", timeout=2) is False
        assert time.monotonic() - start < 4
    finally:
        server.shutdown()


def test_address(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    config = build([command_line(["scale=smoke"])])
    assert mlflow_store.address(config) == f"sqlite:///{tmp_path}/mlflow.db"
    assert (
        mlflow_store.ui_hint(mlflow_store.address(config))
        == f"mlflow ui --backend-store-uri sqlite:///{tmp_path}/mlflow.db"
    )
    config.tracking.uri = "http://own:5000"
    assert mlflow_store.address(config) == "http://own:5000"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://environment:5000")
    assert mlflow_store.address(config) == "http://environment:5000"


def test_passwords_are_neither_shown_nor_logged(tmp_path):
    secret = "postgresql://user:hunter2@host/db"
    assert mlflow_store.without_password(secret) == "postgresql://user:***@host/db"
    config = build([command_line(["scale=smoke", f"tracking.uri={secret}"])])
    assert "hunter2" not in str(run_spec(config, tmp_path).params)
    prepare(tmp_path, config)
    assert "hunter2" not in (tmp_path / "config.yaml").read_text()
    assert config.tracking.uri == secret


def test_parameters_are_the_resolved_configuration(tmp_path):
    config = build([command_line(["scale=smoke", "seed=3"])])
    spec = run_spec(config, tmp_path)
    assert spec.params["num_envs"] == "8" and spec.params["motions.clips.idle.file"] == "builtin:idle"
    assert spec.tags["seed"] == "3" and spec.tags["scale"] == "smoke" and spec.name == "ours-seed3"
    leaves = {key for key, _ in flatten(asdict(config))}
    assert leaves - set(spec.params) == {key for key in leaves if key == "out" or key.startswith("tracking.")}
    assert spec.system_metrics


def test_a_long_parameter_is_cut_and_a_file_keeps_the_whole(tmp_path, uri):
    Tracker(uri, "long", spec_of(tmp_path / "run", **{"motions.clips": "x" * 7000})).finish("FINISHED")
    (value,) = runs_of(uri, "long")[1]["ours-seed0"].data.params.values()
    assert value == "x" * 5999 + "…"


def test_the_commit_is_known_to_mlflow_under_its_own_name():
    if not (Path(__file__).parents[2] / ".git").exists():
        pytest.skip("not a checkout")
    tags = commit_tag()
    assert tags["mlflow.source.git.commit"] == tags["git_commit"] and len(tags["git_commit"]) == 40
    assert tags["git_dirty"] in ("true", "false")
