"""The descent at arrival through physics that learns: the environment's geometry, true derivatives, what it follows."""

import numpy as np
import pytest
import torch

from learner import learned_windows
from learner.batch import following as next_observations
from learner.dynamics import Dynamics, moved
from learner.encoding import deviations
from learner.learned_windows import LearnedWindows
from learner.state import LearnerState
from learner.update import update
from motion.errors import InputError
from workers.reward import KP, RP, Q

ON = {"arrival.weight": 0.1, "arrival.steps": 2, "arrival.hidden": [32], "arrival.batch_size": 8}
ENCODINGS = [("absolute", "absolute"), ("difference", "target"), ("difference", "current")]


def following(chunk):
    return torch.as_tensor(next_observations(chunk).reshape(-1, 282))


def flat(array):
    return torch.as_tensor(np.ascontiguousarray(array).reshape(-1, array.shape[-1]))


def dynamics(config):
    return Dynamics([16], config, torch.Generator().manual_seed(0), "cpu")


@pytest.mark.parametrize("encoding", ("absolute", "difference"))
def test_split_undoes_the_encoding_and_join_makes_it_again(encoding, lessons, make_config):
    chunk = lessons[0]  # of the paper's encoding
    seen = flat(chunk.observation)
    own = dynamics(make_config({"observation.target": encoding}))
    encoded = seen.clone()
    for k in range(139 if encoding == "difference" else 0):
        encoded[:, 143 + k] -= seen[:, 1 + k]
    torch.testing.assert_close(own.join(*dynamics(make_config()).split(seen)), encoded)
    torch.testing.assert_close(own.join(*own.split(seen)), seen, atol=1e-5, rtol=1e-5)


def test_the_target_stands_still_in_the_world_while_the_figure_moves(lessons, make_config):
    """With the true change of pose, what a step says of p_tar is what the environment observes next."""
    chunk, physics = lessons[0], dynamics(make_config())
    seen, after = flat(chunk.observation), following(chunk)
    true = torch.cat([flat(moved(chunk.pose, chunk.next_pose)).float(), after[:, 1:140] - seen[:, 1:140]], dim=1)
    physics.network = lambda inputs: true  # and scales that change nothing, as nothing has been learned
    torch.testing.assert_close(physics.step(seen, flat(chunk.action)), after, atol=2e-4, rtol=1e-4)


def test_deviations_are_the_environments(lessons, make_config):
    chunk = lessons[0]
    ended = torch.as_tensor(chunk.final_observation)
    assert len(ended) > 5
    found = deviations(*dynamics(make_config()).split(ended))
    np.testing.assert_allclose(found, chunk.outcomes.deviations[:, [RP, KP, Q]], atol=1e-4, rtol=1e-3)


@pytest.mark.parametrize("encoding, mode", ENCODINGS)
def test_a_steps_derivatives_are_those_of_differences(encoding, mode, lessons, make_config):
    chunk = lessons[0]
    physics = dynamics(make_config({"observation.target": encoding, "action.mode": mode}))
    for parameter in physics.network.parameters():
        parameter.data = parameter.data.double()
    seen, action = flat(chunk.observation)[:3].double(), flat(chunk.action)[:3].double()
    generator = np.random.default_rng(0)
    for of in (0, 1):
        given = [seen.clone(), action.clone()]
        push = torch.as_tensor(generator.normal(size=given[of].shape))
        given[of].requires_grad_(True)
        weight = torch.as_tensor(generator.normal(size=(3, 282)))
        (gradient,) = torch.autograd.grad((physics.step(*given) * weight).sum(), given[of])
        ends = []
        for sign in (1, -1):
            moved_to = [part.detach().clone() for part in given]
            moved_to[of] += sign * 1e-4 * push
            ends.append((physics.step(*moved_to) * weight).sum().item())
        assert (gradient * push).sum().item() == pytest.approx((ends[0] - ends[1]) / 2e-4, rel=2e-2, abs=2e-2)


