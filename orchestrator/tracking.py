"""Log runs to MLflow from a thread of their own. Training never waits for it, and no step is lost or doubled.

metrics.jsonl is the spool: the thread ships its lines in batches, in order, and takes up behind the last step that
MLflow has. A server that is away is asked again until the run ends; what it did not take stays in metrics.jsonl.
"""

import json
import math
import re
import subprocess
import threading
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from orchestrator import mlflow_store
from orchestrator.folder import metrics_path
from orchestrator.mlflow_store import RunSpec
from orchestrator.plan import run_name
from orchestrator.settings import flatten
from orchestrator.validate import shown

BATCH = 1000  # values per call, MLflow's limit
INTERVAL = 2.0  # seconds between batches
RETRY = 15.0  # seconds between attempts while the server is away
RETRY_CLOSING = 1.0  # the same once the run has ended


class Tracker:
    """Logs one run. `wake()` after every line of metrics; `finish()` at the end.

    spec: the run, `mlflow_store.RunSpec`. experiment: its experiment's name. warn: called once with a line of text if
    MLflow does not answer.
    """

    def __init__(self, uri, experiment, spec, warn=lambda line: None):
        self._uri, self._experiment, self._spec, self._warn = uri, experiment, spec, warn
        self._client = self._run_id = self._error = None
        self._offset = self._shipped = 0
        self._final = None  # (status, metrics, files, time in ms) once the run has ended
        self._lines, self._ended = threading.Event(), threading.Event()
        self._ready, self._done = threading.Event(), threading.Event()
        threading.Thread(target=self._work, name="mlflow", daemon=True).start()

    def wake(self):
        """There are new lines in metrics.jsonl, which from now on only grows. Returns at once."""
        self._lines.set()

    def wait_ready(self, timeout):
        """Wait until the run is there or the first attempt failed. None if it is there, else the reason (text)."""
        if not self._ready.wait(timeout):
            return f"no answer within {timeout:g} s"
        return self._error

    def finish(self, status, metrics=None, files=(), timeout=30.0):
        """Ship the rest, log final metrics and files (paths), set the run's status (FINISHED, FAILED, KILLED).

        Waits at most `timeout` seconds, less if MLflow has not answered before. True if all arrived.
        """
        self._final = (status, metrics or {}, [Path(file) for file in files], int(time.time() * 1000))
        self._lines.set()
        self._ended.set()
        return self._done.wait(min(timeout, 5.0) if self._error else timeout)

    def _work(self):
        while not self._done.is_set():
            final = self._final  # read first: all lines written before `finish` are shipped before the run is closed
            try:
                if self._client is None:
                    self._connect()
                if self._lines.is_set():
                    self._lines.clear()
                    self._ship()
                if final is not None:
                    self._close(*final)
                    self._done.set()
                self._error = None
            except Exception as error:  # whatever a store raises must not end the thread, let alone the training
                # the call may have had its effect all the same: connect again, which asks MLflow where it stands
                self._client = None
                self._lines.set()
                self._failed(error)
            self._ready.set()
            self._pause()

    def _pause(self):
        if self._ended.is_set():
            time.sleep(RETRY_CLOSING if self._error else 0)
        else:
            self._ended.wait(RETRY if self._error else INTERVAL)
            self._lines.wait()

    def _failed(self, error):
        first = self._error is None
        lines = str(error).strip().splitlines()
        self._error = lines[0][:200] if lines else type(error).__name__
        if first:
            uri = mlflow_store.without_password(self._uri)
            self._warn(
                f"MLflow at {uri} does not answer; training goes on, metrics stay in metrics.jsonl ({self._error})"
            )

    def _connect(self):
        client = mlflow_store.make_client(self._uri)
        experiment_id = mlflow_store.ensure_experiment(client, self._uri, self._experiment)
        run_id = mlflow_store.ensure_run(client, self._uri, experiment_id, self._spec)
        mlflow_store.log_params(client, run_id, self._spec.params)
        # `iteration` is in every batch with its own step as value: the last one that MLflow has
        self._shipped, self._offset = int(client.get_run(run_id).data.metrics.get("iteration", 0)), 0
        self._client, self._run_id = client, run_id

    def _ship(self):
        path = metrics_path(self._spec.folder)
        while path.exists() and (batch := self._next_batch(path)):
            metrics, offset, step = batch
            if metrics:
                self._client.log_batch(self._run_id, metrics=metrics)
            self._offset, self._shipped = offset, step

    def _next_batch(self, path):
        """(metrics, offset behind them, last step) of the next whole lines that fit in a batch; None if there are none.

        Lines of steps that MLflow has are skipped.
        """
        from mlflow.entities import Metric

        metrics, offset, last = [], self._offset, self._shipped
        with open(path, "rb") as file:
            file.seek(offset)
            for raw in file:
                if not raw.endswith(b"\n"):
                    break
                line = json.loads(raw)
                step = int(line["iteration"])
                if step > last:
                    values = [
                        Metric(key, float(value), int(1000 * line["perf/time"]), step)
                        for key, value in line.items()
                        if isinstance(value, (int, float)) and math.isfinite(value)
                    ]
                    if metrics and len(metrics) + len(values) > BATCH:
                        break
                    metrics += values
                    last = step
                offset += len(raw)
        return (metrics, offset, last) if offset > self._offset else None

    def _close(self, status, metrics, files, milliseconds):
        from mlflow.entities import Metric

        values = [
            Metric(key, float(value), milliseconds, self._shipped)
            for key, value in metrics.items()
            if value is not None and math.isfinite(value)
        ]
        if values:
            self._client.log_batch(self._run_id, metrics=values)
        for file in files:
            if file.exists():
                self._client.log_artifact(self._run_id, str(file))
        self._client.set_terminated(self._run_id, status)


class NoTracker:
    """Stands for a `Tracker` where `tracking.enabled` is false."""

    def wake(self):
        """Nothing to log."""

    def wait_ready(self, timeout):
        """Always ready."""

    def finish(self, status, metrics=None, files=(), timeout=0.0):
        """Nothing to log."""
        return True


@dataclass(frozen=True)
class Tracking:
    """Where runs are logged. uri: None if nowhere. experiment: name. parent: the sweep's `RunSpec`, if there is one."""

    uri: str | None
    experiment: str
    parent: RunSpec | None = None

    def start(self, spec, warn=lambda line: None):
        """A `Tracker` of a run."""
        return NoTracker() if self.uri is None else Tracker(self.uri, self.experiment, spec, warn)


def run_spec(config, folder, parent=None):
    """How a run of `config` shows in MLflow: its parameters are the whole configuration but addresses and folders."""
    values = asdict(config)
    for own in ("out", "tracking"):
        del values[own]
    params = {re.sub(r"[^\w\-. /:]", "_", key): shown(value) for key, value in flatten(values)}
    tags = {"row": config.row, "seed": str(config.seed), "scale": config.scale, "motions": config.motions.name}
    return RunSpec(Path(folder), run_name(config.row, config.seed), {**tags, **commit_tag()}, params, parent)


def commit_tag():
    """{"git_commit": ...} of the code's repository, {} where there is none."""
    try:
        command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "HEAD"]
        result = subprocess.run(command, capture_output=True, text=True, timeout=5)
    except (OSError, subprocess.TimeoutExpired):
        return {}
    return {"git_commit": result.stdout.strip()} if result.returncode == 0 else {}
