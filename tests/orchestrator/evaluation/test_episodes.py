"""Episodes: several accuracies in one simulation, the metrics against the spec, known extremes."""

import math
from dataclasses import replace

import numpy as np
import pytest
import reference

from orchestrator.config import EvaluationConfig
from orchestrator.evaluation import episodes as module
from orchestrator.evaluation.episodes import Ladder, Simulator, run_tasks
from orchestrator.evaluation.replay import record
from orchestrator.evaluation.statistics import columns, sums
from orchestrator.tasks import TaskGrid
from workers.environment import Environment
from workers.types import FELL, REACHED, TIMED_OUT, Thresholds

FINAL = Thresholds(0.01, 0.09, 0.15)
LIMITS = Thresholds(0.2, 1.5, 0.6)
ENDS = {REACHED: "success", FELL: "failure", TIMED_OUT: "failure"}


@pytest.fixture(scope="module")
def numbers(library):
    return TaskGrid(library, EvaluationConfig(max_tasks=20)).numbers(0, 20)


@pytest.fixture(scope="module")
def tasks(library, numbers):
    return TaskGrid(library, EvaluationConfig()).tasks(numbers)


@pytest.fixture(scope="module")
def nothing(make_policy):
    """A policy whose action is zero whatever it sees."""
    policy = make_policy()
    return replace(
        policy,
        weights=tuple(np.zeros_like(w) for w in policy.weights),
        biases=tuple(np.zeros_like(b) for b in policy.biases),
    )


# ------------------------------------------------------------------------------------------------------- same numbers


@pytest.mark.parametrize("log_sigma", [-2.0, -math.inf])
def test_one_simulation_gives_what_one_per_accuracy_gives(
    log_sigma, library, make_config, make_policy, tasks, numbers, assert_same_bits
):
    """Looser levels end by being reached, by the fall or the time-out of the whole, and at the very last step."""
    levels = [
        Thresholds(9.0, 90.0, 9.0), Thresholds(0.35, 3.0, 1.0, tightenings=1),
        Thresholds(0.3, 2.5, 0.9, heading=0.9, tightenings=2), Thresholds(0.2, 2.0, 0.7, heading=0.4, tightenings=3),
    ]  # fmt: skip
    config = make_config({"task.max_steps": 24})
    together = Simulator(config, library, make_policy()).run(tasks, numbers, levels, log_sigma)
    for level, got in zip(levels, together, strict=True):
        assert_same_bits(got, run_tasks(config, library, make_policy(), tasks, level, log_sigma, numbers))
    ends = {(int(a), int(b)) for a, b in zip(together[1].end, together[3].end)}
    assert {(REACHED, FELL), (REACHED, TIMED_OUT), (FELL, FELL)} <= ends, ends
    assert (together[0].steps == 1).all() and (together[1].steps < together[2].steps).any()


def test_an_evaluation_takes_all_the_time_that_training_does_not(
    library, make_config, make_policy, tasks, numbers, assert_same_bits
):
    whole, short = (make_config({"task.max_steps": 24, **more}) for more in ({}, {"task.training_steps": 3}))
    played = [run_tasks(config, library, make_policy(), tasks, LIMITS, -2.0, numbers) for config in (whole, short)]
    assert_same_bits(*played)
    assert played[0].steps.max() > 3


def test_a_ladder_tells_which_thresholds_an_episode_of_its_own_would_have_met(
    library, make_config, nothing, tasks, numbers
):
    rungs = [Thresholds(0.5 * s, 5 * s, 1.5 * s, heading=2 * s) for s in (2.0, 1.0, 0.9, 0.8, 0.7, 0.6, 0.4, 0.2)]
    config = make_config({"task.max_steps": 30, "action.mode": "target"})
    ladder = Ladder(rungs, len(tasks))
    Simulator(config, library, nothing).run(tasks, numbers, [rungs[-1]], -2.0, ladder)
    for n, rung in enumerate(rungs):
        alone = run_tasks(config, library, nothing, tasks, rung, -2.0, numbers)
        np.testing.assert_array_equal(ladder.met > n, alone.end == REACHED)
    assert len(set(ladder.met)) > 3, ladder.met


