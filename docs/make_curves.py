"""Learning curves of a sweep's runs from their metrics.jsonl: python docs/make_curves.py SWEEP_FOLDER OUT.png

Where they have been evaluated, also the share of tasks that they reach at all thresholds.
"""

import json
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

plt.switch_backend("Agg")  # no screen needed

PANELS = (
    ("return/mean", "mean return"),
    ("achievement", "achievement rate"),
    ("thresholds/tightenings", "threshold tightenings (of 34)"),
)
SMOOTH = 5  # iterations of the running mean; a fiftieth of the run, if that is more


def main(folder, out):
    """One panel per metric, one line per run."""
    paths = sorted(Path(folder).glob("*/evaluation.json"))
    contents = {path.parent.name: json.loads(path.read_text()) for path in paths}
    evaluations = {name: content for name, content in contents.items() if "by_accuracy" in content}  # not in older ones
    count = len(PANELS) + bool(evaluations)
    figure, axes = plt.subplots(1, count, figsize=(4 * count, 3.2), layout="constrained")
    colors = {}
    for path in sorted(Path(folder).glob("*/metrics.jsonl")):
        lines = [json.loads(line) for line in path.read_text().splitlines()]
        samples = np.array([line["samples"] for line in lines]) / 1e6
        width = max(SMOOTH, len(lines) // 50)
        for axis, (key, title) in zip(axes, PANELS):
            values = np.array([np.nan if line[key] is None else line[key] for line in lines], dtype=float)
            if key != "thresholds/tightenings":
                values = np.convolve(values, np.ones(width) / width, "valid")
            (drawn,) = axis.plot(samples[-len(values) :], values, label=path.parent.name)
            colors[path.parent.name] = drawn.get_color()
            axis.set(title=title, xlabel="samples (millions)")
    for name, content in evaluations.items():
        shares = [rung["reached"] / content["tasks"] for rung in content["by_accuracy"]]
        axes[-1].plot(shares, color=colors[name])
        axes[-1].set(title="share of tasks reached at n tightenings", xlabel="n (34: final accuracy)", ylim=(0, 1.02))
    for axis in axes:
        axis.grid(alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].legend(frameon=False, fontsize=8)
    figure.savefig(out, dpi=110)


if __name__ == "__main__":
    main(*sys.argv[1:])
