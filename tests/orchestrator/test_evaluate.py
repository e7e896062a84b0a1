"""The grid of tasks, and evaluation against a slow loop over single episodes."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from orchestrator.config import EvaluationConfig
from orchestrator.evaluate import evaluate_policy, evaluate_run, robustness, run_tasks, table_metrics
from orchestrator.run import train
from orchestrator.tasks import task_grid
from workers.environment import Environment
from workers.types import REACHED, REWARD_PARTS, TIMED_OUT, Thresholds


def grid_of(cancel, rotation=(-math.pi / 2, math.pi / 2), **config):
    count = len(cancel)
    groups = np.array([(s, t) for s in range(count) for t in range(count)])
    library = SimpleNamespace(groups=groups, cancel=np.array(cancel), rotation=np.array(rotation))
    return task_grid(library, EvaluationConfig(**config))


# ---------------------------------------------------------------------------------------------------------- the grid


def test_the_papers_set_has_460278_tasks():
    """9 targets x 562 moments x 91 angles: moments every 0.03 s, angles every pi / 90, both ends included."""
    moments = [62] * 8 + [66]
    assert sum(moments) == 562
    starts = np.linspace(0.1, 1.7, 9)
    grid = grid_of([(start, start + 0.03 * (n - 1)) for start, n in zip(starts, moments, strict=True)])
    assert grid.shape == (460_278, 4)
    angles = np.unique(grid[:, 3].round(9))
    assert len(angles) == 91
    np.testing.assert_allclose(angles, np.radians(np.arange(-90, 91, 2)), atol=1e-8)
    for source, (start, n) in enumerate(zip(starts, moments, strict=True)):
        own = grid[grid[:, 0] == source]
        assert len(own) == 9 * n * 91
        assert own[:, 1].min() == pytest.approx(start) and own[:, 1].max() == pytest.approx(start + 0.03 * (n - 1))
        assert (np.bincount(own[:, 2].astype(int)) == n * 91).all()
    assert len(np.unique(grid, axis=0)) == len(grid)


@pytest.mark.parametrize("end, moments", [(0.0, 1), (0.029, 1), (0.03, 2), (0.0599, 2), (0.06, 3), (2.97, 100)])
def test_moments_begin_at_the_start_of_the_range_and_never_leave_it(end, moments):
    grid = grid_of([(0.0, end)], rotation=(0.2, 0.2))
    np.testing.assert_allclose(grid[:, 1], 0.03 * np.arange(moments), atol=1e-12)
    np.testing.assert_array_equal(grid[:, 3], 0.2)


def test_only_allowed_transitions_are_evaluated(library):
    some = replace(library, groups=np.array([[0, 2], [1, 0]]))
    grid = task_grid(some, EvaluationConfig())
    assert {tuple(pair) for pair in grid[:, [0, 2]].astype(int)} == {(0, 2), (1, 0)}


def test_max_tasks_takes_the_same_spread_of_the_grid_every_time(library):
    whole = task_grid(library, EvaluationConfig())
    some = task_grid(library, EvaluationConfig(max_tasks=900))
    np.testing.assert_array_equal(some, task_grid(library, EvaluationConfig(max_tasks=900)))
    rows = {tuple(task) for task in whole}
    assert len(some) == 900 == len({tuple(task) for task in some}) and all(tuple(task) in rows for task in some)
    # about as many of each source as the grid has
    wanted = np.bincount(whole[:, 0].astype(int)) / len(whole)
    np.testing.assert_allclose(np.bincount(some[:, 0].astype(int)) / 900, wanted, atol=0.06)
    assert len(task_grid(library, EvaluationConfig(max_tasks=10**9))) == len(whole)


# ---------------------------------------------------------------------------------------------------------- episodes


@pytest.fixture(scope="module")
def tasks(library):
    return task_grid(library, EvaluationConfig(max_tasks=20))


@pytest.fixture(scope="module")
def nothing(make_policy):
    """A policy whose action is zero whatever it sees."""
    policy = make_policy()
    return replace(
        policy,
        weights=tuple(np.zeros_like(w) for w in policy.weights),
        biases=tuple(np.zeros_like(b) for b in policy.biases),
    )


LIMITS = Thresholds(0.2, 1.5, 0.6)


@pytest.mark.parametrize("policy_name", ["nothing", "random"])
def test_the_numbers_do_not_depend_on_how_many_simulations_run_at_a_time(
    policy_name, library, make_config, make_policy, nothing, tasks, assert_same_bits
):
    policy = nothing if policy_name == "nothing" else make_policy()
    results = [
        run_tasks(make_config({"evaluation.num_envs": n}), library, policy, tasks, LIMITS, -2.0) for n in (256, 7, 1)
    ]
    assert_same_bits(results[0], results[1])
    assert_same_bits(results[0], results[2])
    np.testing.assert_array_equal(results[0].task, tasks)
    np.testing.assert_array_equal(results[0].environment, np.arange(len(tasks)))


def test_an_evaluation_is_a_loop_over_single_episodes(library, make_config, nothing, tasks):
    """A policy that does nothing, without noise, task by task."""
    config = make_config({"evaluation.num_envs": 8})
    got = run_tasks(config, library, nothing, tasks, LIMITS, -math.inf)
    env, ends = Environment(config, library, 1), set()
    for i, task in enumerate(tasks):
        env.task[0] = task
        env.begin(np.array([0]))
        returned = np.zeros(len(REWARD_PARTS))
        env.end[0] = 0
        steps = 0
        while env.end[0] == 0:
            env.step(np.zeros((1, 31), np.float32), LIMITS)
            returned += env.parts[0]
            steps += 1
        assert (got.end[i], got.fell_on[i], got.steps[i], got.trembles[i]) == (
            env.end[0], env.fell_on[0], steps, env.trembles[0],
        )  # fmt: skip
        np.testing.assert_array_equal(got.deviations[i], env.deviations[0])
        np.testing.assert_allclose(got.parts[i], returned, atol=1e-12)
        ends.add(int(env.end[0]))
    assert len(ends) > 1


def test_doing_nothing_does_not_reach_the_final_accuracy(library, make_config, nothing, tasks):
    final = Thresholds(0.01, 0.09, 0.15)
    episodes = run_tasks(make_config(), library, nothing, tasks, final, -3.7)
    metrics = table_metrics(episodes)
    assert metrics["TTAR"] == 0.0
    assert (episodes.steps[episodes.end == TIMED_OUT] == 60).all() and metrics["TS"] <= 60


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


def test_the_tables_columns_are_plain_means_over_the_episodes(library, make_config, make_policy, tasks):
    episodes = run_tasks(make_config(), library, make_policy(), tasks, LIMITS, -2.0)
    sums = dict.fromkeys(("FRPD", "FRVD", "FRRD", "FKPD", "FJRD", "FJAD", "SURI", "TC", "TS", "TTAR", "Return"), 0.0)
    for i in range(len(episodes)):
        rp, rv, rq, kp, q, _, qv = episodes.deviations[i]
        for name, value in zip(("FRPD", "FRVD", "FRRD", "FKPD", "FJRD", "FJAD"), (rp, rv, rq, kp, q, qv), strict=True):
            sums[name] += value
        sums["SURI"] += episodes.parts[i][REWARD_PARTS.index("upper_body")] / 1.6
        sums["TC"] += episodes.trembles[i]
        sums["TS"] += episodes.steps[i]
        sums["TTAR"] += episodes.end[i] == REACHED
        sums["Return"] += sum(episodes.parts[i])
    got = table_metrics(episodes)
    assert got.keys() == sums.keys()
    for name, total in sums.items():
        assert got[name] == pytest.approx(total / len(tasks), rel=1e-12), name
    assert 0 < got["TTAR"] < 1


@pytest.mark.parametrize(
    "reached, wanted",
    [
        ((), None),
        ((-4.1,), -4.1),
        ((-4.1, -3.7), -3.7),
        ((-4.1, -3.3), -4.1),
        ((-4.1, -3.7, -3.3), -3.3),
        ((-3.3,), None),
    ],
)
def test_ms_is_the_largest_noise_up_to_which_every_task_is_reached(reached, wanted):
    config = SimpleNamespace(evaluation=EvaluationConfig(robustness_log_sigmas=[-3.3, -4.1, -3.7]))
    assert robustness(config, lambda log_sigma: log_sigma in reached) == wanted


def test_an_evaluation_has_the_papers_13_columns_at_both_accuracies(make_config, nothing):
    columns = "FRPD FRVD FRRD FKPD FJRD FJAD SURI TC TS MS TTAR IRFA Return".split()
    config = make_config({
        "evaluation.max_tasks": 6, "evaluation.robustness_log_sigmas": [-4.1, -3.7],
        "curriculum.start": [9.0, 90.0, 9.0],
    })  # fmt: skip
    content = evaluate_policy(config, nothing, tightenings=0, irfa=None)
    assert sorted(content["metrics"]) == sorted(content["trained"]) == sorted(columns)
    assert content["metrics_thresholds"] == [0.01, 0.09, 0.15] and content["trained_thresholds"] == [9.0, 90.0, 9.0]
    # thresholds that everything meets at once
    assert content["trained"]["TTAR"] == 1.0 and content["trained"]["TS"] == 1.0 and content["trained"]["MS"] == -3.7
    assert content["metrics"]["TTAR"] == 0.0 and content["metrics"]["MS"] is None
    assert content["tasks"] == 6 and content["metrics"]["IRFA"] is None
    json.dumps(content, allow_nan=False)


def test_a_runs_evaluation_is_written_beside_its_checkpoint(make_config, tmp_path):
    config = make_config(
        {"budget.iterations": 2, "evaluation.max_tasks": 4, "evaluation.robustness_log_sigmas": [-3.7]}
    )
    train(config, tmp_path)
    content = evaluate_run(tmp_path, config)
    assert json.loads((tmp_path / "evaluation.json").read_text()) == content
    assert (content["checkpoint"], content["iterations"], content["samples"]) == ("00000002.pt", 2, 128)
    assert not list(tmp_path.glob("*.tmp"))
