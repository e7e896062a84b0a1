"""`benchmarks.pushes`: on soles all pushes do as much for their size, on hard feet small ones do more."""

import numpy as np
import pytest

from benchmarks.pushes import measure
from motion.state_machine import build_state_machine
from workers.library import build_library

STEPS = 4


@pytest.fixture(scope="module")
def measured(make_config, make_policy):
    """{sole: figures} of the same untrained policy."""
    found = {}
    for sole in (0.0, 0.02):
        config = make_config({"physics.sole": sole})
        found[sole] = measure(config, make_policy(), build_library(build_state_machine(config.motions)), 96, STEPS, 0)
    return found


def test_soles_make_physics_smooth(measured):
    whole, _, hundredth = (np.array(row["rms"]) for row in measured[0.02]["rows"])
    np.testing.assert_allclose(hundredth, whole, rtol=0.5)


def test_hard_feet_do_not(measured):
    whole, _, hundredth = (np.array(row["rms"]) for row in measured[0.0]["rows"])
    assert (hundredth[1:] > 2 * whole[1:]).all()
