"""Action noise: a moving average of the clock's draws, which no chunk boundary and no other environment shows in."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from workers.counter_random import ACTION, fill_normal
from workers.noise import ActionNoise
from workers.types import judging

SEED = 11


def draw(environment, t, window):
    out = np.empty((1, 31))
    fill_normal(SEED, ACTION, np.array([environment]), np.array([t + window - 1]), out)
    return out[0]


def noise(policy, environment, clock, steps, independent=None):
    source = ActionNoise(policy, SEED, np.asarray(environment), clock)
    sigma = np.full(len(environment), policy.log_sigma)
    alone = np.zeros(len(environment), bool) if independent is None else independent
    return np.array([source.next(sigma, alone) for _ in range(steps)])


@settings(max_examples=40, deadline=None)
@given(
    st.integers(1, 6), st.integers(0, 50), st.sampled_from([0, 2, 3]), st.lists(st.booleans(), min_size=4, max_size=4)
)
def test_noise_is_the_scaled_sum_of_the_last_draws_a_judges_and_an_independent_one_the_last_alone(
    make_policy, window, clock, judges, independent
):
    policy = replace(make_policy(), noise_window=window, judges=judges, judge_log_sigma=-3.0)
    environment = np.array([0, 1, 5, 6])
    got = noise(policy, environment, clock, 3, np.array(independent))
    for t in range(3):
        for row, index in enumerate(environment):
            draws = [draw(index, clock + t - lag, window) for lag in range(window)]
            wanted = np.exp(policy.log_sigma) * (draws[0] if independent[row] else sum(draws) / window**0.5)
            if judges and index % judges == 0:
                wanted = np.exp(-3.0) * draws[0]
            np.testing.assert_allclose(got[t, row], wanted, rtol=1e-5, atol=1e-6)


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 5), st.integers(0, 20), st.integers(1, 6))
def test_noise_does_not_know_where_chunks_begin_nor_who_its_neighbours_are(make_policy, window, clock, cut):
    policy = replace(make_policy(), noise_window=window, judges=2)
    whole = noise(policy, [3, 4, 7], clock, 8)
    np.testing.assert_array_equal(whole[cut:], noise(policy, [3, 4, 7], clock + cut, 8 - cut))
    np.testing.assert_array_equal(whole[:, 1:2], noise(policy, [4], clock, 8))


@pytest.mark.parametrize("window", [1, 4])
def test_noise_keeps_its_deviation_and_is_correlated_over_the_window_only(make_policy, window):
    policy = replace(make_policy(), noise_window=window)
    x = noise(policy, np.arange(400), 0, 12) / np.exp(policy.log_sigma)
    assert x.std(axis=(1, 2)) == pytest.approx(1.0, abs=0.03)  # from the first step on
    for lag in range(1, 8):
        wanted = max(0.0, 1 - lag / window)
        assert (x[lag:] * x[:-lag]).mean() == pytest.approx(wanted, abs=0.02)


def test_judges_are_every_kth_environment_of_the_run():
    assert judging(np.arange(3, 9), 4).tolist() == [False, True, False, False, False, True]
    assert not judging(np.arange(5), 0).any()
