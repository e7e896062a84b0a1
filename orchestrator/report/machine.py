"""What the report says of the machine and of how long the runs took."""

import os
import platform
from importlib import metadata
from pathlib import Path

import numpy as np

from orchestrator.tracking import commit_tag

PACKAGES = ("mujoco-core", "torch", "ray", "numpy", "numba", "mlflow")


def versions():
    """[(name, version)] of Python and of the packages that a run's numbers depend on."""
    found = [("Python", platform.python_version())]
    for package in PACKAGES:
        try:
            found.append((package, metadata.version(package)))
        except metadata.PackageNotFoundError:
            pass
    commit = commit_tag().get("git_commit")
    return [*found, ("commit", commit[:10])] if commit else found


def processor():
    """The processor's name and cores, in words."""
    name = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        name = next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    cores = os.cpu_count() or 1
    return f"{name}, {cores} core{'s' * (cores > 1)}, {platform.system()}"


def efforts(runs):
    """[(run's name, iterations, samples, minutes of training, samples per second)] of those that have begun."""
    rows = []
    for run in runs:
        curves = run.curves
        if len(curves["iteration"]):
            last = {name: values[-1] for name, values in curves.items()}
            speed = float(np.nanmedian(curves["perf/samples_per_second"]))
            rows.append((run.name, int(last["iteration"]), int(last["samples"]), last["perf/seconds"] / 60, speed))
    return rows


def period(runs):
    """(begin, end) of the training in s since 1970, None if no run has begun."""
    begun = [run.curves for run in runs if len(run.curves["iteration"])]
    if not begun:
        return None
    first = min(curves["perf/time"][0] for curves in begun)
    return float(first), float(max(curves["perf/time"][-1] for curves in begun))
