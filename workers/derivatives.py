"""What a small change of the figure or of its action changes a policy step later: derivatives of physics itself.

MuJoCo has no backward pass; on soles (`physics.sole`) physics is smooth enough to be differentiated. A state has 74
tangent coordinates, the root's place (3, world) and turn (3, its own frame), the joints' (31), then as many velocities
as qvel has them. A policy step is played once. In each of its substeps the acceleration a, (next qvel - qvel) / h, is
where the residual r of inverse dynamics vanishes; what a small change of pose, velocity or actuator targets does to it
follows from the implicit function theorem, da = -(dr/da)^-1 dr. No solver runs for that, as in a pushed simulation: the
derivatives of r are known from what a step leaves in MuJoCo's data (`workers.inverse_derivatives`), but for contacts
other than the feet's, with which r is differenced by pose (MuJoCo's `mjd_inverseFD`). The substeps' derivatives are
chained.
"""

import math
from concurrent.futures import ThreadPoolExecutor
from queue import SimpleQueue

import mujoco
import numpy as np
from numba import njit

from workers.action import ABSOLUTE, MODES, TARGET, control, decode
from workers.constraint_derivatives import add_reactions
from workers.humanoid import DIVERGED, build_model
from workers.inverse_derivatives import InverseDerivatives
from workers.kinematics import (
    JOINT_DOF,
    JOINT_QPOS,
    JOINT_SIZE,
    NUM_BODIES,
    NUM_DOF,
    NUM_JOINTS,
    NV,
    exponential,
    forward_kinematics,
    multiply,
    quaternion_at,
)  # fmt: skip
from workers.observation import OBSERVATION_SIZE, observe

TANGENT = 2 * NV
_SIZE = 1e-6  # m, rad: of differences of what is smooth and exact: actuator targets, observations
_DEPTH = 1e-8  # the same of inverse dynamics, where soles begin to give way within less than 0.1 mm
_STATES = 8  # whose matrices are multiplied together
_STATE = mujoco.mjtState.mjSTATE_INTEGRATION


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
def _aim(action, mode, scale, qpos, target_qpos, pd_target, out):
    decode(action, target_qpos if mode == TARGET else qpos, scale, mode == ABSOLUTE, pd_target)
    control(pd_target, qpos, out)


@njit(cache=True, nogil=True)
def _aims(action, mode, scale, qpos, target_qpos, ctrl, out):
    """Actuator targets into ctrl (31,), their derivatives by the state and by the action (31,) into out (31, 105)."""
    pd_target, end, still = np.empty(NUM_DOF), np.empty(NUM_DOF), np.zeros(NV)
    _aim(action, mode, scale, qpos, target_qpos, pd_target, ctrl)
    out[:] = 0.0
    for axis in range(3):  # of all joints at once: the targets of each depend on it alone
        pose, acted = qpos.copy(), action.copy()
        for joint in range(NUM_JOINTS):
            if axis < JOINT_SIZE[joint]:
                push(pose, still, 6 + JOINT_DOF[joint] + axis, _SIZE)
                acted[JOINT_DOF[joint] + axis] += _SIZE
        _aim(action, mode, scale, pose, target_qpos, pd_target, end)
        _joint_differences(ctrl, end, axis, out[:, 6:NV])
        _aim(acted, mode, scale, qpos, target_qpos, pd_target, end)
        _joint_differences(ctrl, end, axis, out[:, TANGENT:])


@njit(cache=True, nogil=True)
def _joint_differences(start, end, axis, out):
    for joint in range(NUM_JOINTS):
        first = JOINT_DOF[joint]
        if axis < JOINT_SIZE[joint]:
            for i in range(first, first + JOINT_SIZE[joint]):
                out[i, first + axis] = (end[i] - start[i]) / _SIZE


