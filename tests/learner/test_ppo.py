"""PPO's loss against slow code, and how an update spends its transitions."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from learner import ppo
from learner.config import PPOConfig
from learner.state import LearnerState
from learner.update import update


def batch(seed, count=12, spread=0.05):
    generator = torch.Generator().manual_seed(seed)
    old_mean, noise, change = torch.randn(3, count, 31, generator=generator)
    return old_mean + spread * change, old_mean + 0.1 * noise, old_mean, torch.randn(count, generator=generator)


def test_log_probabilities_differ_as_those_of_a_normal_distribution():
    mean, action, old_mean, _ = batch(0)
    sigma = torch.linspace(0.05, 0.09, 12)
    got = ppo.log_probability(action, mean, sigma) - ppo.log_probability(action, old_mean, sigma)
    wanted = [torch.distributions.Normal(m, sigma[:, None]).log_prob(action).sum(-1) for m in (mean, old_mean)]
    torch.testing.assert_close(got, wanted[0] - wanted[1], rtol=1e-4, atol=1e-3)


@given(
    seed=st.integers(0, 10_000), sigma=st.sampled_from([0.1, 0.5]), clip=st.sampled_from([0.1, 0.2]),
    lag=st.sampled_from([0.0, 0.03]),
)  # fmt: skip
def test_the_loss_is_the_clipped_surrogate_worked_out_row_by_row(seed, sigma, clip, lag):
    """With a lag, the ratio is clipped around the anchor and weighted by anchor over acting policy, at most 2."""
    mean, action, anchor_mean, advantage = batch(seed, spread=0.03)
    acting_mean = anchor_mean + lag * torch.randn(12, 31, generator=torch.Generator().manual_seed(seed + 1))
    sigmas = [sigma * (1 + row / 12) for row in range(12)]

    def log_density(action, mean, sigma):
        return -sum((x - y) ** 2 for x, y in zip(action, mean, strict=True)) / (2 * sigma**2)

    total, divergence, clipped = 0.0, 0.0, 0
    for m, a, old, o, adv, s in zip(
        *(x.tolist() for x in (mean, action, acting_mean, anchor_mean, advantage)), sigmas, strict=True
    ):
        weight = min(math.exp(log_density(a, o, s) - log_density(a, old, s)), 2.0)
        ratio = math.exp(log_density(a, m, s) - log_density(a, o, s))
        total += weight * min(ratio * adv, min(max(ratio, 1 - clip), 1 + clip) * adv)
        divergence += sum((y - z) ** 2 for y, z in zip(m, o, strict=True)) / (2 * s**2)
        clipped += abs(ratio - 1) > clip
        assert lag > 0 or weight == 1.0
    got = ppo.policy_loss(mean, action, acting_mean, anchor_mean, advantage, torch.tensor(sigmas), clip)
    count = len(advantage)
    assert got[0].item() == pytest.approx(-total / count, rel=1e-3, abs=1e-4)
    assert got[1].item() == pytest.approx(divergence / count, rel=1e-4)
    assert got[2].item() == pytest.approx(clipped / count)


def test_the_divergence_is_that_of_two_normal_distributions():
    mean, action, old_mean, advantage = batch(3)
    sigma = torch.linspace(0.1, 0.3, 12)
    _, got, _ = ppo.policy_loss(mean, action, old_mean, old_mean, advantage, sigma, 0.2)
    normal, deviation = torch.distributions.Normal, sigma[:, None]
    wanted = torch.distributions.kl_divergence(normal(old_mean, deviation), normal(mean, deviation)).sum(-1).mean()
    torch.testing.assert_close(got, wanted)


def test_the_gradient_vanishes_where_the_ratio_is_clipped():
    """A ratio that is already as large as allowed and would profit from growing gets no push."""
    action, old_mean = torch.zeros(1, 31), torch.full((1, 31), 0.1)
    for advantage, moves in ((1.0, False), (-1.0, True)):
        mean = torch.full((1, 31), 0.01, requires_grad=True)
        advantages, sigma = torch.tensor([advantage]), torch.tensor([0.2])
        loss, _, clipped = ppo.policy_loss(mean, action, old_mean, old_mean, advantages, sigma, 0.2)
        (gradient,) = torch.autograd.grad(loss, mean)
        assert clipped == 1.0 and (gradient.abs().max() > 0) == moves


@pytest.mark.parametrize("advantage", [1.0, -1.0])
@pytest.mark.parametrize("lag", [0.15, 0.5])
def test_an_anchor_far_from_the_acting_policy_leaves_loss_and_gradient_finite(lag, advantage):
    """The first update's normalizer alone moves the mean that far; the true terms are of order one."""
    sigma = torch.tensor([math.exp(-2.9)])
    acting_mean, anchor_mean = torch.zeros(1, 31), torch.full((1, 31), lag)
    action = sigma * torch.randn(1, 31, generator=torch.Generator().manual_seed(0))
    mean = torch.full((1, 31), 0.01, requires_grad=True)
    loss, _, _ = ppo.policy_loss(mean, action, acting_mean, anchor_mean, torch.tensor([advantage]), sigma, 0.2)
    (gradient,) = torch.autograd.grad(loss, mean)
    assert loss.isfinite() and gradient.isfinite().all()


@pytest.fixture
def spied(monkeypatch):
    """The arguments of the loss in the updates that the test makes, a dict of arrays per minibatch."""
    calls, original = [], ppo.policy_loss
    names = ("mean", "action", "acting_mean", "anchor_mean", "advantage")

    def spy(*arguments):
        calls.append({name: array.detach().numpy().copy() for name, array in zip(names, arguments[:5], strict=True)})
        return original(*arguments)

    monkeypatch.setattr(ppo, "policy_loss", spy)
    return calls


