"""A run continues from what its folder or its storage holds: older schemas, copies, files that are whole."""

import shutil
from dataclasses import replace
from pathlib import Path

import fsspec
import pytest
from disk import largest_file
from training import lines

from learner import checkpoint
from motion import builtin
from motion.errors import InputError
from motion.formats import npz
from orchestrator.evaluation.subject import load_newest
from orchestrator.folder import metrics_path
from orchestrator.run import train
from orchestrator.saved import load_latest, place
from orchestrator.settings import build, command_line

FIXTURES = sorted((Path(__file__).parents[1] / "learner/checkpoints").iterdir())
# what a schema brought is in its fixture
_CARRIED = {"policy.judges": 2, "policy.average": 0.9, "task.focus": 0.5}
MADE_WITH = {"schema3": _CARRIED, "schema4": {**_CARRIED, "curriculum.scope": "group"}}


@pytest.fixture(scope="module")
def configure(make_config):
    """A run of four iterations with a checkpoint after each; two of them made tests/learner/checkpoints."""

    def make(**changes):
        sizes = {"network.hidden": [4], "num_envs": 2, "horizon": 4, "ppo.minibatch_size": 8, "task.max_steps": 4}
        return make_config({**sizes, "checkpoint.every": 1, **changes})

    return make


@pytest.fixture(scope="module")
def finished(configure, tmp_path_factory):
    """The folder of an undisturbed run."""
    folder = tmp_path_factory.mktemp("run")
    train(configure(), folder)
    return folder


@pytest.fixture
def stopped(configure, tmp_path):
    """The folder of the same run, half done."""
    train(configure(**{"budget.iterations": 2}), tmp_path)
    return tmp_path


def assert_same_end(folder, other, assert_same_bits, config=None):
    assert lines(folder) == lines(other)
    assert_same_bits(load_latest(folder, config)[0], load_latest(other)[0])


@pytest.mark.parametrize("fixture", FIXTURES, ids=lambda path: path.stem)
def test_a_run_continues_from_a_checkpoint_of_every_schema(fixture, configure, tmp_path):
    (tmp_path / "checkpoints").mkdir()
    shutil.copy(fixture, tmp_path / "checkpoints" / "00000002.pt")
    assert train(configure(**MADE_WITH.get(fixture.stem, {})), tmp_path)["iterations"] == 4
    assert [line["iteration"] for line in lines(tmp_path)] == [3, 4]
    saved = load_latest(tmp_path)[0]
    assert saved["parts"][0]["updates"] == 4 and saved["parts"][0]["skipped"] == 0
    assert [policy.version for policy in saved["policies"]] == [3, 4]


def test_a_run_whose_newest_checkpoint_is_broken_continues_from_the_one_before(
    stopped, finished, configure, caplog, assert_same_bits
):
    newest = checkpoint.paths(stopped / "checkpoints")[-1]
    newest.write_bytes(newest.read_bytes()[:5000])
    train(configure(), stopped)
    assert "00000002.pt: not a readable checkpoint (cut off" in caplog.text and "00000001.pt" in caplog.text
    assert_same_end(stopped, finished, assert_same_bits)


def test_a_run_without_a_readable_checkpoint_is_refused(stopped, configure):
    for path in checkpoint.paths(stopped / "checkpoints"):
        path.write_bytes(b"")
    with pytest.raises(InputError, match="none of its 2 checkpoints can be read"):
        train(configure(), stopped)
    assert len(lines(stopped)) == 2


@pytest.mark.parametrize("kind", ["file", "memory"])
def test_checkpoints_in_a_storage_continue_a_run_and_one_that_began_without(
    kind, stopped, finished, configure, tmp_path_factory, assert_same_bits
):
    url = {"file": f"file://{tmp_path_factory.mktemp('storage')}", "memory": "memory://bucket/runs"}[kind]
    try:
        for total in (3, 4):
            config = configure(**{"budget.iterations": total, "checkpoint.storage": url})
            train(config, stopped)
        # what was there stays, what is new went below the names of sweep and run
        assert [path.stem for path in checkpoint.paths(stopped / "checkpoints")] == ["00000001", "00000002"]
        where = place(stopped, config)
        assert str(where).endswith(f"/{stopped.parent.name}/{stopped.name}")
        assert len(checkpoint.paths(where)) == 2
        assert_same_end(stopped, finished, assert_same_bits, config)
    finally:
        fsspec.filesystem("memory").store.clear()


def test_a_checkpoint_of_another_run_in_the_same_place_is_refused(configure, tmp_path):
    storage = f"file://{tmp_path}/storage"
    for name, seed in (("a", 0), ("b", 1)):
        folder = tmp_path / name / "sweep" / "ours-seed0"
        config = configure(**{"checkpoint.storage": storage, "seed": seed})
        if seed == 0:
            train(config, folder)
        else:
            with pytest.raises(InputError, match="of a run with seed=0, asked for seed=1") as error:
                train(config, folder)
            assert "\n" not in str(error.value)


@pytest.mark.parametrize("file", ["checkpoint", "metrics"])
def test_a_run_stopped_by_a_full_disk_continues_with_the_same_numbers(
    file, stopped, finished, configure, assert_same_bits
):
    size = {"checkpoint": 40_000, "metrics": metrics_path(stopped).stat().st_size + 100}[file]
    with largest_file(size), pytest.raises(InputError, match="cannot be written .*free space") as error:
        train(configure(), stopped)
    assert str(stopped) in str(error.value) and "\n" not in str(error.value)
    # whole lines, whole checkpoints, nothing else
    assert metrics_path(stopped).read_text().endswith("}\n")
    assert sorted(path.name for path in (stopped / "checkpoints").iterdir()) == ["00000001.pt", "00000002.pt"]
    assert load_latest(stopped)[0]["iteration"] == 2
    train(configure(), stopped)
    assert_same_end(stopped, finished, assert_same_bits)


@pytest.mark.parametrize(
    "value", ["checkpoints", "/mnt/x", "''", "s3://key:secret@bucket/x", "s3://key:se/cr/et@bucket"]
)
def test_a_storage_is_a_url_without_a_password(value):
    with pytest.raises(InputError, match="checkpoint.storage=.* must be a URL"):
        build([command_line([f"checkpoint.storage={value}"])])
    assert build([command_line(["checkpoint.storage=s3://bucket/x"])]).checkpoint.storage == "s3://bucket/x"


# -------------------------------------------------------------------------------------------------------- other clips


def test_a_run_whose_clips_have_changed_is_neither_continued_nor_evaluated(tmp_path, configure):
    """The same name and file, another pose in it."""
    clip = builtin.load("idle")
    npz.write(clip, tmp_path / "idle.npz")

    def config(iterations):
        made = configure(**{"budget.iterations": iterations})
        own = replace(made.motions.clips["idle"], file="idle.npz")
        return replace(made, motions=replace(made.motions, dir=str(tmp_path), clips={"idle": own}))

    train(config(1), tmp_path / "run")
    train(config(2), tmp_path / "run")
    qpos = clip.qpos.copy()
    qpos[:, 2] += 0.01
    npz.write(replace(clip, qpos=qpos), tmp_path / "idle.npz")
    with pytest.raises(InputError, match="00000002.pt: trained with other clips of the same names.*motions.dir="):
        train(config(3), tmp_path / "run")
    with pytest.raises(InputError, match="trained with other clips of the same names"):
        load_newest(tmp_path / "run", config(2))
