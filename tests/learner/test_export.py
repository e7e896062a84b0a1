"""The exported policy is the rollout's policy, and needs nothing of this project."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from learner.export import digest, export
from workers.inference import PolicyNetwork


@pytest.fixture
def policy(make_policy):
    random = np.random.default_rng(5)
    normal = {"observation_mean": random.normal(size=282) * 3, "observation_scale": 10.0 ** random.uniform(-2, 4, 282)}
    return replace(
        make_policy(hidden=(33, 20), gain=1.0), **{key: value.astype(np.float32) for key, value in normal.items()}
    )


def slow_mean(policy, observation):
    """One row, from the definition in `workers.types.Policy`, in float64."""
    x = [
        min(max((float(s) - float(m)) * float(k), -10.0), 10.0)
        for s, m, k in zip(observation, policy.observation_mean, policy.observation_scale, strict=True)
    ]
    for number, (weight, bias) in enumerate(zip(policy.weights, policy.biases, strict=True)):
        x = [sum(a * float(w) for a, w in zip(x, column, strict=True)) + float(b)
             for column, b in zip(weight.T, bias, strict=True)]  # fmt: skip
        if number < len(policy.weights) - 1:
            x = [max(value, 0.0) for value in x]
    return x


def test_282_numbers_become_the_31_of_the_rollouts(policy):
    observation = (np.random.default_rng(0).normal(size=(7, 282)) * 5).astype(np.float32)
    action = export(policy)(torch.from_numpy(observation)).numpy()
    assert action.shape == (7, 31) and action.dtype == np.float32
    np.testing.assert_allclose(action, PolicyNetwork(policy, 7).mean(observation), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(action[3], slow_mean(policy, observation[3]), rtol=1e-4, atol=1e-4)


def test_the_export_is_a_copy(policy):
    module = export(policy)
    observation = torch.zeros(1, 282)
    before = module(observation).clone()
    policy.weights[0][:] += 1
    assert torch.equal(module(observation), before)
    assert not any(parameter.requires_grad for parameter in module.parameters())


def test_the_digest_is_of_what_decides_the_mean_and_of_nothing_else(policy):
    same = replace(policy, log_sigma=0.0, version=99, weights=tuple(np.asfortranarray(w) for w in policy.weights))
    assert digest(same) == digest(policy)
    for name in ("weights", "biases"):
        for layer in range(len(policy.weights)):
            arrays = [array.copy() for array in getattr(policy, name)]
            arrays[layer].flat[-1] += 1
            assert digest(replace(policy, **{name: tuple(arrays)})) != digest(policy)
    for name in ("observation_mean", "observation_scale"):
        assert digest(replace(policy, **{name: getattr(policy, name) + 1})) != digest(policy)
