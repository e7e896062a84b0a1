"""Derivatives of inverse dynamics by pose and by velocity, in closed form, from what a step leaves in MuJoCo's data.

r(q, v, a') = M a' + Coriolis and gravity + damping v - J^T f - actuators, of a state and of the acceleration a' that
constraints see. A small change of a joint turns all that hangs on it rigidly: seen from there only the velocity and the
acceleration of what carries the joint change (Carpentier and Mansard, "Analytical derivatives of rigid body dynamics
algorithms", 2018). Constraints: `workers.constraint_derivatives`.
"""

import numpy as np
from numba import njit

from workers.constraint_derivatives import known, limits, soles, turning
from workers.kinematics import JOINT_DOF, JOINT_QPOS, JOINT_SIZE, NUM_JOINTS, NV, logarithm, quaternion_at
from workers.spatial import BODY, COUNT, HANGS, PARENT, cross, cross_force, dot, momentum, summed


@njit(cache=True, nogil=True)
def _drag(inertia, v, own, out):
    """What a body's force (6, 6) changes with its velocity v, which turns the change itself; own: its momentum."""
    unit, part, other = np.zeros(6), np.empty(6), np.empty(6)
    for c in range(6):
        unit[c] = 1.0
        cross(unit, v, part)
        momentum(inertia, part, other)
        out[:, c] = other
        cross_force(unit, own, other)
        out[:, c] += other
        momentum(inertia, unit, part)
        cross_force(v, part, other)
        out[:, c] += other
        unit[c] = 0.0


@njit(cache=True, nogil=True)
def _times(matrix, vector, out):
    for r in range(6):
        out[r] += dot(matrix[r], vector)


@njit(cache=True, nogil=True)
def smooth(gravity, cdof, cdof_dot, cinert, qvel, seen, late, by_pose, by_velocity, turned):
    """Add derivatives of M a' + Coriolis and gravity by pose and by velocity, and those of M y by pose; (37, 37) each.

    gravity: m/s^2, downwards. cdof, cdof_dot (37, 6), cinert (18, 10), of MuJoCo. seen: a' (37,). late: y (37,).
    """
    column, rest = qvel.reshape((NV, 1)), np.zeros(6)
    velocity, carried_at = summed(cdof * column, rest)
    lag, lag_above = summed(cdof * late.reshape((NV, 1)), rest)
    rest[5] = gravity  # as if all accelerated upwards
    acceleration, pull = summed(cdof * seen.reshape((NV, 1)) + cdof_dot * column, rest)
    # of all that hangs on a body: force, force of y, inertia, drag
    force, lagging, inertia, drag = np.empty((COUNT, 6)), np.empty((COUNT, 6)), cinert.copy(), np.empty((COUNT, 6, 6))
    own, part = np.empty(6), np.empty(6)
    for k in range(1, COUNT):
        momentum(cinert[k], lag[k], lagging[k])
        momentum(cinert[k], acceleration[k], force[k])
        momentum(cinert[k], velocity[k], own)
        cross_force(velocity[k], own, part)
        force[k] += part
        _drag(cinert[k], velocity[k], own, drag[k])
    for k in range(COUNT - 1, 1, -1):
        force[PARENT[k]] += force[k]
        lagging[PARENT[k]] += lagging[k]
        inertia[PARENT[k]] += inertia[k]
        drag[PARENT[k]] += drag[k]
    # what a dof feels of an acceleration and of a velocity that all that hangs on it has
    felt, dragged = np.empty((NV, 6)), np.zeros((NV, 6))
    for i in range(NV):
        momentum(inertia[BODY[i]], cdof[i], felt[i])
        for c in range(6):
            for d in range(6):  # without temporary arrays
                dragged[i, d] += cdof[i, c] * drag[BODY[i], c, d]
    moved, shifted, lagged, sped = np.empty(6), np.empty(6), np.empty(6), np.empty(6)
    by_turn, by_speed, by_lag = np.empty(6), np.empty(6), np.empty(6)
    for j in range(NV):
        k, axis = BODY[j], cdof[j]
        # of all that hangs on j, by its pose: velocity, acceleration (as seen from there) and S y; by its velocity:
        # acceleration
        cross(carried_at[j], axis, moved)
        cross(pull[j], axis, shifted)
        cross(moved, carried_at[j], part)
        shifted -= part
        cross(lag_above[j], axis, lagged)
        if j < 3:
            sped[:] = 0.0  # of the root's place alone: it does not turn, velocity[k] does
        else:
            cross(velocity[k], axis, sped)
            sped += moved
        # forces on what carries j
        momentum(inertia[k], shifted, by_turn)
        _times(drag[k], moved, by_turn)
        cross_force(axis, force[k], part)
        by_turn += part
        momentum(inertia[k], sped, by_speed)
        _times(drag[k], axis, by_speed)
        momentum(inertia[k], lagged, by_lag)
        cross_force(axis, lagging[k], part)
        by_lag += part
        for i in range(NV):
            if HANGS[i, j]:
                by_pose[i, j] += dot(felt[i], shifted) + dot(dragged[i], moved)
                by_velocity[i, j] += dot(felt[i], sped) + dot(dragged[i], axis)
                turned[i, j] += dot(felt[i], lagged)
            elif HANGS[j, i]:
                by_pose[i, j] += dot(cdof[i], by_turn)
                by_velocity[i, j] += dot(cdof[i], by_speed)
                turned[i, j] += dot(cdof[i], by_lag)


