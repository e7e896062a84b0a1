"""MLflow absent, lost, back and wrong in the middle of a call: no step lost, none doubled. A real `mlflow server` on
SQLite, behind a proxy that fails on demand.
"""

import json
import os
import sqlite3
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path

import pytest

from orchestrator import mlflow_store, spool, tracking
from orchestrator.console import run_command
from orchestrator.folder import exclusive, prepare
from orchestrator.mlflow_store import RunSpec
from orchestrator.settings import build, command_line
from orchestrator.shipping import Shipper
from orchestrator.tracking import Tracker
from tests.cluster.servers import MlflowServer, Proxy, wait_until

BATCHES = "/runs/log-batch"

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    with MlflowServer(tmp_path_factory.mktemp("server")) as server:
        yield server


@pytest.fixture(autouse=True)
def impatient(monkeypatch):
    for name in ("INTERVAL", "RETRY", "RETRY_CLOSING"):
        monkeypatch.setattr(tracking, name, 0.1)


@pytest.fixture
def experiment(request):
    """A name of the test's own."""
    return request.node.name


@pytest.fixture
def spec(tmp_path):
    return spec_of(tmp_path / "ours-seed0")


def spec_of(folder, parent=None):
    folder.mkdir()
    return RunSpec(folder, folder.name, {"row": "ours"}, {"seed": "0"}, parent)


def write_lines(folder, first, last, clock=1000.0):
    """Iterations as the run's loop writes them. clock: two goes at an iteration differ in nothing else."""
    with open(folder / "metrics.jsonl", "a") as file:
        for step in range(first, last + 1):
            line = {"iteration": step, "return/mean": step / 2, "perf/seconds": clock, "perf/time": clock + step}
            file.write(json.dumps(line) + "\n")


def cut_back(folder, last):
    """As a run does that goes on from the checkpoint of iteration `last`."""
    lines = (folder / "metrics.jsonl").read_text().splitlines(keepends=True)
    (folder / "metrics.new").write_text("".join(lines[:last]))
    os.replace(folder / "metrics.new", folder / "metrics.jsonl")


def the_run(server, experiment, name="ours-seed0"):
    """The only run of that name."""
    client = mlflow_store.make_client(server.uri)
    found = client.get_experiment_by_name(experiment)
    (run,) = (run for run in client.search_runs([found.experiment_id]) if run.info.run_name == name)
    return client, run


def assert_every_step_once(server, experiment, last, name="ours-seed0"):
    client, run = the_run(server, experiment, name)
    for key in ("iteration", "return/mean", "perf/seconds"):
        history = client.get_metric_history(run.info.run_id, key)
        assert sorted(metric.step for metric in history) == list(range(1, last + 1)), key
    assert all(m.value == m.step / 2 for m in client.get_metric_history(run.info.run_id, "return/mean"))
    return client, run


def everything(server, experiment):
    """All that MLflow says of an experiment's runs: to see that nothing changed."""
    client = mlflow_store.make_client(server.uri)
    runs = client.search_runs([client.get_experiment_by_name(experiment).experiment_id])
    return {
        run.info.run_id: (
            run.to_dictionary(),
            {key: [vars(m) for m in client.get_metric_history(run.info.run_id, key)] for key in run.data.metrics},
            [(file.path, file.file_size) for file in client.list_artifacts(run.info.run_id)],
        )
        for run in runs
    }


@pytest.fixture
def sync(monkeypatch, capsys):
    """A function of (words, address in the environment) that gives (exit status, output, errors) of the command."""

    def run(*words, environment=""):
        monkeypatch.setenv("MLFLOW_TRACKING_URI", environment)
        monkeypatch.setattr(sys.modules["__main__"], "__spec__", tracking.__spec__)
        capsys.readouterr()
        status = run_command(tracking.main, tracking.__doc__, ["sync", *map(str, words)])
        return status, *capsys.readouterr()

    # the signal handlers of a command line are not for this process
    monkeypatch.setattr("orchestrator.console.catch_signals", lambda: None)
    return run


# --------------------------------------------------------------------------------------------------- the four scenarios


def test_absent_at_the_start_then_there(server, spec, experiment):
    said = []
    proxy = Proxy(server.port)
    tracker = Tracker(proxy.uri, experiment, spec, said.append)
    write_lines(spec.folder, 1, 20)
    tracker.wake()
    assert "127.0.0.1" in tracker.wait_ready(30)
    with proxy:
        write_lines(spec.folder, 21, 30)
        wait_until(lambda: tracker.wait_ready(0) is None, 60, "the server's first answer")
        assert tracker.finish("FINISHED", {"eval/FRPD": 0.5}, timeout=30)
    _, run = assert_every_step_once(server, experiment, 30)
    assert run.info.status == "FINISHED" and run.data.metrics["eval/FRPD"] == 0.5
    assert len(said) == 1


