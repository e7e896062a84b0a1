"""A whole evaluation: its content, the same whoever plays it, in what order, with what interruptions."""

import copy
import csv
import json
import math
import shutil
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import ray

from motion.errors import InputError
from orchestrator.cluster import bundles, start_here
from orchestrator.evaluation import grid as module
from orchestrator.evaluation import kept, pools
from orchestrator.evaluation.episodes import run_tasks
from orchestrator.evaluation.evaluator import levels, num_shards, shard_size
from orchestrator.evaluation.grid import evaluate
from orchestrator.evaluation.kept import Kept
from orchestrator.evaluation.pools import LocalPool, RayPool
from orchestrator.evaluation.statistics import columns, sums
from orchestrator.evaluation.subject import Subject
from orchestrator.tasks import TaskGrid
from workers.types import REACHED

COLUMNS = "FRPD FRVD FRRD FKPD FJRD FJAD SURI TC TS TTAR Return MS IRFA".split()
TASKS = 520


@pytest.fixture(scope="module")
def config(make_config):
    """Three shards of a random policy's episodes, of at most three steps; some reach their target."""
    return make_config({
        "evaluation.max_tasks": TASKS, "task.max_steps": 3, "curriculum.start": [0.35, 3.0, 1.0],
        "evaluation.robustness_resolution": 1.0, "evaluation.log_sigma": -1.5,
    })  # fmt: skip


@pytest.fixture(scope="module")
def subject(make_policy):
    return Subject(make_policy(), tightenings=0, irfa=None, iteration=7, name="00000007.pt")


@pytest.fixture(scope="module")
def whole(config, subject, tmp_path_factory):
    """(folder, content) of an evaluation in one process without interruption."""
    folder = tmp_path_factory.mktemp("whole")
    return folder, evaluate(config, subject, folder, local)


def local(config, subject, shards):
    return LocalPool(config, subject)


class Counting(LocalPool):
    """Counts the shards that it plays, backwards, and is interrupted after `last` of them."""

    def __init__(self, config, subject, last=math.inf):
        super().__init__(config, subject)
        self.shards, self._last = [], last

    def run(self, jobs):
        jobs = list(enumerate(jobs))[::-1]
        for index, (method, arguments) in jobs:
            if method == "shard":
                if len(self.shards) == self._last:
                    raise KeyboardInterrupt
                self.shards.append(arguments[0])
            yield index, getattr(self._evaluator, method)(*arguments)


def assert_same(folder, content, whole):
    assert content == whole[1]
    assert (folder / "failures.csv").read_bytes() == (whole[0] / "failures.csv").read_bytes()


def test_the_columns_are_those_of_all_episodes_at_once(whole, config, subject, library):
    content = whole[1]
    grid, limits = TaskGrid(library, config.evaluation), levels(config, 0)
    numbers = grid.numbers(0, TASKS)
    for name, level, log_sigma in (
        ("metrics", "metrics", -1.5), ("trained", "trained", -1.5),
        ("deterministic", "metrics", -math.inf), ("trained_deterministic", "trained", -math.inf),
    ):  # fmt: skip
        episodes = run_tasks(config, library, subject.policy, grid.tasks(numbers), limits[level], log_sigma, numbers)
        got = dict(content[name])
        assert list(got) == COLUMNS and got.pop("MS") is None and got.pop("IRFA") is None
        assert got == pytest.approx(columns(sums(episodes)), rel=1e-12)
        if name == "trained":
            assert 0 < content[name]["TTAR"] < 1
            by_group = {(g["source"], g["target"]): g for g in content["groups"]}
            for source, target in library.groups:
                own = (episodes.task[:, 0] == source) & (episodes.task[:, 2] == target)
                assert by_group[source, target]["tasks"] == own.sum()
                assert by_group[source, target]["reached_trained"] == (episodes.end[own] == REACHED).sum()
    json.dumps(content, allow_nan=False)
    assert content["states"] == ["idle", "run", "stab"] and content["log_sigma"] == -1.5
    assert content["metrics_thresholds"] == [0.01, 0.09, 0.15] and content["trained_thresholds"] == [0.35, 3.0, 1.0]
    assert content["grid"] == {
        "moment_spacing": 0.03, "rotation_spacing": config.evaluation.rotation_spacing, "max_tasks": TASKS,
        "whole": grid.whole,
    }  # fmt: skip
    for name in ("groups", "by_rotation", "by_moment"):
        assert sum(entry["tasks"] for entry in content[name]) == TASKS
    rungs = content["by_accuracy"]
    for level, rung in (("trained", rungs[0]), ("metrics", rungs[-1])):
        assert rung["thresholds"] == content[f"{level}_thresholds"]
        assert rung["reached"] == round(content[level]["TTAR"] * TASKS)
    assert [rung["tightenings"] for rung in rungs] == list(range(content["final_tightenings"] + 1))


