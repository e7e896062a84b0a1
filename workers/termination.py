"""How an episode ends: target reached, fall, time-out (sections 3 and 4)."""

import math

import numpy as np
from numba import njit

from motion import skeleton
from workers.humanoid import SHAPES
from workers.kinematics import NUM_BODIES, quaternion_at, rotate
from workers.reward import KP, RP, RQ, Q
from workers.types import CONTINUES, FELL, REACHED, TIMED_OUT

_KINDS = {"sphere": 0, "capsule": 1, "box": 2, "cylinder": 3}
_SHAPE_BODY = np.array([skeleton.BODY_INDEX[shape.body] for shape in SHAPES])
_SHAPE_KIND = np.array([_KINDS[shape.kind] for shape in SHAPES])
_SHAPE_A = np.array([shape.a for shape in SHAPES], dtype=np.float64)
_SHAPE_B = np.array([shape.b or (0.0, 0.0, 0.0) for shape in SHAPES], dtype=np.float64)
_SHAPE_RADIUS = np.array([shape.radius for shape in SHAPES])
_NUM_SHAPES = len(SHAPES)


def fall_mask(ignore_bodies):
    """(17,) bool: bodies whose touching the ground is a fall, all but the feet and `ignore_bodies` (names)."""
    mask = np.ones(NUM_BODIES, dtype=np.bool_)
    mask[skeleton.FOOT_BODIES] = False
    mask[[skeleton.BODY_INDEX[name] for name in ignore_bodies]] = False
    return mask


@njit(cache=True)
def _lowest_of_shape(shape, position, q):
    """Lowest height of one collision geometry of a body at `position` (3,) with rotation q, analytically."""
    a = _SHAPE_A[shape]
    kind = _SHAPE_KIND[shape]
    low = position[2] + rotate(q, a[0], a[1], a[2])[2]
    if kind == 0:
        return low - _SHAPE_RADIUS[shape]
    b = _SHAPE_B[shape]
    if kind == 2:  # the third row of the rotation matrix, by the half sizes
        for axis in range(3):
            e = rotate(q, 1.0 * (axis == 0), 1.0 * (axis == 1), 1.0 * (axis == 2))
            low -= abs(e[2]) * b[axis]
        return low
    low = min(low, position[2] + rotate(q, b[0], b[1], b[2])[2])
    if kind == 1:
        return low - _SHAPE_RADIUS[shape]
    length = math.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)
    axis_z = rotate(q, (b[0] - a[0]) / length, (b[1] - a[1]) / length, (b[2] - a[2]) / length)[2]
    return low - _SHAPE_RADIUS[shape] * math.sqrt(max(0.0, 1.0 - axis_z * axis_z))


@njit(cache=True)
def lowest(bodies, rotations, mask):
    """The lowest body among those of mask (17,), as (height in m, body), of a pose's bodies (17, 3), (17, 4)."""
    height, which = np.inf, -1
    for shape in range(_NUM_SHAPES):
        body = _SHAPE_BODY[shape]
        if mask[body]:
            low = _lowest_of_shape(shape, bodies[body], quaternion_at(rotations[body], 0))
            if low < height:
                height, which = low, body
    return height, which


@njit(cache=True)
def reached(deviation, thresholds):
    """Whether deviations (7,) are all below thresholds (4,): d^rp, d^kp, d^q, d^rq."""
    return (
        deviation[RP] < thresholds[0]
        and deviation[KP] < thresholds[1]
        and deviation[Q] < thresholds[2]
        and deviation[RQ] < thresholds[3]
    )


@njit(cache=True)
def terminate(deviation, thresholds, bodies, rotations, mask, steps, max_steps):
    """(end, body that fell or -1) after `steps` policy steps. A fall goes before a reach, a reach before a time-out."""
    height, body = lowest(bodies, rotations, mask)
    if height < 0.0:
        return FELL, body
    if reached(deviation, thresholds):
        return REACHED, -1
    if steps >= max_steps:
        return TIMED_OUT, -1
    return CONTINUES, -1
