"""Windows before nearest approaches, followed through physics that a network learns (`learner.dynamics`).

The policy of now is followed at the states and with the noise of then: a stochastic value gradient (Heess et al.,
"Learning continuous control policies by stochastic value gradients", 2015) of the largest of the three deviations. It
is far steadier than PPO's gradient, and biased: a twentieth of PPO's length is enough, a third is too much (lab book,
section 14).
"""

import numpy as np
import torch

from learner.batch import following
from learner.dynamics import moved
from learner.encoding import deviations
from learner.state import PHYSICS
from workers.types import judging

NEAR = 4.0  # thresholds; who came no nearer is left to PPO
_POWER = 4  # of the norm that stands for the largest of the three deviations


class LearnedWindows:
    """Those of every exploring episode that ended in a chunk; lets the dynamics of a `LearnerState` learn from it.

    metrics: of that.
    """

    def __init__(self, state, chunk):
        self._state = state
        self._observation, self._following, self._action, self._mean = (
            torch.as_tensor(np.ascontiguousarray(array).reshape(chunk.end.size, -1), device=state.device)
            for array in (chunk.observation, following(chunk), chunk.action, chunk.mean)
        )
        self.metrics = {"loss/dynamics": self._learn(chunk)}
        self._near(chunk)

    def __len__(self):
        return len(self._windows)

    def _learn(self, chunk):
        state, samples = self._state, chunk.end.size
        move = moved(chunk.pose, chunk.next_pose).reshape(samples, -1).astype(np.float32)
        move = torch.as_tensor(move, device=state.device)
        order = state.random(PHYSICS).permutation(samples)
        batches = np.array_split(order, -(-samples // state.config.ppo.minibatch_size))
        return state.dynamics.learn(self._observation, self._action, self._following, move, batches)

    def _near(self, chunk):
        """Find the windows: rows (M,) of their first steps, and the thresholds (M, 3) of their episodes' ends."""
        state, steps = self._state, self._state.config.arrival.steps
        horizon, n = chunk.end.shape
        with torch.no_grad():
            left = deviations(*state.dynamics.split(self._following)).cpu().numpy().reshape(horizon, n, 3)
        explores = ~judging(chunk.environment, state.config.policy.judges)
        rows, limits = [], []
        begin = np.zeros(n, dtype=np.int64)
        for (t, i), limit in zip(np.argwhere(chunk.end), chunk.final_thresholds):
            ratio = (left[begin[i] : t + 1, i] / limit).max(axis=1)
            first = begin[i] + int(ratio.argmin()) - steps + 1
            if explores[i] and ratio.min() < NEAR and first >= begin[i]:
                rows.append(first * n + i)
                limits.append(limit)
            begin[i] = t + 1
        self._windows, self._n = np.array(rows, dtype=np.int64), n
        if not rows:
            return
        self._limits = torch.as_tensor(np.array(limits), dtype=torch.float32, device=state.device)
        # what the network misses of the steps that were observed: with it, values are theirs
        every = [self._windows + k * n for k in range(steps)]
        with torch.no_grad():
            self._missing = [
                self._following[at] - state.dynamics.step(self._observation[at], self._action[at]) for at in every
            ]

    def loss(self, chosen, random):
        """Mean over the windows chosen (B,) of the largest deviation at arrival, in thresholds, cut off at NEAR.

        random: not used, the noise is that of the chunk.
        """
        ratio = self._arrive(chosen)
        return ((ratio**_POWER).sum(dim=1) + 1e-6).pow(1 / _POWER).clamp(max=NEAR).mean()

    def _arrive(self, chosen):
        """d^rp, d^kp and d^q at the end of the windows chosen (B,), in thresholds, (B, 3)."""
        state, rows = self._state, self._windows[chosen]
        observation = self._observation[rows]
        for k, missing in enumerate(self._missing):
            noise = self._action[rows + k * self._n] - self._mean[rows + k * self._n]
            action = state.policy(state.observations(observation)) + noise
            observation = state.dynamics.step(observation, action) + missing[chosen]
        return deviations(*state.dynamics.split(observation)) / self._limits[chosen]
