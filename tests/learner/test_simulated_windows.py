"""The descent at arrival by the derivatives of physics: what it says of physics is so when played."""

import copy

import numpy as np
import pytest
import torch

from learner.arrival import Arrival
from learner.encoding import residuals, split
from learner.simulated_windows import SimulatedWindows
from learner.state import LearnerState
from learner.update import update
from workers import windows
from workers.environment import Environment, new_observations
from workers.kinematics import forward_kinematics_batch
from workers.reward import KP, RP, Q
from workers.rollout import Rollout
from workers.types import Thresholds

STEPS, N = 5, 32
ON = {
    "task.max_steps": 8, "physics.sole": 0.02, "arrival.weight": 1.0, "arrival.physics": "simulated",
    "arrival.steps": STEPS, "arrival.share": 1.0, "arrival.batch_size": 16, "policy.log_sigma": -3.0,
    "observation.target": "difference",
}  # fmt: skip


pytestmark = pytest.mark.usefixtures("everybody_is_near")


@pytest.fixture(scope="module")
def lesson(library, make_config, easy, everybody_is_near):
    """(configuration, the chunk of the policy of seed 1, its windows' first states, first steps and targets)."""
    config = make_config(ON)
    rollout, kept = Rollout(config, library, N, config.horizon, seed=5), {}
    scouts, last_steps = rollout._scouts, rollout._scouts._last_steps

    def watched(network, physics, rows, begin, noise):
        kept["states"] = physics.copy(), begin, scouts._env.target_qpos[rows], scouts._env.target_qvel[rows]
        return last_steps(network, physics, rows, begin, noise)

    scouts._last_steps = watched
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(windows, "QUIET", STEPS)  # no noise, so that what is played again is the same
        chunk, _ = rollout.collect(rollout.initial_state(0), LearnerState(config, 1).snapshot(), easy)
    assert len(chunk.windows) == len(kept["states"][0]) >= 20
    return config, chunk, kept["states"]


def played(lesson, library, policy, changes=None):
    """(d^rp, d^kp, d^q (M, 3) in thresholds, residuals (M, 60)) where each window ends if `policy` acts in it, with
    changes (M, K, 31) of its outputs."""
    config, chunk, (physics, begin, *target) = lesson
    found = chunk.windows
    env = Environment(config, library, len(found))
    env.place(physics, np.arange(len(found)))
    env.target_qpos[:], env.target_qvel[:] = target
    forward_kinematics_batch(env.target_qpos, env.target_bodies, np.empty_like(env.rotations))
    for k in range(STEPS):
        seen = torch.as_tensor(env.observe(new_observations(len(found))))
        with torch.no_grad():
            # the normalizer has seen nothing yet
            action = policy(seen.clamp(-10.0, 10.0)).numpy()
        changed = action if changes is None else action + changes[:, k]
        env.step(changed, Thresholds(0.0, 0.0, 0.0), np.flatnonzero(begin <= k))
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


def everyone(chunk):
    return torch.arange(len(chunk.windows))


@torch.no_grad()
def ends(found, changes):
    """(M, 60): where the windows end with changes (M, K, 31) of the outputs, as the derivatives say."""
    return found.ends(torch.arange(len(found)), torch.as_tensor(changes, dtype=torch.float32)[:, None])[:, 0].numpy()


def test_what_the_actions_do_is_what_they_do_when_played(lesson, library):
    """Every action, through the policy's outputs at later steps."""
    config, chunk, _ = lesson
    state, generator = LearnerState(config, 1), np.random.default_rng(0)
    found = SimulatedWindows(state, chunk)
    _, rest = played(lesson, library, state.policy)
    np.testing.assert_allclose(ends(found, np.zeros((len(rest), STEPS, 31))), rest, atol=5e-3)
    for _ in range(3):
        changes = generator.normal(0.0, 1e-3, (len(rest), STEPS, 31)).astype(np.float32)
        said = (ends(found, changes) - ends(found, -changes)) / 2
        true = [played(lesson, library, state.policy, sign * changes)[1] for sign in (1, -1)]
        true = (true[0] - true[1]) / 2
        # one window or another has a foot that just takes hold or lets go
        assert np.corrcoef(said.ravel(), true.ravel())[0, 1] > 0.97
        assert np.median(np.abs(said - true)) < 0.08 * np.abs(true).mean()


