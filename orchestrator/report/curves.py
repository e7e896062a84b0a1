"""Fig. 4: mean return and reductions of the thresholds during training, per row, over iterations, samples, time."""

from dataclasses import dataclass

import numpy as np

AXES = {"iterations": "iteration", "samples": "samples", "minutes": "perf/seconds"}
SCALES = {"minutes": 1 / 60}
QUANTITIES = {"return": "return/mean", "reductions": "thresholds/tightenings"}
POINTS = 300  # of a drawn curve
SMOOTH = 0.04  # share of a run's iterations over which the return's running mean goes, five at least


@dataclass(frozen=True)
class Curve:
    """A row's curve: x (n,), mean, low and high (n,) over its seeds; `seeds` of them reach the end of x."""

    x: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray
    seeds: int


def curve(runs, axis, quantity):
    """The `Curve` of a row's runs (`RunData`), None if none has a line. It ends where the shortest run ends.

    low, high: the lowest and the highest seed. axis: of AXES; quantity: of QUANTITIES.
    """
    runs = [run for run in runs if len(run.curves["iteration"])]
    if not runs:
        return None
    xs = [run.curves[AXES[axis]] * SCALES.get(axis, 1) for run in runs]
    ys = [run.curves[QUANTITIES[quantity]] for run in runs]
    if quantity == "return":
        ys = [running_mean(y, max(5, round(SMOOTH * len(y)))) for y in ys]
    at = xs[0] if len(runs) == 1 else np.linspace(max(x[0] for x in xs), min(x[-1] for x in xs), POINTS)
    if len(at) > POINTS:
        at = at[np.unique(np.linspace(0, len(at) - 1, POINTS).astype(int))]
    values = np.array([held(at, x, y) if quantity == "reductions" else between(at, x, y) for x, y in zip(xs, ys)])
    return Curve(at, values.mean(axis=0), values.min(axis=0), values.max(axis=0), len(runs))


def running_mean(values, window):
    """(n,) mean of the last `window` values that are known, NaN where none is."""
    known = np.isfinite(values)
    sums = np.cumsum(np.concatenate([[0.0], np.where(known, values, 0.0)]))
    counts = np.cumsum(np.concatenate([[0], known]))
    first = np.maximum(np.arange(len(values)) + 1 - window, 0)
    last = np.arange(len(values)) + 1
    count = counts[last] - counts[first]
    return np.where(count > 0, (sums[last] - sums[first]) / np.maximum(count, 1), np.nan)


def between(at, x, y):
    """(m,) y at `at`, linear between the points that are known; NaN before the first."""
    known = np.isfinite(y)
    if not known.any():
        return np.full(len(at), np.nan)
    return np.interp(at, x[known], y[known], left=np.nan)


def held(at, x, y):
    """(m,) y of the last x that is not after `at`: of what changes in steps."""
    return y[np.maximum(np.searchsorted(x, at, side="right") - 1, 0)]
