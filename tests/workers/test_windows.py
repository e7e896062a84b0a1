"""Episodes beside a chunk: who plays them, that they act as in the evaluation and go past their arrival, where their
windows lie, and that nothing else knows of them."""

import dataclasses

import numpy as np
import pytest
import reference

from orchestrator.curriculum import final_tightenings
from workers import windows
from workers.counter_random import DERIVATIVES, TASK, uniforms
from workers.derivatives import Derivatives
from workers.planner import draw_task
from workers.rollout import Rollout
from workers.types import Thresholds, concatenate_windows
from workers.windows import Scouts, drawn

STEPS, HORIZON, SEED, N = 2, 8, 5, 24
ON = {
    "task.max_steps": 10, "physics.sole": 0.02, "arrival.weight": 1.0, "arrival.physics": "simulated",
    "arrival.steps": STEPS, "arrival.share": 0.6, "policy.judges": 4,
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


@pytest.fixture(scope="module", autouse=True)
def everybody_is_near():
    kept, windows.NEAR = windows.NEAR, 1e9
    yield
    windows.NEAR = kept


@pytest.fixture(scope="module")
def config(make_config):
    return make_config(ON)


@pytest.fixture(scope="module")
def chunks(library, config, policy, easy):
    return collect(config, library, policy, easy)


def test_they_end_at_the_nearest_step_of_episodes_that_go_past_their_arrival(library, config, policy):
    """Looked for again in all that was played, by the scalar deviations; thresholds five tightenings on, or floors."""
    scouts, limits = Scouts(config, library, N, SEED, 1), Thresholds(0.35, 3.0, 0.2)
    found = scouts.windows(policy, limits, INDEX, clock=16)
    played = scouts._play(policy, np.flatnonzero(drawn(SEED, INDEX, 16, 0.6)), 16)
    who, expected = np.flatnonzero(drawn(SEED, INDEX, 16, 0.6)), []
    own = np.maximum(np.array([0.35, 3.0, 0.2]) * 0.9**5, [0.01, 0.09, 0.15])
    assert own[2] == 0.15
    for row, environment in enumerate(who):
        target = scouts._env.target_qpos[row], scouts._env.target_qvel[row]
        far = []
        for t in range(10):
            left = reference.deviations(played["qpos"][t + 1, row], played["qvel"][t + 1, row], *target)
            far.append(max(np.array([left.rp, left.kp, left.q]) / own))
            if np.isinf(played["left"][t, row]).all():  # has fallen
                far[-1] = np.inf
        first = int(np.argmin(far)) - STEPS + 1
        if first >= 0 and np.isfinite(min(far)):
            expected.append((environment, first, row))
    assert len(expected) > 5 and found.environment.tolist() == [environment for environment, _, _ in expected]
    np.testing.assert_allclose(found.limits, np.tile(own, (len(found), 1)), rtol=1e-6)
    derivatives = Derivatives(config, 1)
    for m, (_, first, row) in enumerate(expected):
        steps = slice(first, first + STEPS)
        states = slice(first, first + STEPS + 1)
        np.testing.assert_array_equal(found.observation[m], played["observation"][states, row])
        np.testing.assert_array_equal(found.mean[m], played["mean"][steps, row])
        target = [np.tile(array[row], (STEPS, 1)) for array in (scouts._env.target_qpos, scouts._env.target_qvel)]
        of_all = derivatives.of(played["physics"][steps, row], played["action"][steps, row], target[0])
        np.testing.assert_array_equal(found.by_state[m], of_all[1:, :, :74])
        np.testing.assert_array_equal(found.by_action[m], of_all[:, :, 74:])
        after = slice(first + 1, first + STEPS + 1)
        seen = derivatives.observed(played["qpos"][after, row], played["qvel"][after, row], *target)
        np.testing.assert_array_equal(found.seen[m], seen)


def test_they_act_as_in_the_evaluation_on_tasks_drawn_alike(library, config, policy):
    scouts = Scouts(config, library, 200, SEED, 1)
    played = scouts._play(policy, np.arange(200), 8)
    noise = (played["action"] - played["mean"]).astype(np.float64)
    assert noise.std() == pytest.approx(np.exp(-4.0), rel=0.02) and abs(noise.mean()) < 0.001
    steps = noise.reshape(len(noise), -1)
    assert abs(np.corrcoef(steps)[np.triu_indices(len(noise), 1)]).max() < 0.1  # independent from step to step
    task = np.empty(4)
    for environment in (0, 7):
        draw_task(
            SEED, environment, 2**40 + 9, library.groups, library.cancel, library.rotation, 0.0, np.zeros(0), task
        )
        np.testing.assert_array_equal(scouts._env.task[environment], task)
    assert uniforms(SEED, TASK, 0, 2**40 + 9, 0) != uniforms(SEED, DERIVATIVES, 0, 2**40 + 9, 0)


def test_nothing_else_in_a_chunk_knows_of_them(library, make_config, policy, easy, chunks, assert_same_bits):
    bare = collect(make_config({**ON, "arrival.weight": 0.0}), library, policy, easy)
    assert bare[0].windows is None and sum(len(chunk.windows) for chunk in chunks) > 10
    assert_same_bits(bare, [dataclasses.replace(chunk, windows=None) for chunk in chunks])


def test_they_remember_nothing_and_every_chunk_has_its_own(library, config, policy, easy, chunks, assert_same_bits):
    scouts = Scouts(config, library, N, SEED, 2)
    for k in (2, 0, 1):
        assert_same_bits(scouts.windows(policy, easy, INDEX, k * HORIZON), chunks[k].windows)
    assert chunks[0].windows.environment.tolist() != chunks[1].windows.environment.tolist()


def test_two_workers_give_the_same_windows_as_one(library, config, policy, easy, chunks, assert_same_bits):
    shares = [collect(config, library, policy, easy, first, count) for first, count in ((0, 9), (9, N - 9))]
    for whole, *some in zip(chunks, *shares, strict=True):
        assert_same_bits(concatenate_windows([part.windows for part in some[::-1]]), whole.windows)


def test_who_comes_nowhere_near_is_left_out(library, config, policy, easy, monkeypatch):
    monkeypatch.setattr(windows, "NEAR", 1e-9)
    none = Scouts(config, library, N, SEED, 1).windows(policy, easy, INDEX, 0)
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
