"""The descent at arrival by the derivatives of physics: what it says of physics is so when played."""

import copy
import dataclasses

import numpy as np
import pytest
import torch

from learner import followed_windows, ppo
from learner.arrival import Arrival
from learner.encoding import residuals, split
from learner.followed_windows import FollowedWindows
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
    "task.max_steps": 8, "physics.sole": 0.02, "arrival.weight": 1.0,
    "arrival.steps": STEPS, "arrival.share": 1.0, "arrival.batch_size": 16, "policy.log_sigma": -3.0,
    "observation.target": "difference",
}  # fmt: skip


@pytest.fixture(scope="module")
def any_foresight():
    """Windows are descended however little is foreseen yet."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(followed_windows, "LEAST_FORESEEN", -np.inf)
        yield


pytestmark = pytest.mark.usefixtures("everybody_is_near", "any_foresight")


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
    """(d^rp, d^kp, d^q (M, 3) in thresholds at the end, observations (M, K + 1, 282) before each step and after the
    last) of the windows if `policy` acts in them, with changes (M, K, 31) of its outputs."""
    config, chunk, (physics, begin, *target) = lesson
    found = chunk.windows
    env, everybody = Environment(config, library, len(found)), np.arange(len(found))
    env.place(physics, everybody)
    env.target_qpos[:], env.target_qvel[:] = target
    forward_kinematics_batch(env.target_qpos, env.target_bodies, np.empty_like(env.rotations))
    seen = [env.observe(new_observations(len(found)))]
    for k in range(STEPS):
        with torch.no_grad():
            # the normalizer has seen nothing yet
            action = policy(torch.as_tensor(seen[-1]).clamp(-10.0, 10.0)).numpy()
        changed = action if changes is None else action + changes[:, k]
        env.step(changed, Thresholds(0.0, 0.0, 0.0), np.flatnonzero(begin <= k))
        seen.append(env.observe(new_observations(len(found))))
    return env.deviations[:, [RP, KP, Q]] / found.limits, np.stack(seen, axis=1)


def left_of(chunk, seen):
    """(M, K + 1, 60): residuals of windows in which seen (M, K + 1, 282) is seen."""
    every = seen.shape[1]
    limits = torch.as_tensor(chunk.windows.limits).double().repeat_interleave(every, dim=0)
    seen = torch.as_tensor(np.ascontiguousarray(seen)).double().reshape(-1, 282)
    return residuals(*split(seen, True), limits).numpy().reshape(-1, every, 60)


def test_residuals_are_the_deviations_parts(lesson, library):
    config, chunk, _ = lesson
    state = LearnerState(config, 1)
    limits, seen = played(lesson, library, state.policy)
    left = left_of(chunk, seen)[:, -1]
    np.testing.assert_allclose(np.linalg.norm(left[:, :3], axis=1), limits[:, 0], rtol=1e-5)
    keys = np.linalg.norm(left[:, 3:21].reshape(-1, 6, 3), axis=2).sum(axis=1) / 6**0.5
    np.testing.assert_allclose(keys, limits[:, 1], rtol=1e-4)
    np.testing.assert_allclose(np.abs(left[:, 21:]).sum(axis=1) / 31**0.5, limits[:, 2], rtol=1e-4)


def everyone(chunk):
    return torch.arange(len(chunk.windows))


@torch.no_grad()
def followed(found, changes):
    """(M, K + 1, 282): what is seen in the windows with changes (M, K, 31) of the outputs, as the derivatives say."""
    changes = torch.as_tensor(changes, dtype=torch.float32)
    return found.follow(torch.arange(len(changes)), changes[:, None])[:, 0].numpy()


def test_what_the_actions_do_is_what_they_do_when_played(lesson, library):
    """Every action, through the policy's outputs at later steps."""
    config, chunk, _ = lesson
    state, generator = LearnerState(config, 1), np.random.default_rng(0)
    found = FollowedWindows(state, chunk)
    _, rest = played(lesson, library, state.policy)
    np.testing.assert_allclose(followed(found, np.zeros((len(rest), STEPS, 31))), rest, atol=5e-3)
    for _ in range(3):
        changes = generator.normal(0.0, 1e-3, (len(rest), STEPS, 31)).astype(np.float32)
        said, true = (
            (left_of(chunk, play(changes)) - left_of(chunk, play(-changes)))[:, 1:] / 2
            for play in (lambda c: followed(found, c), lambda c: played(lesson, library, state.policy, c)[1])
        )
        # one window or another has a foot that just takes hold or lets go
        assert np.corrcoef(said.ravel(), true.ravel())[0, 1] > 0.97
        assert np.median(np.abs(said - true)) < 0.08 * np.abs(true).mean()


