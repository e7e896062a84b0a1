"""What is left to the target, as a cost of every step to come: a network that foresees it.

A window of a few steps does not show what becomes of the figure later: whoever runs through the target is as near it as
who stops there, and one of them falls. The cost-to-go at the end of a window says so, in all the numbers of the state
that it is differentiated by (a critic at the end of short horizons, as in Xu et al., "Accelerated policy learning with
parallel differentiable simulation", 2022).
"""

import numpy as np
import torch
from torch import nn

from learner.encoding import residuals, split
from learner.gae import advantages
from learner.networks import build_mlp
from workers.observation import OBSERVATION_SIZE
from workers.types import CONTINUES, FELL

NEAR = 4.0  # thresholds: up to here a step costs about what is left, farther off less and less more
FALLEN = 3.0  # m: what is left to who has fallen, for ever, is as if the root's place were so far off
_TRACE = 0.95  # lambda of TD(lambda)
_RATE = 1e-3
_PASSES, _BATCH = 3, 512
_UNIT = 10.0  # of the network's output


class CostToGo:
    """The network and its optimizer: of a state, the discounted sum of the costs of all later steps."""

    def __init__(self, config, generator, device):
        """config: `ArrivalConfig`. generator: of torch, for the first weights."""
        # smooth: its derivatives are what counts
        network = build_mlp([OBSERVATION_SIZE, *config.hidden, 1], generator, 1.0, hidden_gain=1.0, activation=nn.SiLU)
        self.network, self.discount, self._device = network.to(device), config.discount, device
        self._time, self._ends = config.time, config.ends
        self._optimizer = torch.optim.Adam(self.network.parameters(), lr=_RATE, fused=True)

    def state_dict(self):
        """Plain tensors and numbers for a checkpoint."""
        return {"network": self.network.state_dict(), "optimizer": self._optimizer.state_dict()}

    def load_state_dict(self, state):
        """The inverse of `state_dict`."""
        self.network.load_state_dict(state["network"])
        self._optimizer.load_state_dict(state["optimizer"])

    def __call__(self, inputs):
        """(n,), of normalized observations (n, 282)."""
        return _UNIT * self.network(inputs).squeeze(-1)

    def cost(self, square):
        """Of a step after which the residuals' squares (`learner.encoding.residuals`) sum to `square`, of any shape."""
        return self._time + NEAR * torch.log((NEAR + torch.sqrt(1.0 + square)) / (NEAR + 1.0))

    def goes_on(self, square):
        """Share of what is to come after such a step that is left of it, 0 to 1: an arrival ends the rest."""
        return torch.ones_like(square) if self._ends is None else 1.0 - 1.0 / (1.0 + (square / self._ends) ** 2)

    def learn(self, trials, normalized, difference, random):
        """Learn from `workers.types.Trials`; which share of the variance of what they cost was foreseen before that.

        normalized: turns observations (n, 282) into inputs; difference: see `encoding.split`; random: numpy generator.
        """
        steps, count = trials.standing.shape
        if not count:
            return 0.0
        observation = torch.as_tensor(trials.observation, device=self._device).flatten(0, 1)
        limits = torch.as_tensor(trials.limits, device=self._device).repeat(steps + 1, 1)
        with torch.no_grad():
            inputs = normalized(observation)
            square = (residuals(*split(observation, difference), limits) ** 2).sum(dim=1)
            arrays = self(inputs), self.cost(square), self.goes_on(square)
            fallen = self.cost((FALLEN / limits[:count, 0]) ** 2)
        foreseen, costs, goes_on = (array.cpu().numpy().reshape(steps + 1, count) for array in arrays)
        wanted = self.targets(costs, goes_on, foreseen, trials.standing, fallen.cpu().numpy())
        alive = np.concatenate([np.ones((1, count), dtype=bool), trials.standing[:-1]])
        missed = (wanted - foreseen[:-1])[alive]
        explained = 1.0 - float((missed**2).mean() / max(wanted[alive].var(), 1e-12))
        rows, wanted = np.flatnonzero(alive), torch.as_tensor(wanted.ravel(), device=self._device)
        for _ in range(_PASSES):
            for some in np.array_split(random.permutation(rows), -(-len(rows) // _BATCH)):
                some = torch.as_tensor(some, device=self._device)
                loss = (((self(inputs[some]) - wanted[some]) / _UNIT) ** 2).mean()
                self._optimizer.zero_grad(set_to_none=True)
                loss.backward()
                self._optimizer.step()
        return explained

    def targets(self, costs, goes_on, foreseen, standing, fallen):
        """TD(lambda) targets (H, M) of states x_0 to x_{H-1} of M episodes of H steps.

        costs, goes_on, foreseen: (H + 1, M), of x_0 to x_H: of being there, `goes_on`, and the network's. standing:
        (H, M), see `Trials`. fallen: (M,), cost of a step of who has fallen.
        """
        after = np.where(standing, costs[1:], fallen / (1.0 - self.discount))
        end = np.where(standing, CONTINUES, FELL)
        no_timeouts = costs
        return advantages(
            after, foreseen[:-1], foreseen[-1], end, no_timeouts, self.discount, _TRACE, goes_on[1:]
        )[1]
