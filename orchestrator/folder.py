"""A run's folder: whether it is new, can be continued or is finished, and who may write to it."""

import contextlib
import dataclasses
import fcntl
import json
import os
import time
from dataclasses import replace
from pathlib import Path

from motion.errors import InputError
from orchestrator.mlflow_store import without_password
from orchestrator.settings import flatten, load, save
from orchestrator.validate import shown

NEW, UNFINISHED, FINISHED = "new", "unfinished", "finished"

# Keys that change no number of a run: another value continues it
FREE = (
    "out", "runtime", "worker_threads", "spare_threads", "tracking.", "report.", "checkpoint.", "faults.",
    "physics.max_unstable_share", "ppo.max_skipped",
)  # fmt: skip
BUDGET = ("budget.",)  # may be raised
EVALUATION = ("evaluation.",)  # another value needs another evaluation, but no other training


def config_path(folder):
    return Path(folder) / "config.yaml"


def evaluation_path(folder):
    return Path(folder) / "evaluation.json"


def metrics_path(folder):
    return Path(folder) / "metrics.jsonl"


def stop_path(folder):
    """A file that asks the run in a folder to write a checkpoint and stop."""
    return Path(folder) / "stop"


def differences(one, other):
    """[(key, value in one, value in other)] of two `Config`s."""
    first, second = (dict(flatten(dataclasses.asdict(config))) for config in (one, other))
    return [(k, first.get(k), second.get(k)) for k in {**first, **second} if first.get(k) != second.get(k)]


def state_of(folder, config):
    """NEW, UNFINISHED or FINISHED: what is left to do for `config` in `folder`.

    InputError if the folder holds a run of another configuration, naming the first key that differs.
    """
    path = config_path(folder)
    if not path.exists():
        if metrics_path(folder).exists():
            raise InputError(f"{folder}: holds metrics but no config.yaml; choose another out= or delete this folder")
        return NEW
    changed = [entry for entry in differences(load(path), config) if not entry[0].startswith(FREE)]
    changed = [entry for entry in changed if entry[0] != "device" or entry[2] != "auto"]  # auto: as it was
    for key, old, new in changed:
        if not key.startswith(BUDGET + EVALUATION):
            raise InputError(
                f"{folder}: holds a run with {key}={shown(old)}, asked for {key}={shown(new)}; "
                "choose another out= or delete this folder"
            )
    done = iterations_done(folder)
    if any(key.startswith(BUDGET) for key, _, _ in changed) and config.total_iterations < done:
        raise InputError(
            f"{folder}: holds a run of {done} iterations, more than the {config.total_iterations} of the budget; "
            "raise budget.samples or budget.iterations, choose another out= or delete this folder"
        )
    return FINISHED if iterations_evaluated(folder) >= config.total_iterations and not changed else UNFINISHED


def iterations_evaluated(folder):
    """Iterations of the checkpoint that evaluation.json tells of; 0 if there is none. It may be of a run half done."""
    try:
        return int(json.loads(evaluation_path(folder).read_text())["iterations"])
    except (FileNotFoundError, ValueError, KeyError):
        return 0


def iterations_done(folder):
    """Iterations in the run's metrics; 0 if there are none."""
    last = last_metrics(folder)
    return int(last["iteration"]) if last else 0


def last_metrics(folder):
    """The last whole line of metrics.jsonl as a dict, None if there is none."""
    try:
        lines = metrics_path(folder).read_bytes().split(b"\n")
    except FileNotFoundError:
        return None
    return json.loads(lines[-2]) if len(lines) > 1 else None


def prepare(folder, config):
    """Make an unfinished run's folder ready: config.yaml is `config`, and no evaluation of an earlier budget stays."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    # in this order, so that a kill in between never leaves an old evaluation beside a new configuration
    evaluation_path(folder).unlink(missing_ok=True)
    save(without_secrets(config), config_path(folder))


def without_secrets(config):
    """The configuration as it may be stored and logged: without a password in the tracking address."""
    uri = config.tracking.uri
    return replace(config, tracking=replace(config.tracking, uri=uri and without_password(uri)))


def check_writable(folder):
    """Make `folder`; InputError unless files can be made in it."""
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f".writable-{os.getpid()}"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise InputError(f"out={folder}: cannot be written ({error.strerror or error}); choose another out=") from error


@contextlib.contextmanager
def exclusive(folder, wait=0.0):
    """Hold `folder` for this process; InputError if another holds it for longer than `wait` seconds.

    The kernel frees it when the process dies, however it dies.
    """
    with open(Path(folder) / ".lock", "a") as file:
        deadline = time.monotonic() + wait
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() >= deadline:
                    raise InputError(
                        f"{folder}: another process is running in this folder; wait for it or choose another out="
                    ) from None
                time.sleep(0.2)
        yield
