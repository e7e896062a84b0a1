"""The rollout's forward pass against torch's, and its promise: a row's bits do not depend on the batch."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from learner.config import PolicyConfig
from learner.networks import build_networks, snapshot
from learner.normalizer import Normalizer
from workers.inference import PolicyNetwork


def observations(count, seed=0):
    return np.random.default_rng(seed).normal(size=(count, 282)).astype(np.float32) * 3


@pytest.mark.parametrize("hidden", [(16,), (33, 20), (256, 128)])
def test_the_mean_is_torchs(hidden, make_policy):
    policy = make_policy(hidden=hidden, gain=1.0)
    x = observations(50)
    y = np.clip((x - policy.observation_mean) * policy.observation_scale, -10, 10)
    y = torch.from_numpy(y)
    for i, (weight, bias) in enumerate(zip(policy.weights, policy.biases, strict=True)):
        y = y @ torch.from_numpy(weight) + torch.from_numpy(bias)
        y = torch.relu(y) if i < len(policy.weights) - 1 else y
    np.testing.assert_allclose(PolicyNetwork(policy, 50).mean(x), y, rtol=1e-4, atol=1e-4)


def test_a_snapshot_acts_as_the_learners_network(make_config):
    """The learner's normalizer and network, and the worker's, are the same function."""
    config = make_config({"network.output_scale": 1.0})
    network, _ = build_networks(config.network, 3, "cpu")
    normalizer = Normalizer(282, True, "cpu")
    normalizer.update(torch.from_numpy(observations(200, seed=1)) * 2 + 1)
    x = observations(40)
    with torch.no_grad():
        wanted = network(normalizer(torch.from_numpy(x))).numpy()
    got = PolicyNetwork(snapshot(network, None, normalizer, PolicyConfig(), 1.0, 7), 40).mean(x)
    np.testing.assert_allclose(got, wanted, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("hidden", [(16,), (33, 20), (64, 32)])
def test_a_rows_bits_do_not_depend_on_the_batch(hidden, make_policy):
    policy, x = make_policy(hidden=hidden, gain=1.0), observations(67)
    together = PolicyNetwork(policy, 67).mean(x).copy()
    assert together.dtype == np.float32
    for count in (1, 2, 7, 8, 9, 33):
        network = PolicyNetwork(policy, count)
        parts = [network.mean(x[i : i + count]).copy() for i in range(0, 67, count)]
        np.testing.assert_array_equal(np.concatenate(parts), together)
    # wherever the row stands in the batch, and whatever was there before
    network, order = PolicyNetwork(policy, 67), np.random.default_rng(1).permutation(67)
    np.testing.assert_array_equal(network.mean(x[order]), together[order])
    np.testing.assert_array_equal(network.mean(x[:5]), together[:5])


def test_normalized_observations_are_clipped_to_ten(make_policy):
    policy = make_policy()
    policy = replace(
        policy, observation_mean=np.zeros(282, np.float32), observation_scale=np.full(282, 2.0, np.float32)
    )
    network = PolicyNetwork(policy, 2)
    x = np.stack([np.full(282, 5.0), np.full(282, 1e6)]).astype(np.float32)
    far, farther = network.mean(x).copy()
    np.testing.assert_array_equal(far, farther)
