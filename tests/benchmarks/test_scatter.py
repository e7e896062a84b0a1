"""`benchmarks.scatter`: without noise nothing scatters, and noise of a last step does no more than noise of all."""

import numpy as np
import pytest

from benchmarks.limits import Search
from benchmarks.scatter import arrivals, shares
from motion.state_machine import build_state_machine
from workers.library import build_library

STEPS = 6


def search(config, policy, factor=1.0):
    search = Search(config, build_library(build_state_machine(config.motions)), policy, 64, STEPS)
    search.noise *= factor
    return search


def task(config):
    """One that an untrained policy comes nearest to in the middle of its steps."""
    library = build_library(build_state_machine(config.motions))
    source, target = library.groups[1]
    return np.array([source, library.cancel[source].mean(), target, 0.0])


@pytest.fixture(scope="module")
def setting(make_config, make_policy):
    return make_config(), make_policy()


def test_without_noise_nothing_scatters_and_the_bias_is_the_deviation(setting):
    still = search(*setting, factor=0.0)
    found = arrivals(still, task(setting[0]), np.random.default_rng(0))
    assert found["spread"] == pytest.approx(0.0, abs=1e-12) and found["open"] == pytest.approx(0.0, abs=1e-12)
    ratios, _ = still.play(task(setting[0]), np.zeros((1, STEPS, 31)))
    _, residuals = still.play(task(setting[0]), np.zeros((1, STEPS, 31)), int(ratios.argmin()))
    assert found["bias"] == pytest.approx(np.linalg.norm(residuals[0, :3]) * still.final[0])


def test_the_spread_grows_with_the_noise(setting):
    few, many = (arrivals(search(*setting, factor=f), task(setting[0]), np.random.default_rng(0)) for f in (0.5, 2.0))
    assert 0 < few["spread"] < many["spread"] and 0 < few["open"] < many["open"]


def test_shares_fall_with_the_steps_that_have_noise(setting):
    loose = search(*setting, factor=4.0)
    ratios, _ = loose.play(task(setting[0]), np.zeros((1, STEPS, 31)))
    loose.final = loose.final * ratios.min() * 1.001  # so that the motion is within, with little to spare
    found = shares(loose, task(setting[0]), 0, np.random.default_rng(0))
    assert found["improved"] <= 1.0 and len(found["shares"]) == 4
    one, *_, every = found["shares"]
    assert 0 < every < one < 1
    assert shares(search(*setting, factor=0.0), task(setting[0]), 0, np.random.default_rng(0))["shares"] == [0.0] * 4
