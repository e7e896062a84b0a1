"""Checkpoints: exact, whole or refused with a reason, and nothing in them is ever executed."""

import copy
import hashlib
import io
import math
import os
import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import fsspec
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from learner import checkpoint, storage
from learner.state import LearnerState
from learner.update import update
from motion.errors import InputError

# A file of every schema, by the version that introduced it: network.hidden=[4], two simulations, two iterations
FIXTURES = Path(__file__).parent / "checkpoints"


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


@pytest.mark.parametrize("average", [0.0, 0.9])
def test_a_learner_continues_from_its_checkpoint_bit_for_bit(average, tmp_path, lessons, make_config, assert_same_bits):
    config = make_config({"ppo.target_kl": 0.01, "policy.average": average})
    state = LearnerState(config, seed=3)
    for chunk in lessons[:2]:
        state, _ = update(state, [chunk])
    path = checkpoint.save(tmp_path, 2, state.state_dict(), keep=1)
    other = LearnerState(config, seed=3)
    other.load_state_dict(checkpoint.load(path))
    assert_same_bits(copy.deepcopy(state.state_dict()), copy.deepcopy(other.state_dict()))
    for chunk in lessons[2:4]:
        state, metrics = update(state, [chunk])
        other, other_metrics = update(other, [chunk])
        assert metrics == other_metrics
    assert_same_bits(state.state_dict(), other.state_dict())
    assert_same_bits(state.snapshot(), other.snapshot())


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The bytes of a checkpoint."""
    folder = tmp_path_factory.mktemp("whole")
    return checkpoint.save(folder, 1, {"a": torch.arange(500), "text": "x" * 50}, keep=1).read_bytes()


def refused(folder, data):
    """The reason for which a file with these bytes is refused."""
    path = folder / "00000001.pt"
    path.write_bytes(data)
    with pytest.raises(InputError) as error:
        checkpoint.load(path)
    assert str(error.value).startswith(f"{path}: not a readable checkpoint (") and "\n" not in str(error.value)
    return str(error.value)


@given(share=st.floats(0, 1, exclude_max=True))
def test_a_file_that_was_cut_off_is_refused(share, whole, tmp_path_factory):
    data = whole[: int(share * len(whole))]
    reason = refused(tmp_path_factory.getbasetemp(), data)
    assert any(words in reason for words in ("cut off", "empty", "no checkpoint's header"))


@given(place=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
def test_a_file_in_which_a_bit_has_turned_is_refused(place, bit, whole, tmp_path_factory):
    data = bytearray(whole)
    data[int(place * len(data))] ^= 1 << bit
    reason = refused(tmp_path_factory.getbasetemp(), bytes(data))
    assert any(words in reason for words in ("checksum", "cut off", "header", "schema"))


def test_every_bit_of_the_header_counts(whole, tmp_path):
    for place in range(whole.index(b"\n") + 1):
        for bit in range(8):
            data = bytearray(whole)
            data[place] ^= 1 << bit
            refused(tmp_path, bytes(data))


def test_bytes_after_the_end_are_refused(whole, tmp_path):
    assert "bytes" in refused(tmp_path, whole + b"0")


@pytest.mark.parametrize("schema", [0, checkpoint.SCHEMA + 1, 99])
def test_a_file_of_an_unknown_schema_is_refused(schema, whole, tmp_path):
    assert f"schema {schema}" in refused(
        tmp_path, whole.replace(b"schema %d" % checkpoint.SCHEMA, b"schema %d" % schema, 1)
    )
    file = io.BytesIO()
    torch.save({"schema": schema, "content": {}}, file)
    assert f"schema {schema}" in refused(tmp_path, file.getvalue())


# ------------------------------------------------------------------------------------------------------- old schemas


def test_there_is_a_fixture_of_every_schema_ever_released():
    wanted = [f"schema{number}.pt" for number in range(1, checkpoint.SCHEMA + 1)]
    assert sorted(path.name for path in FIXTURES.iterdir()) == wanted


@pytest.mark.parametrize("schema", range(1, checkpoint.SCHEMA + 1))
def test_a_checkpoint_of_an_older_schema_loads_as_one_of_todays(schema, assert_same_bits):
    content = checkpoint.load(FIXTURES / f"schema{schema}.pt")
    data = (FIXTURES / f"schema{schema}.pt").read_bytes()
    raw = torch.load(io.BytesIO(data[data.index(b"PK") :]), weights_only=True)
    assert raw["schema"] == schema and set(content) >= {"iteration", "learner", "curriculum", "workers", "policies"}
    assert content["learner"].pop("skipped") == 0
    if schema < 3:
        assert content["learner"].pop("average") is None
    raw["content"]["learner"].pop("skipped", None)
    assert_same_bits(content, raw["content"])


# ------------------------------------------------------------------------------------------- falling back, full disks


def test_a_broken_newest_checkpoint_falls_back_with_a_warning_that_names_both(tmp_path, caplog):
    one, two, three = (checkpoint.save(tmp_path, k, {"k": k}, keep=3) for k in (1, 2, 3))
    assert checkpoint.load_newest(tmp_path) == ({"k": 3}, three) and not caplog.records
    three.write_bytes(three.read_bytes()[:-1])
    assert checkpoint.load_newest(tmp_path) == ({"k": 2}, two)
    (warning,) = caplog.messages
    assert str(three) in warning and str(two) in warning and "cut off" in warning and "\n" not in warning
    two.write_bytes(b"")
    assert checkpoint.load_newest(tmp_path) == ({"k": 1}, one)


def test_when_all_are_broken_the_folder_is_named_and_none_is_not_an_error(tmp_path):
    assert checkpoint.load_newest(tmp_path) == (None, None) == checkpoint.load_newest(tmp_path / "missing")
    for k in (1, 2):
        checkpoint.save(tmp_path, k, {}, keep=3).write_bytes(b"PK")
    with pytest.raises(InputError, match=f"^{tmp_path}: none of its 2 checkpoints") as error:
        checkpoint.load_newest(tmp_path)
    assert "\n" not in str(error.value)


def test_a_broken_checkpoint_of_the_future_does_not_push_out_good_ones(tmp_path):
    """After a fallback from 10 to 8, what is saved before 10 comes again must not be taken for older."""
    checkpoint.save(tmp_path, 8, {"k": 8}, keep=1)
    (tmp_path / "00000010.pt").write_bytes(b"")
    checkpoint.save(tmp_path, 9, {"k": 9}, keep=1)
    assert checkpoint.load_newest(tmp_path)[0] == {"k": 9}
    checkpoint.save(tmp_path, 10, {"k": 10}, keep=1)
    assert [path.name for path in checkpoint.paths(tmp_path)] == ["00000010.pt"]


def test_the_newest_of_several_folders_is_taken(tmp_path):
    a, b = tmp_path / "a", tmp_path / "b"
    for k, folder in ((1, a), (2, b), (3, a), (3, b)):
        checkpoint.save(folder, k, {"k": k, "in": folder.name}, keep=9)
    assert checkpoint.load_newest(a, b)[0] == {"k": 3, "in": "b"} and checkpoint.load_newest(b, a)[0]["in"] == "a"


def test_checkpoints_live_behind_a_url_as_in_a_folder(caplog):
    url = "memory://checkpoints/x"
    try:
        for k in range(4):
            path = checkpoint.save(url, k, {"k": k, "a": torch.arange(k)}, keep=2)
        assert path == f"{url}/00000003.pt" and checkpoint.paths(url) == [f"{url}/00000002.pt", path]
        assert torch.equal(checkpoint.load(path)["a"], torch.arange(3))
        folder, name = storage.split(path)
        folder.write(name, folder.read(name)[:-5])
        assert checkpoint.load_newest(url)[1] == f"{url}/00000002.pt" and path in caplog.text
    finally:
        fsspec.filesystem("memory").store.clear()


KILLS = """
import os, random, signal, sys, time
import torch
from learner import checkpoint

