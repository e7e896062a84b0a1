"""Dodge: a hop backward by 0.93 m, both feet off the ground, shield up."""

import numpy as np

from motion.builtin.keys import Motion
from motion.builtin.stance import GUARD, LEFT, READY, RIGHT, shifted

BACK = 0.93
CROUCHED, LEAVE, LAND, STOPPED, END = 0.30, 0.48, 0.78, 0.93, 1.8  # s
SPEED = 2.0  # backward in the flight, m/s
RISE = 1.3  # upward speed at take-off, m/s
FALL = 9.81 * (LAND - LEAVE) - RISE  # downward speed at landing


def _path():
    """Pelvis keys: crouch, an even push to the take-off speed, free flight, an even stop, back to the stance."""
    push, stop = LEAVE - CROUCHED, STOPPED - LAND
    low = np.array([0.0, -0.11])  # x, z from the stance
    velocity = np.array([-SPEED, RISE])
    rows = [(0.0, 0.0, 0.0), (1 / 30, 0.0, 0.0)]
    rows += [(CROUCHED + t, *(low + velocity * t * t / (2 * push))) for t in np.linspace(0, push, 6)]
    x, z = rows[-1][1:]
    for t in np.linspace(0, LAND - LEAVE, 10)[1:]:
        rows.append((LEAVE + t, x - SPEED * t, z + RISE * t - 0.5 * 9.81 * t * t))
    x, z = rows[-1][1:]
    for t in np.linspace(0, stop, 6)[1:]:
        rows.append((LAND + t, x - SPEED * (t - t * t / (2 * stop)), z - FALL * (t - t * t / (2 * stop))))
    rows += [(1.50, -BACK, 0.0), (END, -BACK, 0.0)]
    return [(t, *shifted(GUARD, x, 0.0, z)) for t, x, z in rows]


def _hop(place, leave, land, crouch):
    # the toes leave last and touch first; `crouch`: how far the heel comes up in a crouch, degrees
    back = place.moved(x=-BACK)
    return [
        place.at(0.0),
        place.at(0.10),
        place.at(CROUCHED, pitch=crouch),
        place.at(leave, pitch=28),
        back.at(0.5 * (leave + land), x=0.5 * (place.x + back.x), pitch=22, lift=0.10),
        back.at(land, pitch=24),
        back.at(STOPPED, pitch=crouch),
        back.at(STOPPED + 0.25),
        back.at(END),
    ]


_AIR = GUARD.at(
    0.0,
    chest=(-10, 11, 0),
    sword_hand=(0.12, -0.35, 0.24),
    blade=(0.80, -0.22, 0.55),
    shield_hand=(0.25, -0.07, 0.42),
)

DODGE_BACK = Motion(
    name="dodge_back",
    keys=[
        *READY,
        GUARD.at(CROUCHED, hips=(-32, 10, 0), chest=(-10, 14, 0), blade=(0.80, -0.05, 0.60)),
        _AIR.at(LEAVE, hips=(-32, 2, 0)),
        _AIR.at(LAND, hips=(-32, 6, 0)),
        _AIR.at(1.0, hips=(-32, 12, 0), chest=(-10, 15, 0)),
        GUARD.at(1.5),
        GUARD.at(END),
    ],
    right=_hop(RIGHT, 0.50, 0.77, 20),
    left=_hop(LEFT, 0.44, 0.80, 3),
    path=_path(),
)
