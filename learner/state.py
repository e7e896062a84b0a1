"""The learner's state between two updates."""

import copy
import math

import numpy as np
import torch

from learner.cost_to_go import CostToGo
from learner.kfac import KFAC
from learner.networks import build_networks, snapshot
from learner.normalizer import Normalizer
from workers.observation import OBSERVATION_SIZE

# Streams of the learner's random numbers; a number that is gone is not given again, so that runs keep theirs
SHUFFLE, DEMONSTRATIONS, ARRIVALS, FORESIGHT = 0, 1, 3, 4


class LearnerState:
    """All that the learner is between two updates: networks, optimizers, normalizers, the policy's learning rate.

    config: `learner.config.LearnerConfig` and, for what policy and demonstrations observe and how they act,
    `workers.config.EnvConfig` in one. `updates` counts the updates so far, `skipped` those of the last ones in a row
    that changed nothing (see `learner.update`).
    """

    def __init__(self, config, seed, device="cpu"):
        self.config, self.seed, self.device = config, seed, device
        self.policy, self.value = build_networks(config.network, seed, device)
        self.average = copy.deepcopy(self.policy) if config.policy.average else None
        self.descend_by(config.ppo.method(0))
        self.value_optimizer = torch.optim.Adam(self.value.parameters(), lr=config.ppo.learning_rate, fused=True)
        self.observations = Normalizer(OBSERVATION_SIZE, config.ppo.normalize_observations, device)
        self.returns = Normalizer(1, config.ppo.normalize_values, device)
        self.cost_to_go, arrival = None, config.arrival
        if arrival.weight:
            generator = torch.Generator().manual_seed(seed)
            self.cost_to_go = CostToGo(arrival, generator, device)
        self.updates = self.skipped = 0

    _PARTS = ("policy", "value", "policy_optimizer", "value_optimizer", "observations", "returns")
    _NUMBERS = ("learning_rate", "updates", "skipped")

    @property
    def method(self):
        """`adam` or `kfac`: how the policy descends."""
        return "kfac" if isinstance(self.policy_optimizer, KFAC) else "adam"

    @property
    def judge_sigma(self):
        """Deviation of the evaluation's noise, in units of the policy's output."""
        return math.exp(self.config.policy.judge_log_sigma) / self.config.action.scale

    def descend_by(self, method):
        """Let the policy begin anew with `adam` or `kfac`."""
        config = self.config.ppo
        if method == "kfac":
            self.learning_rate = config.natural_rate
            self.policy_optimizer = KFAC(self.policy, self.learning_rate, config.damping)
        else:
            self.learning_rate = config.learning_rate
            self.policy_optimizer = torch.optim.Adam(self.policy.parameters(), lr=self.learning_rate, fused=True)

    def descend(self, name, loss, share=1.0, added=None):
        """One step of the network `policy` or `value` down the gradient of a loss, clipped; its norm before that.

        share: the clipped gradient's in a mean with another, `added`, in the order of the network's parameters and
        clipped as well (None: zero), so that one that joins later makes no step longer.
        """
        network, optimizer = getattr(self, name), getattr(self, f"{name}_optimizer")
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(network.parameters(), self.config.ppo.max_grad_norm)
        if share != 1.0:
            for parameter in network.parameters():
                parameter.grad.mul_(share)
        for parameter, gradient in zip(network.parameters(), added or ()):
            parameter.grad.add_(gradient, alpha=1.0 - share)
        optimizer.step()
        return norm

    def follow(self):
        """Move the averaged weights towards the policy's: a plain mean at first, an exponential one in the long run."""
        if self.average is None:
            return
        decay = min(self.config.policy.average, self.updates / (self.updates + 1))
        with torch.no_grad():
            for mean, weight in zip(self.average.parameters(), self.policy.parameters(), strict=True):
                mean.lerp_(weight, 1 - decay)

    def take_policy(self, policy, samples):
        """Act as a `workers.types.Policy` does, whose normalizer has seen so many samples."""
        layers = [layer for layer in self.policy if isinstance(layer, torch.nn.Linear)]
        with torch.no_grad():
            for layer, weight, bias in zip(layers, policy.weights, policy.biases, strict=True):
                layer.weight.copy_(torch.as_tensor(weight.T.copy()))
                layer.bias.copy_(torch.as_tensor(bias))
        if self.average:
            self.average.load_state_dict(self.policy.state_dict())
        self.observations.become(policy.observation_mean, policy.observation_scale, samples)

    def take_critics(self, critics):
        """Foresee as those of a policy file do (`orchestrator.saved.policy_content`); their optimizers are fresh."""
        self.value.load_state_dict(critics["value"])
        self.returns.load_state_dict(critics["returns"])
        if self.cost_to_go and critics["cost_to_go"]:
            self.cost_to_go.network.load_state_dict(critics["cost_to_go"])

    def snapshot(self):
        """The `workers.types.Policy` to act with."""
        config = self.config
        return snapshot(
            self.policy, self.average, self.observations, config.policy, config.action.scale, self.updates
        )  # fmt: skip

    def state_dict(self):
        """Plain tensors and numbers for a checkpoint; shares memory with the networks."""
        parts = {name: getattr(self, name).state_dict() for name in self._PARTS}
        for name in ("average", "cost_to_go"):
            parts[name] = getattr(self, name) and getattr(self, name).state_dict()
        numbers = {name: getattr(self, name) for name in self._NUMBERS}
        return {**parts, **numbers}

    def load_state_dict(self, state):
        """Become the learner that made `state`."""
        self.descend_by("kfac" if "factors" in state["policy_optimizer"] else "adam")
        for name in self._PARTS:
            getattr(self, name).load_state_dict(state[name])
        if self.average:
            self.average.load_state_dict(state["average"] or state["policy"])
        if self.cost_to_go and state.get("cost_to_go"):  # not of a learner without
            self.cost_to_go.load_state_dict(state["cost_to_go"])
        for name in self._NUMBERS:
            setattr(self, name, state[name])

    def random(self, stream):
        """The random numbers of one purpose in the next update, a function of (seed, purpose, update)."""
        return np.random.Generator(np.random.Philox(key=[self.seed, 2**32 * stream + self.updates]))

    def is_finite(self):
        """Whether every parameter and every normalizer's number is."""
        tensors = [*self.policy.parameters(), *self.value.parameters()]
        if self.cost_to_go:
            tensors += self.cost_to_go.network.parameters()
        for normalizer in (self.observations, self.returns):
            tensors += [normalizer.mean, normalizer.squares]
        return bool(torch.stack([torch.isfinite(tensor).all() for tensor in tensors]).all())
