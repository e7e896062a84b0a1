"""Cuts: down from overhead, up from the right hip, and level from right to left."""

from motion.builtin.feet import step
from motion.builtin.keys import Motion
from motion.builtin.stance import GUARD, LEFT, READY, RIGHT, shifted

_SHORT = LEFT.moved(x=0.20)
_ASIDE = {"shield_hand": (0.14, 0.34, 0.11), "shield_elbow": (-0.2, 0.8, -0.6)}  # the shield out of the blade's way


def _feet(out, back, heel_up, end):
    """Keys of both feet: a short step of the left foot at `out` and `back` (s, s), the right heel up between."""
    left = [
        LEFT.at(0.0),
        *step(*out, LEFT, _SHORT, lift=0.05, toe_off=12, heel=8),
        *step(*back, _SHORT, LEFT, lift=0.04, toe_off=10),
        LEFT.at(end),
    ]
    right = [
        RIGHT.at(0.0),
        RIGHT.at(out[0]),
        RIGHT.at(out[1], pitch=heel_up),
        RIGHT.at(back[0] - 0.10, pitch=heel_up),
        RIGHT.at(back[0] + 0.14),
        RIGHT.at(end),
    ]
    return {"left": left, "right": right}


SLASH_DOWN = Motion(
    name="slash_down",
    keys=[
        *READY,
        GUARD.at(
            0.50,
            pelvis=shifted(GUARD, -0.08, 0.0, 0.0),
            hips=(-38, -2, 0),
            chest=(-14, -6, 0),
            sword_hand=(-0.02, -0.28, 0.84),
            blade=(-0.70, -0.15, 0.65),
            sword_elbow=(0.5, -0.9, 0.2),
            shield_hand=(0.22, 0.04, 0.34),
        ),
        GUARD.at(
            0.66,
            pelvis=shifted(GUARD, 0.08, 0.0, -0.04),
            hips=(-18, 6, 0),
            chest=(4, 8, 0),
            sword_hand=(0.42, -0.20, 0.74),
            blade=(0.65, 0.0, 0.75),
            sword_elbow=(0.3, -0.9, -0.2),
            **_ASIDE,
        ),
        GUARD.at(
            0.78,
            pelvis=shifted(GUARD, 0.16, 0.0, -0.09),
            hips=(-8, 12, 0),
            chest=(12, 20, 0),
            sword_hand=(0.66, -0.12, 0.30),
            blade=(0.92, 0.08, -0.20),
            sword_elbow=(0.0, -0.8, -0.6),
            **_ASIDE,
        ),
        GUARD.at(
            0.92,
            pelvis=shifted(GUARD, 0.17, 0.0, -0.11),
            hips=(-6, 13, 0),
            chest=(14, 24, 0),
            sword_hand=(0.58, -0.06, 0.14),
            blade=(0.85, 0.14, -0.36),
            sword_elbow=(-0.2, -0.8, -0.5),
            **_ASIDE,
        ),
        GUARD.at(
            1.30,
            pelvis=shifted(GUARD, 0.06, 0.0, -0.03),
            hips=(-24, 6, 0),
            chest=(-2, 12, 0),
            sword_hand=(0.26, -0.22, 0.18),
            blade=(0.88, 0.12, 0.25),
            shield_hand=(0.18, 0.10, 0.30),
        ),
        GUARD.at(1.70),
        GUARD.at(1.90),
    ],
    **_feet((0.54, 0.76), (1.10, 1.42), 24, 1.90),
)

