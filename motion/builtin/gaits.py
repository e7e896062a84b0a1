"""Walk and run: one cycle each, from the left foot's touchdown, with sword and shield carried ready."""

from motion.builtin.feet import Foot
from motion.builtin.keys import Key, Motion

WALK_PERIOD, WALK_STRIDE = 1.1, 1.32
RUN_PERIOD, RUN_STRIDE = 0.7, 2.1


def _walk_foot(touchdown, side):
    """Keys of one foot over a cycle, touching down at `touchdown` of the period; place 0 is under the moving pelvis."""
    start = touchdown * WALK_PERIOD
    place = Foot(0.27 + touchdown * WALK_STRIDE, 0.085 * side, 6 * side)
    after = place.moved(x=WALK_STRIDE)
    keys = [
        place.at(start, pitch=-18),
        place.at(start + 0.09),
        place.at(start + 0.40),
        place.at(start + 0.66, pitch=48),
        place.at(start + 0.82, pitch=22, lift=0.06, x=0.5 * (place.x + after.x) - 0.10),
        place.at(start + 0.98, pitch=-12, lift=0.03, x=after.x - 0.10),
    ]
    return _wrapped(keys, WALK_PERIOD, WALK_STRIDE)


def _run_foot(touchdown, side):
    start = touchdown * RUN_PERIOD
    place = Foot(0.20 + touchdown * RUN_STRIDE, 0.06 * side, 4 * side)
    after = place.moved(x=RUN_STRIDE)
    keys = [
        place.at(start),
        place.at(start + 0.12),
        place.at(start + 0.25, pitch=55, lift=0.01),
        place.at(start + 0.40, pitch=75, lift=0.20, x=0.5 * (place.x + after.x) - 0.30),
        place.at(start + 0.54, pitch=12, lift=0.16, x=after.x - 0.28),
        place.at(start + 0.64, pitch=-4, lift=0.04, x=after.x - 0.02),
    ]
    return _wrapped(keys, RUN_PERIOD, RUN_STRIDE)


def _wrapped(keys, period, stride):
    # keys past the end of the cycle belong to its beginning, one stride back
    keys = [k if k.time < period - 1e-9 else k.moved(x=-stride).at(k.time - period) for k in keys]
    return sorted(keys, key=lambda k: k.time)


_WALK = Key(
    pelvis=(0.0, 0.0, 0.81),
    hips=(0, 2, 0),
    chest=(-4, 5, 0),
    look=(0, 3),
    sword_hand=(0.16, -0.30, 0.10),
    blade=(0.90, 0.05, 0.42),
    sword_elbow=(-1.0, -0.5, -0.3),
    shield_hand=(0.24, 0.05, 0.26),
    shield_elbow=(-0.2, 0.6, -0.8),
)


def _walk_keys():
    # double support low, mid-stance high; the pelvis turns with the leg in front, the chest against it
    def key(phase, z, y, hips, chest, sword_x, shield_x):
        return _WALK.at(
            phase * WALK_PERIOD,
            pelvis=(phase * WALK_STRIDE, y, z),
            hips=hips,
            chest=chest,
            sword_hand=(0.16 + sword_x, -0.30, 0.10 + 0.3 * abs(sword_x)),
            shield_hand=(0.24 + shield_x, 0.05 - 0.5 * shield_x, 0.26),
        )

    return [
        key(0.06, 0.796, 0.004, (-6, 2, 0), (6, 5, 0), 0.07, -0.03),
        key(0.31, 0.826, 0.022, (0, 2, -3), (-2, 4, 2), 0.0, 0.0),
        key(0.56, 0.796, -0.004, (6, 2, 0), (-12, 5, 0), -0.07, 0.03),
        key(0.81, 0.826, -0.022, (0, 2, 3), (-4, 4, -2), 0.0, 0.0),
    ]


_RUN = Key(
    pelvis=(0.0, 0.0, 0.80),
    hips=(0, 8, 0),
    chest=(0, 10, 0),
    look=(0, 4),
    sword_hand=(0.05, -0.32, 0.16),
    blade=(0.75, -0.15, 0.65),
    sword_elbow=(-1.0, -0.5, -0.2),
    shield_hand=(0.26, 0.10, 0.28),
    shield_elbow=(-0.4, 0.7, -0.6),
)


def _run_keys():
    # lowest at mid-stance, highest in the flight; arms against the legs
    def key(phase, z, hips, chest, sword_x, shield_x):
        return _RUN.at(
            phase * RUN_PERIOD,
            pelvis=(phase * RUN_STRIDE, 0.0, z),
            hips=hips,
            chest=chest,
            sword_hand=(0.05 + sword_x, -0.32 + 0.2 * sword_x, 0.16 + 0.4 * abs(sword_x)),
            shield_hand=(0.26 + shield_x, 0.10 - 0.4 * shield_x, 0.28),
        )

    return [
        key(0.17, 0.775, (-4, 9, -2), (2, 10, 1), 0.04, -0.02),
        key(0.42, 0.835, (6, 7, 0), (-12, 10, 0), -0.13, 0.06),
        key(0.67, 0.775, (4, 9, 2), (-6, 10, -1), -0.04, 0.02),
        key(0.92, 0.835, (-6, 7, 0), (12, 10, 0), 0.14, -0.06),
    ]


WALK = Motion(
    name="walk",
    keys=_walk_keys(),
    right=_walk_foot(0.5, -1),
    left=_walk_foot(0.0, 1),
    period=WALK_PERIOD,
    stride=WALK_STRIDE,
)
RUN = Motion(
    name="run",
    keys=_run_keys(),
    right=_run_foot(0.5, -1),
    left=_run_foot(0.0, 1),
    period=RUN_PERIOD,
    stride=RUN_STRIDE,
)
