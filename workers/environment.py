"""N transition tasks side by side, on `mujoco.batch.Batch`. No Python loop over environments in a step."""

import numpy as np
from mujoco.batch import Batch, SimulationError
from numba import njit

from workers.action import MODES, act_batch
from workers.humanoid import DIVERGED, build_model
from workers.kinematics import NQ, NUM_BODIES, NUM_DOF, NUM_JOINTS, NV, forward_kinematics, forward_kinematics_batch
from workers.observation import OBSERVATION_SIZE, observe_batch
from workers.planner import begin, draw_task, stays
from workers.reward import deviate, deviate_batch, reward, sign_changes, tremble_share
from workers.termination import fall_mask, terminate
from workers.types import DEVIATIONS, FELL, NUM_PARTS, REACHED, WorkerState


@njit(cache=True)
def _plan(
    seed, stay_probability, environment, episode, failed, ids, groups, cancel, rotation, focus, shares, task, retained,
):  # fmt: skip
    """The next task of environments ids: the same one after a failure that stays, else a new one. Counts episodes."""
    for i in ids:
        episode[i] += 1
        retained[i] = failed[i] and stays(seed, environment[i], episode[i], stay_probability)
        if not retained[i]:
            draw_task(seed, environment[i], episode[i], groups, cancel, rotation, focus[i], shares, task[i])


@njit(cache=True)
def _begin(
    ids, clip_qpos, clip_qvel, first, frames, fps, start, task, transition_time, from_source, own_frame,
    qpos, qvel, bodies, rotations, target_qpos, target_qvel, target_bodies, target_rotations, deviations, joints,
):  # fmt: skip
    """Begin the tasks of environments ids and measure their first deviations."""
    for i in ids:
        begin(
            clip_qpos, clip_qvel, first, frames, fps, start, task[i], transition_time, from_source,
            qpos[i], qvel[i], bodies[i], rotations[i],
            target_qpos[i], target_qvel[i], target_bodies[i], target_rotations[i],
        )  # fmt: skip
        deviate(
            qpos[i], qvel[i], bodies[i], target_qpos[i], target_qvel[i], target_bodies[i],
            own_frame, deviations[i], joints[i],
        )  # fmt: skip


@njit(cache=True)
def _score(
    ids, qpos, qvel, last_qvel, diverged, bodies, rotations, target_qpos, target_qvel, target_bodies,
    thresholds, mask, max_steps, own_frame, penalty, tremble, failure,
    deviations, joints, steps, trembles, parts, end, fell_on,
):  # fmt: skip
    """After physics: bodies, deviations, tremble count, end and reward parts of environments ids."""
    before, joints_before = np.empty(deviations.shape[1]), np.empty(joints.shape[1])
    for i in ids:
        before[:], joints_before[:] = deviations[i], joints[i]
        forward_kinematics(qpos[i], bodies[i], rotations[i])
        deviate(
            qpos[i], qvel[i], bodies[i], target_qpos[i], target_qvel[i], target_bodies[i],
            own_frame, deviations[i], joints[i],
        )  # fmt: skip
        steps[i] += 1
        changes = sign_changes(last_qvel[i], qvel[i])
        trembles[i] += changes
        end[i], fell_on[i] = terminate(deviations[i], thresholds[i], bodies[i], rotations[i], mask, steps[i], max_steps)
        if diverged[i]:
            end[i], fell_on[i] = FELL, -1
        reward(
            before, deviations[i], joints_before, joints[i], changes, trembles[i], end[i],
            penalty, tremble[i], failure, parts[i],
        )  # fmt: skip


