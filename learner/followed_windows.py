"""Windows of episodes as linear models of physics, in which the policy is followed under noise.

A window's derivatives say where its figure would have come to with other actions: a local model of physics, in which
episodes cost no simulation. The policy is followed through it with its reactions to what it sees, under noise of its
own drawing, and descends what is left after every step and, as a network foresees it (`learner.cost_to_go`), after the
last. A single noisy episode says how to correct one deviation from its path; what deviates otherwise, and the feedback
that it takes, is in the model (as in Levine and Abbeel, "Learning neural network policies with guided policy search
under unknown dynamics", 2014, whose models are fitted to episodes).
"""

import torch

from learner.encoding import deviations, residuals, split
from learner.state import FORESIGHT

HARDEST = 3.0  # pull of a window, in units of the median one's
LEAST_FORESEEN = 0.5  # share of the variance of what trials cost; with less a cost-to-go says nothing yet


class FollowedWindows:
    """The `workers.types.Windows` of a chunk for a `LearnerState`, whose cost-to-go learns from the chunk's `Trials`.
    None of them as long as that foresees too little.

    metrics: `arrival/left`, mean over the windows of the largest deviation at their end, in thresholds;
    `arrival/foreseen`, share of the variance of what the trials cost that was foreseen.
    """

    def __init__(self, state, chunk):
        self._state, windows, device = state, chunk.windows, state.device
        self._observation, self._mean, self._by_action, self._by_state, self._seen, self._limits, self._begin = (
            torch.as_tensor(array, device=device)
            for array in (
                windows.observation, windows.mean, windows.by_action, windows.by_state, windows.seen, windows.limits,
                windows.begin,
            )
        )  # fmt: skip
        config = state.config
        self._difference, self._draws = config.observation.target == "difference", config.arrival.draws
        self._deviation = config.arrival.noise * state.judge_sigma
        random = state.random(FORESIGHT)
        explained = state.cost_to_go.learn(chunk.trials, state.observations, self._difference, random)
        self._useful = len(windows) if explained >= LEAST_FORESEEN else 0
        self.metrics = {"arrival/left": 0.0, "arrival/foreseen": explained}
        if len(windows):
            left = deviations(*split(self._observation[:, -1], self._difference)) / self._limits
            self.metrics["arrival/left"] = left.amax(dim=1).mean().item()

    def __len__(self):
        return self._useful

    def inputs(self):
        """The policy's inputs in the windows, (M * K, 282)."""
        return self._state.observations(self._observation[:, :-1].flatten(0, 1))

    def loss(self, chosen, random):
        """Mean over windows chosen (B,), each followed `arrival.draws` times, of the discounted costs of their steps
        and of what is to come. Its gradient is that of a sum in which no window pulls much harder than the median one:
        in a few of them the figure loses its balance, and all is sensitive.

        random: numpy generator of the noise.
        """
        count, steps, size = len(chosen), *self._mean.shape[1:]
        noise = random.standard_normal((count, self._draws, steps, size), dtype="float32")
        noise[:, :, -1] = 0.0  # nothing corrects the last step's: it would only hide the rest
        noise = torch.as_tensor(noise, device=self._state.device) * self._deviation
        noise.requires_grad_()
        chosen = torch.as_tensor(chosen, device=self._state.device)
        observation = self.follow(chosen, noise)
        costs = self._costs(chosen, observation[:, :, 1:]).mean(dim=1)
        # by the outputs of each step, later reactions to them included
        (pull,) = torch.autograd.grad(costs.sum(), noise)
        norm = pull.flatten(1).norm(dim=1)
        pull = pull * (HARDEST * norm.median() / norm.clamp(min=1e-12)).clamp(max=1.0)[:, None, None, None]
        output = self._state.policy(self._state.observations(observation[:, :, :-1].detach()))
        surrogate = (pull * output).sum() / count  # lends the loss its gradient
        return costs.detach().mean() + surrogate - surrogate.detach()

    def follow(self, chosen, changes):
        """(B, D, K + 1, 282): what is seen before each step of windows chosen (B,), and after the last, if the policy
        of now acts, its outputs changed by `changes` (B, D, K, 31), and as far as physics is linear."""
        count, draws, steps, _ = changes.shape
        state, seen = None, [self._observation[chosen, 0, None].expand(count, draws, -1)]
        for k in range(steps):  # state: (B, D, 74), the deviation from the window's own path, in tangent coordinates
            output = self._state.policy(self._state.observations(seen[k]))
            action = output - self._mean[chosen, k, None] + changes[:, :, k]
            after = action @ self._by_action[chosen, k].transpose(1, 2)
            state = after + state @ self._by_state[chosen, k - 1].transpose(1, 2) if k else after
            seen.append(self._observation[chosen, k + 1, None] + state @ self._seen[chosen, k].transpose(1, 2))
        return torch.stack(seen, dim=2)

    def _costs(self, chosen, observation):
        """(B, D), of windows chosen (B,) in which observation (B, D, K, 282) is seen after each step."""
        count, draws, steps, size = observation.shape
        limits = self._limits[chosen].repeat_interleave(draws * steps, dim=0)
        left = residuals(*split(observation.reshape(-1, size), self._difference), limits)
        square = (left**2).sum(dim=1).reshape(count, draws, steps)
        foresight, inputs = self._state.cost_to_go, self._state.observations(observation[:, :, -1].flatten(0, 1))
        age = torch.arange(steps, device=self._state.device) - self._begin[chosen, None]  # of the window's own steps
        goes_on = torch.where(age[:, None] >= 0, foresight.goes_on(square), 1.0).cumprod(dim=2)
        before = torch.cat([torch.ones_like(goes_on[:, :, :1]), goes_on[:, :, :-1]], dim=2)
        weight = torch.where(age >= 0, foresight.discount ** age.clamp(min=0), 0.0)
        rest = foresight.discount ** (steps - self._begin[chosen])
        after = (foresight.cost(square) * weight[:, None] * before).sum(dim=2)
        return after + rest[:, None] * goes_on[:, :, -1] * foresight(inputs).reshape(count, draws)
