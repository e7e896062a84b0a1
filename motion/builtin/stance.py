"""The battle stance that the clips start from and return to: left (shield) foot forward, facing +x."""

from motion.builtin.feet import Foot
from motion.builtin.keys import Key

LEFT = Foot(0.23, 0.12, 0)
RIGHT = Foot(-0.29, -0.13, -55)

GUARD = Key(
    pelvis=(-0.01, 0.0, 0.735),
    hips=(-32, 4, 0),
    chest=(-10, 8, 0),
    look=(0, 4),
    sword_hand=(0.17, -0.30, 0.22),
    blade=(0.80, 0.15, 0.58),
    sword_elbow=(-0.6, -0.5, -0.6),
    shield_hand=(0.26, -0.05, 0.36),
    shield_elbow=(0.0, 0.5, -0.85),
)


READY = [GUARD.at(0.0), GUARD.at(1 / 30)]  # one frame still, so that every clip starts at rest


def shifted(key, x=0.0, y=0.0, z=0.0):
    """The pelvis place of a key moved by x, y, z (m), as a tuple: most keys move the pelvis a little."""
    return (key.pelvis[0] + x, key.pelvis[1] + y, key.pelvis[2] + z)
