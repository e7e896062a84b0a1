"""What a small change of the figure or of its action changes a policy step later: derivatives of physics itself.

MuJoCo has no backward pass; on soles (`physics.sole`) it is smooth enough for differences. A state is changed in its
74 tangent coordinates, the root's place (3, world) and turn (3, its own frame), the joints' (31), then as many
velocities as qvel has them, one at a time, and so is each of the action's 31 numbers; all are stepped side by side.
"""

from concurrent.futures import ThreadPoolExecutor
from queue import SimpleQueue

import numpy as np
from mujoco.batch import Batch, SimulationError
from numba import njit

from workers.action import MODES, act_batch
from workers.humanoid import DIVERGED, build_model
from workers.kinematics import (
    JOINT_DOF,
    JOINT_QPOS,
    JOINT_SIZE,
    NUM_BODIES,
    NUM_DOF,
    NUM_JOINTS,
    NV,
    conjugate,
    exponential,
    forward_kinematics,
    logarithm,
    multiply,
    quaternion_at,
)  # fmt: skip
from workers.observation import OBSERVATION_SIZE, observe

TANGENT = 2 * NV
SIZE = 1e-4  # m, rad, m/s, rad/s, rad of PD target: 1e-3 and 1e-5 agree with it to 4 and 1 %
_SEEN_SIZE = 1e-6  # of what is observed, which is smooth and exact
_ROWS = 1024  # simulations that a thread steps side by side, at most


@njit(cache=True, nogil=True)
def _turn(qpos, start, axis, size):
    x, y, z = size * (axis == 0), size * (axis == 1), size * (axis == 2)
    q = multiply(quaternion_at(qpos, start), exponential(x, y, z))
    for c in range(4):
        qpos[start + c] = q[c]


@njit(cache=True, nogil=True)
def push(qpos, qvel, coordinate, size):
    """Change one tangent coordinate (0 to 73) of the pose qpos (47,), qvel (37,), in place."""
    if coordinate >= NV:
        qvel[coordinate - NV] += size
    elif coordinate < 3:
        qpos[coordinate] += size
    elif coordinate < 6:
        _turn(qpos, 3, coordinate - 3, size)
    else:
        for joint in range(NUM_JOINTS):
            axis = coordinate - 6 - JOINT_DOF[joint]
            if 0 <= axis < JOINT_SIZE[joint]:
                if JOINT_SIZE[joint] == 1:
                    qpos[JOINT_QPOS[joint]] += size
                else:
                    _turn(qpos, JOINT_QPOS[joint], axis, size)


@njit(cache=True, nogil=True)
def difference(qpos, qvel, other_qpos, other_qvel, out):
    """Tangent coordinates out (74,) that lead from one pose to another near it; the inverse of `push`."""
    for c in range(3):
        out[c] = other_qpos[c] - qpos[c]
    out[3], out[4], out[5] = logarithm(multiply(conjugate(quaternion_at(qpos, 3)), quaternion_at(other_qpos, 3)))
    for joint in range(NUM_JOINTS):
        at, start = 6 + JOINT_DOF[joint], JOINT_QPOS[joint]
        if JOINT_SIZE[joint] == 1:
            out[at] = other_qpos[start] - qpos[start]
        else:
            turn = multiply(conjugate(quaternion_at(qpos, start)), quaternion_at(other_qpos, start))
            out[at], out[at + 1], out[at + 2] = logarithm(turn)
    for i in range(NV):
        out[NV + i] = other_qvel[i] - qvel[i]


@njit(cache=True, nogil=True)
def _push_rows(qpos, qvel, action, columns, per_unit):
    """Row i: column columns[i] of (74 tangent coordinates, 31 numbers of the action) pushed; -1: none."""
    for i in range(len(columns)):
        if columns[i] >= TANGENT:
            action[i, columns[i] - TANGENT] += SIZE * per_unit
        elif columns[i] >= 0:
            push(qpos[i], qvel[i], columns[i], SIZE)


@njit(cache=True, nogil=True)
def _differences(qpos, qvel, per_state, per_unit, columns, out):
    """out (M, 74, per_state - 1): derivatives of M states, each a row without a push followed by its pushed rows."""
    change = np.empty(TANGENT)
    for m in range(out.shape[0]):
        first = m * per_state
        for k in range(1, per_state):
            difference(qpos[first], qvel[first], qpos[first + k], qvel[first + k], change)
            size = SIZE * per_unit if columns[first + k] >= TANGENT else SIZE
            for c in range(TANGENT):
                out[m, c, k - 1] = change[c] / size


