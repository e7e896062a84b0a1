"""Policy and value network are functions of the run's seed, each of its own size."""

import torch

from learner.config import NetworkConfig
from learner.networks import build_networks


def sizes(network):
    """Outputs of every layer."""
    return [len(bias) for bias in list(network.parameters())[1::2]]


def test_both_have_the_same_layers_unless_the_value_network_has_its_own():
    policy, value = build_networks(NetworkConfig(hidden=[5, 6]), 0, "cpu")
    assert (sizes(policy), sizes(value)) == ([5, 6, 31], [5, 6, 1])
    other, value = build_networks(NetworkConfig(hidden=[5, 6], value_hidden=[4]), 0, "cpu")
    assert (sizes(other), sizes(value)) == ([5, 6, 31], [4, 1])
    assert all(map(torch.equal, policy.parameters(), other.parameters()))
