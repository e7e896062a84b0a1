"""The noise of actions in training: a function of (seed, environment, clock)."""

import numpy as np

from workers.counter_random import ACTION, fill_normal
from workers.kinematics import NUM_DOF
from workers.types import judging


class ActionNoise:
    """Noise of one worker's actions from `clock` on. Every number is normal with the policy's standard deviation.

    In one environment and dimension, noise t is (x_t + x_{t-1} + ... + x_{t-m+1}) / sqrt(m) of independent standard
    normal x, times sigma; m is `Policy.noise_window`. Judging environments (`Policy.judges`) have x_t times a sigma of
    their own, as in the evaluation.
    """

    def __init__(self, policy, seed, environment, clock, log_sigma=None):
        """environment: (N,) int64, indices in the run. clock: policy steps since the start of the run.

        log_sigma: of those that explore, in units of the policy's output; default: the policy's.
        """
        log_sigma = policy.log_sigma if log_sigma is None else log_sigma
        n, window = len(environment), policy.noise_window
        self._seed, self._environment, self._clock = seed, environment, clock
        self._judging = np.flatnonzero(judging(environment, policy.judges))
        self._sigma = np.full((n, 1), np.exp(log_sigma), dtype=np.float32)
        self._sigma[self._judging] = np.exp(policy.judge_log_sigma)
        self._draws = np.empty((window, n, NUM_DOF))  # x_t lies in row t modulo the window
        for earlier in range(clock - window + 1, clock):
            self._draw(earlier)

    def _draw(self, t):
        # counted from x_{1-m}, the first one that is needed
        window = len(self._draws)
        counter = np.full(len(self._environment), t + window - 1)
        fill_normal(self._seed, ACTION, self._environment, counter, self._draws[t % window])

    def next(self):
        """(N, 31) float32, of the next step."""
        window = len(self._draws)
        self._draw(self._clock)
        noise = self._draws.sum(axis=0) / np.sqrt(window)
        noise[self._judging] = self._draws[self._clock % window, self._judging]
        self._clock += 1
        return self._sigma * noise.astype(np.float32)
