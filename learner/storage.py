"""Folders of files on this machine or behind a URL, in which a file is there as a whole or not at all.

URLs go through `pyarrow.fs`, because its wheel, which Ray Tune needs anyway, holds the clients of S3, Google Cloud
Storage, Azure and HDFS; fsspec would need another package for each. A scheme that pyarrow does not know is asked of
fsspec. Credentials come from the environment, as each client documents it (AWS_ACCESS_KEY_ID, ...).
"""

import contextlib
import errno
import functools
import os
import re
from pathlib import Path
from urllib.parse import unquote, urlsplit

from motion.errors import InputError

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
# pyarrow's names of file systems where an object appears when its upload is complete: no other name is needed
_ATOMIC = ("s3", "gcs", "abfs")


def cannot_write(path, error):
    """The InputError that stands for an error of the file system while `path` was being written."""
    if getattr(error, "errno", None) in _FULL:
        remedy = "free space there"
    else:
        remedy = "see that it can be reached and written" if is_url(path) else "make it writable"
    return InputError(
        f"{path}: cannot be written ({_reason(error)}); what was written before is intact: {remedy}, "
        "then repeat the command to continue"
    )


def sync_folder(path):
    """Make the names in a folder of this machine survive a power cut."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def replace_file(path, data):
    """Give `path` (on this machine) the content `data` (bytes), or on an error leave it and its folder as they were.

    Temporary file, fsync, rename, fsync of the folder: a power cut leaves the old content or the new. InputError if
    the disk is full or refuses.
    """
    path = Path(path)
    temporary = path.with_name(path.name + ".tmp")
    try:
        with open(temporary, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
        sync_folder(path.parent)
    except BaseException as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError):
            raise cannot_write(path, error) from error
        raise


class LocalFolder:
    """A folder of this machine."""

    def __init__(self, path):
        self._path = Path(path)

    def __str__(self):
        return str(self._path)

    def path(self, name):
        """What names a file to a person, and to `split`."""
        return self._path / name

    def names(self):
        """Names of the files, sorted; none if there is no such folder."""
        return sorted(entry.name for entry in self._path.iterdir()) if self._path.is_dir() else []

    def read(self, name):
        """A file's bytes; OSError if it cannot be read."""
        return self.path(name).read_bytes()

    def write(self, name, data):
        """Write a file at once or not at all, the folder being made; InputError if that fails."""
        try:
            if not self._path.is_dir():
                self._path.mkdir(parents=True)
                sync_folder(self._path.parent)
        except OSError as error:
            raise cannot_write(self._path, error) from error
        replace_file(self.path(name), data)

    def remove(self, name):
        """Remove a file, if the file system lets us."""
        with contextlib.suppress(OSError):
            self.path(name).unlink()


class RemoteFolder:
    """A folder (or prefix) behind a URL. The same methods; `path` gives URLs."""

    def __init__(self, url):
        self._url = url
        self._files, self._root = _file_system(url)

    def __str__(self):
        return self._url

    def path(self, name):
        """A file's URL."""
        return join(self._url, name)

    def names(self):
        """Names of the files, sorted; InputError if the storage does not answer."""
        from pyarrow import fs

        try:
            found = self._files.get_file_info(fs.FileSelector(self._root, allow_not_found=True))
        except _errors() as error:
            raise InputError(f"{self._url}: cannot be listed ({_reason(error)}); check checkpoint.storage") from error
        return sorted(info.base_name for info in found if info.type == fs.FileType.File)

    def read(self, name):
        """A file's bytes; OSError if it cannot be read."""
        with self._files.open_input_stream(f"{self._root}/{name}") as file:
            return file.read()

    def write(self, name, data):
        """Write a file at once or not at all; InputError if that fails."""
        path = f"{self._root}/{name}"
        atomic = self._files.type_name in _ATOMIC
        temporary = path if atomic else f"{path}.tmp"
        try:
            if not atomic:
                self._files.create_dir(self._root, recursive=True)
            with self._files.open_output_stream(temporary) as file:
                file.write(data)
            if not atomic:
                self._files.move(temporary, path)
        except _errors() as error:
            # best effort: where it fails too, a reader's checksum tells half a file from a whole one
            with contextlib.suppress(*_errors()):
                self._files.delete_file(temporary)
            raise cannot_write(self.path(name), error) from error

    def remove(self, name):
        """Remove a file, if the storage lets us."""
        with contextlib.suppress(*_errors()):
            self._files.delete_file(f"{self._root}/{name}")


def is_url(where):
    """Whether a path or URL is a URL: file:/..., s3://..."""
    return isinstance(where, str) and re.match(r"[a-z][a-z0-9+.-]*:/", where) is not None


def folder(where):
    """The folder at a path or URL (file: is this machine). InputError for a URL that cannot be used."""
    if not is_url(where):
        return LocalFolder(where)
    url = urlsplit(where)
    if url.scheme != "file":
        return RemoteFolder(where)
    if url.netloc not in ("", "localhost"):
        raise InputError(f"checkpoint.storage={where}: names a machine; use file:///PATH for a folder of this one")
    return LocalFolder(unquote(url.path))


def split(path):
    """(folder, name) of what a folder's `path` gave."""
    if not is_url(path):
        return LocalFolder(Path(path).parent), Path(path).name
    url, mark, query = path.partition("?")
    parent, _, name = url.rpartition("/")
    return folder(parent + mark + query), name


def join(where, *names):
    """A path or URL with names appended to its path."""
    if not is_url(where):
        return Path(where).joinpath(*names)
    url, mark, query = where.partition("?")
    return "/".join([url.rstrip("/"), *names]) + mark + query


@functools.lru_cache(maxsize=16)  # a new client may ask the network where the bucket is
def _file_system(url):
    """(pyarrow file system, path in it) of a URL."""
    from pyarrow import fs

    try:
        try:
            files, path = fs.FileSystem.from_uri(url)
        except ValueError:  # a scheme that pyarrow does not know
            import fsspec

            inner, path = fsspec.url_to_fs(url)
            files = fs.PyFileSystem(fs.FSSpecHandler(inner))
    except (*_errors(), ImportError) as error:
        raise InputError(f"checkpoint.storage={url}: cannot be used ({_reason(error)})") from error
    return files, path.rstrip("/")


def _errors():
    import pyarrow

    return OSError, ValueError, NotImplementedError, pyarrow.ArrowException


def _reason(error):
    """An exception as a few words on one line."""
    text = getattr(error, "strerror", None) or str(error).strip() or type(error).__name__
    return text.splitlines()[0]
