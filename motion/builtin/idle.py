"""Idle: breathing and shifting weight in the battle stance, a loop of 3 s."""

from motion.builtin.keys import Motion
from motion.builtin.stance import GUARD, LEFT, RIGHT, shifted

IDLE = Motion(
    name="idle",
    period=3.0,
    keys=[
        GUARD.at(0.0),
        GUARD.at(
            0.8,
            pelvis=shifted(GUARD, -0.012, 0.004, 0.008),
            chest=(-11, 5.5, 0.5),
            sword_hand=(0.16, -0.305, 0.235),
            blade=(0.78, 0.12, 0.61),
            shield_hand=(0.26, -0.05, 0.375),
        ),
        GUARD.at(
            1.7,
            pelvis=shifted(GUARD, 0.012, -0.004, -0.012),
            hips=(-33, 5, 0),
            chest=(-8, 9, -0.5),
            look=(3, 5),
            sword_hand=(0.18, -0.29, 0.21),
            blade=(0.82, 0.20, 0.55),
            shield_hand=(0.265, -0.04, 0.35),
        ),
        GUARD.at(
            2.4,
            pelvis=shifted(GUARD, 0.002, 0.004, -0.002),
            chest=(-10.5, 7, 0),
            look=(-2, 4),
            sword_hand=(0.165, -0.30, 0.225),
            blade=(0.79, 0.16, 0.59),
        ),
    ],
    left=[LEFT.at(0.0)],
    right=[RIGHT.at(0.0)],
)
