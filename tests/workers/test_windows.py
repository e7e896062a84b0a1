"""Episodes beside a chunk: who plays them, that they act as in the evaluation and go past their arrival, where their
windows lie, and that nothing else knows of them."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import reference

from orchestrator.curriculum import final_tightenings
from workers import windows
from workers.counter_random import DERIVATIVES, TASK, uniforms
from workers.derivatives import Derivatives
from workers.environment import Environment, new_observations
from workers.inference import PolicyNetwork
from workers.kinematics import forward_kinematics_batch
from workers.planner import draw_task, number_of_cells
from workers.rollout import Rollout
from workers.types import Thresholds, concatenate_trials, concatenate_windows
from workers.windows import Scouts, drawn

pytestmark = pytest.mark.usefixtures("everybody_is_near")

STEPS, HORIZON, SEED, N = 2, 8, 5, 24
ON = {
    "task.max_steps": 10, "physics.sole": 0.02, "arrival.weight": 1.0,
    "arrival.steps": STEPS, "arrival.share": 0.6, "policy.judges": 4, "task.focus": 0.7,
}  # fmt: skip
INDEX = np.arange(N)


def collect(config, library, policy, easy, first=0, count=N, chunks=3):
    rollout = Rollout(config, library, count, HORIZON, SEED)
    state, found = rollout.initial_state(first), []
    for _ in range(chunks):
        chunk, state = rollout.collect(state, policy, easy)
        found.append(chunk)
    return found


@pytest.fixture(scope="module")
def policy(make_policy):
    return dataclasses.replace(make_policy(), judges=4, judge_log_sigma=-4.0)


@pytest.fixture(scope="module")
def config(make_config):
    return make_config(ON)


@pytest.fixture(scope="module")
def chunks(library, config, policy, easy, everybody_is_near):
    return collect(config, library, policy, easy)


@pytest.fixture
def scouts(library, config):
    """Scouts that keep what they do: observations, actions and poses of every step; rows and states of the windows."""
    made = Scouts(config, library, N, SEED, 1)
    last_steps, step, kept = made._last_steps, made._env.step, SimpleNamespace(poses=[], actions=[], observations=[])

    def watched_step(action, thresholds, rows):
        env = made._env
        kept.observations.append(env.observe(new_observations(len(rows)), rows))
        kept.actions.append(action[rows].copy())
        step(action, thresholds, rows)
        kept.poses.append((env.qpos[rows].copy(), env.qvel[rows].copy()))

    def watched_last_steps(network, physics, rows, begin, noise):
        kept.rows, kept.states, kept.begin = rows, physics.copy(), begin
        return last_steps(network, physics, rows, begin, noise)

    made._env.step, made._last_steps, made.kept = watched_step, watched_last_steps, kept
    return made


def test_they_end_at_any_step_of_episodes_that_go_past_their_arrival_but_of_those_far_off(
    scouts, config, policy, monkeypatch
):
    """Looked for again in all that was played, by the scalar deviations; thresholds five tightenings on, or floors."""
    monkeypatch.setattr(windows, "FAR", 0.2)
    found, trials = scouts.play(policy, Thresholds(0.35, 3.0, 0.2), INDEX, clock=16)
    who, kept, env, expected = np.flatnonzero(drawn(SEED, INDEX, 16, 0.6)), scouts.kept, scouts._env, []
    own = np.maximum(np.array([0.35, 3.0, 0.2]) * 0.9**5, [0.01, 0.09, 0.15])
    assert own[2] == 0.15
    # once more, for who fell when
    left, physics, _ = scouts._play(
        PolicyNetwork(policy, N), np.float32(np.exp(-4.0)), Thresholds(0.35, 3.0, 0.2), who, 16
    )
    for row, environment in enumerate(who):
        near = []
        for t in range(10):
            deviations = reference.deviations(
                *(pose[row] for pose in kept.poses[t]), env.target_qpos[row], env.target_qvel[row]
            )
            near.append(deviations.rp < 0.2 and np.isfinite(left[t, row]).all())
        steps = np.flatnonzero(near)
        if len(steps):
            last = steps[int(uniforms(SEED, DERIVATIVES, environment, 16, 2**20)[1] * len(steps))]
            expected.append((environment, last - STEPS + 1, row))
    environments, firsts, rows = map(list, zip(*expected))
    assert min(firsts) < 0 < max(firsts) and 5 < len(expected) < len(who)
    assert found.environment.tolist() == environments and kept.rows.tolist() == rows
    np.testing.assert_array_equal(kept.states, physics[np.maximum(firsts, 0), rows])
    np.testing.assert_array_equal(kept.begin, np.maximum(-np.array(firsts), 0))
    np.testing.assert_array_equal(found.begin, kept.begin)
    np.testing.assert_allclose(found.limits, np.tile(own, (len(found), 1)), rtol=1e-6)
    assert trials.environment.tolist() == who.tolist()
    np.testing.assert_allclose(trials.limits, np.tile(own, (len(who), 1)), rtol=1e-6)
    np.testing.assert_array_equal(trials.standing, np.isfinite(left[:, :, 0]))


def test_trials_are_what_was_seen_before_each_step_and_after_the_last(scouts, policy, easy):
    _, trials = scouts.play(policy, easy, INDEX, clock=16)
    count = len(trials)
    np.testing.assert_array_equal(trials.observation[:10], [seen[:count] for seen in scouts.kept.observations[:10]])
    env = scouts._env
    scouts._play(PolicyNetwork(policy, N), np.float32(np.exp(-4.0)), easy, trials.environment, 16)
    np.testing.assert_array_equal(trials.observation[10], env.observe(new_observations(count), np.arange(count)))


def test_all_near_steps_are_equally_likely_to_be_the_last(config):
    near = np.zeros((7, 3000), dtype=bool)
    near[[1, 2, 5, 6]] = True
    near[:, ::3] = False
    last = windows._last(SEED, np.arange(3000), 16, 1, near)
    assert (last[::3] == -1).all()
    found = np.bincount(last[last >= 0], minlength=7) / 2000
    np.testing.assert_allclose(found, [0, 0.25, 0.25, 0, 0, 0.25, 0.25], atol=0.04)


def test_after_an_arrival_is_every_step_later_than_the_first_within_all_limits():
    random = np.random.default_rng(0)
    left, limits = random.uniform(size=(9, 200, 3)), random.uniform(0.3, 0.9, size=(200, 3))
    left[4:, 7] = np.inf  # fell
    found = windows.after_arrival(left, limits)
    for i in range(200):
        over = False
        for t in range(9):
            assert found[t, i] == over
            over = over or all(left[t, i, k] < limits[i, k] for k in range(3))
    assert found.any() and not found.all()


@pytest.mark.parametrize("ends", [None, 3.0])
def test_where_arrivals_end_no_window_does_later(ends, library, make_config, policy, easy, monkeypatch):
    """Limits that all are within at once: every window is of the first step, or of any step where nothing ends."""
    changed, asked = make_config({**ON, "arrival.ends": ends, "arrival.windows": 2}), []
    scouts, last = Scouts(changed, library, N, SEED, 1), windows._last
    monkeypatch.setattr(scouts, "_limits", lambda thresholds, n: np.full((n, 3), 1e6))
    monkeypatch.setattr(windows, "_last", lambda *arguments: asked.append(last(*arguments)) or asked[-1])
    scouts.play(policy, easy, INDEX, 0)
    steps = np.concatenate(asked)
    assert steps.max() == 0 if ends else steps.max() > 5


def test_each_has_as_many_windows_as_asked_for_wherever_they_end(library, make_config, config, policy, easy):
    """They begin in what was seen of the same episodes; the first of each is what there is if it is the only one."""
    (one, alone), (found, trials) = (
        Scouts(make_config({**ON, "arrival.windows": count}), library, N, SEED, 1).play(policy, easy, INDEX, 16)
        for count in (1, 3)
    )
    np.testing.assert_array_equal(trials.observation, alone.observation)
    assert found.environment.tolist() == sorted([*one.environment] * 3)
    np.testing.assert_array_equal(found.observation[::3], one.observation)
    np.testing.assert_array_equal(found.by_action[::3], one.by_action)
    near = trials.standing[:, [trials.environment.tolist().index(environment) for environment in one.environment]]
    first = [windows._last(SEED, one.environment, 16, number, near) - STEPS + 1 for number in range(3)]
    assert len({*map(tuple, first)}) == 3
    for m, environment in enumerate(found.environment):
        row = trials.environment.tolist().index(environment)
        begin = max(first[m % 3][m // 3], 0)
        np.testing.assert_array_equal(found.observation[m, 0], trials.observation[begin, row])


def test_their_last_steps_are_played_again_without_noise_and_differentiated(scouts, library, config, policy, easy):
    """One window after the other, from the state that it begins in."""
    found, _ = scouts.play(policy, easy, INDEX, clock=16)
    env, derivatives, network = Environment(config, library, 1), Derivatives(config, 1), PolicyNetwork(policy, 1)
    for m in range(0, len(found), 3):
        row = scouts.kept.rows[m]
        target = scouts._env.target_qpos[[row]], scouts._env.target_qvel[[row]]
        env.place(scouts.kept.states[m], np.arange(1))
        env.target_qpos[:], env.target_qvel[:] = target
        forward_kinematics_batch(env.target_qpos, env.target_bodies, np.empty_like(env.rotations))
        begin = scouts.kept.begin[m]
        for k in range(begin):  # stands still
            np.testing.assert_array_equal(found.observation[m, k], env.observe(new_observations(1))[0])
            assert not found.by_action[m, k].any() and not found.seen[m, k].any() and not found.by_state[m, :k].any()
        for k in range(begin, STEPS):
            observation = env.observe(new_observations(1))
            mean = network.mean(observation).copy()
            of_all = derivatives.of(env.physics, mean, target[0])[0]
            env.step(mean, Thresholds(0.0, 0.0, 0.0))
            np.testing.assert_array_equal(found.observation[m, k], observation[0])
            np.testing.assert_array_equal(found.mean[m, k], mean[0])
            np.testing.assert_array_equal(found.by_action[m, k], of_all[:, 74:])
            if k:
                np.testing.assert_array_equal(found.by_state[m, k - 1], of_all[:, :74])
            np.testing.assert_array_equal(found.seen[m, k], derivatives.observed(env.qpos, env.qvel, *target)[0])
        np.testing.assert_array_equal(found.observation[m, STEPS], env.observe(new_observations(1))[0])


def test_but_for_the_last_steps_the_noise_is_that_of_before(scouts, policy, easy, monkeypatch):
    """With noise in all steps a window is what was played; without it in the last, up to there."""
    monkeypatch.setattr(windows, "QUIET", 1)
    (found, _), kept = scouts.play(policy, easy, INDEX, clock=16), scouts.kept
    count = len(kept.observations) - STEPS
    played = np.array(kept.observations[:count])
    for m, row in enumerate(kept.rows):
        if kept.begin[m]:
            continue
        at = np.flatnonzero((played[:, row] == found.observation[m, 0]).all(axis=1))
        assert len(at) == 1
        np.testing.assert_array_equal(found.observation[m, 1], played[at[0] + 1, row])
        if at[0] + 2 < count:
            assert (found.observation[m, 2] != played[at[0] + 2, row]).any()
        assert (kept.actions[at[0]][row] != found.mean[m, 0]).any()


def test_they_act_as_in_the_evaluation_on_tasks_of_training(scouts, library, config, policy, easy):
    network, cells = PolicyNetwork(policy, N), number_of_cells(library)
    shares = np.cumsum(np.arange(1, cells + 1)) / np.arange(1, cells + 1).sum()
    focused = dataclasses.replace(easy, shares=tuple(shares.tolist()))
    scouts._play(network, np.float32(np.exp(policy.judge_log_sigma)), focused, INDEX, 8)
    noise = np.array(
        [action - network.mean(seen) for action, seen in zip(scouts.kept.actions, scouts.kept.observations)]
    ).astype(np.float64)
    assert noise.shape == (10, N, 31)
    assert noise.std() == pytest.approx(np.exp(-4.0), rel=0.03) and abs(noise.mean()) < 0.001
    steps = noise.reshape(len(noise), -1)
    assert abs(np.corrcoef(steps)[np.triu_indices(len(noise), 1)]).max() < 0.15  # independent from step to step
    task = np.empty(4)
    for environment in range(N):
        draw_task(SEED, environment, 2**40 + 9, library.groups, library.cancel, library.rotation, 0.7, shares, task)
        np.testing.assert_array_equal(scouts._env.task[environment], task)
    assert uniforms(SEED, TASK, 0, 2**40 + 9, 0) != uniforms(SEED, DERIVATIVES, 0, 2**40 + 9, 0)


def test_nothing_else_in_a_chunk_knows_of_them(library, make_config, policy, easy, chunks, assert_same_bits):
    bare = collect(make_config({**ON, "arrival.weight": 0.0}), library, policy, easy)
    assert bare[0].windows is None and sum(len(chunk.windows) for chunk in chunks) > 10
    assert_same_bits(bare, [dataclasses.replace(chunk, windows=None, trials=None) for chunk in chunks])


def test_nobody_plays_until_so_many_updates_have_been(library, make_config, policy, easy, assert_same_bits, chunks):
    later, asked = make_config({**ON, "arrival.after": 3}), dataclasses.replace(policy, version=3)
    early, late = (collect(later, library, one, easy, chunks=1)[0] for one in (policy, asked))
    assert policy.version < 3 and early.windows is None and early.trials is None
    assert_same_bits(late.windows, chunks[0].windows)


def test_they_remember_nothing_and_every_chunk_has_its_own(library, config, policy, easy, chunks, assert_same_bits):
    scouts = Scouts(config, library, N, SEED, 2)
    for k in (2, 0, 1):
        found, trials = scouts.play(policy, easy, INDEX, k * HORIZON)
        assert_same_bits(found, chunks[k].windows)
        assert_same_bits(trials, chunks[k].trials)
    assert chunks[0].windows.environment.tolist() != chunks[1].windows.environment.tolist()


def test_two_workers_give_the_same_windows_as_one(library, config, policy, easy, chunks, assert_same_bits):
    shares = [collect(config, library, policy, easy, first, count) for first, count in ((0, 9), (9, N - 9))]
    for whole, *some in zip(chunks, *shares, strict=True):
        assert_same_bits(concatenate_windows([part.windows for part in some[::-1]]), whole.windows)
        assert_same_bits(concatenate_trials([part.trials for part in some[::-1]]), whole.trials)


def test_who_comes_nowhere_near_is_left_out(library, config, policy, easy, monkeypatch):
    monkeypatch.setattr(windows, "FAR", 1e-9)
    none = Scouts(config, library, N, SEED, 1).play(policy, easy, INDEX, 0)[0]
    assert len(none) == 0 and none.by_action.shape == (0, STEPS, 74, 31) and none.seen.shape == (0, STEPS, 282, 74)


def test_a_share_plays(library, make_config, policy, easy):
    clocks = range(400)
    found = np.array([drawn(1, np.arange(10), clock, 0.3) for clock in clocks])
    assert found.mean() == pytest.approx(0.3, abs=0.03) and len({tuple(row) for row in found}) > 100
    assert drawn(1, np.arange(10), 3, 1.0).all() and not drawn(1, np.arange(10), 3, 0.0).any()
    nobody = collect(make_config({**ON, "arrival.share": 0.0}), library, policy, easy, chunks=1)[0].windows
    assert len(nobody) == 0 and nobody.observation.shape == (0, STEPS + 1, 282)


def test_their_thresholds_end_at_the_final_accuracy(library, config, policy):
    limits = Thresholds(0.012, 0.12, 0.15, tightenings=final_tightenings(config.curriculum) - 2)
    found = Scouts(config, library, N, SEED, 1)._limits(limits, 3)
    np.testing.assert_allclose(found, np.tile([0.01, 0.09, 0.15], (3, 1)))
