"""Checkpoints: exact, atomic, and nothing in them is ever executed."""

import copy
import math
import os
import pickle

import numpy as np
import pytest
import torch

from learner import checkpoint
from learner.update import LearnerState, update
from motion.errors import InputError


def test_nested_content_comes_back_exactly(tmp_path):
    content = {
        "array": np.arange(6, dtype=np.int16).reshape(2, 3), "float": 0.1, "int": 2**62, "none": None, "text": "ü",
        "inf": math.inf, "bool": True, "scalar": np.float64(1 / 3), "nested": [{"a": (1, 2.5)}, torch.eye(2)],
        "empty": np.zeros((0, 4)),
    }  # fmt: skip
    path = checkpoint.save(tmp_path, 7, content, keep=3)
    got = checkpoint.load(path)
    np.testing.assert_array_equal(got["array"].numpy(), content["array"])
    assert got["array"].dtype == torch.int16 and got["empty"].shape == (0, 4)
    assert {k: got[k] for k in ("float", "int", "none", "text", "inf", "bool", "scalar")} == {
        "float": 0.1, "int": 2**62, "none": None, "text": "ü", "inf": math.inf, "bool": True, "scalar": 1 / 3,
    }  # fmt: skip
    assert got["nested"][0] == {"a": [1, 2.5]} and torch.equal(got["nested"][1], torch.eye(2))


def test_a_learner_continues_from_its_checkpoint_bit_for_bit(tmp_path, lessons, make_config, assert_same_bits):
    config = make_config({"ppo.target_kl": 0.01})
    state = LearnerState(config, config.action, seed=3)
    for chunk in lessons[:2]:
        state, _ = update(state, [chunk])
    path = checkpoint.save(tmp_path, 2, state.state_dict(), keep=1)
    other = LearnerState(config, config.action, seed=3)
    other.load_state_dict(checkpoint.load(path))
    assert_same_bits(copy.deepcopy(state.state_dict()), copy.deepcopy(other.state_dict()))
    for chunk in lessons[2:4]:
        state, metrics = update(state, [chunk])
        other, other_metrics = update(other, [chunk])
        assert metrics == other_metrics
    assert_same_bits(state.state_dict(), other.state_dict())
    assert_same_bits(state.snapshot(), other.snapshot())


@pytest.mark.parametrize("size", [0, 1, 100, 0.5, 0.99])
def test_a_truncated_file_is_refused_by_name(size, tmp_path):
    path = checkpoint.save(tmp_path, 1, {"a": torch.zeros(1000)}, keep=1)
    data = path.read_bytes()
    path.write_bytes(data[: size if size >= 1 or size == 0 else int(size * len(data))])
    with pytest.raises(InputError, match=path.name) as error:
        checkpoint.load(path)
    assert "\n" not in str(error.value)


def test_a_file_of_another_schema_is_refused(tmp_path):
    path = tmp_path / "00000001.pt"
    torch.save({"schema": 99, "content": {}}, path)
    with pytest.raises(InputError, match="99"):
        checkpoint.load(path)


class Malicious:
    """Unpickling it would make a folder."""

    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return os.mkdir, (str(self.marker),)


@pytest.mark.parametrize("how", ["torch", "pickle"])
def test_a_file_that_wants_to_run_code_is_refused_and_runs_none(how, tmp_path):
    path, marker = tmp_path / "00000001.pt", tmp_path / "executed"
    stored = {"schema": checkpoint.SCHEMA, "content": Malicious(marker)}
    if how == "torch":
        torch.save(stored, path)
    else:
        path.write_bytes(pickle.dumps(stored, protocol=2))
    with pytest.raises(InputError, match=path.name):
        checkpoint.load(path)
    assert not marker.exists()


def test_the_newest_are_kept_and_no_temporary_file_is_left(tmp_path):
    for iteration in (1, 2, 10, 9_999_999, 3):
        checkpoint.save(tmp_path / "new", iteration, {"iteration": iteration}, keep=2)
    assert [p.name for p in checkpoint.paths(tmp_path / "new")] == ["00000010.pt", "09999999.pt"]
    assert sorted(p.name for p in (tmp_path / "new").iterdir()) == ["00000010.pt", "09999999.pt"]


def test_a_failed_write_leaves_the_checkpoints_before_it(tmp_path, monkeypatch):
    path = checkpoint.save(tmp_path, 1, {"a": 1}, keep=3)

    def full(*arguments):
        raise OSError("no space left on device")

    monkeypatch.setattr(torch, "save", full)
    with pytest.raises(OSError):
        checkpoint.save(tmp_path, 2, {"a": 2}, keep=3)
    monkeypatch.undo()
    assert checkpoint.paths(tmp_path) == [path] and checkpoint.load(path) == {"a": 1}


def test_other_files_in_the_folder_are_no_checkpoints(tmp_path):
    for name in ("00000003.tmp", "best.pt", "123.pt", "000000010.pt"):
        (tmp_path / name).write_bytes(b"")
    path = checkpoint.save(tmp_path, 4, {}, keep=1)
    assert checkpoint.paths(tmp_path) == [path]
