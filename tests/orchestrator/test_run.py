"""Whole runs at the smallest size: the same numbers whatever the runtime, the workers, and interruptions."""

import dataclasses
import json

import pytest
import ray
from ray import exceptions
from training import Killed, killed_after, lines

from learner import checkpoint, followed_windows, learner
from orchestrator import run
from orchestrator.run import Stopped, load_latest, train
from orchestrator.runtime import FAULTS, LocalRuntime, is_fault, shares
from workers.worker import RolloutWorker


def state_of(folder):
    """Everything in a run's newest checkpoint."""
    return load_latest(folder)[0]


@pytest.fixture(scope="module")
def configure(make_config):
    """A run of five iterations whose thresholds are easy enough to be cut on the way, with all that carries state."""

    def make(**changes):
        easy = {"curriculum.start": [1.0, 8.0, 2.0], "curriculum.window": 1, "curriculum.achievement": 0.2}
        carried = {"policy.judges": 2, "policy.average": 0.9, "task.focus": 0.5, "curriculum.scope": "source"}
        carried |= {"policy.sigma_factor": 0.8, "ppo.optimizer": "kfac", "ppo.natural_epochs": 1}
        carried |= {"policy.noise_window": 3, "policy.independent_from": 2}
        carried |= {"arrival.weight": 0.1, "arrival.steps": 1, "arrival.hidden": [16]}
        time = {"budget.iterations": 5, "task.max_steps": 12, "task.training_steps": 8}
        return make_config({**time, **easy, **carried, **changes})

    return make


@pytest.fixture(scope="module")
def finished(configure, tmp_path_factory):
    """(folder, summary) of the run that others are compared with."""
    folder = tmp_path_factory.mktemp("run")
    return folder, train(configure(), folder)


def assert_same_run(folder, other, assert_same_bits):
    assert lines(folder) == lines(other)
    a, b = state_of(folder), state_of(other)
    for key in ("iteration", "parts", "policies", "thresholds"):
        assert_same_bits(a[key], b[key])


def test_the_same_configuration_twice_is_the_same_run(finished, configure, tmp_path, assert_same_bits):
    folder, summary = finished
    assert train(configure(), tmp_path) == summary
    assert_same_run(folder, tmp_path, assert_same_bits)
    assert_same_bits(state_of(folder)["workers"], state_of(tmp_path)["workers"])


def test_another_seed_is_another_run(finished, configure, tmp_path):
    config = configure()
    config.seed = 1
    train(config, tmp_path)
    assert lines(tmp_path)[0] != lines(finished[0])[0]


def test_there_is_a_line_per_iteration_with_the_clock_under_perf_only(finished):
    folder, summary = finished
    rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert [row["iteration"] for row in rows] == [1, 2, 3, 4, 5]
    assert [row["samples"] for row in rows] == [64 * k for k in range(1, 6)]
    assert {key for key in rows[0] if key.startswith("perf/")} >= {
        "perf/samples_per_second",
        "perf/seconds",
        "perf/time",
    }
    assert [row["thresholds/tightenings"] for row in rows] == sorted(row["thresholds/tightenings"] for row in rows)
    assert summary["iterations"] == 5 and summary["samples"] == 320
    assert 0 < summary["tightenings"] <= 5


@pytest.mark.parametrize("workers", [2, 4, 3])
def test_the_number_of_workers_changes_no_number(workers, finished, configure, tmp_path, assert_same_bits):
    config = configure(num_workers=workers)
    train(config, tmp_path)
    assert_same_run(finished[0], tmp_path, assert_same_bits)


def test_derivatives_are_the_same_whoever_simulates_them_and_after_a_crash(
    configure, tmp_path, monkeypatch, assert_same_bits
):
    monkeypatch.setattr(followed_windows, "LEAST_FORESEEN", float("-inf"))  # three iterations foresee nothing yet
    simulated = {"arrival.weight": 1.0, "arrival.share": 1.0, "physics.sole": 0.02, "budget.iterations": 3}
    train(configure(**simulated), tmp_path / "one")
    assert max(row["gradient/arrival"] for row in lines(tmp_path / "one")) > 0
    with pytest.raises(Killed):
        train(configure(num_workers=3, **simulated), tmp_path / "three", killed_after(2))
    train(configure(num_workers=3, **simulated), tmp_path / "three")
    assert_same_run(tmp_path / "one", tmp_path / "three", assert_same_bits)