@pytest.mark.parametrize("policy_name", ["nothing", "random"])
def test_the_numbers_do_not_depend_on_how_many_simulations_or_threads_there_are(
    policy_name, library, make_config, make_policy, nothing, tasks, assert_same_bits
):
    policy = nothing if policy_name == "nothing" else make_policy()
    results = [
        run_tasks(make_config({"evaluation.num_envs": n}), library, policy, tasks, LIMITS, -2.0, threads=threads)
        for n, threads in ((256, 1), (7, 2), (1, 1))
    ]
    assert_same_bits(results[0], results[1])
    assert_same_bits(results[0], results[2])
    np.testing.assert_array_equal(results[0].task, tasks)
    np.testing.assert_array_equal(results[0].environment, np.arange(len(tasks)))


def test_a_task_goes_by_its_number_and_not_by_what_was_played_before(
    library, make_config, make_policy, tasks, numbers, assert_same_bits
):
    simulator = Simulator(make_config({"evaluation.num_envs": 3}), library, make_policy())
    whole = simulator.run(tasks, numbers, [LIMITS], -2.0)[0]
    for part in (slice(12, 20), slice(0, 2), slice(2, 12)):
        assert_same_bits(simulator.run(tasks[part], numbers[part], [LIMITS], -2.0)[0], whole.take(np.arange(20)[part]))
    other = simulator.run(tasks, numbers + 1, [LIMITS], -2.0)[0]
    assert (other.deviations != whole.deviations).any(axis=1).all()


def test_a_recorded_task_is_the_evaluated_one(library, make_config, make_policy, tasks, numbers):
    config = make_config()
    got = run_tasks(config, library, make_policy(), tasks, LIMITS, -2.0, numbers)
    for i in range(0, 20, 4):
        motion = record(config, library, make_policy(), tasks[i], LIMITS, -2.0, numbers[i])
        assert (motion.end, motion.fell_on, len(motion.qpos) - 1) == (got.end[i], got.fell_on[i], got.steps[i])
        np.testing.assert_array_equal(motion.deviations[-1], got.deviations[i])
        np.testing.assert_array_equal(motion.task, tasks[i])
        assert motion.qpos.shape[1:] == (47,) and motion.qvel.shape == (len(motion.qpos), 37)
        assert motion.pd_target.shape == (len(motion.qpos) - 1, 31) and motion.target_qpos.shape == (47,)


def test_the_noise_is_in_radians_whatever_the_actions_scale(library, make_config, nothing, tasks, assert_same_bits):
    results = [
        run_tasks(make_config({"action.mode": "target", "action.scale": scale}), library, nothing, tasks, LIMITS, -2.0)
        for scale in (1.0, 4.0)
    ]
    assert_same_bits(*results)


def test_returns_count_the_full_reward_whatever_the_row_was_trained_with(
    library, make_config, make_policy, tasks, assert_same_bits
):
    rows = ({}, {"reward.upper_body_penalty": False}, {"reward.tremble": False}, {"reward.failure": -12.0})
    results = [run_tasks(make_config(row), library, make_policy(), tasks, LIMITS, -2.0) for row in rows]
    for other in results[1:]:
        assert_same_bits(results[0], other)


# --------------------------------------------------------------------------------------------------- against the spec


def by_the_spec(motion, limits):
    """The columns of one episode from its poses, by the equations alone."""
    target = (motion.target_qpos, motion.target_qvel)
    after = [reference.deviations(qpos, qvel, *target) for qpos, qvel in zip(motion.qpos, motion.qvel, strict=True)]
    total = surplus = trembles = 0.0
    steps = len(after) - 1
    for t in range(1, steps + 1):
        changes = reference.direction_changes(motion.qvel[t - 1][6:], motion.qvel[t][6:])
        trembles += changes
        end = ENDS[motion.end] if t == steps else None
        total += reference.reward(after[t - 1], after[t], end, changes, trembles)
        surplus += reference.upper_body_improvement(after[t - 1], after[t])
        reached = reference.reached(after[t], (limits.root_position, limits.key_bodies, limits.joint_rotation))
        assert reached == (t == steps and motion.end == REACHED) or motion.end == FELL
    last = after[-1]
    values = (last.rp, last.rv, last.rq, last.kp, last.q, last.qv, surplus, trembles, steps)
    names = ("FRPD", "FRVD", "FRRD", "FKPD", "FJRD", "FJAD", "SURI", "TC", "TS")
    return {**dict(zip(names, values, strict=True)), "TTAR": float(motion.end == REACHED), "Return": total}


