"""`python -m orchestrator.tracking sync`: ship what runs' folders hold and MLflow does not."""

import contextlib
import json
import os
import sys
from dataclasses import replace
from pathlib import Path

from motion.errors import InputError
from orchestrator import folder as run_folder
from orchestrator import mlflow_store, spool
from orchestrator.settings import load
from orchestrator.shipping import Shipper
from orchestrator.spool import Final
from orchestrator.tracking import final_of, one_line

KEY = "tracking.uri="
OF_A_SWEEP = ("table.*", "baselines.*", "report.html", "figures")  # what its folder holds besides its runs


def sync_command(arguments):
    """The command line; returns the exit status, 0 only if MLflow has everything of every folder."""
    named = [Path(argument).absolute() for argument in arguments[1:] if not argument.startswith(KEY)]
    chosen = [argument.removeprefix(KEY) for argument in arguments if argument.startswith(KEY)]
    if arguments[:1] != ["sync"] or not named:
        raise InputError("expected: python -m orchestrator.tracking sync FOLDER... [tracking.uri=ADDRESS]")
    complete = True
    for folder in dict.fromkeys(target for one in named for target in targets(one)):
        done, line = sync(folder, address_of(folder, chosen[-1] if chosen else None))
        print(line, file=sys.stdout if done else sys.stderr, flush=True)
        complete &= done
    return 0 if complete else 1


def targets(folder):
    """The folders to ship for one that was named: a sweep and its runs, or a run and (before it) its sweep."""
    if (own := spool.read_spec(folder)) is None and not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    children = [path for path in sorted(folder.iterdir()) if path.is_dir() and spool.read_spec(path)]
    if own is None and not children:
        raise InputError(f"{folder}: holds no run to ship (.tracking/run.json is missing); name a run's or a sweep's")
    above = [own[0].parent.folder] if own and own[0].parent else []
    return above + [folder] * (own is not None) + children


def address_of(folder, chosen):
    """MLFLOW_TRACKING_URI, else the chosen address, else the one that the run was to be logged at."""
    uri = os.environ.get("MLFLOW_TRACKING_URI") or chosen or spool.read_uri(folder)
    if uri is None:
        raise InputError(f"{folder}: was not logged anywhere; give tracking.uri= or set MLFLOW_TRACKING_URI")
    if "***" in uri:
        raise InputError(f"{folder}: the password of {uri} is not stored; set MLFLOW_TRACKING_URI to the whole address")
    return mlflow_store.absolute(uri)


def sync(folder, uri):
    """Ship one folder. (whether MLflow has everything, a line for the terminal)."""
    spec, experiment = spool.read_spec(folder)
    try:
        with contextlib.ExitStack() as held:
            try:
                held.enter_context(run_folder.exclusive(folder))
            except InputError:
                return False, f"{spec.name}: not shipped: a process is running in {folder}; it ships the run itself"
            final = spool.read_final(folder) or end_of(folder)
            spool.record_final(folder, final)
            shipper = Shipper(uri, experiment, spec)
            shipper.ship()
            was = shipper.closed(final)
            shipper.close(final)
    except Exception as error:
        return False, f"{spec.name}: not shipped: {one_line(error, uri)}"
    what = f"{shipper.new} of {shipper.shipped} steps" if shipper.new else f"nothing new, {shipper.shipped} steps"
    ending = final.status if was else f"{final.status} set"
    return True, f"{spec.name}: {what}; {ending}; run {shipper.run_id} of experiment {experiment}"


def end_of(folder):
    """`Final` of a run or sweep whose process died before it could note one: by the files that it left."""
    started = folder / spool.FOLDER / "run.json"
    table, error = folder / "table.json", folder / "error.txt"
    if run_folder.evaluation_path(folder).exists():
        from orchestrator.trial import logged_at_end

        evaluation = json.loads(run_folder.evaluation_path(folder).read_text())
        ending = logged_at_end(folder, load(run_folder.config_path(folder)), evaluation)
        return _at(run_folder.evaluation_path(folder), final_of(folder, "FINISHED", *ending))
    if table.exists() and table.stat().st_mtime >= started.stat().st_mtime:
        runs = [run for row in json.loads(table.read_text())["rows"] for run in row["runs"]]
        status = "FINISHED" if all(run["status"] == "finished" for run in runs) else "FAILED"
        files = [path for pattern in OF_A_SWEEP for path in sorted(folder.glob(pattern))]
        return _at(table, final_of(folder, status, {}, files))
    if error.exists() and error.stat().st_mtime >= started.stat().st_mtime:
        return _at(error, Final("FAILED", 0))
    metrics = run_folder.metrics_path(folder)
    return _at(metrics if metrics.exists() else started, Final("KILLED", 0))


def _at(path, final):
    """The `Final` at the time of a file."""
    return replace(final, milliseconds=path.stat().st_mtime_ns // 1_000_000)