def test_what_is_seen_is_that_of_slow_obvious_code(lesson):
    """One window, one draw and one step at a time, by the arrays of `workers.types.Windows`."""
    config, chunk, _ = lesson
    state, generator, found = LearnerState(config, 1), np.random.default_rng(0), chunk.windows
    chosen, changes = [4, 0, 4], generator.normal(0.0, 0.01, (3, 2, STEPS, 31)).astype(np.float32)
    ready = FollowedWindows(state, chunk)
    with torch.no_grad():
        quick = ready.follow(torch.as_tensor(chosen), torch.as_tensor(changes)).numpy()
    for row, window in enumerate(chosen):
        for draw in range(2):
            x, seen = np.zeros(74), found.observation[window, 0]
            for k in range(STEPS):
                np.testing.assert_allclose(quick[row, draw, k], seen, rtol=1e-3, atol=1e-3)
                with torch.no_grad():
                    output = state.policy(state.observations(torch.as_tensor(seen[None], dtype=torch.float32)))[0]
                action = output.numpy() - found.mean[window, k] + changes[row, draw, k]
                x = (found.by_state[window, k - 1] @ x if k else 0.0) + found.by_action[window, k] @ action
                seen = found.observation[window, k + 1] + found.seen[window, k] @ x
            np.testing.assert_allclose(quick[row, draw, STEPS], seen, rtol=1e-3, atol=1e-3)


def costs(state, windows, m, seen):
    """Of window m in which seen (K + 1, 282) is seen: each step's, as much as it weighs, and what is to come, by
    definition."""
    total, weight, arrival = 0.0, 1.0, state.config.arrival
    for k in range(windows.begin[m], STEPS):
        square = (residuals(*split(seen[k + 1 : k + 2], True), torch.as_tensor(windows.limits[[m]])) ** 2).sum()
        total = total + weight * (arrival.time + 4 * torch.log((4 + torch.sqrt(1 + square)) / 5))
        weight = weight * 0.93
        if arrival.ends is not None:
            weight = weight * (1 - 1 / (1 + (square / arrival.ends) ** 2))
    return total + weight * state.cost_to_go(state.observations(seen[-1:]))[0]


def drawn_noise(config, count):
    """The evaluation's deviation times a half, none in the last step."""
    sigma = np.exp(config.policy.judge_log_sigma) / config.action.scale
    shape = count, config.arrival.draws, STEPS, 31
    noise = np.random.default_rng(7).standard_normal(shape, dtype=np.float32) * 0.5 * sigma
    noise[:, :, -1] = 0.0
    return torch.as_tensor(noise, dtype=torch.float32)


@pytest.mark.parametrize(("ends", "time"), ((None, 0.0), (5000.0, 1.5)))
def test_its_loss_is_what_is_left_under_noise_after_every_step_and_later(ends, time, lesson):
    config, chunk, _ = lesson
    config = copy.deepcopy(config)
    config.arrival.ends, config.arrival.time = ends, time
    state, chosen = LearnerState(config, 1), np.array([3, 0, int(chunk.windows.begin.argmax())])
    assert chunk.windows.begin.max() > 0
    found, noise = FollowedWindows(state, chunk), drawn_noise(config, 3)
    loss = found.loss(chosen, np.random.default_rng(7)).item()
    with torch.no_grad():
        seen = found.follow(torch.as_tensor(chosen), noise)
        expected = np.mean([[costs(state, chunk.windows, m, one) for one in rows] for m, rows in zip(chosen, seen)])
    assert loss == pytest.approx(expected, rel=1e-5)
    quiet = copy.deepcopy(config)
    quiet.arrival.noise = 0.0
    state = LearnerState(quiet, 1)
    found = FollowedWindows(state, chunk)
    rest = torch.as_tensor(followed(found, np.zeros((len(chunk.windows), STEPS, 31))))
    with torch.no_grad():
        expected = np.mean([costs(state, chunk.windows, m, rest[m]) for m in chosen])
    assert found.loss(chosen, np.random.default_rng(7)).item() == pytest.approx(expected, rel=1e-5)


