"""The report's charts as SVG text in the page's colours (`motion.picture`)."""

import numpy as np

from motion.picture import drawing, palette

ROWS = 8  # colours of rows; more share them, with other dashes
COLOURS = palette(*(f"row{i}" for i in range(ROWS)))
DASHES = ("-", (0, (5, 1.5)), (0, (1.5, 1.2)), (0, (6, 1.5, 1.5, 1.5)))
LABELS = {
    "iterations": "iterations", "samples": "samples", "minutes": "minutes of training",
    "return": "mean return", "reductions": "reductions of the thresholds",
}  # fmt: skip
# colour-blind safe (Okabe and Ito), lighter on dark
LIGHT = ("#0072b2", "#d55e00", "#009e73", "#b0579a", "#8a6d00", "#2f8fc4", "#7a4a2a", "#5b5b5b")
DARK = ("#5db0f0", "#ff8f4d", "#3ecfa3", "#e79bd0", "#e6c13a", "#8fd3ff", "#c99872", "#b5b5b5")


def line_style(number):
    """matplotlib's keywords for the row of this number: a colour of its own and, from the first on, other dashes."""
    return {"color": COLOURS[f"row{number % ROWS}"], "ls": DASHES[(number % ROWS + number // ROWS) % len(DASHES)]}


def training(name, curves, axis, quantity, final=None):
    """Fig. 4 (a) or (b). curves: [(label, `curves.Curve` or None)], by row. final: reductions to the final accuracy."""
    title = f"{LABELS[quantity]} against {LABELS[axis]}"
    with drawing(COLOURS, name, title, 4.6, 2.9) as (_, draw, out):
        for number, (label, curve) in enumerate(curves):
            if curve is None:
                continue
            keywords = line_style(number)
            if curve.seeds > 1:
                draw.fill_between(curve.x, curve.low, curve.high, color=keywords["color"], alpha=0.18, lw=0)
            step = {"drawstyle": "steps-post"} if quantity == "reductions" and curve.seeds == 1 else {}
            draw.plot(curve.x, curve.mean, label=label, **keywords, **step)
        if final and quantity == "reductions":
            top = max((curve.high.max() for _, curve in curves if curve), default=0)
            if top > 0.5 * final:
                draw.axhline(final, color=COLOURS["faint"], lw=0.8)
                draw.annotate("final accuracy", (0.02, final), xycoords=("axes fraction", "data"), xytext=(0, -9),
                              textcoords="offset points", fontsize=8, color=COLOURS["faint"])  # fmt: skip
            draw.yaxis.get_major_locator().set_params(integer=True)
        if axis == "samples":
            draw.xaxis.set_major_formatter(lambda value, _: count(value))
        draw.set_xlabel(LABELS[axis])
        draw.set_ylabel(LABELS[quantity])
        draw.set_xlim(left=0)
        draw.grid(lw=0.6)
    return out["svg"]


def by_rotation(name, rows):
    """Share of tasks reached against the target's turn. rows: [(label, by_rotation of evaluation.json or None)]."""
    with drawing(COLOURS, name, "Share of tasks reached against the turn", 4.6, 2.7) as (_, axis, out):
        for number, (label, bins) in enumerate(rows):
            bins = [entry for entry in bins or () if entry["tasks"]]
            if bins:
                middle = np.degrees([(entry["low"] + entry["high"]) / 2 for entry in bins])
                share = [entry["reached_trained"] / entry["tasks"] for entry in bins]
                axis.plot(middle, share, label=label, **line_style(number))
        axis.set_xlabel("turn of the target (degrees)")
        axis.set_ylabel("share of tasks reached")
        axis.set_ylim(0, 1.02)
        axis.grid(lw=0.6)
    return out["svg"]


def by_accuracy(name, rows):
    """Share of tasks reached at all thresholds. rows: [(label, `heat.accuracies`)]."""
    with drawing(COLOURS, name, "Share of tasks reached against the thresholds", 4.6, 2.7) as (_, axis, out):
        for number, (label, points) in enumerate(rows):
            if points:
                axis.plot(*zip(*points), label=label, **line_style(number))
                axis.set_xlim(0, points[-1][0])
        axis.set_xlabel("reductions of the thresholds (right end: final accuracy)")
        axis.set_ylabel("share of tasks reached")
        axis.set_ylim(0, 1.02)
        axis.grid(lw=0.6)
    return out["svg"]


def count(value):
    """A number of samples in short: 0, 500k, 2M, 4G."""
    for limit, unit in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if value >= limit:
            return f"{value / limit:g}{unit}"
    return f"{value:g}"
