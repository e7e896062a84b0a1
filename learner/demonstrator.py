"""The SBC steps of an update: demonstrations drawn from a chunk, and the gradient steps on them."""

import torch

from learner import sbc
from learner.state import DEMONSTRATIONS


class Demonstrator:
    """Draws demonstrations from a chunk and does the SBC steps of one update."""

    def __init__(self, state, chunk, batch_size):
        """batch_size: demonstrations per step, K of Eq. 17. `valid_share`: of all pairs, how many are valid."""
        self._state, self._chunk, self._size = state, chunk, batch_size
        self.valid_share = 0.0
        self._pairs = ()
        if state.config.sbc.enabled:
            self._pairs = sbc.valid_pairs(chunk.pose, chunk.next_pose, chunk.end)
            horizon, n = chunk.end.shape
            self.valid_share = len(self._pairs) / (n * horizon * (horizon + 1) / 2)
            self._random = state.random(DEMONSTRATIONS)

    def inputs(self):
        """The policy's inputs of one draw of demonstrations, or of none: [(K, 282)] or []."""
        return [self._draw()[0]] if len(self._pairs) else []

    def step(self, share=1.0):
        """One gradient step on `batch_size` demonstrations, drawn uniformly from all valid pairs; its metrics. share:
        factor on the gradient, where PPO's is but a share of what the policy descends."""
        if not len(self._pairs):
            return {"loss/sbc": 0.0, "gradient/sbc": 0.0}
        state, config = self._state, self._state.config.sbc
        inputs, action, weight = self._draw()
        loss = sbc.sbc_loss(state.policy(inputs), action, weight, config)
        norm = state.descend("policy", loss, share)
        return {"loss/sbc": loss.detach(), "gradient/sbc": norm}

    def _draw(self):
        """(policy's inputs (K, 282), action (K, 31), gap weight (K,)) of demonstrations, as tensors."""
        state, chosen = self._state, self._random.integers(len(self._pairs), size=self._size)
        observation, action = sbc.demonstrations(self._chunk, self._pairs, chosen, state.config)
        weighting = state.config.sbc.gap_weighting
        weight = sbc.gap_weights(self._pairs.gap()[chosen], len(self._chunk.end) + 1, weighting)
        observation, action, weight = (
            torch.as_tensor(array, device=state.device) for array in (observation, action, weight)
        )
        with torch.no_grad():
            return state.observations(observation), action, weight
