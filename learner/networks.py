"""Policy and value networks: two separate MLPs (section 5)."""

import math

import numpy as np
import torch
from torch import nn

from workers.kinematics import NUM_DOF
from workers.observation import OBSERVATION_SIZE
from workers.types import Policy


def build_mlp(sizes, generator, output_gain, hidden_gain=2.0**0.5, activation=nn.ReLU):
    """An MLP of `sizes`, inputs to outputs, `activation` between.

    Zero biases; orthogonal weights, drawn from `generator`, times the gain of hidden layers or of the output.
    """
    layers = []
    for i, (a, b) in enumerate(zip(sizes, sizes[1:])):
        layer = nn.Linear(a, b)
        last = i == len(sizes) - 2
        nn.init.orthogonal_(layer.weight, gain=output_gain if last else hidden_gain, generator=generator)
        nn.init.zeros_(layer.bias)
        layers += [layer] if last else [layer, activation()]
    return nn.Sequential(*layers)


def build_networks(config, seed, device):
    """(policy, value) of a `NetworkConfig`, initialised as a function of the run's seed."""
    generator = torch.Generator().manual_seed(seed)
    policy = build_mlp([OBSERVATION_SIZE, *config.hidden, NUM_DOF], generator, config.output_scale)
    value = build_mlp([OBSERVATION_SIZE, *(config.value_hidden or config.hidden), 1], generator, 1.0)
    return policy.to(device), value.to(device)


def snapshot(policy, average, normalizer, config, action_scale, version):
    """The `workers.types.Policy` of a policy network and its observation normalizer: numpy, detached from training.

    average: the network of its averaged weights, or None. config: `learner.config.PolicyConfig`. action_scale: radians
    per unit of its output. version: number of updates that made it.
    """
    weights, biases = _arrays(policy)
    average_weights, average_biases = _arrays(average) if average else ((), ())
    mean, scale = normalizer.mean_and_scale()
    return Policy(
        weights=weights,
        biases=biases,
        observation_mean=mean.cpu().numpy().astype(np.float32),
        observation_scale=scale.cpu().numpy().astype(np.float32),
        version=version,
        log_sigma=config.log_sigma,
        noise_window=config.noise_window,
        independent_from=config.independent_from,
        judges=config.judges,
        judge_log_sigma=config.judge_log_sigma - math.log(action_scale),
        sigma_factor=config.sigma_factor,
        average_weights=average_weights,
        average_biases=average_biases,
    )


def _arrays(network):
    """(weights, biases) of an MLP's layers as tuples of arrays."""
    layers = [layer for layer in network if isinstance(layer, nn.Linear)]
    weights = tuple(np.ascontiguousarray(layer.weight.detach().cpu().numpy().T) for layer in layers)
    return weights, tuple(layer.bias.detach().cpu().numpy().copy() for layer in layers)