@njit(cache=True, nogil=True)
def _advance_turn(turn, speed, pose, timestep):
    """Derivatives pose (3, n) of an orientation, after it has gone on with a velocity (3,) whose own are speed (3, n).

    Both in the turning frame: exp(-h v) pose + h J(h v) speed, J the right Jacobian of the exponential map.
    """
    x, y, z = timestep * turn[0], timestep * turn[1], timestep * turn[2]
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    if angle > 1e-3:  # what is left out below is 1e-9 of the rest there; above, rounding is
        sine, cosine = math.sin(angle) / angle, (1.0 - math.cos(angle)) / square
        rest = (1.0 - sine) / square
    else:
        sine, cosine, rest = 1.0 - square / 6.0, 0.5 - square / 24.0, 1.0 / 6.0 - square / 120.0
    cross = np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)))
    twice = cross @ cross
    back = np.eye(3) - sine * cross + cosine * twice
    right = np.eye(3) - cosine * cross + rest * twice
    pose[:] = back @ pose.copy() + timestep * (right @ speed.copy())


@njit(cache=True, nogil=True)
def _advance(velocity, acceleration, timestep, state):
    """Derivatives state (M, 74, n) a substep on, of whose accelerations they are acceleration (M, 37, n).

    velocity: (M, 37), after the substep.
    """
    for m in range(len(state)):
        pose, speed = state[m, :NV], state[m, NV:]
        speed += timestep * acceleration[m]
        pose[:3] += timestep * speed[:3]
        _advance_turn(velocity[m, 3:6], speed[3:6], pose[3:6], timestep)
        for joint in range(NUM_JOINTS):
            i = 6 + JOINT_DOF[joint]
            if JOINT_SIZE[joint] == 1:
                pose[i] += timestep * speed[i]
            else:
                _advance_turn(velocity[m, i : i + 3], speed[i : i + 3], pose[i : i + 3], timestep)