def test_what_it_has_learned_of_some_steps_holds_for_others(lessons, make_config):
    physics = Dynamics([64], make_config(), torch.Generator().manual_seed(0), "cpu")

    def error(chunk, order):
        move = flat(moved(chunk.pose, chunk.next_pose)).float()
        batches = np.array_split(order, max(len(order) // 24, 1))
        return physics.learn(flat(chunk.observation), flat(chunk.action), following(chunk), move, batches).item()

    for k in range(60):
        error(lessons[k % 2], np.random.default_rng(k).permutation(lessons[0].end.size))
    # of a single minibatch it is the error before anything is learned of it
    assert error(lessons[2], np.arange(20)) < 0.8


def test_windows_end_at_the_nearest_step_of_exploring_episodes_that_came_near(lessons, make_config, monkeypatch):
    monkeypatch.setattr(learned_windows, "NEAR", 1e9)
    chunk = lessons[1]
    state = LearnerState(make_config({**ON, "policy.judges": 4}), 1)
    found = LearnedWindows(state, chunk)
    horizon, n = chunk.end.shape
    left = deviations(*state.dynamics.split(following(chunk))).numpy().reshape(horizon, n, 3)
    expected = []
    for number, (t, i) in enumerate(np.argwhere(chunk.end)):
        start = t
        while start > 0 and not chunk.end[start - 1, i]:
            start -= 1
        worst = [max(left[s, i] / chunk.final_thresholds[number]) for s in range(start, t + 1)]
        first = start + int(np.argmin(worst)) - 1  # two steps
        if chunk.environment[i] % 4 and first >= start:
            expected.append(first * n + i)
    assert expected and list(found._windows) == expected


def test_its_loss_is_what_was_left_if_the_policy_is_still_the_one_that_acted(lessons, make_config, monkeypatch):
    """Values are those that were observed, whatever the network has learned."""
    monkeypatch.setattr(learned_windows, "NEAR", 1e9)
    state = LearnerState(make_config(ON), 1)
    found = LearnedWindows(state, lessons[1])
    network = found._mean
    monkeypatch.setattr(state, "policy", lambda inputs: network[rows.pop(0)])
    n = found._n
    for chosen in range(len(found)):
        first = int(found._windows[chosen])
        rows = [slice(first, first + 1), slice(first + n, first + n + 1)]
        left = deviations(*state.dynamics.split(found._following[first + n : first + n + 1]))[0]
        ratio = (left / found._limits[chosen]).numpy()
        assert found.loss(np.array([chosen]), None).item() == pytest.approx((ratio**4).sum() ** 0.25, rel=1e-3)


@pytest.mark.parametrize("optimizer", ("adam", "kfac"))
def test_an_update_with_it_is_pure_and_comes_back_from_a_checkpoint(
    optimizer, lessons, make_config, monkeypatch, assert_same_bits
):
    monkeypatch.setattr(learned_windows, "NEAR", 1e9)
    config = make_config({**ON, "ppo.optimizer": optimizer})
    state, metrics = update(LearnerState(config, 1), lessons[:1])
    assert metrics["gradient/arrival"] > 0 and metrics["loss/dynamics"] > 0
    again = LearnerState(config, 5)
    again.seed = 1
    again.load_state_dict(state.state_dict())
    first, second = (update(one, lessons[1:2]) for one in (state, again))
    assert_same_bits(first[0].state_dict(), second[0].state_dict())
    assert_same_bits(first[1], second[1])


def test_off_it_changes_nothing_and_on_it_changes_the_policy_only(lessons, make_config, monkeypatch, assert_same_bits):
    monkeypatch.setattr(learned_windows, "NEAR", 1e9)
    off, numbers = update(LearnerState(make_config(), 1), lessons[:1])
    on, _ = update(LearnerState(make_config(ON), 1), lessons[:1])
    assert off.dynamics is None and "loss/arrival" not in numbers
    assert_same_bits(off.value.state_dict(), on.value.state_dict())
    assert not torch.equal(off.policy[0].weight, on.policy[0].weight)


def test_a_learner_that_had_none_begins_with_an_untrained_one(lessons, make_config):
    old = update(LearnerState(make_config(), 1), lessons[:1])[0].state_dict()
    fresh = LearnerState(make_config(ON), 1)
    before = fresh.dynamics.network[0].weight.clone()
    fresh.load_state_dict(old)
    assert torch.equal(before, fresh.dynamics.network[0].weight)


def test_physics_of_a_version_that_saw_other_numbers_is_refused_in_one_line(lessons, make_config):
    saved = LearnerState(make_config(ON), 1).state_dict()
    saved["dynamics"]["inputs"]["mean"] = torch.zeros(282)
    with pytest.raises(InputError, match="sees 282 numbers, this version's 218.*arrival.weight=0"):
        LearnerState(make_config(ON), 1).load_state_dict(saved)


def test_a_chunk_in_which_nobody_came_near_still_teaches_physics_and_nothing_else(
    lessons, make_config, monkeypatch, assert_same_bits
):
    monkeypatch.setattr(learned_windows, "NEAR", 0.0)
    off, _ = update(LearnerState(make_config(), 1), lessons[:1])
    on, metrics = update(LearnerState(make_config(ON), 1), lessons[:1])
    assert_same_bits(off.policy.state_dict(), on.policy.state_dict())
    assert metrics["loss/arrival"] == metrics["gradient/arrival"] == 0.0 and metrics["loss/dynamics"] > 0.0


@pytest.mark.parametrize("both", (True, False))
def test_a_step_goes_down_the_weighted_mean_of_both_clipped_gradients(make_config, both):
    """Or down its share of one."""
    state = LearnerState(make_config({**ON, "arrival.weight": 4.0}), 1)
    parameters = list(state.policy.parameters())
    state.policy_optimizer = torch.optim.SGD(parameters, lr=1.0)
    before = [parameter.detach().clone() for parameter in parameters]
    inputs = torch.as_tensor(np.random.default_rng(0).normal(size=(8, 282)), dtype=torch.float32)
    own = torch.autograd.grad(100.0 * (state.policy(inputs) ** 2).sum(), parameters)
    length = torch.sqrt(sum((gradient**2).sum() for gradient in own))
    assert length > state.config.ppo.max_grad_norm
    other = [torch.ones_like(parameter) for parameter in parameters]
    loss = 100.0 * (state.policy(inputs) ** 2).sum()
    state.descend("policy", loss, other) if both else state.descend("policy", loss, share=0.2)
    for old, new, gradient in zip(before, parameters, own):
        clipped = gradient * state.config.ppo.max_grad_norm / length
        expected = (clipped + 4.0) / 5.0 if both else clipped / 5.0
        torch.testing.assert_close(old - new.detach(), expected, rtol=1e-4, atol=1e-5)