@pytest.mark.parametrize("minibatch_size", [32, 50, 1000])
def test_every_transition_is_used_exactly_once_per_epoch(minibatch_size, spied, lessons, make_config):
    config = make_config({"ppo.epochs": 3, "ppo.minibatch_size": minibatch_size})
    chunk = lessons[1]
    update(LearnerState(config, seed=1), [chunk])
    samples = chunk.end.size
    batches = -(-samples // minibatch_size)
    assert len(spied) == 3 * batches
    sizes = [len(call["action"]) for call in spied]
    assert max(sizes) <= minibatch_size and max(sizes) - min(sizes) <= 1
    wanted = np.sort(chunk.action.reshape(samples, 31), axis=0)
    epochs = [np.concatenate([c["action"] for c in spied[e * batches : (e + 1) * batches]]) for e in range(3)]
    for actions in epochs:
        np.testing.assert_array_equal(np.sort(actions, axis=0), wanted)
    assert not (epochs[0] == epochs[1]).all() and not (epochs[1] == epochs[2]).all()


def test_a_minibatch_holds_the_actions_means_and_advantages_of_the_same_transitions(spied, lessons, make_config):
    config = make_config()
    chunk = lessons[1]
    update(LearnerState(config, seed=1), [chunk])
    where = {action.tobytes(): i for i, action in enumerate(chunk.action.reshape(-1, 31))}
    advantage_of = {}
    for call in spied:
        for action, acting_mean, advantage in zip(call["action"], call["acting_mean"], call["advantage"], strict=True):
            i = where[action.tobytes()]
            np.testing.assert_array_equal(acting_mean, chunk.mean.reshape(-1, 31)[i])
            assert advantage_of.setdefault(i, advantage) == advantage
    advantages = np.array(list(advantage_of.values()))
    assert len(advantages) == chunk.end.size
    assert advantages.mean() == pytest.approx(0.0, abs=1e-5) and advantages.std() == pytest.approx(1.0, abs=1e-4)


def test_the_anchor_is_the_policy_at_the_updates_start_whatever_the_chunks_age(spied, lessons, make_config):
    """Depth 0: the acting policy's own numbers. Depth 1: what the network, one update on, says of the chunk."""
    config = make_config({"ppo.learning_rate": 0.0, "sbc.enabled": False})
    state = LearnerState(config, seed=1)
    state, _ = update(state, [lessons[0]])
    for call in spied:
        np.testing.assert_array_equal(call["anchor_mean"], call["acting_mean"])
    spied.clear()
    state, _ = update(state, [lessons[1]])  # version 0, collected before the first update
    for call in spied:
        # a learning rate of zero: the anchor is the network itself, and differs from the actor by the normalizer
        np.testing.assert_allclose(call["anchor_mean"], call["mean"], atol=1e-6)
        assert np.abs(call["anchor_mean"] - call["acting_mean"]).max() > 1e-4


def test_updates_shuffle_differently(spied, lessons, make_config):
    config = make_config({"ppo.epochs": 1})
    state = LearnerState(config, seed=1)
    for _ in range(2):
        state, _ = update(state, [lessons[1]])
    half = len(spied) // 2
    first, second = (np.concatenate([c["action"] for c in calls]) for calls in (spied[:half], spied[half:]))
    assert (first != second).any(axis=1).mean() > 0.9


@pytest.mark.parametrize(
    "divergence, target, factor",
    [
        (0.0, None, 1.0),
        (9.0, None, 1.0),
        (0.1, 0.1, 1.0),
        (0.14, 0.1, 1.0),
        (0.07, 0.1, 1.0),
        (0.2, 0.1, 1 / 1.3),
        (0.01, 0.1, 1.3),
    ],
)
def test_the_learning_rate_follows_the_divergence_outside_a_dead_band(divergence, target, factor):
    assert ppo.adapt_learning_rate(1e-3, divergence, target, 1.0) == pytest.approx(1e-3 * factor)


def test_the_learning_rate_stays_in_its_range():
    low, high = 1e-3, 1e-3
    for _ in range(50):
        low, high = ppo.adapt_learning_rate(low, 1.0, 0.1, 3e-3), ppo.adapt_learning_rate(high, 0.0, 0.1, 3e-3)
    assert (low, high) == (1e-7, 3e-3)


def test_the_divergence_aimed_at_goes_to_its_final_value_in_a_straight_line_and_stays():
    assert ppo.target_divergence(PPOConfig(target_kl=0.2), 1000) == 0.2
    assert ppo.target_divergence(PPOConfig(final_kl=0.1, kl_updates=50), 100) is None
    config = PPOConfig(target_kl=0.2, final_kl=0.1, kl_updates=50)
    assert [ppo.target_divergence(config, k) for k in (0, 25, 50, 90)] == pytest.approx([0.2, 0.15, 0.1, 0.1])
    assert ppo.target_divergence(PPOConfig(target_kl=0.2, final_kl=0.1), 0) == 0.1


@pytest.mark.parametrize("final", [None, 0.1])
def test_the_first_updates_aim_at_larger_divergences_that_shrink_by_one_factor_to_meet_the_line(final):
    plain = PPOConfig(target_kl=0.2, final_kl=final, kl_updates=50)
    config = replace(plain, first_updates=20, first_kl=0.8)
    aims = [ppo.target_divergence(config, k) for k in range(60)]
    assert aims[0] == 0.8 and aims[20:] == [ppo.target_divergence(plain, k) for k in range(20, 60)]
    factors = [one / other for one, other in zip(aims[1:21], aims)]
    assert factors == pytest.approx([factors[0]] * 20) and factors[0] < 1
    assert ppo.target_divergence(PPOConfig(first_updates=20, first_kl=0.8), 3) is None
