"""Draws the learning curves of runs from MLflow.

Where they have been evaluated, also the share of tasks that they reach at all thresholds (artifact evaluation.json).
RUN is a run's name or id, with =TEXT how the figure shall call it; none: all training runs of the experiment. Of
several runs of one name, the one begun last.

  python docs/make_curves.py sqlite:///mlflow.db ablation curves.png
  python docs/make_curves.py sqlite:///mlflow.db ablation curves.png ours-seed0=Ours no_sbc-seed0="No SBC"
  python docs/make_curves.py sqlite:///a.db three curves.png ours-seed0=Adam --also sqlite:///b.db three ours-seed0
"""

import argparse
import json
import tempfile
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from motion.errors import InputError
from orchestrator import mlflow_store
from orchestrator.redaction import without_password
from orchestrator.tracking import one_line

plt.switch_backend("Agg")  # no screen needed

PANELS = (
    ("return/mean", "mean return"),
    ("achievement", "achievement rate"),
    ("thresholds/tightenings", "threshold tightenings (of 34)"),
)
SMOOTH = 5  # iterations of the running mean; a fiftieth of the run, if that is more
EVALUATION = "evaluation.json"
MOST = 50000  # runs, MLflow's limit of a search


@dataclass(frozen=True)
class Curves:
    """What is drawn of a run. samples: (iterations,); values: the same of each of PANELS' metrics, NaN for none.

    shares: share of tasks reached at 0, 1, ... tightenings, None if the run was not evaluated at all of them.
    """

    label: str
    samples: np.ndarray
    values: dict
    shares: list | None


def read(uri, experiment, chosen=()):
    """The `Curves` of an experiment's runs. chosen: RUNs of the command line. InputError if one is not there."""
    path = mlflow_store.sqlite_path(uri)
    if path and not path.exists():  # MLflow would make one
        raise InputError(f"{uri}: no such database")
    if "://" not in uri:  # MLflow would take it for a folder
        raise InputError(f"{uri}: not an address; give sqlite:///FILE or a server's")
    client = mlflow_store.make_client(uri)
    found = client.get_experiment_by_name(experiment)
    if found is None:
        names = ", ".join(sorted(other.name for other in client.search_experiments()))
        raise InputError(f"{without_password(uri)}: no experiment {experiment!r}; there are: {names}")
    # a sweep's own run has no iterations
    order = ["attributes.start_time ASC"]
    runs = client.search_runs([found.experiment_id], "metrics.iteration > 0", max_results=MOST, order_by=order)
    named = {run.info.run_name: run for run in runs}
    known = {**{run.info.run_id: run for run in runs}, **named}
    curves = []
    for name, _, label in (one.partition("=") for one in chosen or sorted(named)):
        if name not in known:
            there = ", ".join(sorted(named)) or "none"
            raise InputError(f"experiment {experiment!r}: no training run {name!r}; there are: {there}")
        curves.append(read_run(client, known[name].info.run_id, label or name))
    return curves


def read_run(client, run_id, label):
    """The `Curves` of one run."""
    samples = history(client, run_id, "samples")
    steps = sorted(samples)
    values = {}
    for key, _ in PANELS:
        there = history(client, run_id, key)
        values[key] = np.array([there.get(step, np.nan) for step in steps])
    shares = None
    if any(file.path == EVALUATION for file in client.list_artifacts(run_id)):
        with tempfile.TemporaryDirectory() as folder:
            content = json.loads(Path(client.download_artifacts(run_id, EVALUATION, folder)).read_text())
        if "by_accuracy" in content:  # not in older ones
            shares = [rung["reached"] / content["tasks"] for rung in content["by_accuracy"]]
    return Curves(label, np.array([samples[step] for step in steps]), values, shares)


def history(client, run_id, key):
    """{iteration: value} of a metric, all that were logged (the client asks for page after page)."""
    return {metric.step: metric.value for metric in client.get_metric_history(run_id, key)}


def draw(curves, out):
    """One panel per metric, one line per run."""
    count = len(PANELS) + any(one.shares for one in curves)
    figure, axes = plt.subplots(1, count, figsize=(4 * count, 3.2), layout="constrained")
    for number, one in enumerate(curves):
        color = f"C{number}"
        width = min(max(SMOOTH, len(one.samples) // 50), len(one.samples))
        for axis, (key, title) in zip(axes, PANELS):
            values = one.values[key]
            if key != "thresholds/tightenings":
                values = np.convolve(values, np.ones(width) / width, "valid")
            axis.plot(one.samples[-len(values) :] / 1e6, values, color=color, label=one.label)
            axis.set(title=title, xlabel="samples (millions)")
        if one.shares:
            axes[-1].plot(one.shares, color=color)
    if count > len(PANELS):
        axes[-1].set(title="share of tasks reached at n tightenings", xlabel="n (34: final accuracy)", ylim=(0, 1.02))
    for axis in axes:
        axis.grid(alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].legend(frameon=False, fontsize=8)
    figure.savefig(out, dpi=110)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("uri", metavar="TRACKING_URI")
    parser.add_argument("experiment", metavar="EXPERIMENT")
    parser.add_argument("out", metavar="OUT.png")
    parser.add_argument("runs", metavar="RUN", nargs="*", default=[])
    text = "TRACKING_URI EXPERIMENT [RUN ...]: runs from elsewhere in the same figure; last, any number of times"
    parser.add_argument("--also", metavar="...", nargs="+", action="append", default=[], help=text)
    given = parser.parse_args()
    sources = [[given.uri, given.experiment, *given.runs], *given.also]
    curves = []
    for uri, *rest in sources:
        try:
            if not rest:
                raise InputError(f"--also {uri}: no experiment given")
            curves += read(uri, rest[0], rest[1:])
        except Exception as error:  # whatever a store raises
            parser.exit(2, f"error: {one_line(error, uri)}\n")
    draw(curves, given.out)


if __name__ == "__main__":
    main()