def test_lost_in_the_middle_then_back(server, spec, experiment):
    with Proxy(server.port) as proxy:
        tracker = Tracker(proxy.uri, experiment, spec)
        write_lines(spec.folder, 1, 20)
        tracker.wake()
        assert tracker.wait_ready(30) is None
        wait_until(lambda: BATCHES in str(proxy.seen), 30, "first batch")
        proxy.fault = lambda path: "before"
        for first in range(21, 61, 10):
            write_lines(spec.folder, first, first + 9)
            start = time.monotonic()
            tracker.wake()
            assert time.monotonic() - start < 0.05
            time.sleep(0.2)
        assert tracker.wait_ready(0) is not None
        proxy.fault = lambda path: None
        wait_until(lambda: tracker.wait_ready(0) is None, 60, "the server's answer")
        assert tracker.finish("FINISHED", timeout=30)
    assert_every_step_once(server, experiment, 60)


def test_lost_for_good_and_shipped_by_sync(server, spec, experiment, sync):
    with Proxy(server.port) as proxy:
        tracker = Tracker(proxy.uri, experiment, spec)
        write_lines(spec.folder, 1, 20)
        tracker.wake()
        assert tracker.wait_ready(30) is None
        wait_until(lambda: BATCHES in str(proxy.seen), 30, "first batch")
    write_lines(spec.folder, 21, 600)  # several batches
    (spec.folder / "config.yaml").write_text("a: 1\n")
    start = time.monotonic()
    assert tracker.finish("FINISHED", {"eval/FRPD": 0.5}, [spec.folder / "config.yaml"], timeout=1) is False
    assert time.monotonic() - start < 3
    status, _, error = sync(spec.folder)  # the address that the run was logged at: still away
    assert status == 1 and "not shipped" in error and error.count("\n") == 1
    status, output, error = sync(spec.folder, f"tracking.uri={server.uri}")
    assert (status, error) == (0, "")
    assert output.startswith("ours-seed0: 580 of 600 steps; FINISHED set; run ")
    client, run = assert_every_step_once(server, experiment, 600)
    assert run.info.status == "FINISHED" and run.data.metrics["eval/FRPD"] == 0.5
    assert run.info.end_time == spool.read_final(spec.folder).milliseconds
    assert [file.path for file in client.list_artifacts(run.info.run_id)] == ["config.yaml"]
    before = everything(server, experiment)
    status, output, _ = sync(spec.folder, environment=server.uri)
    assert status == 0 and output.startswith("ours-seed0: nothing new, 600 steps; FINISHED; run ")
    assert everything(server, experiment) == before


def test_never_there_then_a_whole_sweep_by_sync_to_two_servers(server, tmp_path, experiment, sync):
    """tracking.enabled=false; then one server, another one, the first again. A row of the sweep was killed."""
    sweep = spec_of(tmp_path / "ablation")
    rows = [spec_of(sweep.folder / f"{row}-seed0", sweep) for row in ("ours", "no_sbc")]
    nowhere = tracking.Tracking(None, experiment, sweep)
    parent = nowhere.start(sweep)
    trackers = [nowhere.start(row) for row in rows]
    for row in rows:
        write_lines(row.folder, 1, 5)
    trackers[0].finish("FINISHED", {"eval/FRPD": 0.5})
    with open(rows[1].folder / "metrics.jsonl", "a") as file:
        file.write('{"iteration": 6, "return/m')  # cut off by the kill
    parent.finish("FAILED")
    status, _, error = sync(sweep.folder)
    assert status == 2 and "was not logged anywhere" in error
    other = f"sqlite:///{tmp_path}/other.db"
    for uri, sent in ((server.uri, "5 of 5 steps"), (other, "5 of 5 steps"), (server.uri, "nothing new, 5 steps")):
        before = everything(server, experiment) if "nothing" in sent else None
        # the second time by the name of a row, whose sweep comes along
        folders = [sweep.folder] if uri != other else [row.folder for row in rows]
        status, output, error = sync(*folders, f"tracking.uri={uri}")
        assert (status, error) == (0, "")
        assert sorted(line.split(":")[0] for line in output.splitlines()) == ["ablation", "no_sbc-seed0", "ours-seed0"]
        assert output.count(sent) == 2
    assert everything(server, experiment) == before
    _, top = the_run(server, experiment, "ablation")
    for row, state in zip(rows, ("FINISHED", "KILLED"), strict=True):
        _, run = assert_every_step_once(server, experiment, 5, row.name)
        assert run.data.tags["mlflow.parentRunId"] == top.info.run_id
        assert run.info.status == state
    assert top.info.status == "FAILED"