@njit(cache=True, nogil=True)
def _observe_differences(qpos, qvel, target_qpos, target_qvel, own, out):
    bodies, moved, rotations = np.empty((NUM_BODIES, 3)), np.empty((NUM_BODIES, 3)), np.empty((NUM_BODIES, 4))
    target_bodies = np.empty((NUM_BODIES, 3))
    rest, end = np.empty(OBSERVATION_SIZE), np.empty(OBSERVATION_SIZE)
    for m in range(qpos.shape[0]):
        forward_kinematics(target_qpos[m], target_bodies, rotations)
        forward_kinematics(qpos[m], bodies, rotations)
        observe(qpos[m], qvel[m], bodies, target_qpos[m], target_qvel[m], target_bodies, own, rest)
        for c in range(TANGENT):
            q, v, places, size = qpos[m].copy(), qvel[m].copy(), bodies, 1.0  # velocities: linear, nothing moves
            if c < NV:
                size, places = _SEEN_SIZE, moved
            push(q, v, c, size)
            if c < NV:
                forward_kinematics(q, moved, rotations)
            observe(q, v, places, target_qpos[m], target_qvel[m], target_bodies, own, end)
            for i in range(OBSERVATION_SIZE):
                out[m, i, c] = (end[i] - rest[i]) / size


class Derivatives:
    """Those of a policy step and of the state, on `threads` threads. A row's numbers depend on nothing but the row."""

    def __init__(self, config, threads):
        """config: `workers.config.EnvConfig`."""
        self._config, self._own = config, config.observation.target == "difference"
        # a simulation and the Python around another's side by side: one batch for each thread, not threads for a batch
        self._pool, self._batches = ThreadPoolExecutor(threads), SimpleQueue()
        for _ in range(threads):
            self._batches.put(Batch(build_model(config.physics), _ROWS, 1))

    def of(self, physics, action, target_qpos, by_state=True):
        """(M, 74, 105) float32: the next state's tangent coordinates by this one's (74) and by the action's (31).

        physics: (M, nstate), MuJoCo's integration state, as `Environment.physics`. action: (M, 31), in units of the
        policy's output. target_qpos: (M, 47). by_state: without, (M, 74, 31), by the action only. Where a simulation
        explodes there are numbers that are not finite.
        """
        columns = np.arange(-1 if by_state else TANGENT - 1, TANGENT + NUM_DOF)
        columns[0] = -1
        found = np.empty((len(physics), TANGENT, len(columns) - 1), dtype=np.float32)

        def some(part):
            batch = self._batches.get()
            try:
                self._some(batch, physics[part], action[part], target_qpos[part], columns, found[part])
            finally:
                self._batches.put(batch)

        self._in_parts(some, len(physics), _ROWS // len(columns))
        return found

    def observed(self, qpos, qvel, target_qpos, target_qvel):
        """(M, 282, 74) float32: s_t by the state, for poses (M, 47), (M, 37) with targets likewise."""
        out = np.empty((len(qpos), OBSERVATION_SIZE, TANGENT), dtype=np.float32)

        def some(part):
            _observe_differences(qpos[part], qvel[part], target_qpos[part], target_qvel[part], self._own, out[part])

        self._in_parts(some, len(qpos), 16)
        return out

    def _in_parts(self, some, count, at_once):
        list(self._pool.map(some, [slice(first, first + at_once) for first in range(0, count, at_once)]))

    def _some(self, batch, physics, action, target_qpos, columns, out):
        mode, scale = MODES[self._config.action.mode], self._config.action.scale
        per_state, rows = len(columns), len(physics) * len(columns)
        batch.state[:rows].reshape(len(physics), per_state, -1)[:] = physics[:, None]
        qpos, qvel, ctrl = (batch.bind(name)[:rows] for name in ("qpos", "qvel", "ctrl"))
        acted, pushed = np.repeat(action.astype(np.float64), per_state, axis=0), np.tile(columns, len(physics))
        _push_rows(qpos, qvel, acted, pushed, 1.0 / scale)
        act_batch(acted, mode, scale, qpos, np.repeat(target_qpos, per_state, axis=0), np.empty_like(acted), ctrl)
        batch.warning[:] = 0
        try:
            batch.step(np.arange(rows), nstep=self._config.physics.substeps)
        except SimulationError as error:
            qvel[error.ids] = np.nan
        qvel[batch.warning[:rows, DIVERGED, 1].any(axis=1)] = np.nan
        _differences(qpos, qvel, per_state, 1.0 / scale, pushed, out)
