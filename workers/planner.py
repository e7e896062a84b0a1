"""The task planner (section 4): which transition an environment tries next, and where its target stands."""

import numpy as np
from numba import njit

from workers.counter_random import STAY, TASK, uniforms
from workers.kinematics import about_z, forward_kinematics, heading, multiply, quaternion_at, rotate
from workers.library import sample_pose
from workers.termination import lowest

MOMENTS, ROTATIONS = 8, 4  # cells of a group's tasks: equal parts of the source's cancel range and of the rotations

_ALL_BODIES = np.ones(17, dtype=np.bool_)


def number_of_cells(library):
    """Cells of all tasks of a `MotionLibrary`."""
    return len(library.groups) * MOMENTS * ROTATIONS


def cells_of(tasks, library):
    """The cell (M,) int64 that each of the tasks (M, 4) lies in, numbered by group, then moment, then rotation."""
    source = tasks[:, 0].astype(np.int64)

    def part(value, low, high, parts):
        share = (value - low) / np.maximum(high - low, 1e-12)  # a range may be a point
        return np.clip((share * parts).astype(np.int64), 0, parts - 1)

    moment = part(tasks[:, 1], library.cancel[source, 0], library.cancel[source, 1], MOMENTS)
    rotation = part(tasks[:, 3], library.rotation[0], library.rotation[1], ROTATIONS)
    return (library.group_of(tasks) * MOMENTS + moment) * ROTATIONS + rotation


@njit(cache=True)
def draw_task(seed, environment, episode, groups, cancel, rotation, focus, shares, task):
    """A task into task (4,): source state, moment (s), target state, rotation (rad), a function of the counters.

    The group is uniform over groups (G, 2), the moment over the source's cancel range, the rotation over its range.
    With probability `focus`, a cell (see `cells_of`) is drawn by its share instead and the task is uniform within it;
    shares: cumulative, one per cell, or empty: no focus.
    """
    u = uniforms(seed, TASK, environment, episode, 0)
    moment, turn = u[1], u[2]
    if shares.shape[0] and u[3] < focus:
        cell = min(np.searchsorted(shares, u[0], side="right"), shares.shape[0] - 1)
        group = cell // (MOMENTS * ROTATIONS)
        moment = (cell // ROTATIONS % MOMENTS + moment) / MOMENTS
        turn = (cell % ROTATIONS + turn) / ROTATIONS
    else:
        group = min(int(u[0] * groups.shape[0]), groups.shape[0] - 1)
    source = groups[group, 0]
    task[0] = source
    task[1] = cancel[source, 0] + moment * (cancel[source, 1] - cancel[source, 0])
    task[2] = groups[group, 1]
    task[3] = rotation[0] + turn * (rotation[1] - rotation[0])


@njit(cache=True)
def stays(seed, environment, episode, probability):
    """Whether an environment keeps its task after the failure that began its episode number `episode`."""
    return uniforms(seed, STAY, environment, episode, 0)[0] < probability


@njit(cache=True)
def ground(qpos, position, rotation):
    """Lift the pose qpos (47,) until nothing is below the floor; position (17, 3), rotation (17, 4) receive its bodies.

    Clips put feet up to 4 cm into the floor, which a simulation would answer with a jump.
    """
    forward_kinematics(qpos, position, rotation)
    height, _ = lowest(position, rotation, _ALL_BODIES)
    if height < 0.0:
        qpos[2] -= height
        for body in range(position.shape[0]):
            position[body, 2] -= height


@njit(cache=True)
def place_target(source_qpos, source_qvel, angle, transition_time, from_source, qpos, qvel):
    """Turn and move the target pose qpos (47,), qvel (37,), as it is in its clip, to its place in the world (Eq. 14).

    The root stands where the source's root gets to in `transition_time` s while its velocity falls evenly to zero, at
    the target's own height. angle: rotation about the vertical, rad; from_source: angle 0 is the source's heading
    (`rotation.reference: source`) rather than the clip's own (`world`).
    """
    turn = angle
    root = quaternion_at(qpos, 3)
    if from_source:
        turn += heading(quaternion_at(source_qpos, 3)) - heading(root)
    q = about_z(turn)
    turned = multiply(q, root)
    for c in range(4):
        qpos[3 + c] = turned[c]
    qpos[0] = source_qpos[0] + 0.5 * transition_time * source_qvel[0]
    qpos[1] = source_qpos[1] + 0.5 * transition_time * source_qvel[1]
    # the linear velocity is in the world, the angular one in the root's own frame
    qvel[0], qvel[1], qvel[2] = rotate(q, qvel[0], qvel[1], qvel[2])


@njit(cache=True)
def begin(
    clip_qpos, clip_qvel, first, frames, fps, start, task, transition_time, from_source,
    qpos, qvel, bodies, rotations, target_qpos, target_qvel, target_bodies, target_rotations,
):  # fmt: skip
    """Begin a task (4,): the source pose on the ground at the world's origin, the target in its place.

    The library's arrays come first; all arguments after `from_source` are outputs of one environment.
    """
    source, target = int(task[0]), int(task[2])
    sample_pose(clip_qpos, clip_qvel, first[source], frames[source], fps[source], task[1], qpos, qvel)
    qpos[0], qpos[1] = 0.0, 0.0
    ground(qpos, bodies, rotations)
    sample_pose(
        clip_qpos, clip_qvel, first[target], frames[target], fps[target], start[target], target_qpos, target_qvel
    )
    place_target(qpos, qvel, task[3], transition_time, from_source, target_qpos, target_qvel)
    forward_kinematics(target_qpos, target_bodies, target_rotations)