# ---------------------------------------------------------------------------------------------- faults inside one call


@pytest.mark.parametrize("call", ["/runs/create", BATCHES, "/runs/update", "/experiments/create", "/runs/get"])
def test_an_answer_lost_after_the_call_had_its_effect(server, spec, experiment, call):
    """The server takes the call and hangs up: once for each kind of call. One run, every step once, one final value."""
    faults = []

    def fault(path):
        if call in path and len(faults) < 3:
            faults.append(path)
            return "after"
        return None

    with Proxy(server.port, fault) as proxy:
        tracker = Tracker(proxy.uri, experiment, spec)
        write_lines(spec.folder, 1, 400)
        tracker.wake()
        wait_until(lambda: tracker._shipper and tracker._shipper.shipped == 400, 60, "400 steps")
        assert tracker.finish("FINISHED", {"eval/FRPD": 0.5}, timeout=60)
    assert len(faults) == 3 or (call.endswith("create") and faults)  # what was made is not made again
    client, run = assert_every_step_once(server, experiment, 400)
    assert len(client.get_metric_history(run.info.run_id, "eval/FRPD")) == 1
    assert run.info.status == "FINISHED"


def test_a_batch_that_arrives_after_the_run_was_cut_back_and_repeated(server, spec, experiment):
    """The killed process's batch is still on its way when the next process asks what MLflow has."""
    held = threading.Event()
    with Proxy(server.port) as proxy:
        first = Shipper(proxy.uri, experiment, spec)
        spool.record_spec(spec, experiment, proxy.uri)
        write_lines(spec.folder, 1, 30)
        first.ship()
        write_lines(spec.folder, 31, 40)
        proxy.fault = lambda path: held if BATCHES in path else None
        with pytest.raises(Exception, match="log-batch"):
            first.ship()
        del first  # killed
        cut_back(spec.folder, 30)
        proxy.fault = lambda path: None
        second = Shipper(proxy.uri, experiment, spec)
        write_lines(spec.folder, 31, 50, clock=2000.0)
        second.ship()
        held.set()
        wait_until(lambda: proxy.late, 30, "the late batch")
        assert proxy.late[0][0] == 200
    assert_every_step_once(server, experiment, 50)


def test_metrics_cut_back_under_a_living_tracker(server, spec, experiment):
    said = []
    tracker = Tracker(server.uri, experiment, spec, said.append)
    write_lines(spec.folder, 1, 40)
    tracker.wake()
    wait_until(lambda: tracker._shipper and tracker._shipper.shipped == 40, 30, "40 steps")
    cut_back(spec.folder, 30)
    write_lines(spec.folder, 31, 60, clock=20000.5)
    tracker.wake()
    assert tracker.finish("FINISHED", timeout=30)
    assert_every_step_once(server, experiment, 60)
    assert said == []


KILLED = """
    import json, os, signal, sys
    from pathlib import Path
    from mlflow import MlflowClient
    from orchestrator import spool
    from orchestrator.mlflow_store import RunSpec
    from orchestrator.settings import build, command_line
    from orchestrator.shipping import Shipper

    uri, experiment, folder = sys.argv[1:]
    folder, calls = Path(folder), []
    log_batch = MlflowClient.log_batch

    def killed(self, run_id, metrics=(), **rest):
        if metrics:
            calls.append(1)
            if len(calls) == 2:
                log_batch(self, run_id, metrics=metrics, **rest)
                os.kill(os.getpid(), signal.SIGKILL)
        return log_batch(self, run_id, metrics=metrics, **rest)

    MlflowClient.log_batch = killed
    spec = RunSpec(folder, folder.name, {}, {})
    spool.record_spec(spec, experiment, uri)
    Shipper(uri, experiment, spec).ship()
"""


def test_kill_9_between_a_batch_and_its_answer(server, spec, experiment):
    write_lines(spec.folder, 1, 600)  # three batches; killed at the second
    arguments = [server.uri, experiment, str(spec.folder)]
    result = subprocess.run([sys.executable, "-c", textwrap.dedent(KILLED), *arguments], timeout=120)
    assert result.returncode == -9
    cut_back(spec.folder, 300)
    write_lines(spec.folder, 301, 700, clock=5000.0)
    tracker = Tracker(server.uri, experiment, spec)
    tracker.wake()
    assert tracker.finish("FINISHED", timeout=60)
    assert_every_step_once(server, experiment, 700)


