"""The noise of actions in training: a function of (seed, environment, clock)."""

import numpy as np

from workers.counter_random import ACTION, fill_normal
from workers.kinematics import NUM_DOF
from workers.types import judging


class ActionNoise:
    """Noise of one worker's actions from `clock` on. Every number is normal with the standard deviation asked for.

    In one environment and dimension, noise t is (x_t + x_{t-1} + ... + x_{t-m+1}) / sqrt(m) of independent standard
    normal x, times sigma; m is `Policy.noise_window`, or 1 where noise is to be independent. Judging environments
    (`Policy.judges`) have x_t times a sigma of their own, as in the evaluation.
    """

    def __init__(self, policy, seed, environment, clock):
        """environment: (N,) int64, indices in the run. clock: policy steps since the start of the run."""
        n, window = len(environment), policy.noise_window
        self._seed, self._environment, self._clock = seed, environment, clock
        self._judging = judging(environment, policy.judges)
        self._judge_sigma = np.exp(policy.judge_log_sigma)
        self._draws = np.empty((window, n, NUM_DOF))  # x_t lies in row t modulo the window
        for earlier in range(clock - window + 1, clock):
            self._draw(earlier)

    def _draw(self, t):
        # counted from x_{1-m}, the first one that is needed
        window = len(self._draws)
        counter = np.full(len(self._environment), t + window - 1)
        fill_normal(self._seed, ACTION, self._environment, counter, self._draws[t % window])

    def next(self, log_sigma, independent):
        """(N, 31) float32, of the next step. log_sigma: (N,), of all but judges, in units of the policy's output.

        independent: (N,) bool, whether the noise of exploring environments is x_t alone; that of judges always is.
        """
        window = len(self._draws)
        self._draw(self._clock)
        noise = self._draws.sum(axis=0) / np.sqrt(window)
        alone = self._judging | independent
        noise[alone] = self._draws[self._clock % window, alone]
        self._clock += 1
        sigma = np.exp(log_sigma)
        sigma[self._judging] = self._judge_sigma
        return sigma[:, None].astype(np.float32) * noise.astype(np.float32)
