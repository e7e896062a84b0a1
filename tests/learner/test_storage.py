"""Files are there as a whole or not at all, on this machine and behind URLs."""

import errno
import os

import fsspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from learner import storage
from motion.errors import InputError


def full(*_, **__):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.fixture
def memory():
    """URL of a folder in fsspec's file system in memory."""
    yield "memory://bucket/runs"
    fsspec.filesystem("memory").store.clear()


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_an_error_while_writing_leaves_the_old_file_and_no_other(call, tmp_path, monkeypatch):
    path = tmp_path / "a.pt"
    storage.replace_file(path, b"old")
    monkeypatch.setattr(os, call, full)
    with pytest.raises(InputError, match="free space") as error:
        storage.replace_file(path, b"new")
    assert str(path) in str(error.value) and "\n" not in str(error.value)
    assert path.read_bytes() == b"old" and os.listdir(tmp_path) == ["a.pt"]


def test_a_file_is_on_the_disk_before_its_name_and_its_name_before_the_call_returns(tmp_path, monkeypatch):
    """What a power cut may leave is decided by this order: content, rename, folder."""
    done = []
    fsync, replace = os.fsync, os.replace

    def spied_fsync(descriptor):
        done.append(("fsync", os.readlink(f"/proc/self/fd/{descriptor}")))
        fsync(descriptor)

    def spied_replace(old, new):
        done.append(("replace", str(new)))
        replace(old, new)

    monkeypatch.setattr(os, "fsync", spied_fsync)
    monkeypatch.setattr(os, "replace", spied_replace)
    storage.LocalFolder(tmp_path / "new").write("a.pt", b"content")
    file, folder = str(tmp_path / "new" / "a.pt"), str(tmp_path / "new")
    assert done == [("fsync", str(tmp_path)), ("fsync", file + ".tmp"), ("replace", file), ("fsync", folder)]


def test_an_interrupt_leaves_no_temporary_file(tmp_path, monkeypatch):
    def interrupt(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupt)
    with pytest.raises(KeyboardInterrupt):
        storage.replace_file(tmp_path / "a.pt", b"new")
    assert os.listdir(tmp_path) == []


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(InputError, match="file/sub"):
        storage.LocalFolder(tmp_path / "file" / "sub").write("a.pt", b"")


@pytest.mark.parametrize("kind", ["path", "file", "memory", "mock"])
def test_a_folder_holds_what_was_written(kind, tmp_path, memory):
    """The same on a path, a file: URL, an fsspec file system, and one of pyarrow's own."""
    urls = {"file": f"file://{tmp_path}/a%20b", "memory": memory, "mock": "mock:///runs"}
    folder = storage.folder(urls.get(kind, tmp_path / "a b"))
    assert folder.names() == []
    for name, data in (("b", b"1"), ("a", b""), ("b", b"\x00\xff")):
        folder.write(name, data)
    assert folder.names() == ["a", "b"] and folder.read("b") == b"\x00\xff" and folder.read("a") == b""
    other, name = storage.split(folder.path("b"))
    assert (str(other), name) == (str(folder), "b") and other.read(name) == b"\x00\xff"
    folder.remove("b")
    folder.remove("b")
    assert folder.names() == ["a"]
    assert not (tmp_path / "a b").exists() or kind in ("path", "file")


@pytest.mark.parametrize("call", ["open_output_stream", "move"])
def test_an_error_of_a_remote_storage_leaves_the_old_file_and_no_other(call, memory, monkeypatch):
    from pyarrow.fs import FSSpecHandler

    folder = storage.folder(memory)
    folder.write("a", b"old")
    with monkeypatch.context() as patch:
        patch.setattr(FSSpecHandler, call, full)
        with pytest.raises(InputError, match="memory://bucket/runs/a: cannot be written"):
            folder.write("a", b"new")
    assert folder.names() == ["a"] and folder.read("a") == b"old"


@pytest.mark.parametrize("url", ["nonsense://bucket/x", "file://machine/x"])
def test_a_url_that_cannot_be_used_is_refused_in_one_line(url):
    with pytest.raises(InputError, match=url) as error:
        storage.folder(url)
    assert "\n" not in str(error.value)


@given(st.lists(st.text("ab0_.=-", min_size=1).map(lambda text: "x" + text), min_size=1, max_size=3))
def test_joining_appends_to_the_path_alone(names):
    joined = storage.join("s3://bucket/x/?region=here", *names)
    assert joined == "s3://bucket/x/" + "/".join(names) + "?region=here"
    assert str(storage.join("/a/b", *names)) == "/a/b/" + "/".join(names)


def test_a_relative_path_with_a_colon_is_no_url(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for where in ("lr:3", "runs/a:b"):
        storage.folder(where).write("a", b"1")
        assert (tmp_path / where / "a").read_bytes() == b"1"