def test_every_column_is_what_the_spec_says_of_the_poses(library, make_config, make_policy, tasks, numbers):
    """A random policy on random tasks, with much noise; episodes end in every way."""
    config, policy = make_config({"task.max_steps": 20}), make_policy()
    got = run_tasks(config, library, policy, tasks, LIMITS, -2.0, numbers)
    few = np.arange(0, 20, 2)
    got = got.take(few)
    slow = [by_the_spec(record(config, library, policy, tasks[i], LIMITS, -2.0, numbers[i]), LIMITS) for i in few]
    assert set(got.end) == {REACHED, FELL, TIMED_OUT}
    fast = columns(sums(got))
    assert fast.keys() == slow[0].keys()
    for name in fast:
        assert fast[name] == pytest.approx(sum(row[name] for row in slow) / 10, rel=1e-9, abs=1e-9), name
    for i in range(0, 10, 3):  # one by one, as well
        for name, value in columns(sums(got.take(np.array([i])))).items():
            assert value == pytest.approx(slow[i][name], rel=1e-9, abs=1e-9), name


# ----------------------------------------------------------------------------------------------------------- extremes


class Moved(Environment):
    """Physics replaced by `move(environment, rows)`, which sets the poses."""

    move = None

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self._batch.step = lambda ids, nstep: self.move(ids)


def first_deviations(library, config, tasks):
    """Of every task before its first step, by the spec: (deviations, joint velocities, the target's)."""
    env = Environment(config, library, len(tasks))
    env.task[:] = tasks
    env.begin(np.arange(len(tasks)))
    poses = zip(env.qpos, env.qvel, env.target_qpos, env.target_qvel, strict=True)
    return [reference.deviations(*pose) for pose in poses], env.qvel[:, 6:].copy(), env.target_qvel[:, 6:].copy()


def test_an_oracle_that_is_put_on_the_target_reaches_every_one_in_one_step(
    library, make_config, nothing, tasks, monkeypatch
):
    def teleport(env, ids):
        env.qpos[ids], env.qvel[ids] = env.target_qpos[ids], env.target_qvel[ids]

    monkeypatch.setattr(Moved, "move", teleport)
    monkeypatch.setattr(module, "Environment", Moved)
    config = make_config()
    got = columns(sums(run_tasks(config, library, nothing, tasks, FINAL, -3.7)))
    first, velocities, wanted_velocities = first_deviations(library, config, tasks)
    for name in ("FRPD", "FRVD", "FRRD", "FKPD", "FJRD", "FJAD"):
        assert got[name] == pytest.approx(0.0, abs=1e-7), name
    assert got["TTAR"] == 1.0 and got["TS"] == 1.0
    surplus = [reference.weighted_mean(d.u, reference.UPPER) for d in first]
    assert got["SURI"] == pytest.approx(np.mean(surplus))
    assert got["TC"] == np.mean((velocities * wanted_velocities < 0).sum(axis=1)) <= 31
    gains = [2.4 * d.rp + 0.1 * d.rv + 0.1 * d.rq + 0.3 * d.kp + 1.6 * u for d, u in zip(first, surplus)]
    assert got["Return"] == pytest.approx(np.mean(gains) + 3 + 1 + 1)


def test_a_figure_that_does_not_move_at_all_keeps_its_deviations_until_time_is_up(
    library, make_config, nothing, tasks, monkeypatch
):
    monkeypatch.setattr(Moved, "move", lambda env, ids: None)
    monkeypatch.setattr(module, "Environment", Moved)
    config = make_config()
    got = columns(sums(run_tasks(config, library, nothing, tasks, FINAL, -3.7)))
    first, _, _ = first_deviations(library, config, tasks)
    assert not any(reference.reached(d, (0.01, 0.09, 0.15)) for d in first)
    for name, key in zip(("FRPD", "FRVD", "FRRD", "FKPD", "FJRD", "FJAD"), ("rp", "rv", "rq", "kp", "q", "qv")):
        assert got[name] == pytest.approx(np.mean([getattr(d, key) for d in first]), abs=1e-9), name
    assert (got["SURI"], got["TC"], got["TS"], got["TTAR"], got["Return"]) == (0.0, 0.0, 60.0, 0.0, -3.0)


def test_neither_doing_nothing_nor_acting_at_random_reaches_the_final_accuracy(
    library, make_config, make_policy, nothing, tasks
):
    for policy in (nothing, make_policy()):
        episodes = run_tasks(make_config(), library, policy, tasks, FINAL, -2.0)
        got = columns(sums(episodes))
        assert got["TTAR"] == 0.0 and 1 <= got["TS"] <= 60 and got["TC"] <= 31 * got["TS"]
        assert set(episodes.end) <= {FELL, TIMED_OUT} and (episodes.steps[episodes.end == TIMED_OUT] == 60).all()
        np.testing.assert_array_equal(episodes.parts[:, 5], -3.0)
