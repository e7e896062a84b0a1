"""A disk that is full, for tests that may not mount one."""

import contextlib
import resource


@contextlib.contextmanager
def largest_file(size):
    """No file can grow beyond `size` bytes meanwhile: as on a full disk a write takes a part, the next fails."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
