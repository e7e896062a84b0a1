"""Pickled arrays that hold no clip, are damaged or would run a program: refused, and never executed."""

import os
import pickle
from collections import OrderedDict

import numpy as np
import pytest

from motion.errors import InputError
from motion.formats import read_clip
from tests.motion.formats.files import poselib, refusal, save, save_pickle


@pytest.mark.parametrize("content", [[1, 2], "text", None])
def test_another_pickled_object_is_refused(tmp_path, content):
    refusal(save(tmp_path / "a.npy", content))


def test_a_plain_array_is_refused(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((5, 47)))
    assert "(5, 47)" in refusal(tmp_path / "a.npy")


@pytest.mark.parametrize("share", [0.0001, 0.01, 0.05, 0.5, 0.9, 0.999])
def test_a_truncated_pickle_is_refused(tmp_path, share):
    path = save(tmp_path / "a.npy", poselib())
    content = path.read_bytes()
    path.write_bytes(content[: max(1, int(len(content) * share))])
    refusal(path)


def test_a_damaged_pickle_is_refused_or_read_but_never_fails_otherwise(tmp_path):
    path = save(tmp_path / "a.npy", poselib(3))
    content = bytearray(path.read_bytes())
    generator = np.random.default_rng(0)
    for _ in range(150):
        spoiled = content.copy()
        for place in generator.integers(128, 700, 3):
            spoiled[place] = generator.integers(256)
        path.write_bytes(spoiled)
        try:
            read_clip(path)
        except InputError as error:
            assert "\n" not in str(error)


class Call:
    """Pickles as the call of `function` with `arguments`."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("protocol", range(5))
def test_a_program_in_a_pickle_is_refused_and_not_run(tmp_path, protocol):
    victim = tmp_path / "victim"
    program = pickle.dumps(Call(os.system, f"touch {victim}"), protocol)
    assert "system" in refusal(save_pickle(tmp_path / "a.npy", program))
    assert not victim.exists()


def test_a_program_deep_inside_a_sound_clip_is_refused_and_not_run(tmp_path):
    victim = tmp_path / "victim"
    data = poselib()
    data["rotation"]["context"]["dtype"] = Call(eval, f"open({str(victim)!r}, 'w')")
    assert "eval" in refusal(save(tmp_path / "a.npy", data))
    assert not victim.exists()


@pytest.mark.parametrize(
    "function",
    [getattr, __import__, np.load, np.frombuffer, np.array, pickle.loads, OrderedDict.fromkeys],
)
def test_only_the_few_names_of_a_clip_are_allowed(tmp_path, function):
    assert "refused without running it" in refusal(save(tmp_path / "a.npy", Call(function, "x")))


def test_an_object_array_made_of_raw_bytes_is_not_turned_into_pointers(tmp_path):
    # numpy's own dtype takes these flags, and then the array's bytes for addresses: the process crashes or worse
    program = (
        b"\x80\x02cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85C\x01b\x87R"
        b"(K\x01K\x01\x85cnumpy\ndtype\nX\x02\x00\x00\x00O8\x89\x88\x87R"
        b"(K\x03X\x01\x00\x00\x00|NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb\x89C\x08AAAAAAAAtb."
    )
    refusal(save_pickle(tmp_path / "a.npy", program))
