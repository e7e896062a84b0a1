"""The descent at arrival by the derivatives of physics: what it follows is what a changed policy really does."""

import copy

import numpy as np
import pytest
import torch

from learner.arrival import Arrival
from learner.simulated_windows import SimulatedWindows
from learner.state import LearnerState
from learner.update import update
from workers import windows
from workers.environment import Environment, new_observations
from workers.kinematics import forward_kinematics_batch
from workers.reward import KP, RP, Q
from workers.rollout import Rollout
from workers.types import Thresholds

STEPS, N = 3, 32
ON = {
    "task.max_steps": 8, "physics.sole": 0.02, "arrival.weight": 1.0, "arrival.physics": "simulated",
    "arrival.steps": STEPS, "arrival.share": 1.0, "arrival.batch_size": 16, "policy.log_sigma": -3.0,
    "observation.target": "difference",
}  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def everybody_is_near():
    kept, windows.NEAR = windows.NEAR, 1e9
    yield
    windows.NEAR = kept


@pytest.fixture(scope="module")
def lesson(library, make_config, easy):
    """(configuration, the chunk of the policy of seed 1, what its scouts played)."""
    config = make_config(ON)
    rollout = Rollout(config, library, N, config.horizon, seed=5)
    state, policy = rollout.initial_state(0), LearnerState(config, 1).snapshot()
    chunk, _ = rollout.collect(state, policy, easy)
    assert len(chunk.windows) >= 20
    return config, chunk, (rollout._scouts, rollout._scouts._play(policy, np.arange(N), 0))


def played(lesson, library, policy):
    """d^rp, d^kp, d^q (M, 3), in thresholds, where each window ends if `policy` acts in it with the noise of then."""
    config, chunk, (scouts, before) = lesson
    found, row = chunk.windows, chunk.windows.environment
    starts = zip(row, found.observation[:, 0])
    first = [np.flatnonzero((before["observation"][:, i] == start).all(axis=1))[0] for i, start in starts]
    env = Environment(config, library, len(found))
    env.physics[:] = before["physics"][first, row]
    env.target_qpos[:], env.target_qvel[:] = scouts._env.target_qpos[row], scouts._env.target_qvel[row]
    forward_kinematics_batch(env.qpos, env.bodies, env.rotations)
    forward_kinematics_batch(env.target_qpos, env.target_bodies, np.empty_like(env.rotations))
    for k in range(STEPS):
        at = np.array(first) + k, row
        noise = before["action"][at] - before["mean"][at]
        seen = torch.as_tensor(env.observe(new_observations(len(found))))
        with torch.no_grad():
            env.step(policy(seen).numpy() + noise, Thresholds(0.0, 0.0, 0.0))
    return env.deviations[:, [RP, KP, Q]] / found.limits


def test_with_the_policy_that_acted_it_arrives_where_the_figure_did(lesson, library):
    config, chunk, _ = lesson
    state = LearnerState(config, 1)
    with torch.no_grad():
        found = SimulatedWindows(state, chunk).arrive(np.arange(len(chunk.windows))).numpy()
    # nothing has been seen by the normalizer yet: the policy takes observations as they are
    np.testing.assert_allclose(found, played(lesson, library, state.policy), atol=2e-3, rtol=2e-3)


def test_its_gradient_is_that_of_playing_a_changed_policy(lesson, library):
    """By the policy's weights, through all steps of the windows and the corrections of later ones."""
    config, chunk, _ = lesson
    state, generator = LearnerState(config, 1), torch.Generator().manual_seed(0)
    everyone = np.arange(len(chunk.windows))
    for _ in range(3):
        direction = [torch.randn(p.shape, generator=generator) * p.abs().mean() for p in state.policy.parameters()]
        total = SimulatedWindows(state, chunk).arrive(everyone).sum(dim=1)
        said = np.zeros(len(everyone))
        for m in everyone:  # of every window for itself
            gradient = torch.autograd.grad(total[m], list(state.policy.parameters()), retain_graph=True)
            said[m] = sum((g * d).sum() for g, d in zip(gradient, direction)).item()
        ends = []
        for sign in (1.0, -1.0):
            policy = copy.deepcopy(state.policy)
            with torch.no_grad():
                for parameter, change in zip(policy.parameters(), direction):
                    parameter += sign * 0.003 * change
            ends.append(played(lesson, library, policy).sum(axis=1))
        true = (ends[0] - ends[1]) / 0.006
        assert np.abs(true).max() > 1e-3, np.corrcoef(said, true)
        assert np.corrcoef(said, true)[0, 1] > 0.95
        # one window or another has a foot that just takes hold or lets go
        assert np.median(np.abs(said - true)) < 0.05 * np.abs(true).mean()


@pytest.mark.parametrize("optimizer", ("adam", "kfac"))
def test_an_update_with_it_is_pure_and_needs_no_learned_physics(optimizer, lesson, make_config, assert_same_bits):
    _, chunk, _ = lesson
    state = LearnerState(make_config({**ON, "ppo.optimizer": optimizer}), 1)
    before = copy.deepcopy(state.state_dict())
    first, second = (update(state, [chunk]) for _ in range(2))
    assert_same_bits(state.state_dict(), before)
    assert_same_bits(first[0].state_dict(), second[0].state_dict())
    assert_same_bits(first[1], second[1])
    assert state.dynamics is None and first[1]["gradient/arrival"] > 0 and "loss/dynamics" not in first[1]


def test_a_step_down_its_gradient_brings_the_figure_nearer(lesson, library):
    config, chunk, _ = lesson
    state = LearnerState(config, 1)
    arrival, everyone = Arrival(state, chunk), np.arange(len(chunk.windows))

    def left():
        return np.linalg.norm(played(lesson, library, state.policy), ord=4, axis=1).mean()

    before = left()
    for _ in range(20):
        loss = arrival._loss(everyone)
        gradient = torch.autograd.grad(loss, list(state.policy.parameters()))
        with torch.no_grad():
            norm = torch.sqrt(sum((g**2).sum() for g in gradient))
            for parameter, g in zip(state.policy.parameters(), gradient):
                parameter -= 0.01 * g / norm
    gained = before - loss.item()
    assert gained > 0 and left() == pytest.approx(before - gained, abs=0.3 * gained)


def test_a_chunk_without_windows_changes_nothing(lesson, assert_same_bits):
    config, chunk, _ = lesson
    none = copy.copy(chunk)
    object.__setattr__(none, "windows", chunk.windows.take(np.zeros(0, dtype=np.int64)))
    state = LearnerState(config, 1)
    added, metrics = Arrival(state, none).gradient()
    assert added is None and metrics == {"loss/arrival": 0.0, "gradient/arrival": 0.0}
    assert np.isfinite(update(state, [none])[1]["loss/policy"])
