"""Derivatives of what constraints exert: joints at their limits, and corners of boxes on the floor.

A limit or a contact's edge exerts f = D (-J a' - b J v - k I depth) while that is positive, MuJoCo's soft constraints:
D = const I / (1 - I), I the impedance, which rises with the depth, as k and b given by `efc_KBIP`. By acceleration and
velocity f is linear. By pose its depth, its J and its lever change.
"""

import math

import mujoco
import numpy as np
from numba import njit

from workers.kinematics import JOINT_DOF, JOINT_QPOS, NUM_JOINTS, NV, logarithm, quaternion_at
from workers.spatial import COUNT, HANGS, TIP, cross, dot, summed

_LIMIT = int(mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT)
_PLANE, _BOX = int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_BOX)
_EDGES = 4  # of a contact's pyramid


@njit(cache=True, nogil=True)
def turning(x, y, z):
    """(3, 3): the change of a rotation's exponential map by a small turn in the turned frame."""
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    if angle > 1e-3:
        rest = (1.0 - 0.5 * angle / math.tan(0.5 * angle)) / square
    else:
        rest = 1.0 / 12.0 + square / 720.0
    matrix = np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)))
    return np.eye(3) + 0.5 * matrix + rest * (matrix @ matrix)


@njit(cache=True, nogil=True)
def add_reactions(force, weight, springs, lengths, starts, columns, values, by_acceleration, by_velocity):
    """Add what active constraints exert against a change of acceleration and of velocity (37, 37): J^T D J, J^T D b J.

    Of each row: force (MuJoCo's efc_state may be of an iteration before), weight: D, springs: (k, b, I, dI/d depth),
    and J: lengths, starts, columns, values, sparse.
    """
    for row in range(len(force)):
        if force[row] > 0.0:
            for i in range(starts[row], starts[row] + lengths[row]):
                for j in range(starts[row], starts[row] + lengths[row]):
                    product = weight[row] * values[i] * values[j]
                    by_acceleration[columns[i], columns[j]] += product
                    by_velocity[columns[i], columns[j]] += springs[row, 1] * product


@njit(cache=True, nogil=True)
def _by_depth(force, weight, spring, depth):
    """What a constraint's force gains by the depth."""
    stiffness, impedance, slope = spring[0], spring[2], spring[3]
    return force * slope / (impedance * (1.0 - impedance)) - weight * stiffness * (impedance + depth * slope)


@njit(cache=True, nogil=True)
def limits(
    qpos, qvel, seen, kinds, force, weight, springs, depth, starts, lengths, columns, values, by_pose
):  # fmt: skip
    """Add what joints at their limits exert against a change of pose to by_pose (37, 37).

    qvel, seen: v, a' (37,). Of every row: kinds, MuJoCo's; depth, pos - margin; the rest as in `add_reactions`.
    """
    for row in range(len(force)):
        if kinds[row] != _LIMIT or force[row] <= 0.0:
            continue
        first, size = starts[row], lengths[row]
        turned = np.zeros((3, 3))  # [c, j]: what a turn about j changes in J's c
        if size == 3:
            x, y, z = 0.0, 0.0, 0.0
            for joint in range(NUM_JOINTS):
                if 6 + JOINT_DOF[joint] == columns[first]:
                    x, y, z = logarithm(quaternion_at(qpos, JOINT_QPOS[joint]))
            axis = np.array((x, y, z))
            angle = math.sqrt(x * x + y * y + z * z)
            axis /= angle
            by_map = turning(x, y, z)
            for j in range(3):
                along = axis[0] * by_map[0, j] + axis[1] * by_map[1, j] + axis[2] * by_map[2, j]
                for c in range(3):
                    turned[c, j] = -(by_map[c, j] - along * axis[c]) / angle
        rise = _by_depth(force[row], weight[row], springs[row], depth[row])
        for j in range(size):
            change = rise * values[first + j]
            for c in range(size):
                at = columns[first + c]
                change -= weight[row] * turned[c, j] * (seen[at] + springs[row, 1] * qvel[at])
            for c in range(size):
                exerted = values[first + c] * change + turned[c, j] * force[row]
                by_pose[columns[first + c], columns[first + j]] -= exerted


