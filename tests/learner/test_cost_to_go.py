"""What is left to the target, as a cost of all steps to come: targets by their definition, and that it is learned."""

import copy
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from learner.cost_to_go import CostToGo
from learner.encoding import residuals, split
from learner.normalizer import Normalizer
from workers.config import ArrivalConfig
from workers.types import Trials

DISCOUNT = 0.9
FALLEN = 4 * math.log((4 + math.sqrt(1 + 30.0**2)) / 5)  # 3 m off, at a threshold of 0.1 m


def made(seed=0, ends=None, time=0.0):
    config = ArrivalConfig(hidden=[32, 32], discount=DISCOUNT, ends=ends, time=time)
    return CostToGo(config, torch.Generator().manual_seed(seed), "cpu")


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_targets_are_means_of_n_step_returns(seed):
    """TD(lambda): (1 - lambda) lambda^(n-1) of every n-step return, the rest of the longest; a fall costs for ever,
    and what follows on a state weighs as much as that lets go on."""
    random = np.random.default_rng(seed)
    steps, count = 6, 4
    costs, goes_on, foreseen = random.random((3, steps + 1, count))
    standing = np.logical_and.accumulate(random.random((steps, count)) < 0.85, axis=0)
    found = made().targets(costs, goes_on, foreseen, standing, np.full(count, FALLEN))
    for m in range(count):
        for t in range(steps):
            if not standing[t, m]:
                assert found[t, m] == pytest.approx(FALLEN / (1 - DISCOUNT), rel=1e-5)
                continue
            returns = []  # of 1, 2, ... steps
            for n in range(1, steps - t + 1):
                total, weight = 0.0, 1.0
                for k in range(n):
                    if standing[t + k, m]:
                        total += weight * costs[t + k + 1, m]
                    else:
                        total += weight * FALLEN / (1 - DISCOUNT)
                        break
                    weight *= DISCOUNT * goes_on[t + k + 1, m]
                else:
                    total += weight * foreseen[t + n, m]
                returns.append(total)
            shares = [0.05 * 0.95 ** (n - 1) for n in range(1, len(returns))] + [0.95 ** (len(returns) - 1)]
            assert found[t, m] == pytest.approx(np.dot(shares, returns), rel=1e-4)


def test_a_step_costs_about_what_is_left_when_near_and_ever_less_more_farther_off():
    left = torch.tensor([0.0, 1.0, 2.0, 10.0, 30.0])
    cost = made().cost
    found = cost(left**2)
    assert found[0] == 0.0 and (found.diff() > 0).all()
    assert found[-1] == pytest.approx(FALLEN, rel=1e-6)
    slope = torch.func.vmap(torch.func.grad(lambda x: cost(x**2)))(torch.linspace(2.0, 100.0, 50))
    assert (slope.diff() < 0).all() and slope[0] < 1.0
    torch.testing.assert_close(made(time=2.0).cost(left**2), found + 2.0)


def test_an_arrival_ends_what_is_to_come():
    square = torch.tensor([0.0, 1.5, 4.5, 1e6])
    torch.testing.assert_close(made(ends=1.5).goes_on(square), torch.tensor([0.0, 0.5, 0.9, 1.0]))
    assert (made().goes_on(square) == 1.0).all()


@pytest.fixture
def trials():
    """Episodes in which the root's place goes its own way towards the target; who is far off falls."""
    random, steps, count = np.random.default_rng(0), 12, 64
    observation = np.tile(random.normal(0.0, 0.1, (1, 1, 282)), (steps + 1, count, 1)).astype(np.float32)
    observation[:, :, 142:] = 0.0  # at the target (as a difference from it), but for the place
    observation[:, :, 140] = np.linspace(1.0, 0.0, steps + 1)[:, None] * random.uniform(0.0, 2.0, count)
    standing = np.tile(observation[0, :, 140] < 1.5, (steps, 1))
    standing[:4] = True
    return Trials(np.arange(count), np.full((count, 3), 0.1, dtype=np.float32), observation, standing)


def test_it_foresees_more_and_more_of_what_trials_cost(trials):
    network, random = made(ends=1.0, time=0.5), np.random.default_rng(1)
    normalized = Normalizer(282, False, "cpu")
    found = [network.learn(trials, normalized, True, random) for _ in range(60)]
    assert found[0] < 0.2 and found[-1] > 0.6
    seen = torch.as_tensor(trials.observation)
    falling, arriving = (seen[3, who] for who in (trials.standing[-1] == 0, trials.standing[-1]))
    assert network(normalized(falling)).min() > network(normalized(arriving)).max()
    limits = torch.full((64, 3), 0.1)
    left = residuals(*split(seen[3], True), limits)
    assert network.cost((left**2).sum(dim=1)).max() < FALLEN


def test_learning_is_a_function_of_its_arguments_and_goes_on_from_a_checkpoint(trials, assert_same_bits):
    normalized = Normalizer(282, False, "cpu")
    one, two = made(), made(seed=3)
    one.learn(trials, normalized, True, np.random.default_rng(1))
    two.load_state_dict(copy.deepcopy(one.state_dict()))
    for network in (one, two):
        network.learn(trials, normalized, True, np.random.default_rng(2))
    assert_same_bits(one.state_dict(), two.state_dict())


def test_nobodys_trials_teach_nothing(trials):
    network = made()
    before = [parameter.clone() for parameter in network.network.parameters()]
    none = Trials(np.zeros(0, dtype=np.int64), trials.limits[:0], trials.observation[:, :0], trials.standing[:, :0])
    assert network.learn(none, Normalizer(282, False, "cpu"), True, np.random.default_rng(1)) == 0.0
    assert all(map(torch.equal, before, network.network.parameters()))
