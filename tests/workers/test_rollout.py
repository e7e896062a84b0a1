"""`collect` is pure, and an environment's numbers are its own: batch, threads and other environments do not matter."""

import copy
import itertools
from dataclasses import replace

import numpy as np
import pytest

from workers.counter_random import ACTION, fill_normal
from workers.inference import PolicyNetwork
from workers.rollout import Rollout
from workers.types import CONTINUES, FELL, REACHED, TIMED_OUT, concatenate_outcomes

HORIZON, SEED = 8, 5


def collected(rollout, state, chunks, make_policy, thresholds):
    """Chunks in sequence from `state`, each with another policy; and the state after them."""
    out = []
    for k in range(chunks):
        chunk, state = rollout.collect(state, make_policy(version=k), thresholds)
        out.append(chunk)
    return out, state


def test_collecting_twice_gives_the_same_bits_and_leaves_its_arguments(
    trajectories, make_policy, easy, assert_same_bits
):
    state, policy = trajectories.states[1], make_policy(version=1)
    arguments = copy.deepcopy((state, policy, easy))
    first = trajectories.rollout.collect(state, policy, easy)
    # something else in between
    trajectories.rollout.collect(trajectories.states[4], make_policy(seed=8), easy)
    second = trajectories.rollout.collect(state, policy, easy)
    assert_same_bits(list(first), list(second))
    assert_same_bits(list(first), [trajectories.chunks[1], trajectories.states[2]])
    assert_same_bits(list(arguments), [state, policy, easy])


def test_a_later_call_does_not_write_into_an_earlier_chunk(trajectories, make_policy, easy, assert_same_bits):
    chunk, state = trajectories.rollout.collect(trajectories.states[0], make_policy(), easy)
    kept = copy.deepcopy((chunk, state))
    trajectories.rollout.collect(state, make_policy(seed=3), easy)
    assert_same_bits(list(kept), [chunk, state])


def test_an_environment_of_a_batch_of_64_equals_the_same_one_alone(
    library, make_config, make_policy, easy, columns, assert_same_bits
):
    """Bit for bit over several chunks with resets, whoever else is in the batch."""
    config = make_config({"task.max_steps": 16})
    batch = Rollout(config, library, 64, HORIZON, SEED)
    together, last = collected(batch, batch.initial_state(0), 5, make_policy, easy)
    alone = Rollout(config, library, 1, HORIZON, SEED)
    ended = 0
    for i in (0, 1, 7, 8, 31, 63):
        single, state = collected(alone, alone.initial_state(i), 5, make_policy, easy)
        for chunk, whole in zip(single, together, strict=True):
            assert_same_bits(chunk, columns(whole, [i]))
            ended += len(chunk.outcomes)
        for name, array in vars(state).items():
            if name != "clock":
                np.testing.assert_array_equal(array[0], getattr(last, name)[i], err_msg=name)
    assert ended > 15


def test_training_ends_an_episode_after_training_steps_if_that_is_earlier(
    library, make_config, make_policy, easy, assert_same_bits
):
    def chunks(**task):
        rollout = Rollout(make_config({f"task.{name}": steps for name, steps in task.items()}), library, 24, 8, SEED)
        return collected(rollout, rollout.initial_state(0), 3, make_policy, easy)

    short = chunks(training_steps=5, max_steps=16)
    assert_same_bits(short, chunks(max_steps=5))
    assert_same_bits(chunks(training_steps=16, max_steps=5), chunks(max_steps=5))
    late = [steps for chunk in short[0] for steps in chunk.outcomes.steps[chunk.outcomes.end == TIMED_OUT]]
    assert late and set(late) == {5}


@pytest.mark.parametrize("threads", [2, 3])
def test_threads_change_no_number(threads, library, trajectories, make_policy, easy, assert_same_bits):
    rollout = Rollout(trajectories.config, library, 24, HORIZON, SEED, threads)
    chunks, state = collected(rollout, rollout.initial_state(0), 3, make_policy, easy)
    assert_same_bits([chunks, state], [trajectories.chunks[:3], trajectories.states[3]])


