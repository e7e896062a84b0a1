"""Dead blending: D. Holden, "Dead Blending", 2023, theorangeduck.com/page/dead-blending; in Unreal Engine since 5.3.

The source clip is dropped at the moment. Its pose is extrapolated with its velocity there, which decays exponentially,
and crossfaded into the target clip, which plays at once from its start point. The half-life of every coordinate is the
rule of Unreal's node ("Dead Blending Node in Unreal Engine", 2023): in proportion to the way to the target divided by
the velocity, between 0.05 and 1 s; the shortest where the velocity leads away from the target. Not taken over: the
node's limits of 5 m/s and 360 degrees/s, which strikes exceed, so that a limb would stop in one frame.
"""

import numpy as np

from motion import rotations
from motion.baselines.poses import blend, ease, frames_of, join, split, split_velocity
from motion.baselines.scene import make_scene

DURATION = 0.4  # s, as long as the interpolation: what differs is the method
HALF_LIFE, SHORTEST, LONGEST = 1.0, 0.05, 1.0  # s, the node's defaults
_SLOW = 1e-4  # m/s, rad/s


def dead_blending(states, task, fps=30, placement=None):
    """Poses (T, 47) of the transition; see `motion.baselines`."""
    scene, times = make_scene(states, task, placement), frames_of(DURATION, fps)
    return blend(extrapolated(scene, times), scene.target_poses(times), ease(times / times[-1]))


def extrapolated(scene, times):
    """Poses (n, 47) of the source going on by its velocity, `times` (n,) s after the moment."""
    (linear, turns), (linear_b, turns_b) = split(scene.source_poses([0.0])[0]), split(scene.target_poses([0.0])[0])
    speed, rate = split_velocity(scene.source_velocity, turns)
    way = rotations.to_exponential_map(rotations.multiply(turns_b, rotations.conjugate(turns)))
    moved = travel(linear_b - linear, speed, times[:, None])
    turned = rotations.from_exponential_map(travel(way, rate, times[:, None, None]))
    return join(linear + moved, rotations.multiply(turned, turns))


def travel(way, velocity, times):
    """How far a coordinate gets in `times` s, of its velocity and its way to the target; all broadcast."""
    away = np.where(np.abs(velocity) < _SLOW, np.copysign(_SLOW, velocity), velocity)
    decay = np.log(2) / np.clip(HALF_LIFE * way / away, SHORTEST, LONGEST)
    return velocity / decay * (1 - np.exp(-decay * times))
