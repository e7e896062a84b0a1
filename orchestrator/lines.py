"""A file of lines that is only ever appended to, and never left with part of a line by an error."""

import contextlib
import os

from learner.storage import cannot_write


class LineFile:
    """Appends lines to a file. InputError if the disk is full; the file then ends with the line before."""

    def __init__(self, path):
        self._path = path
        self._file = open(path, "ab", buffering=0)  # with a buffer, closing would try a failed write again

    def write(self, text):
        """Append whole lines (str) and hand them to the operating system."""
        end, data = os.fstat(self._file.fileno()).st_size, text.encode()
        try:
            while data:  # the last bytes of a full disk take part of a line without an error
                data = data[self._file.write(data) :]
        except OSError as error:
            with contextlib.suppress(OSError):
                os.ftruncate(self._file.fileno(), end)
            raise cannot_write(self._path, error) from error

    def sync(self):
        """Make all lines so far survive a power cut. InputError if that fails."""
        try:
            os.fsync(self._file.fileno())
        except OSError as error:
            raise cannot_write(self._path, error) from error

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._file.close()