class Environment:
    """`num_envs` transition tasks; arrays have that many rows.

    A caller observes, steps, and begins new tasks where `end` says that one is over; a step resets nothing by itself,
    so that the pose that an episode ended in can still be read. All arrays are overwritten by the next call.
    """

    def __init__(self, config, library, num_envs, threads=1):
        """config: `workers.config.EnvConfig`; library: `workers.library.MotionLibrary`."""
        self.config, self.library, self.num_envs = config, library, num_envs
        self._substeps = config.physics.substeps
        self._batch = Batch(build_model(config.physics), num_envs, threads)
        self.physics = self._batch.state  # (num_envs, nstate), MuJoCo's integration state
        self.qpos, self.qvel = self._batch.bind("qpos"), self._batch.bind("qvel")
        self._ctrl, self._warmstart = self._batch.bind("ctrl"), self._batch.bind("qacc_warmstart")
        self.target_qpos, self.target_qvel = np.zeros((num_envs, NQ)), np.zeros((num_envs, NV))
        self.target_qpos[:, 3] = 1.0
        self.bodies, self.rotations = np.zeros((num_envs, NUM_BODIES, 3)), np.zeros((num_envs, NUM_BODIES, 4))
        self.target_bodies, self._target_rotations = np.zeros_like(self.bodies), np.zeros_like(self.rotations)
        self.deviations, self.joints = np.zeros((num_envs, len(DEVIATIONS))), np.zeros((num_envs, NUM_JOINTS))
        self.steps, self.trembles = np.zeros(num_envs, dtype=np.int64), np.zeros(num_envs, dtype=np.int64)
        self.task, self.retained = np.zeros((num_envs, 4)), np.zeros(num_envs, dtype=np.bool_)
        self.parts, self.totals = np.zeros((num_envs, NUM_PARTS)), np.zeros((num_envs, NUM_PARTS))
        self.end, self.fell_on = np.zeros(num_envs, dtype=np.int8), np.zeros(num_envs, dtype=np.int16)
        self.pd_target = np.zeros((num_envs, NUM_DOF))
        self._all = np.arange(num_envs)
        self._mask = fall_mask(config.fall.ignore_bodies)
        self._own_frame = config.reward.key_body_frame == "own"
        self._mode = MODES[config.action.mode]
        self._difference = config.observation.target == "difference"

    def begin(self, ids):
        """Begin the tasks in rows `ids` of `task`: poses set, counters, sums and the solver's warm start zeroed."""
        library, task = self.library, self.config.task
        self._batch.state[ids] = 0.0
        _begin(
            ids, library.qpos, library.qvel, library.first, library.frames, library.fps, library.start, self.task,
            task.transition_time, self.config.rotation.reference == "source", self._own_frame,
            self.qpos, self.qvel, self.bodies, self.rotations,
            self.target_qpos, self.target_qvel, self.target_bodies, self._target_rotations,
            self.deviations, self.joints,
        )  # fmt: skip
        self.steps[ids] = self.trembles[ids] = 0
        self.totals[ids] = 0.0

    def observe(self, out, ids=None):
        """s_t of every environment, or of rows ids, into out (len, 282)."""
        rows = self._all if ids is None else ids
        observe_batch(
            self.qpos[rows], self.qvel[rows], self.bodies[rows],
            self.target_qpos[rows], self.target_qvel[rows], self.target_bodies[rows], self._difference, out,
        )  # fmt: skip
        return out

    def step(self, action, thresholds, ids=None):
        """One policy step of rows ids (or all) with action (num_envs, 31) and `workers.types.Thresholds`.

        Fills deviations, parts, end, fell_on, pd_target of these rows and adds to steps, trembles, totals. A simulation
        that explodes (MuJoCo gives it up, or it is faster than `physics.max_speed`) keeps the pose that it had before
        the step and ends as a fall on body -1; no other row knows of it.
        """
        rows = self._all if ids is None else ids
        act_batch(action, self._mode, self.config.action.scale, self.qpos, self.target_qpos, self.pd_target, self._ctrl)
        last_qpos, last_qvel = self.qpos.copy(), self.qvel.copy()
        self._batch.warning[:] = 0
        refused = []
        try:
            self._batch.step(ids, nstep=self._substeps)
        except SimulationError as error:  # the others have been stepped
            refused = error.ids
        diverged = self._batch.warning[:, DIVERGED, 1].any(axis=1)
        diverged[refused] = True
        # MuJoCo looks at the start of a step, and for numbers beyond 1e10: what the last substep did is seen here
        diverged |= ~np.isfinite(self.qpos).all(axis=1)
        diverged |= ~(np.abs(self.qvel).max(axis=1) <= self.config.physics.max_speed)  # true of NaN, too
        if diverged.any():
            self.qpos[diverged], self.qvel[diverged] = last_qpos[diverged], last_qvel[diverged]
        switches = self.config.reward
        limits = thresholds.of(self.groups(thresholds, self._all))
        _score(
            rows, self.qpos, self.qvel, last_qvel, diverged, self.bodies, self.rotations,
            self.target_qpos, self.target_qvel, self.target_bodies,
            limits,
            self._mask, self.config.task.time_limit, self._own_frame,
            bool(switches.upper_body_penalty), tremble_share(switches, limits[:, 4]),
            float(switches.failure),
            self.deviations, self.joints, self.steps, self.trembles, self.parts, self.end, self.fell_on,
        )  # fmt: skip
        self.totals[rows] += self.parts[rows]

    def groups(self, thresholds, ids):
        """What `Thresholds.of` takes for rows ids: the numbers of their tasks' groups where they matter."""
        return self.library.group_of(self.task[ids]) if thresholds.groups else ids

    def place(self, physics, ids):
        """Put rows ids (M,) into states physics (M, nstate), as `physics` has them; tasks and targets stay."""
        self._batch.state[ids] = physics
        bodies, rotations = self.bodies[ids], self.rotations[ids]  # copies
        forward_kinematics_batch(self.qpos[ids], bodies, rotations)
        self.bodies[ids], self.rotations[ids] = bodies, rotations

    def load(self, state):
        """Become the environments of a `WorkerState`."""
        self.place(state.physics, self._all)
        for name in ("steps", "trembles", "task", "retained", "target_qpos", "target_qvel", "totals"):
            getattr(self, name)[:] = getattr(state, name)
        forward_kinematics_batch(self.target_qpos, self.target_bodies, self._target_rotations)
        deviate_batch(
            self.qpos, self.qvel, self.bodies, self.target_qpos, self.target_qvel, self.target_bodies,
            self._own_frame, self.deviations, self.joints,
        )  # fmt: skip

    def save(self, environment, episode, clock):
        """The `WorkerState` of these environments; the arguments are the fields that the planner and the noise own."""
        names = ("steps", "trembles", "task", "retained", "target_qpos", "target_qvel", "totals")
        return WorkerState(
            environment=environment.copy(),
            physics=self._batch.state.copy(),
            episode=episode.copy(),
            clock=clock,
            **{name: getattr(self, name).copy() for name in names},
        )

    def plan(self, seed, environment, episode, ids, focus=None, shares=()):
        """Draw the next tasks of rows ids into `task`: kept after a failure with the stay probability, else new.

        focus (num_envs,) and shares: see `planner.draw_task`; by default all tasks are equally likely.
        """
        library = self.library
        focus = np.zeros(self.num_envs) if focus is None else focus
        failed = (self.end != REACHED) & (self.end != 0)
        _plan(
            seed, self.config.task.stay_probability, environment, episode, failed, ids,
            library.groups, library.cancel, library.rotation, focus, np.array(shares, dtype=np.float64),
            self.task, self.retained,
        )  # fmt: skip


def new_observations(*shape):
    """An empty float32 array (*shape, 282)."""
    return np.empty((*shape, OBSERVATION_SIZE), dtype=np.float32)
