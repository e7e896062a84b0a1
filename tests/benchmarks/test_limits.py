"""`benchmarks.limits` measures what is left as the deviations do, and what it finds can be played again."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.limits import Search, newton_steps
from motion.state_machine import build_state_machine
from workers.library import build_library
from workers.reward import KP, RP, Q

STEPS = 6


@pytest.fixture(scope="module")
def search(make_config, make_policy):
    config = make_config()
    library = build_library(build_state_machine(config.motions))
    return Search(config, library, make_policy(), 24, STEPS), library


def task_of(library, group, share, turn):
    source, target = library.groups[group]
    low, high = library.cancel[source]
    return np.array([source, low + share * (high - low), target, turn])


def test_residuals_are_the_deviations_in_units_of_the_final_accuracy(search):
    search, library = search
    offsets = np.random.default_rng(0).normal(0, 0.3, (20, STEPS, 31))
    ratios, residuals = search.play(task_of(library, 1, 0.3, 0.7), offsets, STEPS - 1)
    deviations = search._env.deviations[:20]
    np.testing.assert_allclose(np.linalg.norm(residuals[:, :3], axis=1), deviations[:, RP] / 0.01)
    keys = np.linalg.norm(residuals[:, 3:21].reshape(20, 6, 3), axis=2).sum(axis=1)
    np.testing.assert_allclose(keys, deviations[:, KP] / 0.09)
    np.testing.assert_allclose(np.abs(residuals[:, 21:]).sum(axis=1), deviations[:, Q] / 0.15)
    standing = np.isfinite(ratios[:, -1])
    assert standing.any()
    largest = np.max([deviations[:, RP] / 0.01, deviations[:, KP] / 0.09, deviations[:, Q] / 0.15], axis=0)
    np.testing.assert_allclose(ratios[standing, -1], largest[standing])


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000), st.integers(2, 6), st.integers(6, 12))
def test_where_all_is_linear_one_of_the_steps_leaves_next_to_nothing(seed, residuals, inputs):
    rng = np.random.default_rng(seed)
    jacobian, residual = rng.normal(size=(residuals, inputs)), rng.normal(size=residuals)
    x = rng.normal(size=(200, inputs))
    left = residual + newton_steps(x, x @ jacobian.T, residual) @ jacobian.T
    condition = np.linalg.cond(jacobian) ** 2  # damping keeps what hardly shows from being undone
    assert np.linalg.norm(left, axis=1).min() < min(1.0, 0.01 * condition) * np.linalg.norm(residual)


def test_an_improved_motion_is_nearer_and_comes_out_again_when_played(search):
    search, library = search
    task = task_of(library, 0, 0.5, 0.4)
    found = search.improve(task, 4, np.random.default_rng(3))
    assert found["improved"] < found["policy"] and 0 < found["rounds"] <= 4
    again, _ = search.play(task, np.array([found["offsets"]]))
    assert again.min() == pytest.approx(found["improved"], rel=1e-9) and again.argmin() + 1 == found["step"]
    plain, _ = search.play(task, np.zeros((3, STEPS, 31)))
    assert plain.min(axis=1) == pytest.approx([found["policy"]] * 3, rel=1e-9)
    twice = search.improve(task, 4, np.random.default_rng(3))
    assert twice == found


def test_a_motions_own_actions_take_it_where_it_went_and_noise_of_them_elsewhere(search):
    search, library = search
    task, still = task_of(library, 1, 0.4, -0.5), np.zeros((3, STEPS, 31))
    ratios, residuals = search.play(task, still, STEPS - 1)
    again, same = search.play(task, still, STEPS - 1, actions=search.acted[0])
    np.testing.assert_array_equal(again, ratios)
    np.testing.assert_array_equal(same, residuals)
    noise = np.zeros_like(still)
    noise[1, -1], noise[2, 0] = 0.1, 0.1
    last, _ = search.play(task, noise, actions=search.acted[0])
    np.testing.assert_array_equal(last[0], ratios[0])
    np.testing.assert_array_equal(last[1, :-1], ratios[0, :-1])
    assert last[1, -1] != ratios[0, -1] and last[2, 0] != ratios[0, 0]
