"""Faults of physics and of updates are survived, counted, kept for replay, and end the run when there are too many."""

import json

import numpy as np
import pytest
import ray

from learner import checkpoint
from motion.errors import InputError
from orchestrator import faults
from orchestrator.folder import metrics_path
from orchestrator.metrics import summarize
from orchestrator.run import train
from orchestrator.saved import load_latest
from workers import dump
from workers.replay import replay
from workers.types import Outcomes

pytestmark = pytest.mark.usefixtures("elsewhere")


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """MuJoCo writes MUJOCO_LOG.TXT to the working directory when a simulation diverges."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def exploding(make_config):
    """A run whose simulations explode now and then, their time step being too long."""

    def make(**changes):
        coarse = {"physics.timestep": 0.025, "physics.substeps": 2, "action.scale": 5.0, "task.max_steps": 8}
        return make_config({**coarse, "checkpoint.every": 1, "physics.max_unstable_share": 1.0, **changes})

    return make


def lines(folder):
    return [json.loads(line) for line in metrics_path(folder).read_text().splitlines()]


def dumps(folder):
    return {path.name: path.read_bytes() for path in (folder / "faults").iterdir()}


@pytest.fixture(scope="module")
def survived(exploding, tmp_path_factory):
    """The folder of a run that went on whatever exploded."""
    folder = tmp_path_factory.mktemp("survived")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        train(exploding(), folder)
    return folder


def test_explosions_are_counted_and_each_simulations_is_kept_and_replays(survived):
    rows = lines(survived)
    assert [row["iteration"] for row in rows] == [1, 2, 3, 4]
    counts = [row["physics/unstable"] for row in rows]
    assert sum(counts) > 3 and max(counts) <= 8
    for row in rows:
        assert (row["end/unstable"] > 0) == (row["physics/unstable"] > 0)
        assert row["update/skipped"] == 0
        files = sorted((survived / "faults").glob(f"unstable-{row['iteration']:08d}-*.npz"))
        assert len(files) == row["physics/unstable"]
        for path in files:
            taken = dump.read(path)
            assert taken.iteration == row["iteration"] and taken.state.environment[0] == int(path.stem[-8:])
            assert replay(taken)[1]


def test_workers_and_crashes_change_no_recording(survived, exploding, tmp_path):
    """Two workers, and killed after an iteration that is then done again: the same files, byte for byte."""

    def killed(metrics):
        if metrics["iteration"] == 3:
            raise KeyboardInterrupt

    config = exploding(num_workers=2, **{"checkpoint.every": 2})
    with pytest.raises(KeyboardInterrupt):
        train(config, tmp_path, killed)
    train(config, tmp_path)
    assert dumps(tmp_path) == dumps(survived)


def test_the_number_of_recordings_is_bounded(survived, exploding, tmp_path, monkeypatch):
    monkeypatch.setattr(faults, "MAX_DUMPS", 2)
    train(exploding(), tmp_path)
    kept = dumps(tmp_path)
    assert len(kept) == 2 and kept.items() < dumps(survived).items()


def test_too_many_explosions_stop_the_run_with_the_checkpoint_before(survived, exploding, tmp_path):
    """And a larger share continues it with the numbers of a run that was never stopped."""
    counts = [row["physics/unstable"] for row in lines(survived)]
    last = next(k for k in range(1, 4) if counts[k])  # the first iteration that is not survived, from 0
    train(exploding(**{"budget.iterations": 1}), tmp_path)
    text = f"{counts[last]} of 8 simulations exploded in iteration {last + 1}"
    with pytest.raises(InputError, match=text) as error:
        train(exploding(**{"physics.max_unstable_share": 0.0}), tmp_path)
    text = str(error.value)
    assert "\n" not in text and f"/checkpoints/{last:08d}.pt" in text and "physics.max_unstable_share" in text
    assert len(lines(tmp_path)) == last + 1 and load_latest(tmp_path)[0]["iteration"] == last
    train(exploding(), tmp_path)
    assert [row["return/mean"] for row in lines(tmp_path)] == [row["return/mean"] for row in lines(survived)]
    assert dumps(tmp_path).keys() == dumps(survived).keys()


@pytest.mark.parametrize("share, count, stops", [(0.0, 1, True), (0.01, 1, False), (0.01, 2, True), (0.3, 3, False)])
def test_the_share_is_of_all_simulations_and_rounded_up(share, count, stops, make_config, tmp_path):
    config = make_config({"physics.max_unstable_share": share, "num_envs": 8})
    metrics = {"iteration": 5, "physics/unstable": 0, "update/skipped": 0}
    faults.check(config, tmp_path, metrics, None)
    metrics["physics/unstable"] = count
    nothing = ([], None, None, [no_outcomes()])
    if stops:
        with pytest.raises(InputError, match="There is no checkpoint yet"):
            faults.check(config, tmp_path, metrics, lambda: nothing)
    else:
        faults.check(config, tmp_path, metrics, lambda: nothing)


def no_outcomes():
    return Outcomes(**{name: np.zeros(0, dtype=np.int64) for name in Outcomes.__dataclass_fields__})


def test_two_explosions_of_one_simulation_count_once(trajectories):
    outcomes = trajectories.chunks[0].outcomes
    assert summarize(outcomes, outcomes)["physics/unstable"] == 0
    first = outcomes.take([0, 0, 1])
    first.end[:], first.fell_on[:], first.environment[:] = 2, -1, [4, 4, 6]
    metrics = summarize(first, first)
    assert metrics["physics/unstable"] == 2 and metrics["end/unstable"] == 1.0


# ----------------------------------------------------------------------------------------------------- skipped updates


def test_skipped_updates_in_a_row_stop_the_run_which_a_larger_number_continues(make_config, tmp_path):
    """A learning rate beyond float32: every update would spoil the parameters, and is skipped."""

    def configure(limit):
        return make_config({"ppo.learning_rate": 3e38, "ppo.max_skipped": limit, "checkpoint.every": 1})

    for _ in range(2):  # the same command again: the same end
        with pytest.raises(InputError, match="iteration 3 was number 3 in a row") as error:
            train(configure(3), tmp_path)
        text = str(error.value)
        assert "\n" not in text and "/checkpoints/00000002.pt" in text and "ppo.max_skipped" in text
        rows = lines(tmp_path)
        assert [row["update/skipped"] for row in rows] == [1, 2, 3]
        assert "NaN" not in metrics_path(tmp_path).read_text() and "Infinity" not in metrics_path(tmp_path).read_text()
        saved = load_latest(tmp_path)[0]
        assert saved["iteration"] == 2 and saved["parts"][0]["skipped"] == 2
        assert all(tensor.isfinite().all() for tensor in saved["parts"][0]["policy"].values())
    train(configure(9), tmp_path)
    assert [row["update/skipped"] for row in lines(tmp_path)] == [1, 2, 3, 4]
    assert checkpoint.paths(tmp_path / "checkpoints")[-1].stem == "00000004"


@pytest.mark.slow
def test_recordings_on_ray_are_those_of_local(survived, exploding, tmp_path):
    ray.init(num_cpus=2, include_dashboard=False, object_store_memory=100 * 2**20, log_to_driver=False, address="local")
    try:
        train(exploding(runtime="ray"), tmp_path)
    finally:
        ray.shutdown()
    assert dumps(tmp_path) == dumps(survived)
