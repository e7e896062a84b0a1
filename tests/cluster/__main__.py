"""A sweep on a cluster of several raylets on this machine, and on request one of them killed in the middle.

usage: python -m tests.cluster [--kill NODE] [--after ITERATION] [--workers N] [key=value ...]

Prints on which node each actor ran, and whether the run's metrics are those of the same run in one process. Exits with
0 if they are.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.cluster.nodes import ROOT, Nodes, has_dashboard

ROW = "ours-seed0"


def run_sweep(environment, out, *overrides, during=lambda: None, patience=1500):
    """Run the row `ours` at scale=smoke; (exit status, output). during: called twice a second while it runs."""
    words = ["sweeps/ablation.yaml", "scale=smoke", "rows=[ours]", "tracking.enabled=false", "report.enabled=false"]
    words += [f"out={out}", *overrides]
    deadline = time.monotonic() + patience
    with tempfile.TemporaryFile("w+") as output:
        process = subprocess.Popen(
            [sys.executable, "-m", "orchestrator.sweep", *words],
            cwd=ROOT,
            env=environment,
            stdout=output,
            stderr=subprocess.STDOUT,
        )
        try:
            while process.poll() is None:
                assert time.monotonic() < deadline, "the sweep takes too long"
                during()
                time.sleep(0.5)
        finally:
            process.kill()
            process.wait()
        output.seek(0)
        return process.returncode, output.read()


def metrics(out):
    """The lines of the run's metrics so far, without what depends on the clock."""
    path = Path(out) / ROW / "metrics.jsonl"
    lines = path.read_bytes().split(b"\n")[:-1] if path.exists() else []
    return [{k: v for k, v in json.loads(line).items() if not k.startswith("perf/")} for line in lines]


def killer(nodes, index, out, after):
    """A function for `during`: kills a node once the run has written iteration `after`."""
    killed = []

    def during():
        if not killed and len(metrics(out)) >= after:
            nodes.kill(index)
            killed.append(index)
            print(f"killed node {index} ({nodes.ip(index)}) after iteration {len(metrics(out))}", flush=True)

    return during


def main(arguments):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kill", type=int, metavar="NODE", help="1 or 2; 0 is the head")
    parser.add_argument("--after", type=int, default=3, metavar="ITERATION")
    parser.add_argument("--workers", type=int, default=3, metavar="N")
    options, overrides = parser.parse_known_args(arguments)
    overrides = [f"num_workers={options.workers}", "budget.iterations=8", *overrides]
    with tempfile.TemporaryDirectory() as folder:
        alone, together = f"{folder}/alone", f"{folder}/together"
        plain = {key: value for key, value in os.environ.items() if key != "RAY_ADDRESS"}
        status, output = run_sweep({**plain, "PYTHONPATH": str(ROOT)}, alone, *overrides, "runtime=local")
        assert status == 0, output
        with Nodes(cpus=(2, 2), head_cpus=1, dashboard=has_dashboard()) as nodes:
            during = killer(nodes, options.kill, together, options.after) if options.kill else lambda: None
            status, output = run_sweep(nodes.environment, together, *overrides, during=during)
            if nodes.dashboard:
                print("\n".join(f"{name} on {address}" for name, address in nodes.actors()))
        same = metrics(alone) == metrics(together)
        print(output, f"exit status {status}; metrics {'identical' if same else 'differ'}")
    return 0 if status == 0 and same else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