def test_every_failed_task_is_listed_with_its_passes(whole, config, subject, library):
    with open(whole[0] / "failures.csv", newline="") as file:
        lines = {int(line["task"]): line for line in csv.DictReader(file)}
    grid, limits = TaskGrid(library, config.evaluation), levels(config, 0)["trained"]
    numbers = grid.numbers(0, TASKS)
    noise, calm = (
        run_tasks(config, library, subject.policy, grid.tasks(numbers), limits, log_sigma, numbers)
        for log_sigma in (-1.5, -math.inf)
    )
    failed = {(True, True): "both", (True, False): "noise", (False, True): "deterministic"}
    seen = set()
    for i, number in enumerate(numbers):
        ends = noise.end[i] != REACHED, calm.end[i] != REACHED
        if not any(ends):
            assert number not in lines
            continue
        line = lines.pop(number)
        assert line["failed"] == failed[ends]
        seen.add(line["failed"])
        assert (int(line["steps"]), int(line["deterministic_steps"])) == (noise.steps[i], calm.steps[i])
        assert (line["end"] == "reached") == (not ends[0])
        source, target = (["idle", "run", "stab"].index(line[name]) for name in ("source", "target"))
        np.testing.assert_array_equal([source, float(line["moment"]), target, float(line["rotation"])], noise.task[i])
    assert not lines and {"both", "noise"} <= seen


def test_neither_simulations_nor_threads_nor_the_order_of_shards_change_a_number(config, subject, whole, tmp_path):
    changed = replace(config, evaluation=replace(config.evaluation, num_envs=50), worker_threads=2)
    assert_same(tmp_path, evaluate(changed, subject, tmp_path, lambda *_: Counting(changed, subject)), whole)


@pytest.fixture(scope="module")
def ray_here():
    """Ray on two CPUs."""
    start_here(num_cpus=2, include_dashboard=False, object_store_memory=100 * 2**20, log_to_driver=False)
    yield
    ray.shutdown()


def test_ray_workers_give_the_numbers_of_one_process(config, subject, whole, tmp_path, ray_here):
    content = evaluate(config, subject, tmp_path, lambda *_: RayPool(config, subject, [1, 1]))
    assert_same(tmp_path, content, whole)


def test_a_ray_worker_that_dies_changes_no_number(config, subject, whole, tmp_path, ray_here):
    class Dying(RayPool):
        def run(self, jobs):
            for k, result in enumerate(super().run(jobs)):
                if k == 0:
                    ray.kill(self._actors[0], no_restart=False)
                yield result

    assert_same(tmp_path, evaluate(config, subject, tmp_path, lambda *_: Dying(config, subject, [1])), whole)


