"""Straight attacks: a lunging stab and a stepping bash with the shield."""

from motion.builtin.feet import step
from motion.builtin.keys import Motion
from motion.builtin.stance import GUARD, LEFT, READY, RIGHT, shifted

_LUNGE = LEFT.moved(x=0.30)
_BASH = LEFT.moved(x=0.36)

STAB = Motion(
    name="stab",
    keys=[
        *READY,
        GUARD.at(  # weight back, hand to the hip, point at the enemy
            0.42,
            pelvis=shifted(GUARD, -0.09, -0.01, -0.03),
            hips=(-46, 4, 0),
            chest=(-22, 4, 0),
            sword_hand=(-0.16, -0.34, 0.22),
            blade=(1.0, 0.14, 0.10),
            sword_elbow=(-1.0, -0.3, 0.1),
        ),
        GUARD.at(  # hips lead, arm long
            0.72,
            pelvis=shifted(GUARD, 0.24, 0.0, -0.09),
            hips=(0, 10, 0),
            chest=(22, 14, 0),
            sword_hand=(0.74, -0.08, 0.46),
            blade=(1.0, 0.06, -0.02),
            sword_elbow=(0.0, -0.6, -0.8),
            shield_hand=(0.10, 0.24, 0.22),
        ),
        GUARD.at(
            0.84,
            pelvis=shifted(GUARD, 0.25, 0.0, -0.095),
            hips=(1, 10, 0),
            chest=(23, 14, 0),
            sword_hand=(0.74, -0.08, 0.45),
            blade=(1.0, 0.06, -0.04),
            sword_elbow=(0.0, -0.6, -0.8),
            shield_hand=(0.10, 0.24, 0.22),
        ),
        GUARD.at(
            1.15,
            pelvis=shifted(GUARD, 0.08, 0.0, -0.03),
            hips=(-22, 6, 0),
            chest=(0, 10, 0),
            sword_hand=(0.30, -0.24, 0.28),
            blade=(0.95, 0.1, 0.30),
            shield_hand=(0.22, 0.04, 0.32),
        ),
        GUARD.at(1.55),
        GUARD.at(1.70),
    ],
    left=[
        LEFT.at(0.0),
        *step(0.48, 0.72, LEFT, _LUNGE, lift=0.05, toe_off=10, heel=10),
        *step(1.02, 1.36, _LUNGE, LEFT, lift=0.04, toe_off=10),
        LEFT.at(1.70),
    ],
    right=[
        RIGHT.at(0.0),
        RIGHT.at(0.45),
        RIGHT.at(0.72, pitch=30),
        RIGHT.at(0.84, pitch=30),
        RIGHT.at(1.20),
        RIGHT.at(1.70),
    ],
)

SHIELD_BASH = Motion(
    name="shield_bash",
    keys=[
        *READY,
        GUARD.at(  # coil behind the shield
            0.42,
            pelvis=shifted(GUARD, -0.11, 0.0, -0.05),
            hips=(-12, 8, 0),
            chest=(20, 12, 0),
            sword_hand=(0.05, -0.34, 0.20),
            shield_hand=(0.17, 0.02, 0.34),
        ),
        GUARD.at(  # throw the left side forward
            0.70,
            pelvis=shifted(GUARD, 0.25, 0.0, -0.06),
            hips=(-46, 10, 0),
            chest=(-18, 20, 0),
            sword_hand=(-0.16, -0.40, 0.12),
            blade=(0.70, -0.65, 0.20),
            shield_hand=(0.46, -0.30, 0.26),
            shield_elbow=(-0.2, 0.84, -0.5),
        ),
        GUARD.at(
            0.82,
            pelvis=shifted(GUARD, 0.265, 0.0, -0.065),
            hips=(-47, 10, 0),
            chest=(-19, 20, 0),
            sword_hand=(-0.16, -0.40, 0.12),
            blade=(0.70, -0.65, 0.20),
            shield_hand=(0.46, -0.30, 0.26),
            shield_elbow=(-0.2, 0.84, -0.5),
        ),
        GUARD.at(1.15, pelvis=shifted(GUARD, 0.12, 0.0, -0.03), hips=(-38, 5, 0), chest=(-14, 10, 0)),
        GUARD.at(1.50),
        GUARD.at(1.70),
    ],
    left=[
        LEFT.at(0.0),
        *step(0.46, 0.70, LEFT, _BASH, lift=0.06, toe_off=12, heel=8),
        *step(1.02, 1.36, _BASH, LEFT, lift=0.04, toe_off=10),
        LEFT.at(1.70),
    ],
    right=[
        RIGHT.at(0.0),
        RIGHT.at(0.45),
        RIGHT.at(0.70, pitch=26),
        RIGHT.at(0.82, pitch=26),
        RIGHT.at(1.15),
        RIGHT.at(1.70),
    ],
)
