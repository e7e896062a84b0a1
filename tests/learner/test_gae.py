"""Generalised advantage estimation: by hand, against explicit sums, and at every kind of end."""

import numpy as np
import pytest
import reference
import torch
from hypothesis import given
from hypothesis import strategies as st

from learner.gae import advantages
from learner.state import LearnerState
from learner.update import update
from workers.types import CONTINUES, FELL, REACHED, TIMED_OUT


def column(*values, dtype=np.float32):
    return np.array(values, dtype=dtype)[:, None]


def test_a_trajectory_without_an_end_worked_out_by_hand():
    # delta = (1 + .9 * .2 - .5, 0 + .9 * .1 - .2, 2 + .9 * .3 - .1) = (.68, -.11, 2.17); lambda * gamma = .72
    got, returns = advantages(
        column(1, 0, 2),
        column(0.5, 0.2, 0.1),
        np.float32([0.3]),
        column(0, 0, 0, dtype=np.int8),
        np.zeros((3, 1)),
        0.9,
        0.8,
    )
    wanted = [0.68 + 0.72 * (-0.11 + 0.72 * 2.17), -0.11 + 0.72 * 2.17, 2.17]
    np.testing.assert_allclose(got[:, 0], wanted, rtol=1e-6)
    np.testing.assert_allclose(returns[:, 0], np.add(wanted, [0.5, 0.2, 0.1]), rtol=1e-6)


def test_steps_that_let_half_go_on_worked_out_by_hand():
    # delta = (1 + .9 * .2 - .5, 0 + .45 * .1 - .2, 2 + .9 * .3 - .1); lambda * gamma = .72, .36 after the second step
    got, _ = advantages(
        column(1, 0, 2), column(0.5, 0.2, 0.1), np.float32([0.3]), column(0, 0, 0, dtype=np.int8),
        np.zeros((3, 1)), 0.9, 0.8, column(1, 0.5, 1),
    )  # fmt: skip
    np.testing.assert_allclose(got[:, 0], [0.68 + 0.72 * (-0.155 + 0.36 * 2.17), -0.155 + 0.36 * 2.17, 2.17], rtol=1e-6)


@pytest.mark.parametrize("end", [REACHED, FELL])
def test_an_end_in_the_middle_worked_out_by_hand(end):
    # nothing follows the second step: delta = -.2, and the first step's sum stops there
    got, _ = advantages(
        column(1, 0, 2), column(0.5, 0.2, 0.1), np.float32([0.3]), column(0, end, 0, dtype=np.int8),
        np.full((3, 1), 7.0), 0.9, 0.8,
    )  # fmt: skip
    np.testing.assert_allclose(got[:, 0], [0.68 + 0.72 * -0.2, -0.2, 2.17], rtol=1e-6)


def test_a_time_out_worked_out_by_hand():
    arguments = column(1, 0, 2), column(0.5, 0.2, 0.1), np.float32([0.3]), column(0, TIMED_OUT, 0, dtype=np.int8)
    terminal, _ = advantages(*arguments, np.zeros((3, 1)), 0.9, 0.8)
    np.testing.assert_allclose(terminal[:, 0], [0.68 + 0.72 * -0.2, -0.2, 2.17], rtol=1e-6)
    # bootstrapped from a value of 4: delta = 0 + .9 * 4 - .2 = 3.4; the sum still stops
    bootstrap, _ = advantages(*arguments, np.full((3, 1), 4.0), 0.9, 0.8)
    np.testing.assert_allclose(bootstrap[:, 0], [0.68 + 0.72 * 3.4, 3.4, 2.17], rtol=1e-6)


@given(
    seed=st.integers(0, 2**32 - 1), horizon=st.integers(1, 12), share=st.sampled_from([0.0, 0.2, 1.0]),
    gamma=st.sampled_from([0.0, 0.9, 1.0]), lam=st.sampled_from([0.0, 0.95, 1.0]), bootstrap=st.booleans(),
)  # fmt: skip
def test_advantages_are_explicit_sums(seed, horizon, share, gamma, lam, bootstrap):
    generator, n = np.random.default_rng(seed), 3
    reward, value, timeout_value = generator.normal(size=(3, horizon, n)).astype(np.float32)
    last_value = generator.normal(size=n).astype(np.float32)
    end = np.where(generator.random((horizon, n)) < share, generator.integers(1, 4, (horizon, n)), CONTINUES).astype(
        np.int8
    )
    if not bootstrap:
        timeout_value[:] = 0
    got, returns = advantages(reward, value, last_value, end, timeout_value, gamma, lam)
    assert got.shape == (horizon, n) and got.dtype == returns.dtype == np.float32
    for i in range(n):
        following = np.append(value[1:, i], last_value[i])
        late = end[:, i] == TIMED_OUT
        following[late] = timeout_value[late, i]
        terminal = (end[:, i] != CONTINUES) & ~(late & bootstrap)
        wanted = reference.gae(reward[:, i], value[:, i], following, terminal, end[:, i] != CONTINUES, gamma, lam)
        np.testing.assert_allclose(got[:, i], wanted, atol=1e-4)
        np.testing.assert_allclose(returns[:, i], wanted + value[:, i], atol=1e-4)


@pytest.mark.parametrize("timeout", ["terminal", "bootstrap"])
def test_an_update_values_time_outs_by_the_chosen_rule(timeout, lessons, make_config):
    """On a real chunk: the mean absolute advantage, which `update` reports, is that of the explicit sums."""
    config = make_config({"ppo.timeout": timeout})
    state = LearnerState(config, seed=1)
    chunk = next(c for c in lessons if (c.end == TIMED_OUT).sum() >= 3 and (c.end == FELL).any())
    state, _ = update(state, [chunk])  # so that returns are scaled
    _, metrics = update(state, [chunk])

    def value(observation):
        mean, scale = state.returns.mean_and_scale()
        with torch.no_grad():
            out = state.value(state.observations(torch.from_numpy(observation))).numpy()
        return out[..., 0] / scale.item() + mean.item()

    horizon, n = chunk.end.shape
    values, last = value(chunk.observation), value(chunk.last_observation)
    final = np.zeros((horizon, n))
    final[np.nonzero(chunk.end)] = value(chunk.final_observation)
    total = 0.0
    for i in range(n):
        over, late = chunk.end[:, i] != CONTINUES, chunk.end[:, i] == TIMED_OUT
        following = np.where(late, final[:, i], np.append(values[1:, i], last[i]))
        terminal = over & ~(late & (timeout == "bootstrap"))
        total += np.abs(reference.gae(chunk.reward[:, i], values[:, i], following, terminal, over, 0.99, 0.95)).sum()
    assert metrics["value/error"] == pytest.approx(total / chunk.end.size, rel=1e-4)
