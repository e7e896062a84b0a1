"""Windows with derivatives: which episodes get them, where they lie, and that nothing else in a chunk knows of them."""

import dataclasses

import numpy as np
import pytest
import reference

from workers import windows
from workers.counter_random import DERIVATIVES, uniforms
from workers.rollout import Rollout
from workers.types import concatenate_windows
from workers.windows import drawn

STEPS, HORIZON, SEED, N = 2, 8, 5, 24
ON = {
    "task.max_steps": 16, "physics.sole": 0.02, "arrival.weight": 1.0, "arrival.physics": "simulated",
    "arrival.steps": STEPS, "arrival.share": 0.6, "policy.judges": 4,
}  # fmt: skip


def collect(config, library, policy, easy, first=0, count=N, chunks=3):
    rollout = Rollout(config, library, count, HORIZON, SEED)
    state, found = rollout.initial_state(first), []
    for _ in range(chunks):
        chunk, state = rollout.collect(state, policy, easy)
        found.append(chunk)
    return found


@pytest.fixture(scope="module")
def policy(make_policy):
    return dataclasses.replace(make_policy(), judges=4)


@pytest.fixture(scope="module", autouse=True)
def everybody_is_near():
    kept, windows.NEAR = windows.NEAR, 1e9
    yield
    windows.NEAR = kept


@pytest.fixture(scope="module")
def chunks(library, make_config, policy, easy):
    return collect(make_config(ON), library, policy, easy)


def test_they_end_at_the_nearest_step_of_the_drawn_exploring_episodes(library, make_config, policy, easy, chunks):
    """Looked for again in a chunk that was collected without them, by the scalar deviations of its poses."""
    rollout = Rollout(make_config({**ON, "arrival.weight": 0.0}), library, N, HORIZON, SEED)
    state, total = rollout.initial_state(0), 0
    for chunk in chunks:
        targets = [(state.target_qpos[i].copy(), state.target_qvel[i].copy()) for i in range(N)]
        episode, expected = state.episode.copy(), []
        bare, after = rollout.collect(state, policy, easy)
        begun = dict.fromkeys(range(N), 0)
        for number, (t, i) in enumerate(np.argwhere(bare.end)):
            first_of_chunk = begun[i] == 0
            steps = range(begun[i], t + 1)
            begun[i] = t + 1
            if i % 4 == 0 or uniforms(SEED, DERIVATIVES, i, episode[i], 0)[0] >= 0.6:
                episode[i] += 1
                continue
            episode[i] += 1
            if not first_of_chunk:  # its target is not in the state before the chunk
                continue
            far = []
            for s in steps:
                qpos, qvel = np.split(bare.next_pose[s, i].astype(np.float64), [47])
                left = reference.deviations(qpos, qvel, *targets[i])
                far.append(max(np.array([left.rp, left.kp, left.q]) / bare.final_thresholds[number]))
            first = steps[0] + int(np.argmin(far)) - STEPS + 1
            if first >= steps[0]:
                expected.append((i, first))
        found = list(zip(chunk.windows.environment.tolist(), chunk.windows.step.tolist()))
        assert found == sorted(found)
        ends = {i: np.flatnonzero(bare.end[:, i]) for i in range(N)}
        assert {(i, step) for i, step in found if step <= ends[i][0]} == set(expected)
        total += len(expected)
        state = after
    assert total > 5


def test_nothing_else_in_a_chunk_knows_of_them(library, make_config, policy, easy, chunks, assert_same_bits):
    bare = collect(make_config({**ON, "arrival.weight": 0.0}), library, policy, easy)
    assert bare[0].windows is None and sum(len(chunk.windows) for chunk in chunks) > 5
    assert_same_bits(bare, [dataclasses.replace(chunk, windows=None) for chunk in chunks])


def test_two_workers_give_the_same_windows_as_one(library, make_config, policy, easy, chunks, assert_same_bits):
    config = make_config(ON)
    shares = [collect(config, library, policy, easy, first, count) for first, count in ((0, 9), (9, N - 9))]
    for whole, *some in zip(chunks, *shares, strict=True):
        assert_same_bits(concatenate_windows([part.windows for part in some[::-1]]), whole.windows)


def test_none_are_drawn_of_no_share_and_all_of_all(library, make_config, policy, easy):
    none = collect(make_config({**ON, "arrival.share": 0.0}), library, policy, easy, chunks=1)[0].windows
    assert len(none) == 0 and none.by_action.shape == (0, STEPS, 74, 31) and none.seen.shape == (0, STEPS, 282, 74)
    counters = np.arange(4000)
    assert drawn(1, counters % 7, counters, 1.0).all() and not drawn(1, counters % 7, counters, 0.0).any()
    assert drawn(1, counters % 7, counters, 0.3).mean() == pytest.approx(0.3, abs=0.03)