def test_no_window_pulls_much_harder_than_the_median_one(lesson, monkeypatch):
    """The gradient, from each window's own, of its costs by the parameters and by the outputs of its steps."""
    monkeypatch.setattr(followed_windows, "HARDEST", 1.1)
    config, chunk, _ = lesson
    chosen, state, noise = [3, 0, 5, 9, 4], LearnerState(config, 1), drawn_noise(config, 5)
    found, parameters, own = FollowedWindows(state, chunk), list(state.policy.parameters()), []
    for row, m in enumerate(chosen):
        changes = noise[[row]].requires_grad_()
        seen = found.follow(torch.as_tensor([m]), changes)[0]
        mean = sum(costs(state, chunk.windows, m, one) for one in seen) / len(seen)
        *gradient, pull = torch.autograd.grad(mean, [*parameters, changes])
        own.append((gradient, pull.norm()))
    norms = torch.stack([norm for _, norm in own])
    assert norms.max() > 1.2 * norms.median()
    quick = torch.autograd.grad(found.loss(np.array(chosen), np.random.default_rng(7)), parameters)
    for k, found_gradient in enumerate(quick):
        expected = sum(gradient[k] * min(1, 1.1 * norms.median() / norm) for gradient, norm in own) / len(own)
        torch.testing.assert_close(found_gradient, expected, rtol=1e-3, atol=1e-4 * float(expected.abs().max()))


def test_a_policy_that_has_moved_since_is_followed_to_where_it_would_come(lesson, library):
    config, chunk, _ = lesson
    state, generator = LearnerState(config, 1), torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in state.policy.parameters():
            parameter += 2e-3 * parameter.abs().mean() * torch.randn(parameter.shape, generator=generator)
    still = np.zeros((len(chunk.windows), STEPS, 31))
    moved, stale = (followed(FollowedWindows(learner, chunk), still) for learner in (state, LearnerState(config, 1)))
    _, true = played(lesson, library, state.policy)
    moved, stale, true = (left_of(chunk, seen) for seen in (moved, stale, true))
    assert np.linalg.norm(moved - true) < 0.5 * np.linalg.norm(stale - true)


@pytest.mark.parametrize("optimizer", ("adam", "kfac"))
def test_an_update_with_it_is_pure(optimizer, lesson, make_config, assert_same_bits):
    _, chunk, _ = lesson
    state = LearnerState(make_config({**ON, "ppo.optimizer": optimizer}), 1)
    before = copy.deepcopy(state.state_dict())
    first, second = (update(state, [chunk]) for _ in range(2))
    assert_same_bits(state.state_dict(), before)
    assert_same_bits(first[0].state_dict(), second[0].state_dict())
    assert_same_bits(first[1], second[1])
    assert first[1]["gradient/arrival"] > 0
    assert first[1]["arrival/left"] > 0


def test_steps_down_its_gradient_bring_the_figure_nearer_under_noise(lesson, library):
    config, chunk, _ = lesson
    state, generator = LearnerState(config, 1), np.random.default_rng(0)
    sigma = np.exp(config.policy.judge_log_sigma) / config.action.scale
    noise = generator.normal(0.0, sigma, (4, len(chunk.windows), STEPS, 31)).astype(np.float32)

    found = FollowedWindows(state, chunk)
    with torch.no_grad():
        for parameter in state.cost_to_go.network.parameters():
            parameter.zero_()  # so that all that is descended can be played

    @torch.no_grad()
    def cost():
        plays = [torch.as_tensor(played(lesson, library, state.policy, changes)[1]) for changes in noise]
        return np.mean([[costs(state, chunk.windows, m, seen) for m, seen in enumerate(play)] for play in plays])

    before, optimizer = cost(), torch.optim.SGD(state.policy.parameters(), lr=4e-2)
    for _ in range(10):
        optimizer.zero_grad()
        found.loss(everyone(chunk), generator).backward()
        optimizer.step()
    assert cost() < 0.98 * before


