"""Generalised advantage estimation (Schulman et al. 2016) over a chunk of T steps of N environments."""

import numpy as np

from workers.types import TIMED_OUT


def advantages(reward, value, last_value, end, timeout_value, gamma, gae_lambda, goes_on=None):
    """(advantage, return), each (T, N) float32.

    reward, value: (T, N). last_value: (N,), value of the observation after the last step. end: (T, N), how an episode
    ended with the step, 0 if it did not. timeout_value: (T, N), the value to bootstrap a time-out with, read only where
    end is TIMED_OUT: zero treats it as a failure like any other. A fall and a reach end with value zero. goes_on:
    (T, N), what gamma is multiplied by after each step; None: nothing.
    """
    advantage = np.zeros_like(reward)
    running = np.zeros(reward.shape[1], dtype=reward.dtype)
    following, goes_on = last_value, np.ones_like(reward) if goes_on is None else goes_on
    for t in range(len(reward) - 1, -1, -1):
        over = end[t] != 0
        bootstrap = np.where(over, np.where(end[t] == TIMED_OUT, timeout_value[t], 0.0), following)
        delta = reward[t] + gamma * bootstrap * goes_on[t] - value[t]
        running = delta + np.where(over, 0.0, gamma * gae_lambda * running * goes_on[t])
        advantage[t] = running
        following = value[t]
    return advantage, advantage + value
