"""The processes of docker/compose.yaml, started natively: PostgreSQL, `mlflow server` on it, a Ray head and workers
with token authentication, and a sweep through `ray job submit`. Needs Debian's package postgresql; takes minutes.
"""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import pytest

from orchestrator import mlflow_store
from tests.cluster.__main__ import run_sweep
from tests.cluster.nodes import RAY, Nodes, has_dashboard
from tests.cluster.servers import MlflowServer, Postgres, Proxy

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]

SECRET = "hunter2-of-the-tracking-server"


@pytest.fixture(scope="module")
def database():
    if Postgres.programs() is None:
        pytest.skip("PostgreSQL is not installed (Debian: apt-get install postgresql)")
    if not has_dashboard():
        pytest.skip("Ray's dashboard is not installed (pip install -e .[cluster])")
    with Postgres() as database:
        yield database


@pytest.fixture(scope="module")
def driver(tmp_path_factory):
    """PYTHONPATH with PostgreSQL's client, which the project itself does not need."""
    if importlib.util.find_spec("psycopg2"):
        return ""
    folder = tmp_path_factory.mktemp("psycopg2")
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", f"--target={folder}", "psycopg2-binary"]
    if subprocess.run(command, capture_output=True).returncode:
        pytest.skip("psycopg2-binary is not installed and no package index has it")
    return str(folder)


@pytest.fixture(scope="module")
def server(database, driver, tmp_path_factory):
    environment = {**database.environment, "PYTHONPATH": driver}
    with MlflowServer(tmp_path_factory.mktemp("server"), database.uri, environment) as server:
        yield server


@pytest.fixture(scope="module")
def nodes(server):
    """A head with 1 CPU and two workers' machines with 2; all log to the server, by an address with a password."""
    with Proxy(server.port) as proxy:
        uri = proxy.uri.replace("://", f"://segue:{SECRET}@")
        with Nodes(cpus=(2, 2), head_cpus=1, dashboard=True, environment={"MLFLOW_TRACKING_URI": uri}) as nodes:
            nodes.requests = proxy.seen
            yield nodes


@pytest.fixture(scope="module")
def sweep(nodes, tmp_path_factory):
    """(folder, output) of a sweep of one row whose learner and three workers fit on no single machine."""
    folder = tmp_path_factory.mktemp("submitted")
    (folder / "work").mkdir()
    (folder / "work/mine.yaml").write_text("name: mine\nbase: {scale: smoke}\nseeds: [0]\nrows: {ours: {}}\n")
    words = ["python", "-m", "orchestrator.sweep", "mine.yaml", "num_workers=3", f"out={folder / 'out'}"]
    words[0] = sys.executable
    status, output = nodes.submit(*words, working_dir=folder / "work", patience=1500)
    assert status == 0, output[-3000:]
    return folder / "out", output


def test_the_submitted_sweep_finished_with_its_table(sweep):
    out, output = sweep
    assert "succeeded" in output
    assert (out / "table.md").exists() and (out / "ours-seed0/evaluation.json").exists()


def test_its_workers_were_spread_over_the_machines(sweep, nodes):
    placed = nodes.actors()
    print("\n".join(f"{name} on {address}" for name, address in placed))
    workers = [address for name, address in placed if "RolloutWorker" in name]
    assert len(workers) == 3 and len(set(workers)) >= 2
    assert len([name for name, _ in placed if "Learner" in name]) == 1


def test_its_runs_arrived_in_postgresql(sweep, server, database):
    client = mlflow_store.make_client(server.uri)
    runs = client.search_runs([client.get_experiment_by_name("mine").experiment_id])
    named = {run.info.run_name: run for run in runs}
    assert set(named) == {"mine", "ours-seed0"}
    child = named["ours-seed0"]
    assert child.data.tags["mlflow.parentRunId"] == named["mine"].info.run_id
    assert {run.info.status for run in runs} == {"FINISHED"}
    lines = [json.loads(line) for line in (sweep[0] / "ours-seed0/metrics.jsonl").read_text().splitlines()]
    history = client.get_metric_history(child.info.run_id, "return/mean")
    written = {line["iteration"]: line["return/mean"] for line in lines if line["return/mean"] is not None}
    assert {metric.step: metric.value for metric in history} == written
    rows = database.query(f"SELECT step FROM metrics WHERE run_uuid = '{child.info.run_id}' AND key = 'iteration'")
    assert sorted(map(int, rows)) == [line["iteration"] for line in lines] == [1, 2, 3]
    assert "evaluation.json" in {file.path for file in client.list_artifacts(child.info.run_id)}
    assert any(server.artifacts.rglob("evaluation.json"))


def test_the_servers_password_is_used_and_kept_nowhere(sweep, nodes, database):
    out, output = sweep
    assert all(headers.get("Authorization", "").startswith("Basic ") for _, headers in nodes.requests)
    assert SECRET not in output
    for path in (path for path in out.rglob("*") if path.is_file()):
        assert SECRET.encode() not in path.read_bytes(), path
    for table, column in (("params", "value"), ("tags", "value"), ("experiments", "artifact_location")):
        assert database.query(f"SELECT count(*) FROM {table} WHERE {column} LIKE '%{SECRET}%'") == ["0"]


def test_who_has_no_token_may_not_submit(nodes):
    environment = {**nodes.environment, "RAY_AUTH_TOKEN": "0" * 64}
    for name in ("RAY_ADDRESS", "RAY_JOB_ID"):
        environment.pop(name, None)
    command = [*RAY, "job", "submit", "--address", nodes.dashboard, "--", "echo", "reached"]
    result = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert result.returncode != 0 and "reached\n" not in result.stdout
    assert "oken" in result.stdout + result.stderr  # says what is wrong


def test_a_driver_with_a_wrong_token_is_told_so_in_one_line(nodes, tmp_path):
    status, output = run_sweep({**nodes.environment, "RAY_AUTH_TOKEN": "0" * 64}, tmp_path / "out")
    assert status == 2
    (line,) = [line for line in output.splitlines() if line.startswith("error: ")]
    assert "RAY_AUTH_TOKEN" in line and "Traceback" not in output and "0" * 64 not in output


def test_only_this_machine_reaches_the_dashboard(nodes):
    """Listening addresses of every process of the cluster that serves the dashboard's port."""
    port = int(nodes.dashboard.rpartition(":")[2])
    found = []
    for line in Path("/proc/net/tcp").read_text().splitlines()[1:]:
        local, state = line.split()[1], line.split()[3]
        if state == "0A" and int(local.split(":")[1], 16) == port:
            found.append(local.split(":")[0])
    assert found == ["0100007F"]  # 127.0.0.1


def test_a_killed_machine_leaves_the_cluster_and_a_new_one_joins(nodes):
    nodes.kill(2)
    assert nodes.alive() == [0, 1]
    assert nodes.add(2) == 3 and nodes.alive() == [0, 1, 3]
