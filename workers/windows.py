"""The last steps before the nearest approach of some episodes, with the derivatives of physics along them.

What `arrival.physics=simulated` learns from (`learner.arrival`). Which episodes is a function of (seed, environment,
episode), so that it does not depend on how many workers there are.
"""

import numpy as np
from numba import njit

from workers.counter_random import DERIVATIVES, uniforms
from workers.derivatives import TANGENT, Derivatives, observed
from workers.kinematics import NQ, NUM_DOF
from workers.observation import OBSERVATION_SIZE
from workers.reward import KP, RP, Q
from workers.types import Windows

NEAR = 4.0  # thresholds; who came no nearer is left to PPO


@njit(cache=True)
def drawn(seed, environment, episode, share):
    """Whether the episodes numbered episode (E,) of environments (E,) are among the share, (E,) bool."""
    out = np.empty(len(episode), dtype=np.bool_)
    for i in range(len(episode)):
        out[i] = uniforms(seed, DERIVATIVES, environment[i], episode[i], 0)[0] < share
    return out


class WindowRecorder:
    """Follows the steps of one chunk of an `Environment` after another; scratch memory only."""

    def __init__(self, config, env, horizon, seed, threads):
        """config: `EnvConfig`. horizon: steps of a chunk. seed: of the run."""
        n = env.num_envs
        self._config, self._env, self._seed = config.arrival, env, seed
        self._own = config.observation.target == "difference"
        self._derivatives = Derivatives(config, threads)
        self._physics = np.empty((horizon, n, env.physics.shape[1]))
        self._target = np.empty((horizon, n, NQ)), np.empty((horizon, n, env.target_qvel.shape[1]))
        self._after = np.empty_like(self._target[0]), np.empty_like(self._target[1])
        self._left = np.empty((horizon, n, 3))

    def begin(self):
        """A new chunk."""
        self._begun = np.zeros(self._env.num_envs, dtype=np.int64)  # the step of the chunk at which an episode began
        self._found = []  # (step, column, limits)

    def before(self, t):
        """Step t is about to be taken."""
        self._physics[t] = self._env.physics
        self._target[0][t], self._target[1][t] = self._env.target_qpos, self._env.target_qvel

    def after(self, t):
        """It has been taken, and nothing has begun anew yet."""
        self._after[0][t], self._after[1][t] = self._env.qpos, self._env.qvel
        self._left[t] = self._env.deviations[:, [RP, KP, Q]]

    def ended(self, t, ids, environment, episode, explores, limits):
        """Episodes ended in rows ids at step t. environment, episode: (N,), indices in the run and numbers; explores:
        (N,) bool. limits: (len, 3), the thresholds that judged them."""
        steps = self._config.steps
        chosen = explores[ids] & drawn(self._seed, environment[ids], episode[ids], self._config.share)
        for i, limit in zip(ids[chosen], limits[chosen]):
            ratio = (self._left[self._begun[i] : t + 1, i] / limit).max(axis=1)
            first = self._begun[i] + int(ratio.argmin()) - steps + 1
            if ratio.min() < NEAR and first >= self._begun[i]:
                self._found.append((first, i, limit))
        self._begun[ids] = t + 1

    def windows(self, action, environment):
        """The chunk's `Windows`. action: (T, N, 31), what was done; environment: (N,), indices in the run."""
        found, steps = sorted(self._found, key=lambda item: (item[1], item[0])), self._config.steps
        first, column = (np.array([item[k] for item in found], dtype=np.int64) for k in (0, 1))
        limits = np.array([item[2] for item in found]).reshape(-1, 3)
        parts = [
            self._derivatives.of(
                self._physics[first + k, column], action[first + k, column], self._target[0][first + k, column], k > 0
            )
            for k in range(steps)
        ]
        by_state = [part[:, :, :TANGENT] for part in parts[1:]]
        seen = [
            observed(*(array[first + k, column] for array in (*self._after, *self._target)), self._own)
            for k in range(steps)
        ]
        made = Windows(
            environment=environment[column],
            step=first,
            limits=limits.astype(np.float32),
            by_action=_stack([part[:, :, -NUM_DOF:] for part in parts], len(found), TANGENT, NUM_DOF),
            by_state=_stack(by_state, len(found), TANGENT, TANGENT),
            seen=_stack(seen, len(found), OBSERVATION_SIZE, TANGENT),
        )
        fine = np.isfinite(made.by_action).all(axis=(1, 2, 3)) & np.isfinite(made.by_state).all(axis=(1, 2, 3))
        return made if fine.all() else made.take(np.flatnonzero(fine))


def _stack(parts, count, *shape):
    """(count, len(parts), *shape) float32."""
    if not parts:
        return np.empty((count, 0, *shape), dtype=np.float32)
    return np.ascontiguousarray(np.stack(parts, axis=1), dtype=np.float32)
