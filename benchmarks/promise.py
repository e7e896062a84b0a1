"""What it costs that nothing is lost: checkpoints, the lines of metrics.jsonl, and shipping them to MLflow.

    python -m benchmarks.promise [--json] [--iterations 41] [key=value ...]

Trains at scale=laptop in this process (runtime=local: nothing overlaps with the costs, the worst case) and adds up, in
the same run, the wall time of every checkpoint and line, and the CPU time of the thread that ships to MLflow (SQLite).
Printed as shares of the training time; connecting to MLflow, once per run, is listed apart.
"""

import argparse
import contextlib
import json
import tempfile
import time
from dataclasses import replace
from pathlib import Path

from benchmarks.throughput import build_config
from orchestrator import run
from orchestrator.history import History
from orchestrator.shipping import Shipper
from orchestrator.tracking import Tracker, run_spec


class Stopwatch:
    """Adds up the time that functions take. clock: `time.perf_counter`, or `time.thread_time` for another thread."""

    def __init__(self):
        self.seconds = {}

    @contextlib.contextmanager
    def watching(self, name, owner, method, clock):
        """Time every call of owner.method within this context."""
        original = getattr(owner, method)

        def timed(*arguments, **keywords):
            begun = clock()
            try:
                return original(*arguments, **keywords)
            finally:
                self.seconds[name] = self.seconds.get(name, 0.0) + clock() - begun

        setattr(owner, method, timed)
        try:
            yield
        finally:
            setattr(owner, method, original)


def measure(config):
    """Seconds by name, `training` among them: the time between the first and the last iteration's report."""
    watch, reports = Stopwatch(), []
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        folder = Path(folder)
        for name, owner, method, clock in (
            ("checkpoints", run._Loop, "_save", time.perf_counter),
            ("lines", History, "write", time.perf_counter),
            ("shipping", Shipper, "ship", time.thread_time),
            ("connecting", Shipper, "__init__", time.thread_time),
        ):
            stack.enter_context(watch.watching(name, owner, method, clock))
        (folder / "run").mkdir()
        tracker = Tracker(f"sqlite:///{folder}/mlflow.db", "benchmark", run_spec(config, folder / "run"))
        tracker.wait_ready(120.0)

        def report(metrics):
            reports.append(time.perf_counter())
            if len(reports) == 1:  # compiled and connected: what counts begins here
                watch.seconds |= dict.fromkeys(("checkpoints", "lines", "shipping"), 0.0)
            tracker.wake()

        run.train(config, folder / "run", report)
        arrived = tracker.finish("FINISHED")
    if not arrived:
        raise RuntimeError("MLflow did not take everything")
    return {**watch.seconds, "training": reports[-1] - reports[0]}


def main():
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one last line with every figure")
    parser.add_argument("--iterations", type=int, default=41)
    parser.add_argument("overrides", nargs="*", help="configuration, key=value")
    options = parser.parse_args()
    config = build_config(options.overrides, runtime="local")
    config = replace(config, budget=replace(config.budget, samples=None, iterations=options.iterations))
    seconds = measure(config)
    training = seconds["training"]
    names = ("checkpoints", "lines", "shipping")
    shares = {name: seconds[name] / training for name in names}
    shares["all"] = sum(shares.values())
    for name, share in shares.items():
        print(f"{name:12s} {share:8.2%} of the training time")
    print(f"training {training:.1f} s, {options.iterations - 1} updates, checkpoint every {config.checkpoint.every}")
    print(f"connecting to MLflow, once: {seconds['connecting']:.2f} s of CPU")
    if options.json:
        print(json.dumps({"shares": shares, "seconds": seconds}))


if __name__ == "__main__":
    main()
