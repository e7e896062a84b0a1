"""MLflow's database at its default address, a SQLite file that the first run makes."""

import subprocess
import sys
import time

import pytest
from commands import PROJECT

from orchestrator import mlflow_store

FIRST_USE = "import sys; from orchestrator import mlflow_store; mlflow_store.make_client(sys.argv[1])"


def first_use(uri):
    return subprocess.Popen([sys.executable, "-c", FIRST_USE, uri], cwd=PROJECT)


@pytest.mark.slow
def test_a_database_is_whole_or_not_there_whoever_is_killed_or_comes_second(tmp_path):
    """A run stopped in its first seconds, while the tables are made, must not leave a file that MLflow can't open."""
    path = tmp_path / "mlflow.db"
    killed = first_use(uri := f"sqlite:///{path}")
    deadline = time.monotonic() + 100
    while not any(file.stat().st_size for file in tmp_path.glob("mlflow.db*")):
        assert killed.poll() is None and time.monotonic() < deadline
        time.sleep(0.01)
    killed.kill()
    killed.wait()
    assert not path.exists() and list(tmp_path.glob("mlflow.db*"))
    processes = [first_use(uri), first_use(uri)]
    assert [process.wait(100) for process in processes] == [0, 0]
    assert [file.name for file in tmp_path.glob("mlflow.db*")] == ["mlflow.db"]
    client = mlflow_store.make_client(uri)
    mlflow_store.ensure_experiment(client, uri, "first")
    assert [found.name for found in client.search_experiments()] == ["first", "Default"]
