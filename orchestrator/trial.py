"""One run from start to end, wherever it lives: train (or continue), evaluate, log to MLflow."""

import contextlib
import re
import time
import traceback
from pathlib import Path

from learner import checkpoint
from motion.errors import InputError
from orchestrator import folder as run_folder
from orchestrator.evaluate import evaluate_run
from orchestrator.progress import EVALUATING
from orchestrator.run import Stopped, train
from orchestrator.settings import load
from orchestrator.tracking import run_spec

FILES = ("config.yaml", "evaluation.json", "failures.csv", "baselines.json", "baselines.md")
EVALUATED = {
    "eval": "metrics",
    "trained": "trained",
    "eval_deterministic": "deterministic",
    "trained_deterministic": "trained_deterministic",
}
STALE_LOCK = 60.0  # seconds that a killed sweep's processes may take to let go of a run's folder


def execute(config, folder, tracking, report, warn=lambda line: None, notice=None, stop=lambda: False):
    """Do all that is left of a run in its prepared folder; returns evaluation.json's content.

    report: called with every iteration's metrics, and with {"phase": EVALUATING} in between. warn: called with lines of
    text, from any thread; notice (default: warn) with others, from this thread alone. When stop() becomes true,
    `orchestrator.run.Stopped` is raised after a checkpoint. An error leaves error.txt.
    """
    folder, notice = Path(folder), notice or warn
    with run_folder.exclusive(folder, STALE_LOCK):
        tracker = tracking.start(run_spec(config, folder, tracking.parent), warn)
        try:
            train(config, folder, lambda metrics: (tracker.wake(), report(metrics)), stop, notice)
            report({"phase": EVALUATING})
            evaluation = evaluate_run(folder, config)
        except BaseException as error:
            stopped = not isinstance(error, Exception)
            if not stopped:
                with contextlib.suppress(OSError):  # a full disk must not hide what it has caused
                    (folder / "error.txt").write_text(traceback.format_exc())
            tracker.finish("KILLED" if stopped else "FAILED", timeout=2.0 if stopped else 30.0)
            raise
        (folder / "error.txt").unlink(missing_ok=True)
        if not tracker.finish("FINISHED", *logged_at_end(folder, config, evaluation)):
            notice(f"MLflow lacks some of it; to ship that: python -m orchestrator.tracking sync {folder}")
        return evaluation


def logged_at_end(folder, config, evaluation):
    """(metrics, files, whether to register its policy) that a finished run adds to what its iterations logged."""
    files = [folder / name for name in FILES if (folder / name).exists()]
    if config.checkpoint.storage is None:  # what lies in a storage of its own is not copied to another
        files += checkpoint.paths(folder / "checkpoints")[-1:]
    return evaluation_metrics(evaluation), files, config.tracking.register_model


def evaluation_metrics(evaluation):
    """The table's columns by their names in MLflow, as far as the evaluation has them.

    eval/...: at the final accuracy; trained/...: at the thresholds to which training came; both with the noise of the
    evaluation. The same without noise: eval_deterministic/..., trained_deterministic/...
    """
    found = {name: evaluation.get(part, {}) for name, part in EVALUATED.items()}
    return {f"{name}/{key}": value for name, values in found.items() for key, value in values.items()}


def reason(error):
    """An exception as one line for the terminal and the table: the cause, not Ray's wrapping."""
    cause = getattr(error, "cause", None) or error
    lines = [line.strip() for line in re.sub(r"\x1b\[\d*m", "", str(cause)).splitlines() if line.strip()]
    if type(cause).__module__.startswith("ray.") and len(lines) > 1:
        return lines[-1][:300]  # Ray's message ends with the traceback of another process, whose last line is the cause
    return f"{type(cause).__name__}: {lines[0] if lines else 'no message'}"[:300]


class Throttle:
    """Passes on a run's reports, at most one in `interval` seconds; always the first, and the last before a new phase.

    What a report costs must not slow the run, and the clock decides over nothing else.
    """

    def __init__(self, report, interval=1.0):
        self._report, self._interval, self._last, self._held = report, interval, None, None

    def __call__(self, message):
        new_phase = "phase" in message
        if new_phase and self._held is not None:
            self._report(self._held)
        now = time.monotonic()
        if new_phase or self._last is None or now - self._last >= self._interval:
            self._report(message)
            self._last, self._held = time.monotonic(), None
        else:
            self._held = message


def trainable(job, tracking):
    """Ray Tune's function: one run of a sweep. job: {"job": {name, folder}}; the configuration is in the folder.

    An error is reported, not raised: Tune starts a trial again that raised, and the error would come back. What it may
    start again is a trial whose process or machine died; the run then continues.
    """
    from ray import tune

    folder = Path(job["job"]["folder"])
    try:
        if not folder.is_dir():
            raise InputError(f"{folder} is not on this machine; out= must be on storage that all machines share")
        config = load(run_folder.config_path(folder))
        execute(
            config, folder, tracking, Throttle(tune.report),
            notice=lambda line: tune.report({"notice": line}), stop=run_folder.stop_path(folder).exists,
        )  # fmt: skip
    except Stopped:
        tune.report({"stopped": True})
    except Exception as error:
        tune.report({"failure": reason(error)})
