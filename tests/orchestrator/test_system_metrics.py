"""The machine's load: sampled beside the run, shipped once each, never a danger to the run."""

import json
import time

import pytest

from orchestrator import mlflow_store, spool, system_metrics
from orchestrator.mlflow_store import RunSpec
from orchestrator.system_metrics import Sampler
from orchestrator.tracking import Tracker


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(system_metrics, "FIRST", 0.01)
    monkeypatch.setattr(system_metrics, "INTERVAL", 0.01)


def samples(folder):
    path = spool.system_path(folder)
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def wait_for(condition, seconds=60):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_samples_have_mlflows_names_and_sensible_values(tmp_path):
    sampler = Sampler(tmp_path)
    wait_for(lambda: len(samples(tmp_path)) >= 3)
    sampler.stop()
    found = samples(tmp_path)
    assert [line["step"] for line in found] == list(range(1, len(found) + 1))
    for line in found:
        assert all(key.startswith("system/") for key in line["metrics"])
        assert 0 <= line["metrics"]["system/cpu_utilization_percentage"] <= 100
        assert 0 < line["metrics"]["system/system_memory_usage_percentage"] <= 100
        assert abs(line["milliseconds"] / 1000 - time.time()) < 100
    time.sleep(0.1)
    assert samples(tmp_path) == found  # it has ended


def test_a_continued_run_continues_its_samples_after_a_line_that_was_cut_off(tmp_path):
    path = spool.system_path(tmp_path)
    path.parent.mkdir()
    path.write_text('{"step": 1}\n{"step": 2}\n{"step": 3, "mill')
    sampler = Sampler(tmp_path)
    wait_for(lambda: path.read_text().count("\n") >= 3)
    sampler.stop()
    assert [line["step"] for line in samples(tmp_path)[:3]] == [1, 2, 3]


def test_a_monitor_or_a_disk_that_fails_ends_the_samples_and_nothing_else(tmp_path, monkeypatch):
    def broken():
        raise OSError("no such device")

    monkeypatch.setattr(system_metrics, "monitors", broken)
    sampler = Sampler(tmp_path)
    sampler.stop()
    assert samples(tmp_path) == []


def test_every_sample_is_shipped_once_even_if_it_was_forgotten_that_it_was(tmp_path, monkeypatch):
    uri, folder = f"sqlite:///{tmp_path}/mlflow.db", tmp_path / "run"
    folder.mkdir()
    spec = RunSpec(folder, "ours-seed0", {"row": "ours"}, {}, system_metrics=True)
    tracker = Tracker(uri, "load", spec)
    wait_for(lambda: len(samples(folder)) >= 150)  # more values than fit in one batch
    tracker.wake()
    assert tracker.finish("KILLED")
    (folder / ".tracking" / "system.json").unlink()
    again = Tracker(uri, "load", spec)
    wait_for(lambda: len(samples(folder)) >= 155)
    assert again.finish("FINISHED")
    client = mlflow_store.make_client(uri)
    (run,) = client.search_runs([client.get_experiment_by_name("load").experiment_id])
    history = client.get_metric_history(run.info.run_id, "system/cpu_utilization_percentage")
    assert [metric.step for metric in history] == [line["step"] for line in samples(folder)]
    assert [metric.timestamp for metric in history] == [line["milliseconds"] for line in samples(folder)]
    assert not (folder / "metrics.jsonl").exists()
