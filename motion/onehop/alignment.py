"""Kovar et al. 2002: distance of two windows of body points under the best horizontal translation and yaw."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Alignment:
    """The rigid motion p -> R_z(yaw) p + (x, y, 0) applied to the second window. yaw: rad. x, y: m."""

    yaw: float
    x: float
    y: float


def align(a, b, weights=None):
    """D, m^2, and the Alignment of window b to window a, both (frames, P, 3).

    D is the weighted mean squared distance of corresponding points, least over all yaws and horizontal translations.
    weights: (frames, P) or whatever broadcasts to it, >= 0; None for equal ones. If every yaw is as good, yaw is 0.
    """
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    if a.shape != b.shape or a.ndim != 3 or a.shape[2] != 3:
        raise ValueError(f"windows have shapes {a.shape} and {b.shape}, not the same (frames, points, 3)")
    w = np.broadcast_to(1.0 if weights is None else np.asarray(weights, dtype=np.float64), a.shape[:2])
    w = w / w.sum()
    za, zb = a[..., 0] + 1j * a[..., 1], b[..., 0] + 1j * b[..., 1]
    # moved to the first point before the mean, so that a window far from the origin loses nothing
    mean_a, mean_b = za[0, 0] + np.sum(w * (za - za[0, 0])), zb[0, 0] + np.sum(w * (zb - zb[0, 0]))
    za, zb = za - mean_a, zb - mean_b
    yaw = float(np.angle(np.sum(w * za * zb.conj())))
    turn = np.exp(1j * yaw)
    # the residuals themselves, not a difference of sums: exact to rounding for similar windows too
    distance = float(np.sum(w * (np.abs(za - turn * zb) ** 2 + (a[..., 2] - b[..., 2]) ** 2)))
    shift = mean_a - turn * mean_b
    return distance, Alignment(yaw, float(shift.real), float(shift.imag))