def test_a_batch_is_taken_whole_or_not_at_all(server, spec, experiment):
    """What shipping relies on: where the database refuses one value (a full disk), none of its batch is kept."""
    write_lines(spec.folder, 1, 600)
    shipper = Shipper(server.uri, experiment, spec)
    with sqlite3.connect(server.folder / "server.db") as database:
        row = f"NEW.run_uuid = '{shipper.run_id}' AND NEW.step = 400 AND NEW.key = 'return/mean'"
        database.execute(f"CREATE TRIGGER full BEFORE INSERT ON metrics WHEN {row} BEGIN SELECT RAISE(ABORT, ''); END")
    with pytest.raises(Exception, match="log-batch|IntegrityError"):
        shipper.ship()
    assert_every_step_once(server, experiment, 250)  # the first batch
    with sqlite3.connect(server.folder / "server.db") as database:
        database.execute("DROP TRIGGER full")
    Shipper(server.uri, experiment, spec).ship()
    assert_every_step_once(server, experiment, 600)


# ------------------------------------------------------------------------------------------------------------- sync


def test_sync_leaves_a_run_alone_that_a_process_is_running(server, spec, experiment, sync):
    spool.record_spec(spec, experiment, server.uri)
    write_lines(spec.folder, 1, 3)
    with exclusive(spec.folder):
        status, output, error = sync(spec.folder)
    assert status == 1 and output == "" and "a process is running" in error


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["nowhere"], "no such folder"),
        (["."], "holds no run to ship"),
        ([], "expected: python -m orchestrator.tracking sync"),
    ],
)
def test_sync_refuses_in_one_line(tmp_path, monkeypatch, sync, arguments, words):
    monkeypatch.chdir(tmp_path)
    status, output, error = sync(*arguments)
    assert status == 2 and words in error and error.count("\n") == 1


def test_the_end_of_a_run_that_could_not_note_it(server, tmp_path, experiment, sync):
    """Killed between evaluation.json and the note of the end: sync logs what the run would have logged."""
    spec = spec_of(tmp_path / "ours-seed0")
    spool.record_spec(spec, experiment, server.uri)
    write_lines(spec.folder, 1, 3)
    prepare(spec.folder, build([command_line(["scale=smoke"])]))
    (spec.folder / "evaluation.json").write_text(
        json.dumps({"metrics": {"FRPD": 0.5, "IRFA": None}, "trained": {"FRPD": 0.25}})
    )
    assert sync(spec.folder)[0] == 0
    client, run = assert_every_step_once(server, experiment, 3)
    assert run.info.status == "FINISHED"
    assert (run.data.metrics["eval/FRPD"], run.data.metrics["trained/FRPD"]) == (0.5, 0.25)
    assert {file.path for file in client.list_artifacts(run.info.run_id)} == {"config.yaml", "evaluation.json"}


# ----------------------------------------------------------------------------------------------------------- secrets


def test_a_run_with_a_password_in_the_address_keeps_it_nowhere(server, tmp_path):
    """The command line as a user runs it: the password reaches the server, and no file, no line, no entry of MLflow."""
    out, secret, token = tmp_path / "run", "hunter2-in-the-address", "hunter2-in-the-environment"
    with Proxy(server.port) as proxy:
        environment = {
            **os.environ,
            "MLFLOW_TRACKING_URI": proxy.uri.replace("://", f"://me:{secret}@"),
            "AWS_SECRET_ACCESS_KEY": token,
            "PYTHONPATH": str(Path(tracking.__file__).parents[1]),
        }
        command = [
            "orchestrator.train",
            "scale=smoke",
            "runtime=local",
            f"out={out}",
            f"tracking.uri=http://{secret}@x",
        ]
        result = subprocess.run(
            [sys.executable, "-m", *command], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=280
        )
        assert result.returncode == 0, result.stderr
        assert len(proxy.seen) > 5 and all(h["Authorization"].startswith("Basic ") for _, h in proxy.seen)
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert out / ".tracking/run.json" in files
    client, run = the_run(server, "train")
    (version,) = client.search_model_versions("name = 'train-ours'")
    assert (run.info.status, version.run_id) == ("FINISHED", run.info.run_id)
    kept = json.dumps(everything(server, "train"))
    assert '"num_envs": "8"' in kept
    for word in (secret, token):
        assert word not in result.stdout + result.stderr
        assert word not in kept
        assert [path for path in files if word.encode() in path.read_bytes()] == []
