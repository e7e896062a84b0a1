"""Log runs to MLflow from a thread of their own. Training never waits for it, and no step is lost or doubled.

usage: python -m orchestrator.tracking sync FOLDER... [tracking.uri=ADDRESS]

  python -m orchestrator.tracking sync runs/ablation                all runs of a sweep
  python -m orchestrator.tracking sync runs/ablation/ours-seed0     one run, and its sweep's own entry

`sync` ships to MLflow what could not be shipped while the runs ran, or all of it to another server. What is there
already stays as it is: running it twice changes nothing. Address: MLFLOW_TRACKING_URI, else tracking.uri=, else
where the run was to be logged (passwords are never stored, so that an address with one has to be given again).
"""

# metrics.jsonl is the spool: the thread ships its lines in batches, in order, and takes up behind the last step that
# MLflow has (orchestrator/shipping.py). A server that is away is asked again until the run ends; what it did not take
# stays in the run's folder.

import contextlib
import re
import subprocess
import sys
import threading
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from orchestrator import spool
from orchestrator.mlflow_store import RunSpec
from orchestrator.plan import run_name
from orchestrator.redaction import redact, without_password
from orchestrator.settings import flatten
from orchestrator.shipping import Shipper
from orchestrator.system_metrics import Sampler
from orchestrator.validate import shown

INTERVAL = 2.0  # seconds between batches
RETRY = 15.0  # seconds between attempts while the server is away
RETRY_CLOSING = 1.0  # the same once the run has ended
UNANSWERED = 5.0  # seconds that a run's end waits for MLflow if it did not answer before
TROUBLED = 60.0  # the same if it stops answering then; longer only while it takes what it is given


class Tracker:
    """Logs one run. `wake()` after every line of metrics; `finish()` at the end.

    spec: the run, `mlflow_store.RunSpec`. experiment: its experiment's name. warn: called once with a line of text if
    MLflow does not answer.
    """

    def __init__(self, uri, experiment, spec, warn=lambda line: None):
        self._uri, self._experiment, self._spec, self._warn = uri, experiment, spec, warn
        self._shipper = self._error = None
        self._sampler = Sampler(spec.folder) if spec.system_metrics else None
        self._final = None  # `spool.Final` once the run has ended
        self._lines, self._ended = threading.Event(), threading.Event()
        self._ready, self._done = threading.Event(), threading.Event()
        self._arrived = False
        spool.record_spec(spec, experiment, uri)
        threading.Thread(target=self._work, name="mlflow", daemon=True).start()

    def wake(self):
        """There are new lines in metrics.jsonl. Returns at once."""
        self._lines.set()

    def wait_ready(self, timeout):
        """Wait until the run is there or the first attempt failed. None if it is there, else the reason (text)."""
        if not self._ready.wait(timeout):
            return f"no answer within {timeout:g} s"
        return self._error

    def finish(self, status, metrics=None, files=(), model=False, timeout=240.0):
        """Ship the rest, log final metrics and files (paths), set the run's status (FINISHED, FAILED, KILLED).

        model: register the policy of the newest checkpoint, too. Waits at most `timeout` seconds, less if MLflow has
        not answered before. True if all arrived; else the run's folder keeps the rest for `sync`.
        """
        final = final_of(self._spec.folder, status, metrics or {}, files, model)
        if self._sampler:
            self._sampler.stop()
        with contextlib.suppress(OSError):  # a full disk must not hide what it has caused; `sync` does without
            spool.record_final(self._spec.folder, final)
        self._final = final
        self._lines.set()
        self._ended.set()
        began, limit = time.monotonic(), min(timeout, UNANSWERED) if self._error else timeout
        while not self._done.wait(0.1) and time.monotonic() - began < limit:
            if self._error:
                limit = min(limit, TROUBLED)
        self._done.set()  # whoever ships next shall be the only one
        return self._arrived

    def _work(self):
        while not self._done.is_set():
            final = self._final  # read first: all lines written before `finish` are shipped before the run is closed
            try:
                if self._shipper is None:
                    self._shipper = Shipper(self._uri, self._experiment, self._spec)
                    if final is None:
                        self._shipper.running()
                if self._lines.is_set():
                    self._lines.clear()
                    self._shipper.ship()
                if final is not None:
                    self._shipper.close(final)
                    self._arrived = True
                    self._done.set()
                self._error = None
            except Exception as error:  # whatever a store raises must not end the thread, let alone the training
                # the call may have had its effect all the same: a new shipper asks MLflow where it stands
                self._shipper = None
                self._lines.set()
                self._failed(error)
            self._ready.set()
            self._pause()

    def _pause(self):
        if self._ended.is_set():
            self._done.wait(RETRY_CLOSING if self._error else 0)
        else:
            self._ended.wait(RETRY if self._error else INTERVAL)
            self._lines.wait()

    def _failed(self, error):
        first = self._error is None
        self._error = one_line(error, self._uri)
        if first:
            self._warn(
                f"MLflow at {without_password(self._uri)} does not answer; training goes on, metrics stay in "
                f"metrics.jsonl ({self._error})"
            )


