"""Missing, empty, unreadable or other files: refused on one line that names the file."""

import numpy as np
import pytest

from tests.motion.formats.files import poselib, refusal, save


@pytest.mark.parametrize("suffix", [".npy", ".txt", ".npz"])
def test_a_missing_file_is_named_with_its_nearest_neighbours(tmp_path, suffix):
    for name in ("Atk_Stab", "Atk_Slash", "Atk_Stub", "Atk_Staff", "Zzzzz"):
        (tmp_path / f"{name}{suffix}").touch()
    message = refusal(tmp_path / f"Atk_Stb{suffix}")
    assert "no such file; did you mean" in message
    assert f"Atk_Stab{suffix}" in message
    assert message.count(suffix) == 4  # the file and three others
    assert "Zzzzz" not in message


def test_a_missing_folder_is_named(tmp_path):
    assert f"no folder {tmp_path / 'nowhere'}" in refusal(tmp_path / "nowhere/a.npy")


@pytest.mark.parametrize("suffix", [".npy", ".txt", ".npz"])
def test_an_empty_file_is_refused(tmp_path, suffix):
    (tmp_path / f"a{suffix}").touch()
    assert "is empty" in refusal(tmp_path / f"a{suffix}")


@pytest.mark.parametrize("name", ["a.npy", "folder"])
def test_a_folder_is_refused(tmp_path, name):
    (tmp_path / name).mkdir()
    assert "is a folder" in refusal(tmp_path / name)


def test_another_kind_of_file_is_refused(tmp_path):
    (tmp_path / "a.bvh").write_text("HIERARCHY")
    assert ".npy, .txt, .npz" in refusal(tmp_path / "a.bvh")


def test_a_file_without_permission_is_refused(tmp_path, monkeypatch):
    path = save(tmp_path / "a.npy", poselib())

    def locked(*_, **__):  # a file's mode does not stop root, who may run the tests
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr("builtins.open", locked)
    assert "permissions" in refusal(path)


@pytest.mark.parametrize("suffix", [".npy", ".txt", ".npz"])
def test_noise_is_refused(tmp_path, suffix):
    (tmp_path / f"a{suffix}").write_bytes(np.random.default_rng(0).bytes(4096))
    refusal(tmp_path / f"a{suffix}")