def test_every_task_is_judged_and_explored_by_the_thresholds_of_its_group(
    library, trajectories, make_policy, easy, make_config
):
    """Thresholds that differ between groups: each environment's numbers are those under its own ones for all alike."""
    config = make_config({"task.max_steps": 16, "task.stay_probability": 0.0, "reward.tremble_ramp": 3})
    rollout = Rollout(config, library, 24, HORIZON, SEED)
    policy = replace(make_policy(), sigma_factor=0.8, noise_window=3, independent_from=1)
    state = rollout.initial_state(0)
    strict = replace(easy, root_position=0.01, tightenings=2)
    strict_groups = np.arange(len(library.groups)) % 2 == 1
    rows = [strict.of(np.zeros(1))[0] if own else easy.of(np.zeros(1))[0] for own in strict_groups]
    mixed = replace(easy, groups=tuple(tuple(row.tolist()) for row in rows))
    chunk, _ = rollout.collect(state, policy, mixed)
    own = strict_groups[library.group_of(state.task)]
    alike = {False: rollout.collect(state, policy, easy)[0], True: rollout.collect(state, policy, strict)[0]}
    reached = {False: 0, True: 0}
    for i in range(24):
        other = alike[bool(own[i])]
        length = (np.flatnonzero(other.end[:, i]).tolist() or [HORIZON - 1])[0] + 1  # of the first episode
        np.testing.assert_array_equal(chunk.end[:length, i], other.end[:length, i])
        np.testing.assert_array_equal(chunk.reward[:length, i], other.reward[:length, i])
        np.testing.assert_array_equal(chunk.action[:length, i], other.action[:length, i])
        np.testing.assert_array_equal(chunk.log_sigma[:length, i], other.log_sigma[:length, i])
        reached[bool(own[i])] += (other.end[:length, i] == REACHED).any()
    assert reached[False] > reached[True]
    ended = chunk.outcomes
    np.testing.assert_array_equal(ended.tightenings, 2 * strict_groups[library.group_of(ended.task)])


def test_judges_act_with_the_averaged_weights_and_nobody_else(library, trajectories, make_policy, easy):
    other = make_policy(seed=9)
    policy = replace(
        make_policy(version=1), judges=3, average_weights=other.weights, average_biases=other.biases,
    )  # fmt: skip
    chunk, _ = trajectories.rollout.collect(trajectories.states[1], policy, easy)
    judge = chunk.environment % 3 == 0
    averaged = replace(policy, weights=other.weights, biases=other.biases)
    for acting, rows in ((policy, ~judge), (averaged, judge)):
        network = PolicyNetwork(acting, int(rows.sum()))
        for t in range(HORIZON):
            np.testing.assert_array_equal(chunk.mean[t, rows], network.mean(chunk.observation[t, rows]))


def test_seed_and_environment_make_different_episodes(library, make_config, make_policy, easy):
    rollouts = [Rollout(make_config(), library, 4, HORIZON, seed) for seed in (0, 1)]
    first = [r.collect(r.initial_state(0), make_policy(), easy)[0] for r in rollouts]
    assert (first[0].pose[0] != first[1].pose[0]).any(axis=1).all()
    assert len(np.unique(first[0].action[0], axis=0)) == 4


def test_a_chunk_has_the_documented_shapes_and_types(trajectories):
    t, n = HORIZON, 24
    for k, chunk in enumerate(trajectories.chunks):
        ended = int((chunk.end != CONTINUES).sum())
        wanted = {
            "environment": ((n,), "int64"), "observation": ((t, n, 282), "float32"), "action": ((t, n, 31), "float32"),
            "mean": ((t, n, 31), "float32"), "reward": ((t, n), "float32"), "end": ((t, n), "int8"),
            "last_observation": ((n, 282), "float32"), "final_observation": ((ended, 282), "float32"),
            "pose": ((t, n, 84), "float32"), "next_pose": ((t, n, 84), "float32"), "pd_target": ((t, n, 31), "float32"),
            "log_sigma": ((t, n), "float64"),
        }  # fmt: skip
        for name, (shape, dtype) in wanted.items():
            array = getattr(chunk, name)
            assert (array.shape, array.dtype) == (shape, np.dtype(dtype)), name
            assert np.isfinite(array).all(), name
        outcomes = {
            "clock": ((), "int64"), "environment": ((), "int64"), "task": ((4,), "float64"), "retained": ((), "bool"),
            "end": ((), "int8"), "fell_on": ((), "int16"), "tightenings": ((), "int64"), "steps": ((), "int64"),
            "trembles": ((), "int64"), "parts": ((7,), "float64"), "deviations": ((7,), "float64"),
        }  # fmt: skip
        for name, (shape, dtype) in outcomes.items():
            array = getattr(chunk.outcomes, name)
            assert (array.shape, array.dtype) == ((ended, *shape), np.dtype(dtype)), name
        assert chunk.version == k


def test_the_trajectories_of_these_tests_end_in_every_way(trajectories):
    ends = np.concatenate([chunk.end.ravel() for chunk in trajectories.chunks])
    assert set(ends) == {CONTINUES, REACHED, FELL, TIMED_OUT}
    assert np.bincount(ends).min() > 5


def test_a_pose_goes_on_where_no_episode_ended_and_jumps_where_one_did(trajectories):
    for chunk in trajectories.chunks:
        going = chunk.end[:-1] == CONTINUES
        np.testing.assert_array_equal(chunk.pose[1:][going], chunk.next_pose[:-1][going])
        assert (chunk.pose[1:][~going] != chunk.next_pose[:-1][~going]).any(axis=-1).all()
    for one, other in itertools.pairwise(trajectories.chunks):
        going = one.end[-1] == CONTINUES
        np.testing.assert_array_equal(other.pose[0][going], one.next_pose[-1][going])


