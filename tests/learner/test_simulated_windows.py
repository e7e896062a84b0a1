"""The descent at arrival by the derivatives of physics: its corrections do when played what they are said to do."""

import copy

import numpy as np
import pytest
import torch

from learner.arrival import Arrival
from learner.encoding import residuals, split
from learner.simulated_windows import SimulatedWindows, corrections
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
    "observation.target": "difference", "arrival.correction": 0.3,
}  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def everybody_is_near():
    kept, windows.NEAR = windows.NEAR, 1e9
    yield
    windows.NEAR = kept


@pytest.fixture(scope="module")
def lesson(library, make_config, easy):
    """(configuration, the chunk of the policy of seed 1, the states that its windows begin in, their targets)."""
    config = make_config(ON)
    rollout, kept = Rollout(config, library, N, config.horizon, seed=5), {}
    scouts, last_steps = rollout._scouts, rollout._scouts._last_steps

    def watched(network, physics, rows, noise):
        kept["states"] = physics.copy(), scouts._env.target_qpos[rows], scouts._env.target_qvel[rows]
        return last_steps(network, physics, rows, noise)

    scouts._last_steps = watched
    chunk, _ = rollout.collect(rollout.initial_state(0), LearnerState(config, 1).snapshot(), easy)
    assert len(chunk.windows) == len(kept["states"][0]) >= 20
    return config, chunk, kept["states"]


def played(lesson, library, policy, changes=None):
    """(d^rp, d^kp, d^q (M, 3) in thresholds, residuals (M, 60)) where each window ends if `policy` acts in it, with
    changes (M, K, 31) of its outputs."""
    config, chunk, (physics, *target) = lesson
    found = chunk.windows
    env = Environment(config, library, len(found))
    env.physics[:] = physics
    env.target_qpos[:], env.target_qvel[:] = target
    forward_kinematics_batch(env.qpos, env.bodies, env.rotations)
    forward_kinematics_batch(env.target_qpos, env.target_bodies, np.empty_like(env.rotations))
    for k in range(STEPS):
        seen = torch.as_tensor(env.observe(new_observations(len(found))))
        with torch.no_grad():
            # the normalizer has seen nothing yet
            action = policy(seen.clamp(-10.0, 10.0)).numpy()
        env.step(action if changes is None else action + changes[:, k], Thresholds(0.0, 0.0, 0.0))
    end = torch.as_tensor(env.observe(new_observations(len(found))).astype(np.float64))
    left = residuals(*split(end, True), torch.as_tensor(found.limits, dtype=torch.float64)).numpy()
    return env.deviations[:, [RP, KP, Q]] / found.limits, left


def test_residuals_are_the_deviations_parts(lesson, library):
    config, chunk, _ = lesson
    state = LearnerState(config, 1)
    limits, left = played(lesson, library, state.policy)
    np.testing.assert_allclose(np.linalg.norm(left[:, :3], axis=1), limits[:, 0], rtol=1e-5)
    keys = np.linalg.norm(left[:, 3:21].reshape(-1, 6, 3), axis=2).sum(axis=1) / 6**0.5
    np.testing.assert_allclose(keys, limits[:, 1], rtol=1e-4)
    np.testing.assert_allclose(np.abs(left[:, 21:]).sum(axis=1) / 31**0.5, limits[:, 2], rtol=1e-4)


def test_what_the_actions_do_is_what_they_do_when_played(lesson, library):
    """Derivatives of the windows' ends by every action, through the policy's outputs at later steps."""
    config, chunk, _ = lesson
    state, generator = LearnerState(config, 1), np.random.default_rng(0)
    with torch.no_grad():
        limits = torch.as_tensor(chunk.windows.limits)
        residual, by_actions = SimulatedWindows(state, chunk)._end(chunk.windows, limits)
    _, rest = played(lesson, library, state.policy)
    np.testing.assert_allclose(residual, rest, atol=5e-3)
    for _ in range(3):
        changes = generator.normal(0.0, 1e-3, (len(rest), STEPS, 31)).astype(np.float32)
        said = np.einsum("mrkd,mkd->mr", by_actions.numpy(), changes)
        ends = [played(lesson, library, state.policy, sign * changes)[1] for sign in (1, -1)]
        true = (ends[0] - ends[1]) / 2
        # one window or another has a foot that just takes hold or lets go
        assert np.corrcoef(said.ravel(), true.ravel())[0, 1] > 0.97
        assert np.median(np.abs(said - true)) < 0.05 * np.abs(true).mean()


