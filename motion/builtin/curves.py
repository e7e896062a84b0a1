"""Smooth curves through keys: monotone cubic Hermite, so that nothing overshoots and equal keys hold exactly still."""

import numpy as np


def curve(times, values, at, period=None, drift=0.0):
    """Values (N, D) at times `at` (N,) of the curve through keys `values` (K, D) at increasing `times` (K,) seconds.

    Without `period` the curve starts and ends at rest. With it the keys lie in [0, period) and the curve repeats, each
    cycle moved by `drift` (D,): its value and its rate are the same on both sides of the seam.
    """
    times, values = np.asarray(times, dtype=np.float64), np.asarray(values, dtype=np.float64)
    if period is not None:
        times = np.concatenate([times + period * k for k in (-1, 0, 1)])
        values = np.concatenate([values + np.asarray(drift) * k for k in (-1, 0, 1)])
    slopes = _slopes(times, values)
    i = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 2)
    width = (times[i + 1] - times[i])[:, None]
    s = np.clip((at - times[i])[:, None] / width, 0.0, 1.0)
    step = values[i + 1] - values[i]
    ease = s * s * (3 - 2 * s)
    return values[i] + step * ease + width * s * (1 - s) * ((1 - s) * slopes[i] - s * slopes[i + 1])


def _slopes(times, values):
    # Fritsch and Butland: the weighted harmonic mean of both sides' rates, zero at every local extreme
    width = np.diff(times)[:, None]
    rate = np.diff(values, axis=0) / width
    a, b = 2 * width[1:] + width[:-1], width[1:] + 2 * width[:-1]
    same = rate[:-1] * rate[1:] > 0
    before, after = np.where(same, rate[:-1], 1.0), np.where(same, rate[1:], 1.0)
    slopes = np.zeros_like(values)
    slopes[1:-1] = np.where(same, (a + b) / (a / before + b / after), 0.0)
    return slopes
