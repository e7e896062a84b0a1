"""The learner's state: what a step goes down, and what it takes from learners of other settings."""

import numpy as np
import pytest
import torch

from learner.state import LearnerState
from learner.update import update

ON = {"arrival.weight": 4.0, "arrival.hidden": [32], "physics.sole": 0.02}


@pytest.mark.parametrize("both", (True, False))
def test_a_step_goes_down_the_weighted_mean_of_both_clipped_gradients(make_config, both):
    """Or down its share of one."""
    state = LearnerState(make_config(ON), 1)
    parameters = list(state.policy.parameters())
    state.policy_optimizer = torch.optim.SGD(parameters, lr=1.0)
    before = [parameter.detach().clone() for parameter in parameters]
    inputs = torch.as_tensor(np.random.default_rng(0).normal(size=(8, 282)), dtype=torch.float32)
    own = torch.autograd.grad(100.0 * (state.policy(inputs) ** 2).sum(), parameters)
    length = torch.sqrt(sum((gradient**2).sum() for gradient in own))
    assert length > state.config.ppo.max_grad_norm
    other = [torch.ones_like(parameter) for parameter in parameters]
    loss = 100.0 * (state.policy(inputs) ** 2).sum()
    state.descend("policy", loss, 0.2, other if both else None)
    for old, new, gradient in zip(before, parameters, own):
        clipped = gradient * state.config.ppo.max_grad_norm / length
        expected = (clipped + 4.0) / 5.0 if both else clipped / 5.0
        torch.testing.assert_close(old - new.detach(), expected, rtol=1e-4, atol=1e-5)


def test_a_learner_that_had_no_cost_to_go_begins_with_an_untrained_one(lessons, make_config):
    old = update(LearnerState(make_config(), 1), lessons[:1])[0].state_dict()
    fresh = LearnerState(make_config(ON), 1)
    before = fresh.cost_to_go.network[0].weight.clone()
    fresh.load_state_dict(old)
    assert torch.equal(before, fresh.cost_to_go.network[0].weight)
    assert torch.equal(fresh.policy[0].weight, old["policy"]["0.weight"])


def test_off_there_is_none(lessons, make_config):
    state, numbers = update(LearnerState(make_config(), 1), lessons[:1])
    assert state.cost_to_go is None and "loss/arrival" not in numbers