class _Simulation:
    """A thread's own: plays policy steps of up to `_STATES` states and keeps how their substeps react."""

    def __init__(self, config):
        physics, self._mode, self._scale = config.physics, MODES[config.action.mode], config.action.scale
        self._model = build_model(physics)
        # inverse dynamics of the acceleration that is integrated. implicitfast is Euler's step here, bit for bit (no
        # actuator has damping), only slower; of the two inverses, which round otherwise, runs keep the one they had
        self._model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        self._model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_INVDISCRETE
        self._data, self._differences = mujoco.MjData(self._model), np.empty((NV, NV))
        self._inverse = InverseDerivatives(self._model)
        self._after = np.empty(mujoco.mj_stateSize(self._model, _STATE))
        self._kp, self._limits = self._model.actuator_gainprm[:, 0], self._model.actuator_forcerange[:, 1]
        self._damping, self._timestep, self._substeps = self._model.dof_damping, physics.timestep, physics.substeps
        self._aims = np.empty((_STATES, NUM_DOF, TANGENT + NUM_DOF))  # derivatives of actuator targets
        self._lost = np.empty(_STATES, dtype=bool)  # whose simulation exploded
        shape = _STATES, physics.substeps
        self._mass, self._constraint = np.empty((*shape, NV, NV)), np.empty((*shape, NV, NV))  # M, J^T D J
        self._react = np.empty((*shape, NV, TANGENT))  # r by pose and velocity, at the same a'
        self._turned = np.empty((*shape, NV, NV))  # M (a' - a) by pose
        self._stiffness = np.empty((*shape, NUM_DOF))  # of the actuators, N m / rad; 0 at their limits
        self._velocity = np.empty((*shape, NV))  # after the substep

    def play(self, m, physics, action, target_qpos, by_state):
        """A policy step of state m, which begins at physics (nstate,); without by_state, not by its first state."""
        data = self._data
        mujoco.mj_resetData(self._model, data)
        mujoco.mj_setState(self._model, data, physics, _STATE)
        _aims(action, self._mode, self._scale, data.qpos, target_qpos, data.ctrl, self._aims[m])
        try:
            for k in range(self._substeps):
                self._substep(m, k, by_state or k > 0)
            self._lost[m] = data.warning.number[DIVERGED].any() or not np.isfinite(self._velocity[m]).all()
        except mujoco.FatalError:
            self._lost[m] = True
        if self._lost[m]:  # the others of its stack can be solved
            self._mass[m], self._constraint[m], self._react[m], self._turned[m] = np.eye(NV), 0.0, 0.0, 0.0
            self._stiffness[m], self._velocity[m] = 0.0, 0.0

    def _substep(self, m, k, by_state):
        data, qpos, qvel = self._data, self._data.qpos.copy(), self._data.qvel.copy()
        mujoco.mj_step(self._model, data)
        # inertia, forces and constraints are still those of before the step
        mass, constraint, react, turned = (
            of[m, k] for of in (self._mass, self._constraint, self._react, self._turned)
        )  # fmt: skip
        mujoco.mj_fullM(self._model, data, mass)
        constraint[:] = react[:] = turned[:] = 0.0
        add_reactions(
            data.efc_force, data.efc_D, data.efc_KBIP, data.efc_J_rownnz, data.efc_J_rowadr, data.efc_J_colind,
            data.efc_J, constraint, react[:, NV:],
        )  # fmt: skip
        self._stiffness[m, k] = np.where(np.abs(data.actuator_force) < self._limits, self._kp, 0.0)
        self._velocity[m, k] = data.qvel
        if by_state:
            acceleration = (data.qvel - qvel) / self._timestep
            known = self._inverse.add(data, qpos, qvel, acceleration, self._stiffness[m, k], react, turned)
            if not known:
                self._difference(qpos, qvel, acceleration, react[:, :NV])
                turned[:] = 0.0  # is in the differences

    def _difference(self, qpos, qvel, acceleration, out):
        """Derivatives of r by pose (37, 37), of a substep that began at qpos, qvel."""
        model, data = self._model, self._data
        mujoco.mj_getState(model, data, self._after, _STATE)
        data.qpos[:], data.qvel[:], data.qacc[:] = qpos, qvel, acceleration
        mujoco.mjd_inverseFD(model, data, _DEPTH, True, self._differences, None, None, None, None, None, None)
        out[:] = self._differences.T
        mujoco.mj_setState(model, data, self._after, _STATE)

    def chain(self, count, by_state):
        """(count, 74, 105 or 31): derivatives of the policy steps of the first `count` states."""
        aims = self._aims[:count, :, 0 if by_state else TANGENT :]
        found = np.zeros((count, TANGENT, aims.shape[2]))
        if by_state:
            found[:, :, :TANGENT] = np.eye(TANGENT)
        lag = np.diag(self._timestep * self._damping)
        for k in range(self._substeps):
            # (M + J^T D J) da' = -dr at the same a'; (M + h damping) a = M a', as damping is made implicit
            mass, react = self._mass[:count, k], self._react[:count, k]
            damped = np.linalg.inv(mass + lag)
            answer = damped @ mass @ np.linalg.inv(mass + self._constraint[:count, k])
            by_pose = damped @ self._turned[:count, k] - answer @ react[:, :, :NV]
            by_aims = answer[:, :, 6:] * self._stiffness[:count, k, None]
            acceleration = by_pose @ found[:, :NV] - answer @ react[:, :, NV:] @ found[:, NV:] + by_aims @ aims
            _advance(self._velocity[:count, k], acceleration, self._timestep, found)
        found[self._lost[:count]] = np.nan
        return found


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
                size, places = _SIZE, moved
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
        # a simulation and the Python around another's side by side
        self._pool, self._simulations = ThreadPoolExecutor(threads), SimpleQueue()
        for _ in range(threads):
            self._simulations.put(_Simulation(config))

    def of(self, physics, action, target_qpos, by_state=True):
        """(M, 74, 105) float32: the next state's tangent coordinates by this one's (74) and by the action's (31).

        physics: (M, nstate), MuJoCo's integration state, as `Environment.physics`. action: (M, 31), in units of the
        policy's output. target_qpos: (M, 47). by_state: without, (M, 74, 31), by the action only. Where a simulation
        explodes there are numbers that are not finite.
        """
        found = np.empty((len(physics), TANGENT, (TANGENT if by_state else 0) + NUM_DOF), dtype=np.float32)

        def some(part):
            simulation = self._simulations.get()
            try:
                found[part] = self._some(simulation, physics[part], action[part], target_qpos[part], by_state)
            finally:
                self._simulations.put(simulation)

        self._in_parts(some, len(physics), _STATES)
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

    def _some(self, simulation, physics, action, target_qpos, by_state):
        for m in range(len(physics)):
            simulation.play(m, physics[m], action[m].astype(np.float64), target_qpos[m], by_state)
        return simulation.chain(len(physics), by_state)