def test_corrected_actions_come_nearer_by_as_much_as_foreseen(lesson, library):
    config, chunk, _ = lesson
    state = LearnerState(config, 1)
    found = SimulatedWindows(state, chunk)
    changes = found.corrections.numpy()
    before, after = (played(lesson, library, state.policy, c)[1] for c in (None, changes))
    with torch.no_grad():
        residual, by_actions = found._end(chunk.windows, torch.as_tensor(chunk.windows.limits))
    foreseen = residual.numpy() + np.einsum("mrkd,mkd->mr", by_actions.numpy(), changes)
    gained, said = (np.linalg.norm(before, axis=1) - np.linalg.norm(end, axis=1) for end in (after, foreseen))
    assert (said > 0).all() and (gained > 0).mean() > 0.9
    assert np.median(np.abs(gained - said) / said) < 0.1


def test_corrections_are_those_of_least_squares():
    """Against numpy's, of the stacked problem |r + J x|^2 + |x|^2 / deviation^2."""
    generator = np.random.default_rng(0)
    residual, by_actions = generator.normal(size=(4, 7)), generator.normal(size=(4, 7, 2, 31))
    for deviation in (0.01, 0.3, 10.0):
        found = corrections(torch.as_tensor(residual), torch.as_tensor(by_actions), deviation).numpy()
        for m in range(4):
            stacked = np.concatenate([by_actions[m].reshape(7, -1), np.eye(62) / deviation])
            wanted = np.concatenate([-residual[m], np.zeros(62)])
            expected = np.linalg.lstsq(stacked, wanted, rcond=None)[0].reshape(2, 31)
            np.testing.assert_allclose(found[m], expected, atol=1e-9)


def test_its_gradient_is_that_of_the_corrected_actions_likelihood(lesson):
    config, chunk, _ = lesson
    state = LearnerState(config, 1)
    found, chosen = SimulatedWindows(state, chunk), np.array([3, 0, 3])
    given = state.observations(torch.as_tensor(chunk.windows.observation[chosen, :STEPS]))
    wanted = state.policy(given).detach() + found.corrections[chosen]
    sigma = np.exp(config.policy.judge_log_sigma) / config.action.scale
    likelihood = -((wanted - state.policy(given)) ** 2).sum(dim=(1, 2)) / (2 * sigma**2)
    parameters = list(state.policy.parameters())
    expected = torch.autograd.grad(-likelihood.mean(), parameters)
    for one, other in zip(torch.autograd.grad(found.loss(chosen), parameters), expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-5 * float(other.abs().max()))


def test_a_policy_that_has_moved_since_is_corrected_from_where_it_would_come_to(lesson, library):
    config, chunk, _ = lesson
    state, generator = LearnerState(config, 1), torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in state.policy.parameters():
            parameter += 2e-3 * parameter.abs().mean() * torch.randn(parameter.shape, generator=generator)
    found = SimulatedWindows(state, chunk).corrections.numpy()
    stale = SimulatedWindows(LearnerState(config, 1), chunk).corrections.numpy()
    # corrected from where it comes to when it is played
    left = torch.as_tensor(played(lesson, library, state.policy)[1])
    with torch.no_grad():
        limits = torch.as_tensor(chunk.windows.limits)
        by_actions = SimulatedWindows(state, chunk)._end(chunk.windows, limits)[1]
    true = corrections(left.float(), by_actions, config.arrival.correction / config.action.scale).numpy()
    assert np.linalg.norm(found - true) < 0.5 * np.linalg.norm(stale - true)


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
    assert first[1]["arrival/left"] > 0


def test_steps_down_its_gradient_bring_the_figure_nearer(lesson, library):
    config, chunk, _ = lesson
    state, everyone = LearnerState(config, 1), np.arange(len(chunk.windows))

    def left():
        return np.linalg.norm(played(lesson, library, state.policy)[1], axis=1).mean()

    before = left()
    optimizer = torch.optim.SGD(state.policy.parameters(), lr=1e-5)
    for _ in range(10):
        optimizer.zero_grad()
        SimulatedWindows(state, chunk).loss(everyone).backward()
        optimizer.step()
    assert left() < 0.99 * before


def test_a_chunk_without_windows_changes_nothing(lesson, assert_same_bits):
    config, chunk, _ = lesson
    none = copy.copy(chunk)
    object.__setattr__(none, "windows", chunk.windows.take(np.zeros(0, dtype=np.int64)))
    state = LearnerState(config, 1)
    added, metrics = Arrival(state, none).gradient()
    assert added is None and metrics == {"loss/arrival": 0.0, "gradient/arrival": 0.0, "arrival/left": 0.0}
    assert np.isfinite(update(state, [none])[1]["loss/policy"])
