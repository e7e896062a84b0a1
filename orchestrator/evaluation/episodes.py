"""Episodes of an evaluation, judged at several accuracies in one simulation.

An episode at looser thresholds is the beginning of the one at tighter thresholds: the state, the policy and the noise
do not know of them. So it is simulated to the tightest, and what it was when it first met each looser level is noted.
"""

import math
from dataclasses import replace

import numpy as np
from numba import njit

from workers.config import RewardConfig
from workers.counter_random import EVALUATION, fill_normal
from workers.environment import Environment, new_observations
from workers.inference import PolicyNetwork
from workers.kinematics import NUM_DOF, NUM_JOINTS
from workers.reward import END, KP, RP, RQ, Q, reward
from workers.types import DEVIATIONS, FELL, NUM_PARTS, REACHED, Outcomes

_JUDGED = np.array([RP, KP, Q, RQ])
_ZEROS = np.zeros(NUM_JOINTS)


def judged_config(config):
    """The run's configuration with the full reward ("Return: always with the full reward", section 6), and all the time
    that a transition may take."""
    reward = RewardConfig(key_body_frame=config.reward.key_body_frame)
    return replace(config, reward=reward, task=replace(config.task, training_steps=None))


class Acting:
    """A policy's actions in evaluation. The noise is a function of (seed, task's number, step) and of nothing else."""

    def __init__(self, config, policy, num_rows, log_sigma):
        """log_sigma: log of the actions' standard deviation in radians; -inf for none."""
        self._network = PolicyNetwork(policy, num_rows)
        self._seed = config.seed
        self._sigma = math.exp(log_sigma) / config.action.scale
        self._noise = np.empty((num_rows, NUM_DOF)) if self._sigma else None

    def act(self, env, number, rows, action):
        """Fill rows `rows` (k,) of action (N, 31); number: (N,), of each environment's task in the grid."""
        mean = self._network.mean(env.observe(new_observations(len(rows)), rows))
        if self._noise is None:
            action[rows] = mean
            return
        noise = self._noise[: len(rows)]
        fill_normal(self._seed, EVALUATION, number[rows], env.steps[rows], noise)
        action[rows] = mean + self._sigma * noise


class Simulator:
    """Simulations that are used for one block of tasks after the other."""

    def __init__(self, config, library, policy, threads=1):
        """config: the run's `Config`; library: `MotionLibrary`; threads: of physics."""
        self._config, self._library, self._policy, self._threads = judged_config(config), library, policy, threads
        self._env = None

    def run(self, tasks, number, levels, log_sigma, ladder=None):
        """A list of one `Outcomes` per level of `levels` (`Thresholds`, loosest first), each ordered as the tasks.

        tasks: (M, 4), one episode each; number: (M,) int64, each task's number in the grid, which names its noise and
        is `Outcomes.environment`. ladder: a `Ladder` to fill, or None. Neither the number of simulations nor that of
        threads changes a bit.
        """
        count = min(self._config.evaluation.num_envs, len(tasks))
        if self._env is None or self._env.num_envs < count:
            self._env = Environment(self._config, self._library, count, self._threads)
        env, rows = self._env, self._env.num_envs
        acting = Acting(self._config, self._policy, rows, log_sigma)
        notes = [_Notes(rows, level) for level in levels[:-1]]
        out = [_empty_outcomes(tasks, number, level) for level in levels]
        place = np.zeros(rows, dtype=np.int64)  # which of the tasks each row is at
        own_number = np.zeros(rows, dtype=np.int64)
        action = np.zeros((rows, NUM_DOF), dtype=np.float32)
        begun, fresh, active = 0, np.arange(count), np.zeros(0, dtype=np.int64)
        while True:
            fresh = fresh[: len(tasks) - begun]
            if len(fresh):
                place[fresh] = np.arange(begun, begun + len(fresh))
                begun += len(fresh)
                own_number[fresh] = number[place[fresh]]
                env.task[fresh] = tasks[place[fresh]]
                env.begin(fresh)
                for note in notes:
                    note.met[fresh] = False
                active = np.union1d(active, fresh)
            if not len(active):
                return out
            acting.act(env, own_number, active, action)
            env.step(action, levels[-1], active)
            for note in notes:
                note.look(env, active)
            if ladder:
                ladder.look(env, active, place[active])
            over = env.end[active] != 0
            fresh = active[over]
            if len(fresh):
                for outcomes, note in zip(out, [*notes, None]):
                    _store(outcomes, place[fresh], env, fresh, note)
                active = active[~over]