def known(kinds):
    """Whether all contacts are of the floor and a box; kinds: (n, 2), the types of their geometries."""
    return bool((kinds == (_PLANE, _BOX)).all())


@njit(cache=True, nogil=True)
def _edges(x, y, z, frame, friction, out):
    """The edges of a pyramid as forces (4, 6), at (x, y, z) from the center of mass."""
    for e in range(_EDGES):
        slide = friction[e // 2] * (1.0 - 2.0 * (e % 2))
        for c in range(3):
            out[e, 3 + c] = frame[c] + slide * frame[3 * (1 + e // 2) + c]
        out[e, 0] = y * out[e, 5] - z * out[e, 4]
        out[e, 1] = z * out[e, 3] - x * out[e, 5]
        out[e, 2] = x * out[e, 4] - y * out[e, 3]


@njit(cache=True, nogil=True)
def soles(
    qvel, seen, cdof, center, bodies, address, dist, position, frame, friction, force, weight, springs, depth, by_pose
):  # fmt: skip
    """Add what the floor, z = 0, exerts against a change of pose on corners of boxes to by_pose (37, 37).

    center: of mass. Of every contact: bodies; address, the first of its four rows; dist, position, frame, friction, as
    in MuJoCo. Of every row: as in `limits`.
    """
    speed, speed_above = summed(cdof * qvel.reshape((NV, 1)), np.zeros(6))
    pull, pull_above = summed(cdof * seen.reshape((NV, 1)), np.zeros(6))
    met = np.zeros(COUNT, dtype=np.bool_)
    total, changes = np.zeros((COUNT, 6)), np.zeros((COUNT, NV, 6))  # the force on each body, and by pose
    edges, lever, other = np.empty((_EDGES, 6)), np.empty(3), np.empty(6)
    for n in range(len(bodies)):
        k, row = bodies[n], address[n]
        if row < 0:
            continue
        x, y, z = position[n, 0] - center[0], position[n, 1] - center[1], position[n, 2] - center[2]
        _edges(x, y, z, frame[n], friction[n], edges)
        damping = springs[row, 1]
        motion = pull[k] + damping * speed[k]  # what J is multiplied with
        met[k] = True
        for e in range(_EDGES):
            if force[row + e] > 0.0:
                total[k] += force[row + e] * edges[e]
        for j in range(NV):
            if not HANGS[TIP[k], j]:
                continue
            # the corner moves with the body; the contact's place is above or below it, half as deep
            axis, corner = cdof[j], z + 0.5 * dist[n]
            moved_x = axis[3] + axis[1] * corner - axis[2] * y
            moved_y = axis[4] + axis[2] * x - axis[0] * corner
            raised = axis[5] + axis[0] * y - axis[1] * x
            cross(axis, motion - pull_above[j] - damping * speed_above[j], other)
            for e in range(_EDGES):
                f, edge = force[row + e], edges[e]
                if f > 0.0:
                    lever[0] = moved_y * edge[5] - 0.5 * raised * edge[4]
                    lever[1] = 0.5 * raised * edge[3] - moved_x * edge[5]
                    lever[2] = moved_x * edge[4] - moved_y * edge[3]
                    turned = dot(other, edge) + motion[0] * lever[0] + motion[1] * lever[1] + motion[2] * lever[2]
                    change = _by_depth(f, weight[row + e], springs[row], depth[row]) * raised
                    changes[k, j] += (change - weight[row + e] * turned) * edge
                    for c in range(3):
                        changes[k, j, c] += f * lever[c]
    for k in range(COUNT):
        if met[k]:
            _subtract_forces(TIP[k], cdof, total[k], changes[k], by_pose)


@njit(cache=True, nogil=True)
def _subtract_forces(tip, cdof, force, changes, by_pose):
    """What dofs feel of a force (6,) on what `tip` moves, which changes (37, 6) by pose, and turn themselves."""
    other = np.empty(6)
    for j in range(NV):
        if HANGS[tip, j]:
            for i in range(NV):
                if HANGS[tip, i]:
                    by_pose[i, j] -= dot(cdof[i], changes[j])
                    if HANGS[i, j]:
                        cross(cdof[j], cdof[i], other)
                        by_pose[i, j] -= dot(other, force)
