"""Windows before nearest approaches, followed by the derivatives of physics that their worker simulated.

The policy of now, less the one that acted, changes an action; that changes the next state, in its tangent coordinates,
and that the policy's next action. To first order: exact where the policy is still the one that acted.
"""

import torch

from learner.encoding import deviations, split


class SimulatedWindows:
    """The `workers.types.Windows` of a chunk for a `LearnerState`. metrics: none."""

    metrics = {}

    def __init__(self, state, chunk):
        self._state, self._count = state, len(chunk.windows)
        self._difference = state.config.observation.target == "difference"
        names = ("limits", "observation", "mean", "by_action", "by_state", "seen")
        self._tensors = {name: torch.as_tensor(getattr(chunk.windows, name), device=state.device) for name in names}

    def __len__(self):
        return self._count

    def arrive(self, chosen):
        """d^rp, d^kp and d^q at the end of the windows chosen (B,), in thresholds, (B, 3)."""
        chosen = torch.as_tensor(chosen, device=self._state.device)
        limits, recorded, mean, by_action, by_state, seen = (tensor[chosen] for tensor in self._tensors.values())
        observation, tangent = recorded[:, 0], None
        for k in range(mean.shape[1]):
            change = self._state.policy(self._state.observations(observation)) - mean[:, k]
            carried = 0.0 if tangent is None else by_state[:, k - 1] @ tangent
            tangent = carried + by_action[:, k] @ change[:, :, None]
            observation = recorded[:, k + 1] + (seen[:, k] @ tangent)[:, :, 0]
        return deviations(*split(observation, self._difference)) / limits
