"""Inertialization: D. Bollo, "Inertialization: High-Performance Animation Transitions in Gears of War", GDC 2018.

The source clip is dropped at the moment. The target clip plays at once, from its start point, and what the pose and its
velocity would jump by is added to it as an offset that decays along a quintic to nothing: value, velocity and
acceleration are zero after the blend time. Offsets are 3-vectors, of rotations the exponential map of the rotation that
leads, in the parent's frame, from the target's to the source's.

`inertialization` decays each coordinate of an offset from its full velocity with no acceleration at first: position and
velocity are continuous. `inertialization_unreal` is the curve that Unreal Engine ships (AnimNode_Inertialization) as in
Bollo's talk: an offset keeps its direction, only the velocity along it counts, one that would let it grow is cut to
zero, the first acceleration and the end time are chosen so that it never passes zero. So velocity across the offset, or
away from the target, is lost in one frame.
"""

import numpy as np

from motion import rotations
from motion.baselines.poses import frames_of, join, split, split_velocity
from motion.baselines.scene import make_scene

DURATION = 0.4  # s, as long as the interpolation: what differs is the method


def inertialization(states, task, fps=30, placement=None):
    """Poses (T, 47) of the transition; see `motion.baselines`."""
    return _transition(make_scene(states, task, placement), frames_of(DURATION, fps), _full)


def inertialization_unreal(states, task, fps=30, placement=None):
    """The same as Unreal Engine evaluates it."""
    return _transition(make_scene(states, task, placement), frames_of(DURATION, fps), _guarded)


def _transition(scene, times, decay):
    (linear_a, turns_a), (linear_b, turns_b) = split(scene.source_poses([0.0])[0]), split(scene.target_poses([0.0])[0])
    speed_a, rate_a = split_velocity(scene.source_velocity, turns_a)
    speed_b, rate_b = split_velocity(scene.target_velocity, turns_b)
    difference = rotations.multiply(turns_a, rotations.conjugate(turns_b))
    turn = rotations.to_exponential_map(difference)
    turn_rate = exponential_rate(turn, rate_a - rotations.rotate(difference, rate_b))
    # the root's position is one vector, the hinges are four of one coordinate
    offset, velocity = linear_a - linear_b, speed_a - speed_b
    linear, turns = split(scene.target_poses(times))
    root = decay(offset[None, :3], velocity[None, :3], times)[:, 0]
    hinges = decay(offset[3:, None], velocity[3:, None], times)[..., 0]
    turned = rotations.from_exponential_map(decay(turn, turn_rate, times))
    return join(linear + np.concatenate([root, hinges], axis=1), rotations.multiply(turned, turns))


def exponential_rate(vector, angular):
    """d/dt (n, 3) of exponential maps (n, 3) that turn at `angular` (n, 3) rad/s in the fixed frame.

    The inverse left Jacobian of SO(3): w - v x w / 2 + c v x (v x w), c = (1 - (a / 2) cot(a / 2)) / a^2, a = |v|.
    """
    half = np.maximum(np.linalg.norm(vector, axis=-1, keepdims=True) / 2, 1e-12)
    # near zero the formula cancels; its series is 1 / 12 + a^2 / 720
    exact = (1 - half / np.tan(half)) / (4 * half**2)
    factor = np.where(half < 1e-2, 1 / 12 + half**2 / 180, exact)
    across = np.cross(vector, angular)
    return angular - across / 2 + factor * np.cross(vector, across)


def quintic(offset, velocity, acceleration, end, times):
    """The quintic with these values at 0 and value, velocity, acceleration zero from `end` (> 0) on; all broadcast.

    Bollo 2018, "Inertialization": x(t) = A t^5 + B t^4 + C t^3 + a0 t^2 / 2 + v0 t + x0.
    """
    s = np.minimum(times / end, 1.0)
    v, a = velocity * end, acceleration * end**2
    fifth, fourth, third = -(a + 6 * v + 12 * offset) / 2, (3 * a + 16 * v + 30 * offset) / 2, -(3 * a + 12 * v) / 2
    third = third - 10 * offset
    return ((((fifth * s + fourth) * s + third) * s + a / 2) * s + v) * s + offset


def _full(offset, velocity, times):
    """Offsets (n, ..., d) over times (n,) of offsets (..., d) and their velocities."""
    times = times.reshape(-1, *[1] * offset.ndim)
    return quintic(offset, velocity, 0.0, times[-1], times)


def _guarded(offset, velocity, times):
    """The same by Unreal Engine's rules; the last axis is that of the offsets' direction."""
    size = np.linalg.norm(offset, axis=-1)
    along = np.minimum(np.sum(offset * velocity, axis=-1) / np.maximum(size, 1e-12), 0.0)
    # an offset that closes fast ends early: at -5 x0 / v0 the quintic with the least acceleration just stays above 0
    closing = np.minimum(times[-1], 5 * size / np.maximum(-along, 1e-12))
    end = np.maximum(closing, 1e-9)
    acceleration = np.maximum(0.0, -(8 * along * end + 20 * size) / end**2)
    times = times.reshape(-1, *[1] * size.ndim)
    length = np.where(size > 1e-9, quintic(size, along, acceleration, end, times), 0.0)
    return length[..., None] * offset / np.maximum(size, 1e-12)[..., None]
