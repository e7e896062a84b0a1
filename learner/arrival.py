"""Descent of what is left to the target, through the physics of a few steps (not in the paper).

PPO learns from one number per episode; the pose that it came to says in all its numbers how to correct. K steps of
episodes are looked at again: what changes of the policy would have changed is told by derivatives of physics, by what
an action does and by what later actions make of it (`learner.followed_windows`).
"""

import torch

from learner.followed_windows import FollowedWindows
from learner.state import ARRIVALS


class Arrival:
    """Of one update: its gradients, from windows of the chunk; nothing if `arrival.weight` is 0."""

    def __init__(self, state, chunk):
        config = state.config.arrival
        self._state, self._windows, self._metrics = state, (), {}
        if not config.weight or chunk.windows is None:
            return
        self._random, self._windows = state.random(ARRIVALS), FollowedWindows(state, chunk)
        self._metrics = {"loss/arrival": 0.0, "gradient/arrival": 0.0, **self._windows.metrics}

    @property
    def descends(self):
        """Whether there is anything to descend."""
        return len(self._windows) > 0

    @property
    def rest(self):
        """Weight of PPO's gradient in the mean with this one."""
        return 1.0 / (1.0 + self._state.config.arrival.weight) if self.descends else 1.0

    def inputs(self):
        """The policy's inputs in the windows: [(n, 282)] or []."""
        return [self._windows.inputs()] if self._windows else []

    def gradient(self):
        """(gradient in the order of the policy's parameters, clipped as PPO's, or None; metrics) of a few windows."""
        if not self.descends:
            return None, self._metrics
        state, config = self._state, self._state.config.arrival
        chosen = self._random.integers(len(self._windows), size=config.batch_size)
        loss = self._windows.loss(chosen, self._random)
        parameters = list(state.policy.parameters())
        found = torch.autograd.grad(loss, parameters)
        norm = torch.sqrt(sum((gradient**2).sum() for gradient in found))
        factor = (state.config.ppo.max_grad_norm / (norm + 1e-6)).clamp(max=1.0)
        metrics = {**self._metrics, "loss/arrival": loss.detach(), "gradient/arrival": norm}
        return [factor * gradient for gradient in found], metrics
