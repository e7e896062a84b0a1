"""Where the feet are: keys of standing, rolling and stepping feet, and the ankle's pose that follows from them."""

from dataclasses import dataclass, replace

import numpy as np

from motion import rotations
from motion.builtin import curves

ANKLE = 0.05  # height of the foot body's origin over a flat sole, m
TOE, HEEL = 0.1335, -0.0435  # sole's edges along the foot's x, m


@dataclass(frozen=True)
class Foot:
    """A key: the flat foot's place x, y (m), its yaw and pitch (degrees, heel up positive), the sole's lift (m)."""

    x: float
    y: float
    yaw: float
    pitch: float = 0.0
    lift: float = 0.0
    time: float = 0.0

    def at(self, time, **changes):
        """The same key at another time, with changes."""
        return replace(self, time=time, **changes)

    def moved(self, x=0.0, y=0.0, yaw=0.0):
        """The place moved by x, y (m) and turned by yaw (degrees)."""
        return replace(self, x=self.x + x, y=self.y + y, yaw=self.yaw + yaw)


def step(start, end, source, target, lift=0.06, toe_off=20.0, heel=0.0):
    """Keys of a step between two flat places: up from `start`, down at `end` with the heel `heel` degrees first."""
    length = end - start
    middle = start + 0.5 * length
    keys = [
        source.at(start),
        source.at(start + 0.25 * length, pitch=toe_off, lift=0.3 * lift, x=source.x + 0.1 * (target.x - source.x)),
        target.at(
            middle,
            x=0.5 * (source.x + target.x),
            y=0.5 * (source.y + target.y),
            yaw=0.5 * (source.yaw + target.yaw),
            pitch=0.4 * toe_off,
            lift=lift,
        ),
    ]
    if heel:
        keys.append(target.at(end - 0.06, pitch=-heel))
    return keys + [target.at(end)]


def track(keys, at, period=None, stride=0.0):
    """Ankle positions (N, 3), foot rotations (N, 4) and planted flags (N,) at times `at` (N,) of a list of `Foot` keys.

    `period` and `stride` (s, m along x): the keys are one cycle of a gait.
    """
    times = np.array([key.time for key in keys])
    values = np.array([[key.x, key.y, key.yaw, key.pitch, key.lift] for key in keys])
    drift = np.array([stride, 0, 0, 0, 0])
    x, y, yaw, pitch, lift = curves.curve(times, values, at, period, drift).T
    yaw, pitch = np.radians(yaw), np.radians(pitch)
    rotation = rotations.multiply(rotations.about_z(yaw), rotations.about_y(pitch))
    # the foot rolls over the edge that the pitch brings down; near flat the pivot wanders between the edges, for a
    # sudden change of pivot would be a jump of the ankle's velocity (the sole sinks 2 mm by it at most)
    middle, half = 0.5 * (TOE + HEEL), 0.5 * (TOE - HEEL)
    pivot = np.stack([middle + half * np.tanh(pitch / 0.08), 0 * x, 0 * x - ANKLE], axis=-1)
    flat = np.stack([x, y, ANKLE + lift], axis=-1)
    ankle = flat + rotations.rotate(rotations.about_z(yaw), pivot) - rotations.rotate(rotation, pivot)
    return ankle, rotation, _planted(times, values, at, period, drift)


def _planted(times, values, at, period, drift):
    # planted: between two equal keys of a flat foot
    if period is not None:
        times = np.append(times, times[0] + period)
        values = np.append(values, values[:1] + drift, axis=0)
        at = times[0] + np.mod(at - times[0], period)
    i = np.clip(np.searchsorted(times, at + 1e-9, side="right") - 1, 0, len(times) - 2)
    flat = (values[:, 3:] == 0).all(axis=-1)
    standing = np.append(flat[:-1] & (values[:-1] == values[1:]).all(axis=-1), False)
    # the last instant of standing, which the next interval begins with, counts
    return standing[i] | ((i > 0) & np.isclose(at, times[i]) & standing[i - 1])