def test_nothing_is_descended_until_much_is_foreseen_but_the_foresight_learns(lesson, monkeypatch):
    monkeypatch.setattr(followed_windows, "LEAST_FORESEEN", 0.99)
    config, chunk, _ = lesson
    state = LearnerState(config, 1)
    after, metrics = update(state, [chunk])
    assert metrics["gradient/arrival"] == 0.0 and metrics["arrival/foreseen"] < 0.99
    before, learned = (one.cost_to_go.network[0].weight for one in (state, after))
    assert not torch.equal(before, learned)


@pytest.mark.parametrize(("weight", "descended", "share"), ((4.0, True, 0.2), (4.0, False, 1.0), (0.0, True, 1.0)))
def test_steps_of_sbc_are_as_much_shorter_as_ppos_gradient(lesson, make_config, monkeypatch, weight, descended, share):
    config, chunk = make_config({**ON, "arrival.weight": weight}), lesson[1]
    if not descended:
        monkeypatch.setattr(followed_windows, "LEAST_FORESEEN", np.inf)
    shares, descend = [], LearnerState.descend

    def watched(state, name, loss, share=1.0, added=None):
        if name == "policy":
            shares.append((share, added is not None))
        return descend(state, name, loss, share, added)

    monkeypatch.setattr(LearnerState, "descend", watched)
    update(LearnerState(config, 1), [chunk])
    # one step of SBC, then one of PPO, to which the windows' gradient joins
    assert set(shares[::2]) == {(share, False)} and set(shares[1::2]) == {(share, share < 1.0)}


@pytest.mark.parametrize(("own", "descended"), ((True, True), (True, False), (False, True)))
def test_beside_windows_the_divergence_may_have_an_aim_of_its_own_under_the_evaluations_noise(
    lesson, make_config, monkeypatch, own, descended
):
    """The step size follows it from PPO's deviation exp(-3) to the evaluation's exp(-3.7): exp(1.4) times as large."""
    plain, seen = {**ON, "ppo.target_kl": 0.5, "ppo.final_kl": 0.1, "ppo.kl_updates": 10}, []
    config = make_config({**plain, "arrival.target_kl": 2.0, "arrival.final_kl": 1.0} if own else plain)
    if not descended:
        monkeypatch.setattr(followed_windows, "LEAST_FORESEEN", np.inf)
    monkeypatch.setattr(ppo, "adapt_learning_rate", lambda rate, *told: seen.append(told) or rate)
    state = LearnerState(config, 1)
    state.updates = 5
    update(state, [lesson[1]])
    state.config = make_config(plain)
    update(state, [lesson[1]])
    (divergence, target, _), (reference, usual, _) = seen
    assert usual == pytest.approx(0.3)
    if own and descended:
        assert target == pytest.approx(1.5) and divergence == pytest.approx(reference * np.exp(1.4), rel=1e-4)
    else:
        assert (divergence, target) == (reference, usual)


def test_a_chunk_without_windows_changes_nothing(lesson, assert_same_bits):
    config, chunk, _ = lesson
    none = copy.copy(chunk)
    object.__setattr__(none, "windows", chunk.windows.take(np.zeros(0, dtype=np.int64)))
    state = LearnerState(config, 1)
    added, metrics = Arrival(state, none).gradient()
    assert added is None and metrics["loss/arrival"] == metrics["gradient/arrival"] == metrics["arrival/left"] == 0.0
    assert np.isfinite(update(state, [none])[1]["loss/policy"])
    early = dataclasses.replace(chunk, windows=None, trials=None)  # before `arrival.after`
    assert Arrival(state, early).gradient() == (None, {}) and Arrival(state, early).inputs() == []
    assert "arrival/foreseen" not in update(state, [early])[1]
