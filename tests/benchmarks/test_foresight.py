"""`benchmarks.foresight`: nothing but noise before physics is learned, right where physics itself foresees."""

import numpy as np
import pytest
import torch

from benchmarks import foresight
from benchmarks.foresight import correlation, measure
from learner.dynamics import moved
from learner.networks import snapshot
from learner.state import LearnerState
from motion.state_machine import build_state_machine
from workers.library import build_library

SETTINGS = {"arrival.weight": 0.1, "arrival.hidden": [64], "physics.sole": 0.02, "policy.log_sigma": -3.0}


@pytest.fixture
def subject(make_config):
    config = make_config(SETTINGS)
    state = LearnerState(config, 1)
    policy = snapshot(state.policy, None, state.observations, config.policy, config.action.scale, 0)
    return config, state, policy, 0, build_library(build_state_machine(config.motions)), 3, 40, 0


def learn(state, chunk, number):
    """One pass of its physics over a chunk."""
    after = np.concatenate([chunk.observation[1:], chunk.last_observation[None]])
    after[np.nonzero(chunk.end)] = chunk.final_observation
    seen, action, after, move = (
        torch.as_tensor(np.ascontiguousarray(array, dtype=np.float32).reshape(chunk.end.size, -1))
        for array in (chunk.observation, chunk.action, after, moved(chunk.pose, chunk.next_pose))
    )
    order = np.random.default_rng(number).permutation(chunk.end.size)
    state.dynamics.learn(seen, action, after, move, np.array_split(order, 4))


def test_a_network_that_has_learned_nothing_knows_nothing(subject):
    rows = measure(*subject)
    assert sum(row["pushes"] for row in rows.values()) == 3 * 40
    assert all(row["mm"] > 0 for row in rows.values())
    assert abs(rows[0]["root"]) < 0.5


def test_what_was_learned_of_other_steps_is_foreseen(subject, lessons):
    config, state, *_ = subject
    before = measure(*subject)[0]["joints"]
    for k in range(150):
        learn(state, lessons[k % len(lessons)], k)
    assert measure(*subject)[0]["joints"] > max(0.4, before + 0.3)


def test_simulated_derivatives_foresee_what_is_far_too_much_for_the_network(make_config, subject):
    """Small pushes on soles, through the policy's corrections."""
    config = make_config({**SETTINGS, "arrival.physics": "simulated", "policy.log_sigma": -6.0})
    state = LearnerState(config, 1)
    policy = snapshot(state.policy, None, state.observations, config.policy, config.action.scale, 0)
    rows = measure(config, state, policy, *subject[3:])
    assert sum(row["pushes"] for row in rows.values()) == 3 * 40
    for k in range(4):
        assert min(rows[k][name] for name in ("root", "keys", "joints")) > 0.9


def test_without_pushes_nothing_is_foreseen(subject):
    config, state, policy, cuts, library, *_ = subject
    follower = foresight.Follower(config, library, policy, 4)
    task = np.zeros(4)
    noise = np.zeros((foresight.STEPS, 4, 31))
    observations, actions, nearest = follower.play(task, noise)
    said = foresight.foreseen(state, observations[:, 0], actions[:, 0], noise[:, 1:], nearest)
    assert said.abs().max() < 1e-4


def test_correlation_is_about_zero():
    a = np.random.default_rng(0).normal(size=(5, 3))
    assert correlation(a, 2 * a) == pytest.approx(1) and correlation(a, -a) == pytest.approx(-1)
    assert correlation(a, np.zeros((5, 3))) == 0
