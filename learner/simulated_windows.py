"""Windows before nearest approaches, followed by the derivatives of physics that their worker simulated.

The policy of now, less the one that acted, changes an action; that changes the next state, in its tangent coordinates,
and that the policy's next action. To first order: exact where the policy is still the one that acted.
"""

import numpy as np
import torch

from learner.batch import following
from learner.encoding import deviations, split


class SimulatedWindows:
    """The `workers.types.Windows` of a chunk for a `LearnerState`. metrics: none."""

    metrics = {}

    def __init__(self, state, chunk):
        self._state, windows = state, chunk.windows
        self._difference = state.config.observation.target == "difference"

        def tensor(array):
            return torch.as_tensor(np.ascontiguousarray(array), device=state.device)

        steps = windows.by_action.shape[1]
        column = np.searchsorted(chunk.environment, windows.environment)
        at = windows.step[:, None] + np.arange(steps), column[:, None]
        self._observation, self._mean = tensor(chunk.observation[at]), tensor(chunk.mean[at])
        self._next = tensor(following(chunk)[at])
        self._limits, self._by_action, self._by_state, self._seen = (
            tensor(array) for array in (windows.limits, windows.by_action, windows.by_state, windows.seen)
        )

    def __len__(self):
        return len(self._limits)

    def arrive(self, chosen):
        """d^rp, d^kp and d^q at the end of the windows chosen (B,), in thresholds, (B, 3)."""
        chosen = torch.as_tensor(chosen, device=self._state.device)
        by_action, by_state, seen = self._by_action[chosen], self._by_state[chosen], self._seen[chosen]
        observation, tangent = self._observation[chosen, 0], None
        for k in range(by_action.shape[1]):
            change = self._state.policy(self._state.observations(observation)) - self._mean[chosen, k]
            carried = 0.0 if tangent is None else by_state[:, k - 1] @ tangent
            tangent = carried + by_action[:, k] @ change[:, :, None]
            observation = self._next[chosen, k] + (seen[:, k] @ tangent)[:, :, 0]
        return deviations(*split(observation, self._difference)) / self._limits[chosen]
