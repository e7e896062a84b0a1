"""Load of the machine that a run's loop runs on, under the names that MLflow shows as system metrics.

A thread of its own reads it with MLflow's monitors (processors, memory, disk, network, GPUs) and appends it to
.tracking/system.jsonl in the run's folder, from where it is shipped as the run's metrics are. It is no part of the
run's numbers: another folder, another clock, its own steps.
"""

import contextlib
import json
import threading
import time

from orchestrator.spool import system_path

INTERVAL = 10.0  # seconds between samples, as MLflow has it
FIRST = 1.0  # seconds until the first: a short run has some, too
PREFIX = "system/"


class Sampler:
    """Samples until `stop()`."""

    def __init__(self, folder):
        """folder: of the run. A run that continues continues its samples."""
        self._path, self._stop = system_path(folder), threading.Event()
        self._thread = threading.Thread(target=self._work, name="system-metrics", daemon=True)
        self._thread.start()

    def stop(self):
        """Take a last sample and end."""
        self._stop.set()
        self._thread.join(timeout=2.0)

    def _work(self):
        # whatever a monitor or the disk raises: a run must not suffer from being watched
        with contextlib.suppress(Exception):
            read = monitors()
            sample(read)  # the first share of processor time is since the machine's start
            number, wait = whole_lines(self._path), FIRST
            while True:
                stopped = self._stop.wait(wait)
                number, wait = number + 1, INTERVAL
                line = {"step": number, "milliseconds": int(time.time() * 1000), "metrics": sample(read)}
                with open(self._path, "a") as file:
                    file.write(json.dumps(line) + "\n")
                if stopped:
                    return


def monitors():
    """MLflow's monitors of what this machine has."""
    # the monitors import psutil, which Ray's wheel carries and puts on the path
    import ray  # noqa: F401, I001
    from mlflow.system_metrics.metrics.cpu_monitor import CPUMonitor
    from mlflow.system_metrics.metrics.disk_monitor import DiskMonitor
    from mlflow.system_metrics.metrics.gpu_monitor import GPUMonitor
    from mlflow.system_metrics.metrics.network_monitor import NetworkMonitor

    found = [CPUMonitor(), DiskMonitor(), NetworkMonitor()]
    with contextlib.suppress(Exception):  # no GPU, or nvidia-ml-py is not installed
        found.append(GPUMonitor())
    return found


def sample(read):
    """One value of everything that the monitors read, by its name in MLflow."""
    values = {}
    for monitor in read:
        monitor.collect_metrics()
        values |= {PREFIX + key: round(value, 3) for key, value in monitor.aggregate_metrics().items()}
        monitor.clear_metrics()
    return values


def whole_lines(path):
    """Number of whole lines in a file; the rest of a line that a crash cut off goes."""
    data = path.read_bytes() if path.exists() else b""
    whole = data[: data.rfind(b"\n") + 1]
    if whole != data:
        path.write_bytes(whole)
    path.parent.mkdir(parents=True, exist_ok=True)
    return whole.count(b"\n")
