"""`benchmarks.derivatives`: what it compares are the derivatives and as many simulations as differences would take."""

import numpy as np
import pytest

from benchmarks import derivatives


def test_its_two_figures_are_of_the_same_times(make_config):
    found = derivatives.measure(make_config({"physics.sole": 0.02}), 4, 1)
    assert set(found) == {1, 2}
    for row in found.values():
        assert row["ratio"] > 0 and row["steps"] * row["ratio"] == pytest.approx(106)


def test_its_states_are_of_all_moments_of_episodes(make_config):
    env, action = derivatives.states(make_config({}), 24)
    assert action.shape == (24, 31) and np.isfinite(env.physics).all()
    np.testing.assert_array_equal(env.steps, 1 + np.arange(24) % 12)