def test_ends_are_those_of_slow_obvious_code(lesson):
    """One window, one draw and one step at a time, by the arrays of `workers.types.Windows`."""
    config, chunk, _ = lesson
    state, generator, found = LearnerState(config, 1), np.random.default_rng(0), chunk.windows
    chosen, changes = [4, 0, 4], generator.normal(0.0, 0.01, (3, 2, STEPS, 31)).astype(np.float32)
    with torch.no_grad():
        quick = SimulatedWindows(state, chunk).ends(torch.as_tensor(chosen), torch.as_tensor(changes)).numpy()
    for row, window in enumerate(chosen):
        limits = torch.as_tensor(found.limits[window : window + 1])

        def left(observation, limits=limits):
            return residuals(*split(observation[None], True), limits)[0]

        last = torch.as_tensor(found.observation[window, -1])
        by_end = torch.autograd.functional.jacobian(left, last).numpy() @ found.seen[window, -1]
        for draw in range(2):
            x = np.zeros(74)
            for k in range(STEPS):
                seen = found.observation[window, k] + (found.seen[window, k - 1] @ x if k else 0.0)
                with torch.no_grad():
                    output = state.policy(state.observations(torch.as_tensor(seen[None], dtype=torch.float32)))[0]
                action = output.numpy() - found.mean[window, k] + changes[row, draw, k]
                x = (found.by_state[window, k - 1] @ x if k else 0.0) + found.by_action[window, k] @ action
            expected = left(last).numpy() + by_end @ x
            np.testing.assert_allclose(quick[row, draw], expected, rtol=1e-3, atol=1e-3 * np.abs(expected).max())


def test_its_loss_is_the_mean_of_what_is_left_under_noise(lesson):
    """Against its definition, of the noise that it says: the evaluation's deviation times a half, none in the last."""
    config, chunk, _ = lesson
    state, chosen = LearnerState(config, 1), np.array([3, 0, 3])
    found = SimulatedWindows(state, chunk)
    sigma = np.exp(config.policy.judge_log_sigma) / config.action.scale
    draws = config.arrival.draws
    noise = np.random.default_rng(7).standard_normal((3, draws, STEPS, 31), dtype=np.float32) * 0.5 * sigma
    noise[:, :, -1] = 0.0
    with torch.no_grad():
        left = found.ends(torch.as_tensor(chosen), torch.as_tensor(noise, dtype=torch.float32)).numpy()
        loss = found.loss(chosen, np.random.default_rng(7)).item()
    assert loss == pytest.approx(np.sqrt(1 + (left**2).sum(axis=2)).mean(), rel=1e-5)
    quiet = copy.deepcopy(config)
    quiet.arrival.noise = 0.0
    rest = ends(found, np.zeros((len(found), STEPS, 31)))[chosen]
    with torch.no_grad():
        loss = SimulatedWindows(LearnerState(quiet, 1), chunk).loss(chosen, np.random.default_rng(7)).item()
    assert loss == pytest.approx(np.sqrt(1 + (rest**2).sum(axis=1)).mean(), rel=1e-5)


def test_a_policy_that_has_moved_since_is_followed_to_where_it_would_come(lesson, library):
    config, chunk, _ = lesson
    state, generator = LearnerState(config, 1), torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in state.policy.parameters():
            parameter += 2e-3 * parameter.abs().mean() * torch.randn(parameter.shape, generator=generator)
    still = np.zeros((len(chunk.windows), STEPS, 31))
    followed, stale = (ends(SimulatedWindows(learner, chunk), still) for learner in (state, LearnerState(config, 1)))
    _, true = played(lesson, library, state.policy)
    assert np.linalg.norm(followed - true) < 0.5 * np.linalg.norm(stale - true)


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


def test_steps_down_its_gradient_bring_the_figure_nearer_under_noise(lesson, library):
    config, chunk, _ = lesson
    state, generator = LearnerState(config, 1), np.random.default_rng(0)
    sigma = np.exp(config.policy.judge_log_sigma) / config.action.scale
    noise = generator.normal(0.0, sigma, (4, len(chunk.windows), STEPS, 31)).astype(np.float32)

    def left():
        return np.mean([np.linalg.norm(played(lesson, library, state.policy, n)[1], axis=1).mean() for n in noise])

    before, learner = left(), SimulatedWindows(state, chunk)
    optimizer = torch.optim.SGD(state.policy.parameters(), lr=3e-3)
    for _ in range(10):
        optimizer.zero_grad()
        learner.loss(everyone(chunk), generator).backward()
        optimizer.step()
    assert left() < 0.98 * before


def test_a_chunk_without_windows_changes_nothing(lesson, assert_same_bits):
    config, chunk, _ = lesson
    none = copy.copy(chunk)
    object.__setattr__(none, "windows", chunk.windows.take(np.zeros(0, dtype=np.int64)))
    state = LearnerState(config, 1)
    added, metrics = Arrival(state, none).gradient()
    assert added is None and metrics == {"loss/arrival": 0.0, "gradient/arrival": 0.0, "arrival/left": 0.0}
    assert np.isfinite(update(state, [none])[1]["loss/policy"])
