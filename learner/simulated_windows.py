"""Windows before nearest approaches, whose actions are corrected by the derivatives that their worker simulated.

Of every window the actions of its K steps are corrected: by the least changes that bring its end nearer to the target,
as far as physics is linear and with what the policy makes of them at later steps (a Gauss-Newton step with
Levenberg-Marquardt damping). The policy is then moved along them, as SBC moves it towards demonstrated actions (Eq.
17), but all steps of an update move it the same way: how far it has moved already is no reason to go back, as the mean
correction is far smaller than that of a single window.
"""

import math

import torch

from learner.encoding import deviations, residuals, split


class SimulatedWindows:
    """The `workers.types.Windows` of a chunk for a `LearnerState`, corrected.

    corrections: (M, K, 31), of the policy's output, the policy being that of now. metrics: `arrival/left`, mean over
    the windows of the largest deviation at their end, in thresholds.
    """

    def __init__(self, state, chunk):
        self._state, windows, device = state, chunk.windows, state.device
        self._observation, self._mean = (
            torch.as_tensor(array, device=device) for array in (windows.observation, windows.mean)
        )
        config = state.config
        self._difference = config.observation.target == "difference"
        self._sigma = math.exp(config.policy.judge_log_sigma) / config.action.scale  # in units of the policy's output
        self.metrics = {"arrival/left": 0.0}
        if not len(windows):
            return
        with torch.no_grad():
            limits = torch.as_tensor(windows.limits, device=device)
            left = deviations(*split(self._observation[:, -1], self._difference)) / limits
            self.metrics["arrival/left"] = left.amax(dim=1).mean().item()
            self._given = state.observations(self._observation[:, :-1].flatten(0, 1))
            residual, by_actions = self._end(windows, limits)
            # where the policy of now would have come to: it may be an update newer than the one that acted
            self._begun = state.policy(self._given).reshape(self._mean.shape)
            residual = residual + torch.einsum("mrkd,mkd->mr", by_actions, self._begun - self._mean)
            self.corrections = corrections(residual, by_actions, config.arrival.correction / config.action.scale)

    def __len__(self):
        return len(self._mean)

    def _end(self, windows, limits):
        """(residuals (M, R) at the windows' ends, in thresholds; their derivatives (M, R, K, 31) by the actions)."""
        count, steps, size = self._mean.shape
        by_action, by_state, seen = (
            torch.as_tensor(array, device=self._state.device)
            for array in (windows.by_action, windows.by_state, windows.seen)
        )
        moved = None  # (M, 74, k * 31): the state before step k by the actions so far
        for k in range(steps):
            if k:
                # a state that is pushed is seen by the policy, whose output changes, too
                seen_by_policy = self._policy_by_observation(self._observation[:, k]) @ seen[:, k - 1]
                moved = (by_state[:, k - 1] + by_action[:, k] @ seen_by_policy) @ moved
            moved = by_action[:, k] if moved is None else torch.cat([moved, by_action[:, k]], dim=2)

        def end(observation, limit):
            return residuals(*split(observation[None], self._difference), limit[None])[0]

        last = self._observation[:, -1]
        by_observation = torch.func.vmap(torch.func.jacrev(end))(last, limits)
        residual = residuals(*split(last, self._difference), limits)
        return residual, (by_observation @ (seen[:, -1] @ moved)).reshape(count, -1, steps, size)

    def _policy_by_observation(self, observation):
        """(M, 31, 282), of observations (M, 282)."""
        state = self._state
        return torch.func.vmap(torch.func.jacrev(lambda one: state.policy(state.observations(one))))(observation)

    def loss(self, chosen):
        """Of the windows chosen (B,): a number whose gradient is that of minus the mean log likelihood of their
        corrected actions, where the policy is as it was when the update began."""
        chosen = torch.as_tensor(chosen, device=self._state.device)
        mean = self._state.policy(self._given.reshape(*self._mean.shape[:2], -1)[chosen])
        done = (mean - self._begun[chosen]) * self.corrections[chosen]
        return -done.sum(dim=(1, 2)).mean() / self._sigma**2


def corrections(residual, by_actions, deviation):
    """Changes (M, K, 31) of actions that minimise |residual + what they change|^2 + |changes|^2 / deviation^2.

    residual: (M, R), by_actions: (M, R, K, 31), its derivatives. deviation: of corrections that cost as much as a
    residual of one.
    """
    count, rows, steps, size = by_actions.shape
    jacobian = by_actions.reshape(count, rows, -1).double()
    square = jacobian @ jacobian.transpose(1, 2)
    square = square + torch.eye(rows, dtype=square.dtype, device=square.device) / deviation**2
    found = -jacobian.transpose(1, 2) @ torch.linalg.solve(square, residual.double()[:, :, None])
    return found.reshape(count, steps, size).to(residual.dtype)
