"""Windows before nearest approaches as linear models of physics, in which the policy is followed under noise.

A window's derivatives say where its figure would have come to with other actions: a local model of physics, in which
episodes cost no simulation. The policy is followed through it with its reactions to what it sees, under noise of its
own drawing, and descends what is left at the end. A single noisy episode says how to correct one deviation from its
path; what deviates otherwise, and the feedback that it takes, is in the model (as in Levine and Abbeel, "Learning
neural network policies with guided policy search under unknown dynamics", 2014, whose models are fitted to episodes).
"""

import math

import torch

from learner.encoding import deviations, residuals, split


class SimulatedWindows:
    """The `workers.types.Windows` of a chunk for a `LearnerState`.

    metrics: `arrival/left`, mean over the windows of the largest deviation at their end, in thresholds.
    """

    def __init__(self, state, chunk):
        self._state, windows, device = state, chunk.windows, state.device
        self._observation, self._mean, self._by_action, self._by_state = (
            torch.as_tensor(array, device=device)
            for array in (windows.observation, windows.mean, windows.by_action, windows.by_state)
        )
        config, seen = state.config, torch.as_tensor(windows.seen, device=device)
        self._seen, self._draws = seen[:, :-1], config.arrival.draws
        sigma = math.exp(config.policy.judge_log_sigma) / config.action.scale  # in units of the policy's output
        self._deviation = config.arrival.noise * sigma
        self.metrics = {"arrival/left": 0.0}
        if not len(windows):
            return
        difference = config.observation.target == "difference"
        limits, last = torch.as_tensor(windows.limits, device=device), self._observation[:, -1]
        with torch.no_grad():
            left = deviations(*split(last, difference)) / limits
            self.metrics["arrival/left"] = left.amax(dim=1).mean().item()

            def end(observation, limit):
                return residuals(*split(observation[None], difference), limit[None])[0]

            self._residual = residuals(*split(last, difference), limits)
            self._by_end = torch.func.vmap(torch.func.jacrev(end))(last, limits) @ seen[:, -1]

    def __len__(self):
        return len(self._mean)

    def loss(self, chosen, random):
        """Mean of sqrt(1 + |residuals|^2) at the ends of windows chosen (B,), each followed `arrival.draws` times.

        random: numpy generator of the noise.
        """
        count, steps, size = len(chosen), *self._mean.shape[1:]
        noise = random.standard_normal((count, self._draws, steps, size), dtype="float32")
        noise[:, :, -1] = 0.0  # nothing corrects the last step's: it would only hide the rest
        noise = torch.as_tensor(noise, device=self._state.device) * self._deviation
        left = self.ends(torch.as_tensor(chosen, device=self._state.device), noise)
        # far off a pull that grows no more: a window in which all is sensitive does not outweigh the others
        return torch.sqrt(1.0 + (left**2).sum(dim=-1)).mean()

    def ends(self, chosen, changes):
        """(B, D, 60): residuals, in thresholds, where the policy of now comes to in windows chosen (B,), its outputs
        changed by `changes` (B, D, K, 31), and as it reacts to what they do, as far as physics is linear there."""
        count, draws, steps, _ = changes.shape
        state = None  # (B, D, 74): the deviation from the window's own path, in tangent coordinates
        for k in range(steps):
            observation = self._observation[chosen, k, None].expand(count, draws, -1)
            if k:
                observation = observation + state @ self._seen[chosen, k - 1].transpose(1, 2)
            output = self._state.policy(self._state.observations(observation))
            action = output - self._mean[chosen, k, None] + changes[:, :, k]
            after = action @ self._by_action[chosen, k].transpose(1, 2)
            state = after + state @ self._by_state[chosen, k - 1].transpose(1, 2) if k else after
        return self._residual[chosen, None] + state @ self._by_end[chosen].transpose(1, 2)