def test_environments_are_shared_out_evenly_and_completely():
    for envs, workers in ((8, 1), (8, 3), (10, 4), (4096, 7)):
        parts = shares(envs, workers)
        assert [first for first, _ in parts] == [sum(n for _, n in parts[:i]) for i in range(workers)]
        counts = [count for _, count in parts]
        assert sum(counts) == envs and max(counts) - min(counts) <= 1


@pytest.mark.parametrize("depth", [0, 1])
def test_chunk_k_is_collected_with_policy_and_thresholds_k_minus_depth(depth, configure, tmp_path, monkeypatch):
    versions, tightenings = [], []
    update, collect = learner.update, RolloutWorker.collect

    def spied_update(state, chunks):
        versions.append((state.updates, chunks[0].version))
        return update(state, chunks)

    def spied_collect(self, state, policy, thresholds):
        tightenings.append(thresholds.tightenings)
        return collect(self, state, policy, thresholds)

    monkeypatch.setattr(learner, "update", spied_update)
    monkeypatch.setattr(RolloutWorker, "collect", spied_collect)
    config = configure(pipeline_depth=depth)
    summary = train(config, tmp_path)
    assert versions == [(k, max(0, k - depth)) for k in range(5)]
    # the thresholds of each line are those that its chunk was collected with
    assert [row["thresholds/tightenings"] for row in lines(tmp_path)] == tightenings
    assert tightenings[: depth + 1] == [0] * (depth + 1) and tightenings[-1] > 0
    assert summary["tightenings"] >= tightenings[-1]


@pytest.mark.parametrize("depth", [0, 1])
def test_the_window_after_a_tightening_holds_only_episodes_under_the_new_thresholds(depth, configure, tmp_path):
    """Thresholds that all meet, then, after one cut, that nobody can meet: there is no second cut."""
    config = configure(pipeline_depth=depth, **{
        "curriculum.start": [50.0, 500.0, 50.0], "curriculum.floor": [1e-9] * 3, "curriculum.factor": 1e-6,
    })  # fmt: skip
    assert train(config, tmp_path)["tightenings"] == 1


@pytest.mark.parametrize("depth", [0, 1])
@pytest.mark.parametrize("kill", [1, 3, 4])
def test_a_run_that_was_killed_continues_as_if_it_had_not_been(
    kill, depth, finished, configure, tmp_path, tmp_path_factory, assert_same_bits
):
    """Checkpoints come every second iteration; what was done after the last one is done again."""
    whole = finished[0]
    if depth == 0:
        whole = tmp_path_factory.mktemp("whole")
        train(configure(pipeline_depth=0), whole)
    config = configure(pipeline_depth=depth)
    with pytest.raises(Killed):
        train(config, tmp_path, killed_after(kill))
    assert len(lines(tmp_path)) == kill
    with open(tmp_path / "metrics.jsonl", "a") as file:
        file.write('{"iteration": 5, "sam')  # a line that the crash cut off
    train(config, tmp_path)
    assert_same_run(whole, tmp_path, assert_same_bits)
    assert_same_bits(state_of(whole)["workers"], state_of(tmp_path)["workers"])


def test_a_finished_run_is_left_as_it_is(finished, configure):
    folder, summary = finished
    before = (folder / "metrics.jsonl").read_bytes()
    assert train(configure(), folder) == summary
    assert (folder / "metrics.jsonl").read_bytes() == before


def test_a_larger_budget_continues_where_the_run_stopped(finished, configure, tmp_path, assert_same_bits):
    config = configure()
    config.budget.iterations = 3
    train(config, tmp_path)
    assert len(lines(tmp_path)) == 3
    train(configure(), tmp_path)
    assert_same_run(finished[0], tmp_path, assert_same_bits)


def test_the_checkpoint_holds_what_load_latest_says(finished):
    folder, _ = finished
    content, path = load_latest(folder)
    assert path == checkpoint.paths(folder / "checkpoints")[-1] and path.stem == "00000005"
    saved, curriculum = content["parts"]
    assert saved["updates"] == curriculum.iteration == content["iteration"] == 5
    assert [policy.version for policy in content["policies"]] == [4, 5]
    assert len(content["thresholds"]) == 2 and content["workers"][0].clock == 40
    assert dataclasses.is_dataclass(content["workers"][0])


