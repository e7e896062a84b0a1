"""Command lines run as a user runs them, each in a process and a folder of its own."""

import os
import subprocess
import sys
import time
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[1]


def start(module, folder, *arguments):
    """A command in a folder of its own, output into one pipe."""
    environment = {**os.environ, "PYTHONPATH": str(PROJECT)}
    for name in ("MLFLOW_TRACKING_URI", "RAY_ADDRESS", "OMP_NUM_THREADS"):
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
