"""Compiled spatial vectors (6,), angular before linear, and what of the figure hangs on what.

All are at one place, the figure's center of mass, as MuJoCo's `cdof`, `cvel` and `cinert` are. The root's place (dofs 0
to 2) is a joint of its own, on which its turn (3 to 5) hangs.
"""

import numpy as np
from numba import njit

from motion import skeleton
from workers.kinematics import JOINT_SIZE, NUM_BODIES, NV

PARENT = np.concatenate([[0], np.asarray(skeleton.PARENTS) + 1])  # bodies as MuJoCo counts them, the world first
PARENT[1] = 0
COUNT = NUM_BODIES + 1
BODY = np.concatenate([np.ones(6), np.repeat([joint.body + 1 for joint in skeleton.JOINTS], JOINT_SIZE)]).astype(int)


def _hangs():
    """(37, 37): [i, j], whether dof i hangs on the joint of dof j or is one of its own."""
    out = np.zeros((NV, NV), dtype=bool)
    for i in range(NV):
        body = BODY[i]
        while body:
            out[i] |= BODY == body
            body = PARENT[body]
    out[:3, 3:6] = False
    return out


HANGS = _hangs()
# the dof that moves a body last
TIP = np.zeros(COUNT, dtype=int)
for _body in range(1, COUNT):
    _own = np.flatnonzero(BODY == _body)
    TIP[_body] = _own[-1] if len(_own) else TIP[PARENT[_body]]


@njit(cache=True, nogil=True)
def cross(a, b, out):
    """Rate of the motion b, which moves with a."""
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
    out[3] = a[1] * b[5] - a[2] * b[4] + a[4] * b[2] - a[5] * b[1]
    out[4] = a[2] * b[3] - a[0] * b[5] + a[5] * b[0] - a[3] * b[2]
    out[5] = a[0] * b[4] - a[1] * b[3] + a[3] * b[1] - a[4] * b[0]


@njit(cache=True, nogil=True)
def cross_force(a, f, out):
    """Rate of the force f, which moves with a."""
    out[0] = a[1] * f[2] - a[2] * f[1] + a[4] * f[5] - a[5] * f[4]
    out[1] = a[2] * f[0] - a[0] * f[2] + a[5] * f[3] - a[3] * f[5]
    out[2] = a[0] * f[1] - a[1] * f[0] + a[3] * f[4] - a[4] * f[3]
    out[3] = a[1] * f[5] - a[2] * f[4]
    out[4] = a[2] * f[3] - a[0] * f[5]
    out[5] = a[0] * f[4] - a[1] * f[3]


@njit(cache=True, nogil=True)
def momentum(inertia, v, out):
    """Inertia (10,), as MuJoCo's cinert, times a motion."""
    i = inertia
    out[0] = i[0] * v[0] + i[3] * v[1] + i[4] * v[2] - i[8] * v[4] + i[7] * v[5]
    out[1] = i[3] * v[0] + i[1] * v[1] + i[5] * v[2] + i[8] * v[3] - i[6] * v[5]
    out[2] = i[4] * v[0] + i[5] * v[1] + i[2] * v[2] - i[7] * v[3] + i[6] * v[4]
    out[3] = i[8] * v[1] - i[7] * v[2] + i[9] * v[3]
    out[4] = i[6] * v[2] - i[8] * v[0] + i[9] * v[4]
    out[5] = i[7] * v[0] - i[6] * v[1] + i[9] * v[5]


@njit(cache=True, nogil=True)
def dot(a, b):
    """Of a motion and a force: power."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3] + a[4] * b[4] + a[5] * b[5]


@njit(cache=True, nogil=True)
def summed(motions, start):
    """(of each body (18, 6), of what carries each dof's joint (37, 6)): start and the motions (37, 6) of all dofs that
    move it."""
    bodies, carriers = np.zeros((COUNT, 6)), np.empty((NV, 6))
    bodies[0] = start
    first = 0
    for k in range(1, COUNT):
        bodies[k] = bodies[PARENT[k]]
        while first < NV and BODY[first] == k:  # twice for the root
            last = first
            while last < NV and BODY[last] == k and (first >= 3 or last < 3):
                carriers[last] = bodies[k]
                last += 1
            for j in range(first, last):
                bodies[k] += motions[j]
            first = last
    return bodies, carriers