def run_tasks(config, library, policy, tasks, limits, log_sigma, number=None, threads=1):
    """The `Outcomes` of tasks (M, 4) at one accuracy, ordered as the tasks.

    limits: `Thresholds`. log_sigma: log of the actions' deviation in radians; -inf for none. number: (M,), the tasks'
    numbers in the grid; default 0, 1, ...
    """
    number = np.arange(len(tasks)) if number is None else number
    return Simulator(config, library, policy, threads).run(tasks, number, [limits], log_sigma)[0]


class Ladder:
    """How far down a ladder of thresholds each task's episode came at any of its steps.

    met: (M,) int64, rungs whose thresholds it met, 0 to len(rungs): rung n was reached where met > n.
    """

    def __init__(self, rungs, tasks):
        """rungs: `Thresholds`, each tighter than the one before and none tighter than those that end the episodes."""
        self._limits = np.array([_limits(rung) for rung in rungs])
        self.met = np.zeros(tasks, dtype=np.int64)

    def look(self, env, active, place):
        """Note how far the active rows, which play the tasks `place`, have come with this step."""
        deviations = env.deviations[active[:, None], _JUDGED]
        near = (deviations[:, None] < self._limits).all(axis=2).sum(axis=1)
        near[env.end[active] == FELL] = 0  # a fall goes before a reach
        self.met[place] = np.maximum(self.met[place], near)


def _limits(level):
    return [level.root_position, level.key_bodies, level.joint_rotation, level.heading]


class _Notes:
    """What each row's episode was when it first met one of the looser levels."""

    def __init__(self, rows, level):
        self._limits = np.array(_limits(level))
        self.met = np.zeros(rows, dtype=bool)
        self.steps, self.trembles = np.zeros(rows, dtype=np.int64), np.zeros(rows, dtype=np.int64)
        self.parts, self.deviations = np.zeros((rows, NUM_PARTS)), np.zeros((rows, len(DEVIATIONS)))

    def look(self, env, active):
        """Note those of the active rows that meet the level with this step. A fall goes before a reach."""
        near = (env.deviations[active[:, None], _JUDGED] < self._limits).all(axis=1)
        near &= ~self.met[active] & (env.end[active] != FELL)
        rows = active[near]
        if not len(rows):
            return
        self.met[rows] = True
        self.steps[rows], self.trembles[rows] = env.steps[rows], env.trembles[rows]
        self.deviations[rows], self.parts[rows] = env.deviations[rows], env.totals[rows]
        # until its end an episode has no part of this; here it ends with success
        self.parts[rows, END] = _success(self.deviations[rows])


@njit(cache=True)
def _success(deviations):
    """r_end (Eq. 9) of episodes that reach their target with deviations (n, 7), to the same bits as in a step."""
    out, parts = np.empty(len(deviations)), np.empty(NUM_PARTS)
    for i in range(len(deviations)):
        row = deviations[i]
        reward(row, row, _ZEROS, _ZEROS, 0, 0, REACHED, True, 0.0, 0.0, parts)
        out[i] = parts[END]
    return out


def _empty_outcomes(tasks, number, level):
    """`Outcomes` of tasks that are yet to be played."""
    count = len(tasks)
    return Outcomes(
        clock=np.zeros(count, dtype=np.int64),
        environment=np.array(number, dtype=np.int64),
        task=np.array(tasks, dtype=np.float64),
        retained=np.zeros(count, dtype=bool),
        end=np.zeros(count, dtype=np.int8),
        fell_on=np.full(count, -1, dtype=np.int16),
        tightenings=np.full(count, level.tightenings, dtype=np.int64),
        steps=np.zeros(count, dtype=np.int64),
        trembles=np.zeros(count, dtype=np.int64),
        parts=np.zeros((count, NUM_PARTS)),
        deviations=np.zeros((count, len(DEVIATIONS))),
    )


def _store(outcomes, place, env, rows, note):
    """Put the ends of rows' episodes to their places; where `note` saw the level met before, that is the end."""
    outcomes.end[place], outcomes.fell_on[place] = env.end[rows], env.fell_on[rows]
    outcomes.steps[place], outcomes.trembles[place] = env.steps[rows], env.trembles[rows]
    outcomes.parts[place], outcomes.deviations[place] = env.totals[rows], env.deviations[rows]
    if note is None:
        return
    met = note.met[rows]
    place, rows = place[met], rows[met]
    outcomes.end[place], outcomes.fell_on[place] = REACHED, -1
    outcomes.steps[place], outcomes.trembles[place] = note.steps[rows], note.trembles[rows]
    outcomes.parts[place], outcomes.deviations[place] = note.parts[rows], note.deviations[rows]