def one_line(error, uri):
    """What an error of MLflow says, in one line and without secrets."""
    lines = redact(str(error), uri).strip().splitlines()
    return lines[0][:200] if lines else type(error).__name__


def final_of(folder, status, metrics, files, model=False):
    """`spool.Final` of a run that ends now."""
    names = [Path(file).relative_to(folder) if Path(file).is_relative_to(folder) else file for file in files]
    return spool.Final(status, int(time.time() * 1000), metrics, tuple(map(str, names)), model)


class NoTracker:
    """Stands for a `Tracker` where `tracking.enabled` is false: keeps in the folder what `sync` would need."""

    def __init__(self, experiment, spec):
        self._folder = spec.folder
        spool.record_spec(spec, experiment, None)

    def wake(self):
        """Nothing to log."""

    def wait_ready(self, timeout):
        """Always ready."""

    def finish(self, status, metrics=None, files=(), model=False, timeout=0.0):
        """Nothing to log."""
        with contextlib.suppress(OSError):
            spool.record_final(self._folder, final_of(self._folder, status, metrics or {}, files, model))
        return True


@dataclass(frozen=True)
class Tracking:
    """Where runs are logged. uri: None if nowhere. experiment: name. parent: the sweep's `RunSpec`, if there is one."""

    uri: str | None
    experiment: str
    parent: RunSpec | None = None

    def start(self, spec, warn=lambda line: None):
        """A `Tracker` of a run."""
        return NoTracker(self.experiment, spec) if self.uri is None else Tracker(self.uri, self.experiment, spec, warn)


def run_spec(config, folder, parent=None):
    """How a run of `config` shows in MLflow: its parameters are the whole configuration but addresses and folders."""
    values = asdict(config)
    for own in ("out", "tracking"):
        del values[own]
    params = {re.sub(r"[^\w\-. /:]", "_", key): shown(value) for key, value in flatten(values)}
    tags = {"row": config.row, "seed": str(config.seed), "scale": config.scale, "motions": config.motions.name}
    name, tags = run_name(config.row, config.seed), {**tags, **commit_tag()}
    return RunSpec(Path(folder), name, tags, params, parent, config.tracking.system_metrics)


def commit_tag():
    """Tags of the code's repository, {} where there is none: `git_commit`, `git_dirty` (whether files differ from it).

    Under MLflow's own names, too, by which its pages show the commit as the run's source.
    """
    git = ["git", "-C", str(Path(__file__).parent)]
    try:
        commit = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True, timeout=5)
        if commit.returncode != 0:
            return {}
        clean = subprocess.run([*git, "diff", "--quiet", "HEAD"], capture_output=True, timeout=5).returncode == 0
    except (OSError, subprocess.TimeoutExpired):
        return {}
    sha = commit.stdout.strip()
    source = {"mlflow.source.type": "LOCAL", "mlflow.source.name": "segue", "mlflow.source.git.commit": sha}
    return {"git_commit": sha, "git_dirty": str(not clean).lower(), **source}


def main(arguments):
    """Command line; returns the exit status, 0 only if MLflow has everything."""
    from orchestrator.sync import sync_command

    return sync_command(arguments)


if __name__ == "__main__":
    from orchestrator.console import run_command

    sys.exit(run_command(main, __doc__, sys.argv[1:]))