SLASH_UP = Motion(
    name="slash_up",
    keys=[
        *READY,
        GUARD.at(  # the blade goes out and round the right side, not through the floor
            0.32,
            pelvis=shifted(GUARD, -0.05, -0.01, -0.04),
            hips=(-40, 6, 0),
            chest=(-16, 11, 0),
            sword_hand=(-0.06, -0.42, 0.24),
            blade=(0.45, -0.85, 0.20),
            sword_elbow=(-0.8, -0.5, -0.1),
        ),
        GUARD.at(
            0.52,
            pelvis=shifted(GUARD, -0.10, -0.01, -0.08),
            hips=(-46, 8, 0),
            chest=(-20, 14, 0),
            sword_hand=(-0.44, -0.42, 0.22),
            blade=(-0.60, -0.68, -0.42),
            sword_elbow=(-0.6, -0.4, 0.6),
        ),
        GUARD.at(
            0.68,
            pelvis=shifted(GUARD, 0.06, 0.0, -0.08),
            hips=(-22, 6, 0),
            chest=(4, 10, 0),
            sword_hand=(0.14, -0.44, 0.12),
            blade=(0.65, -0.70, -0.25),
            sword_elbow=(-0.5, -0.8, -0.2),
            **_ASIDE,
        ),
        GUARD.at(
            0.80,
            pelvis=shifted(GUARD, 0.14, 0.0, -0.02),
            hips=(0, 2, 0),
            chest=(18, 2, 0),
            sword_hand=(0.60, -0.08, 0.46),
            blade=(0.85, 0.25, 0.45),
            sword_elbow=(0.0, -0.8, -0.5),
            **_ASIDE,
        ),
        GUARD.at(
            0.94,
            pelvis=shifted(GUARD, 0.15, 0.01, 0.01),
            hips=(8, 0, 0),
            chest=(24, -4, 0),
            sword_hand=(0.36, 0.12, 0.76),
            blade=(0.25, 0.55, 0.80),
            sword_elbow=(0.5, -0.7, -0.2),
            **_ASIDE,
        ),
        GUARD.at(
            1.36,
            pelvis=shifted(GUARD, 0.06, 0.0, -0.01),
            hips=(-22, 4, 0),
            chest=(0, 8, 0),
            sword_hand=(0.30, -0.20, 0.36),
            blade=(0.70, 0.25, 0.66),
            shield_hand=(0.18, 0.10, 0.30),
        ),
        GUARD.at(1.70),
        GUARD.at(1.90),
    ],
    **_feet((0.57, 0.79), (1.14, 1.46), 24, 1.90),
)

SLASH_LEFT = Motion(
    name="slash_left",
    keys=[
        *READY,
        GUARD.at(
            0.48,
            pelvis=shifted(GUARD, -0.09, -0.01, -0.03),
            hips=(-46, 4, 0),
            chest=(-26, 6, 0),
            sword_hand=(-0.26, -0.40, 0.46),
            blade=(-0.60, -0.75, 0.25),
            sword_elbow=(-0.3, -0.8, -0.4),
        ),
        GUARD.at(
            0.64,
            pelvis=shifted(GUARD, 0.06, 0.0, -0.06),
            hips=(-20, 6, 0),
            chest=(0, 8, 0),
            sword_hand=(0.34, -0.44, 0.42),
            blade=(0.60, -0.80, 0.03),
            sword_elbow=(-0.2, -0.8, -0.4),
            **_ASIDE,
        ),
        GUARD.at(
            0.74,
            pelvis=shifted(GUARD, 0.12, 0.0, -0.07),
            hips=(-2, 7, 0),
            chest=(18, 10, 0),
            sword_hand=(0.64, -0.10, 0.40),
            blade=(0.95, 0.25, 0.0),
            sword_elbow=(0.0, -0.7, -0.6),
            **_ASIDE,
        ),
        GUARD.at(
            0.88,
            pelvis=shifted(GUARD, 0.14, 0.01, -0.07),
            hips=(10, 7, 0),
            chest=(30, 12, 0),
            sword_hand=(0.44, 0.24, 0.43),
            blade=(0.20, 0.97, 0.10),
            sword_elbow=(0.4, -0.6, -0.5),
            **_ASIDE,
        ),
        GUARD.at(
            1.32,
            pelvis=shifted(GUARD, 0.06, 0.0, -0.02),
            hips=(-20, 5, 0),
            chest=(2, 9, 0),
            sword_hand=(0.32, -0.18, 0.32),
            blade=(0.80, 0.25, 0.50),
            shield_hand=(0.18, 0.10, 0.30),
        ),
        GUARD.at(1.70),
        GUARD.at(1.90),
    ],
    **_feet((0.53, 0.74), (1.12, 1.44), 24, 1.90),
)