def test_the_pose_that_an_episode_ended_in_is_kept(trajectories):
    """next_pose at an end, final_observation and the outcome's deviations all speak of the same frame."""
    for chunk in trajectories.chunks:
        at = np.nonzero(chunk.end)
        assert len(at[0]) == len(chunk.final_observation) == len(chunk.outcomes)
        pose, observation = chunk.next_pose[at], chunk.final_observation
        np.testing.assert_allclose(observation[:, 0], pose[:, 2])  # root height
        np.testing.assert_allclose(observation[:, 91:122], pose[:, 47 + 6 :])  # joint velocities
        # the target's root position in the heading frame is as long as d^rp
        np.testing.assert_allclose(
            np.linalg.norm(observation[:, 140:143], axis=1), chunk.outcomes.deviations[:, 0], rtol=1e-4
        )
        np.testing.assert_array_equal(chunk.outcomes.environment, chunk.environment[at[1]])
        np.testing.assert_array_equal(chunk.outcomes.end, chunk.end[at])


def test_the_last_observation_is_what_the_next_chunk_begins_with(trajectories):
    for one, other in itertools.pairwise(trajectories.chunks):
        np.testing.assert_allclose(one.last_observation, other.observation[0], atol=1e-6)


def test_actions_are_the_networks_mean_plus_the_clocks_noise(trajectories, make_policy):
    chunk, state = trajectories.chunks[3], trajectories.states[3]
    policy = make_policy(version=3)
    network = PolicyNetwork(policy, 24)
    for t in range(HORIZON):
        np.testing.assert_array_equal(network.mean(chunk.observation[t]), chunk.mean[t])
        noise = np.empty((24, 31))
        fill_normal(SEED, ACTION, state.environment, np.full(24, state.clock + t), noise)
        np.testing.assert_allclose(chunk.action[t] - chunk.mean[t], np.exp(policy.log_sigma) * noise, atol=1e-5)
    assert trajectories.states[4].clock == state.clock + HORIZON


def test_tighter_thresholds_are_explored_with_less_noise_but_never_less_than_judges_have(
    trajectories, make_policy, easy
):
    policy = replace(make_policy(version=3), sigma_factor=0.8, judges=3, judge_log_sigma=-2.0)
    state = trajectories.states[3]
    exploring = state.environment % 3 != 0
    for tightenings, wanted in ((0, np.exp(-1.0)), (3, np.exp(-1.0) * 0.8**3), (34, np.exp(-2.0))):
        chunk, _ = trajectories.rollout.collect(state, policy, replace(easy, tightenings=tightenings))
        assert np.exp(chunk.log_sigma) == pytest.approx(wanted)
        noise = np.empty((24, 31))
        fill_normal(SEED, ACTION, state.environment, np.full(24, state.clock), noise)
        got = chunk.action[0] - chunk.mean[0]
        np.testing.assert_allclose(got[exploring], wanted * noise[exploring], atol=1e-5)
        np.testing.assert_allclose(got[~exploring], np.exp(-2.0) * noise[~exploring], atol=1e-5)


def test_noise_has_no_window_from_so_many_tightenings_on(trajectories, make_policy, easy):
    policy = replace(make_policy(version=3), noise_window=3, independent_from=2)
    state = trajectories.states[3]
    draws = np.empty((3, 24, 31))  # of this step and of the two before
    for lag, draw in enumerate(draws):
        fill_normal(SEED, ACTION, state.environment, np.full(24, state.clock + 2 - lag), draw)
    for tightenings, wanted in ((1, draws.sum(axis=0) / np.sqrt(3)), (2, draws[0]), (34, draws[0])):
        chunk, _ = trajectories.rollout.collect(state, policy, replace(easy, tightenings=tightenings))
        got = (chunk.action[0] - chunk.mean[0]) / np.exp(policy.log_sigma)
        np.testing.assert_allclose(got, wanted, atol=1e-5)


def test_outcomes_account_for_every_step_and_reward_of_their_episodes(trajectories):
    chunks = trajectories.chunks
    reward = np.concatenate([chunk.reward for chunk in chunks])
    end = np.concatenate([chunk.end for chunk in chunks])
    joined = concatenate_outcomes([chunk.outcomes for chunk in chunks])
    for environment in range(24):
        mine = joined.take(np.flatnonzero(joined.environment == environment))
        begin = 0
        for i, last in enumerate(np.flatnonzero(end[:, environment])):
            assert mine.clock[i] == last + 1
            assert mine.steps[i] == last + 1 - begin
            assert mine.parts[i].sum() == pytest.approx(reward[begin : last + 1, environment].sum(), abs=1e-4)
            begin = last + 1


def test_outcomes_are_ordered_by_step_then_environment_whoever_collected_them(trajectories, columns, assert_same_bits):
    whole = trajectories.chunks[2]
    parts = [columns(whole, range(a, b)).outcomes for a, b in ((16, 24), (0, 5), (5, 16))]
    assert_same_bits(concatenate_outcomes(parts), whole.outcomes)