torch.set_num_threads(1)  # a child that is forked beside OpenMP's threads waits for them for ever
folder, moments, halves = sys.argv[1], random.Random(0), 0
for kill in range(20):
    last = checkpoint.load_newest(folder)[0]
    begin = last["k"] + 1 if last else 0
    child = os.fork()
    if not child:
        for k in range(begin, 10**6):
            checkpoint.save(folder, k, {"k": k, "a": torch.full((300_000,), k)}, keep=2)
    time.sleep(moments.uniform(0.005, 0.1))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    halves += any(name.endswith(".tmp") for name in os.listdir(folder)) if os.path.isdir(folder) else 0
    paths = checkpoint.paths(folder)
    assert len(paths) <= 3
    for path in paths:
        content = checkpoint.load(path)
        assert int(path.stem) == content["k"] and (content["a"] == content["k"]).all()
    assert not paths or checkpoint.load(paths[-1])["k"] >= begin - 1
print(len(paths), halves)
"""


def test_a_process_killed_at_any_moment_leaves_whole_checkpoints_only(tmp_path):
    """20 kills with SIGKILL, several of them while a file was being written."""
    done = subprocess.run([sys.executable, "-c", KILLS, str(tmp_path / "new")], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    checkpoints, halves = map(int, done.stdout.split())
    assert checkpoints >= 2 and halves >= 1


@pytest.fixture
def small_disk(tmp_path):
    """A disk of 64 KiB."""
    if os.geteuid() or shutil.which("mount") is None:
        pytest.skip("only root may mount a small disk")
    command = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(tmp_path)]
    if subprocess.run(command, capture_output=True).returncode:
        pytest.skip("mounting is not allowed here")
    yield tmp_path
    subprocess.run(["umount", str(tmp_path)], check=True)


def test_a_full_disk_stops_with_one_line_and_the_last_checkpoint_intact(small_disk):
    path = checkpoint.save(small_disk, 1, {"a": torch.arange(1000)}, keep=3)
    with pytest.raises(InputError, match="00000002.pt: cannot be written .*free space") as error:
        checkpoint.save(small_disk, 2, {"a": torch.arange(10_000)}, keep=3)
    assert "\n" not in str(error.value)
    assert os.listdir(small_disk) == [path.name]
    assert torch.equal(checkpoint.load_newest(small_disk)[0]["a"], torch.arange(1000))


class Malicious:
    """Unpickling it would make a folder."""

    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return os.mkdir, (str(self.marker),)


@pytest.mark.parametrize("how", ["whole", "schema 1", "torch", "pickle"])
def test_a_file_that_wants_to_run_code_is_refused_and_runs_none(how, tmp_path):
    path, marker = tmp_path / "00000001.pt", tmp_path / "executed"
    stored = {"schema": 1 if how == "schema 1" else checkpoint.SCHEMA, "content": Malicious(marker)}
    file = io.BytesIO()
    torch.save(stored, file)
    data = pickle.dumps(stored, protocol=2) if how == "pickle" else file.getvalue()
    if how == "whole":
        digest = hashlib.sha256(data).hexdigest()
        data = f"segue checkpoint, schema {checkpoint.SCHEMA}, {len(data)} bytes, sha256 {digest}\n".encode() + data
    path.write_bytes(data)
    with pytest.raises(InputError, match=path.name):
        checkpoint.load(path)
    assert not marker.exists()


def test_the_newest_are_kept_and_no_temporary_file_is_left(tmp_path):
    for iteration in (1, 2, 10, 9_999_999):
        (tmp_path / "00000005.pt.tmp").write_bytes(b"of a process that was killed")
        checkpoint.save(tmp_path, iteration, {"iteration": iteration}, keep=2)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["00000010.pt", "09999999.pt"]


def test_other_files_in_the_folder_are_no_checkpoints(tmp_path):
    for name in ("best.pt", "123.pt", "000000010.pt"):
        (tmp_path / name).write_bytes(b"")
    path = checkpoint.save(tmp_path, 4, {}, keep=1)
    assert checkpoint.paths(tmp_path) == [path]