def test_an_interrupted_evaluation_plays_only_the_shards_that_are_left(config, subject, whole, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        evaluate(config, subject, tmp_path, lambda *_: Counting(config, subject, 1))
    assert not (tmp_path / "failures.csv").exists()
    pool = Counting(config, subject)
    assert_same(tmp_path, evaluate(config, subject, tmp_path, lambda *_: pool), whole)
    assert pool.shards == [1, 0]


def test_shards_that_are_gone_or_cut_off_are_played_again_and_no_others(config, subject, whole, tmp_path):
    shutil.copytree(whole[0], tmp_path, dirs_exist_ok=True)
    first, second, _ = sorted(tmp_path.glob("evaluation/*/shard-*.json"))
    first.unlink()
    second.write_bytes(second.read_bytes()[:100])
    pool = Counting(config, subject)
    assert_same(tmp_path, evaluate(config, subject, tmp_path, lambda *_: pool), whole)
    assert pool.shards == [1, 0]


@pytest.mark.parametrize(
    "change",
    [
        {"evaluation.log_sigma": -3.0}, {"evaluation.max_tasks": 599}, {"evaluation.moment_spacing": 0.04},
        {"seed": 1}, {"physics.iterations": 9}, {"curriculum.floor": [0.02, 0.09, 0.15]}, {"task.max_steps": 2},
        {"policy": 4}, {"tightenings": 2}, {"motions.clips.idle.start": 0.1},
    ],
    ids=str,
)  # fmt: skip
def test_shards_of_something_else_are_not_taken(change, config, make_policy, subject, monkeypatch):
    keys = []
    monkeypatch.setattr(module, "Kept", lambda folder, key: keys.append(key) or Kept(None, key))
    monkeypatch.setattr(module, "play", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    other, changed = copy.deepcopy(config), subject
    for key, value in change.items():
        if key == "policy":
            changed = replace(subject, policy=make_policy(seed=value))
        elif key == "tightenings":
            changed = replace(subject, tightenings=value)
        else:
            *path, name = key.split(".")
            owner = other
            for part in path:
                owner = owner[part] if isinstance(owner, dict) else getattr(owner, part)
            setattr(owner, name, value)
    for c, s in ((config, subject), (copy.deepcopy(config), subject), (other, changed)):
        with pytest.raises(KeyboardInterrupt):
            evaluate(c, s, None, lambda *_: None)
    assert keys[0] == keys[1] != keys[2]


def test_what_other_evaluations_left_goes_when_one_is_finished(config, subject, whole, tmp_path):
    shutil.copytree(whole[0], tmp_path, dirs_exist_ok=True)
    (tmp_path / "evaluation/0123456789abcdef").mkdir()
    evaluate(config, subject, tmp_path, local)
    assert [path.name for path in (tmp_path / "evaluation").iterdir()] == [
        path.name for path in (whole[0] / "evaluation").iterdir()
    ]


def test_thresholds_that_everything_meets_give_the_largest_noise_of_the_bracket(make_config, subject):
    config = make_config({
        "evaluation.max_tasks": 6, "curriculum.start": [9.0, 90.0, 9.0], "evaluation.robustness_bracket": [-4.0, -2.5],
    })  # fmt: skip
    content = evaluate(config, subject)
    assert content["trained"]["TTAR"] == 1.0 and content["trained"]["TS"] == 1.0 and content["trained"]["MS"] == -2.5
    assert content["metrics"]["TTAR"] == 0.0 and content["metrics"]["MS"] is None


def test_a_grid_of_zero_tasks_is_one_clear_line(config, subject, library, monkeypatch):
    monkeypatch.setattr(module, "build_library", lambda machine: replace(library, groups=library.groups[:0]))
    with pytest.raises(InputError, match="the grid holds no task; widen a cancel range"):
        evaluate(config, subject)


class Unplayed:
    """A pool that plays nothing: of every shard its first 30 tasks failed."""

    def __init__(self, grid, breakdown):
        self._grid, self._counts, self.closed = grid, breakdown, False

    def run(self, jobs):
        for index, (method, arguments) in enumerate(jobs):
            yield index, self.shard(*arguments) if method == "shard" else [0]

    def shard(self, index):
        size = shard_size(len(self._grid))
        sums = [float(len(self._grid.numbers(index * size, (index + 1) * size)))] * 18
        failure = [index * size, 0, 0.1, 1, 0.2, 2, 5, 30, 0.1, 0.2, 0.3, 2, 5, 30]
        levels = {"trained": sums, "metrics": sums}
        return {
            "sums": {"noise": levels, "deterministic": levels}, "counts": self._counts,
            "failures": [[failure[0] + i, *failure[1:]] for i in range(30)],
            "failed": {"trained": [0], "metrics": [0]},
        }  # fmt: skip

    def close(self):
        self.closed = True


def test_memory_does_not_grow_with_the_grid(config, subject, library, tmp_path, monkeypatch):
    """Twice as many tasks in shards that are no larger: the same peak."""
    monkeypatch.setattr(kept, "replace_file", lambda path, data: path.write_bytes(data))  # without waiting for the disk
    peaks, counts = [], []
    empty = {"groups": [[0] * 6] * 9, "rotation": [[0] * 3] * 12, "moment": [[0] * 3] * 46, "accuracy": [[0] * 3] * 35}
    for name, turn in (("small", 0.0043), ("large", 0.0043 / 2)):
        evaluation = replace(config.evaluation, max_tasks=0, rotation_spacing=turn)
        changed = replace(config, evaluation=evaluation)
        pool = Unplayed(TaskGrid(library, evaluation), empty)
        tracemalloc.start()
        content = evaluate(changed, subject, tmp_path / name, lambda *_, pool=pool: pool)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        counts.append(num_shards(content["tasks"]))
        assert pool.closed
        with open(tmp_path / name / "failures.csv") as file:
            assert sum(1 for _ in file) == 1 + 30 * counts[-1]
    assert counts[1] > 1.9 * counts[0]
    assert peaks[1] < 1.1 * peaks[0], peaks


@pytest.mark.parametrize("tasks", [1, 255, 256, 257, 16384, 16385, 460_278, 10**8])
def test_shards_cover_the_grid_and_grow_no_further_than_4096(tasks):
    size, count = shard_size(tasks), num_shards(tasks)
    assert size * (count - 1) < tasks <= size * count and 256 <= size <= 4096


@pytest.mark.parametrize(
    "change, initialized, shards, cpus",
    [
        ({"runtime": "ray"}, True, 5, [2, 3, 3]),  # the CPUs of its learner and of its workers, each one's as they were
        ({"runtime": "ray"}, True, 4, None),
        ({"runtime": "ray"}, False, 5, None),
        ({"runtime": "local"}, True, 5, None),
    ],
)
def test_a_run_is_evaluated_on_its_own_cpus(change, initialized, shards, cpus, make_config, subject, monkeypatch):
    """An actor for every bundle of the run's placement group: none waits for a CPU that the run does not have."""
    config = make_config({**change, "learner_threads": 2, "num_workers": 2, "worker_threads": 3})
    monkeypatch.setattr(pools.ray, "is_initialized", lambda: initialized)
    monkeypatch.setattr(pools, "RayPool", lambda config, subject, cpus: cpus)
    pool = pools.within_run(config, subject, shards)
    if cpus:
        assert pool == cpus == [bundle["CPU"] for bundle in bundles(config)]
    else:
        assert isinstance(pool, LocalPool)


def test_more_workers_than_the_cluster_has_cpus_are_one_clear_line(make_config, subject, monkeypatch):
    monkeypatch.setattr(pools.ray, "available_resources", lambda: {"CPU": 1.0})
    monkeypatch.setattr(pools.ray, "cluster_resources", lambda: {"CPU": 2.0})
    monkeypatch.setattr(pools, "RayPool", lambda config, subject, cpus: cpus)
    assert pools.of_cluster(make_config(), subject, 9) == [1]
    assert pools.of_cluster(make_config({"evaluation.num_workers": 2}), subject, 9) == [1, 1]
    assert pools.of_cluster(make_config({"evaluation.num_workers": 2}), subject, 1) == [1]
    with pytest.raises(InputError, match="evaluation.num_workers=3: Ray has 2 CPUs in all; lower it"):
        pools.of_cluster(make_config({"evaluation.num_workers": 3}), subject, 9)