@pytest.mark.parametrize("depth", [0, 1])
def test_a_run_that_is_asked_to_stop_has_a_checkpoint_of_where_it_stopped(
    depth, configure, tmp_path, tmp_path_factory, assert_same_bits
):
    whole = tmp_path_factory.mktemp("whole")
    train(configure(pipeline_depth=depth), whole)
    config = configure(pipeline_depth=depth, **{"checkpoint.every": 100})
    asked = []
    with pytest.raises(Stopped):
        train(config, tmp_path, lambda metrics: asked.append(metrics["iteration"]), lambda: len(asked) >= 2)
    done = len(lines(tmp_path))
    assert 2 < done < 5 and state_of(tmp_path)["iteration"] == done  # nothing has to be done again
    train(config, tmp_path)
    assert_same_run(whole, tmp_path, assert_same_bits)


class Faulty(LocalRuntime):
    """Loses the learner when the iterations of `faults` are waited for; a runtime of one process has no such faults."""

    faults, built = [], 0

    def __init__(self, config, learner=None, curriculum=None, notice=None):
        super().__init__(config, learner, curriculum)
        Faulty.built += 1
        self._updates = learner["updates"] if learner else 0

    def update(self, chunks):
        self._updates += 1
        if self._updates in Faulty.faults:
            Faulty.faults.remove(self._updates)
            raise exceptions.ActorDiedError()
        return super().update(chunks)


@pytest.fixture
def lose(monkeypatch):
    """A function that lists the updates in which the learner is lost, each entry once."""
    monkeypatch.setattr(run, "build_runtime", Faulty)

    def fill(*updates):
        Faulty.faults, Faulty.built = list(updates), 0

    return fill


def test_a_lost_learner_is_restored_from_the_checkpoint_and_its_iterations_repeated(
    lose, finished, configure, tmp_path, assert_same_bits
):
    lose(1, 4, 4, 5)
    said = []
    assert train(configure(), tmp_path, notice=said.append) == finished[1]
    assert_same_run(finished[0], tmp_path, assert_same_bits)
    assert Faulty.built == 5 and len(said) == 4
    assert "starts again" in said[0] and "checkpoint of iteration 2" in said[1]


def test_a_fault_that_comes_back_every_time_ends_the_run(lose, configure, tmp_path):
    lose(*[4] * 20)
    with pytest.raises(exceptions.ActorDiedError):
        train(configure(**{"faults.restarts": 2}), tmp_path)
    assert Faulty.built == 3
    # the second fault and those after it made no new iteration
    assert len(lines(tmp_path)) == 3 or len(lines(tmp_path)) == 2


def test_an_error_of_the_code_is_no_fault(configure, tmp_path, monkeypatch):
    def broken(*_):
        raise ValueError("a bug")

    monkeypatch.setattr(LocalRuntime, "observe", broken)
    with pytest.raises(ValueError, match="a bug"):
        train(configure(), tmp_path)
    error = exceptions.RayTaskError("f", "traceback", ValueError("a bug")).as_instanceof_cause()
    assert not isinstance(error, FAULTS)
    lost = exceptions.RayTaskError("f", "traceback", exceptions.ActorDiedError()).as_instanceof_cause()
    assert isinstance(lost, FAULTS) and is_fault(lost)


@pytest.fixture(scope="module")
def cluster():
    ray.init(num_cpus=2, include_dashboard=False, object_store_memory=100 * 2**20, log_to_driver=False, address="local")
    yield
    ray.shutdown()


def test_ray_gives_the_numbers_of_local(cluster, finished, configure, tmp_path, assert_same_bits):
    folder, summary = finished
    assert train(configure(runtime="ray", spare_threads=1), tmp_path) == summary
    assert_same_run(folder, tmp_path, assert_same_bits)
    assert_same_bits(state_of(folder)["workers"], state_of(tmp_path)["workers"])


def test_a_run_begins_with_anothers_learner_on_ray_as_locally(
    cluster, finished, configure, tmp_path, assert_same_bits
):
    for runtime in ("local", "ray"):
        train(configure(runtime=runtime, seed=1, **{"start.checkpoint": str(finished[0])}), tmp_path / runtime)
    assert_same_run(tmp_path / "local", tmp_path / "ray", assert_same_bits)


@pytest.mark.slow
def test_a_run_may_be_killed_on_ray_and_continued_on_ray_or_locally(
    cluster, finished, configure, tmp_path, assert_same_bits
):
    for runtimes in (("ray", "ray"), ("ray", "local")):
        folder = tmp_path / "-".join(runtimes)
        with pytest.raises(Killed):
            train(configure(runtime=runtimes[0]), folder, killed_after(3))
        train(configure(runtime=runtimes[1]), folder)
        assert_same_run(finished[0], folder, assert_same_bits)