@njit(cache=True, nogil=True)
def _add_actuators(qpos, stiffness, by_pose):
    """Derivatives by pose of what actuators exert against a change: they pull a joint's own map to their targets."""
    for joint in range(NUM_JOINTS):
        first = JOINT_DOF[joint]
        if JOINT_SIZE[joint] == 1:
            by_pose[6 + first, 6 + first] += stiffness[first]
        else:
            by_map = turning(*logarithm(quaternion_at(qpos, JOINT_QPOS[joint])))
            for r in range(3):
                for c in range(3):
                    by_pose[6 + first + r, 6 + first + c] += stiffness[first + r] * by_map[r, c]


class InverseDerivatives:
    """Of a model of `workers.humanoid`."""

    def __init__(self, model):
        """model: whose contacts are soft and in pyramids, and whose actuators have no damping of their own."""
        self._gravity, self._damping = -float(model.opt.gravity[2]), np.diag(model.dof_damping)
        self._geom_type, self._geom_body = model.geom_type.copy(), model.geom_bodyid.copy()

    def add(self, data, qpos, qvel, acceleration, stiffness, react, turned):
        """Add derivatives of r by pose and velocity to react (37, 74), which has what constraints change by velocity,
        and those of M (a' - a) by pose to turned (37, 37). False: those of r by pose lack a contact unknown here.

        data: a step after qpos, qvel, whose acceleration a was (37,). stiffness: of the actuators (31,), N m / rad.
        """
        by_pose, by_velocity = react[:, :NV], react[:, NV:]
        seen = data.qacc
        smooth(
            self._gravity, data.cdof, data.cdof_dot, data.cinert, qvel, seen, seen - acceleration, by_pose,
            by_velocity, turned,
        )  # fmt: skip
        by_velocity += self._damping
        _add_actuators(qpos, stiffness, by_pose)
        if not data.nefc:
            return True
        contact, depth = data.contact, data.efc_pos - data.efc_margin
        force, weight, springs = data.efc_force, data.efc_D, data.efc_KBIP
        limits(
            qpos, qvel, seen, data.efc_type, force, weight, springs, depth, data.efc_J_rowadr, data.efc_J_rownnz,
            data.efc_J_colind, data.efc_J, by_pose,
        )  # fmt: skip
        geoms = contact.geom
        if not known(self._geom_type[geoms]):
            return False
        soles(
            qvel, seen, data.cdof, data.subtree_com[1], self._geom_body[geoms[:, 1]], contact.efc_address, contact.dist,
            contact.pos, contact.frame, contact.friction, force, weight, springs, depth, by_pose,
        )  # fmt: skip
        return True
