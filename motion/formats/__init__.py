"""Readers of clip files, one module a format, and `read_clip`, which picks the one for a file."""

import difflib
from pathlib import Path

from motion.errors import InputError
from motion.formats import deepmimic, npz, reallusion

_READERS = {".npy": reallusion.read, ".txt": deepmimic.read, ".npz": npz.read}


def read_clip(path, name=None, looping=None):
    """The clip in the file `path`: poselib's .npy, DeepMimic's .txt or the project's .npz.

    name: the clip's, by default the file's without its suffix. looping: overrides what the file says; a clip that loops
    gets its ends joined (`poses.close_cycle`). Raises InputError, one line with the file and the remedy, for every file
    that is not a sound clip.
    """
    path = Path(path)
    reader = _READERS.get(path.suffix.lower())
    if path.is_dir():
        raise InputError(f"{path}: is a folder; give a clip file in it")
    if reader is None:
        raise InputError(f"{path}: files of this kind are not read; give one of {', '.join(_READERS)}")
    try:
        if path.stat().st_size == 0:
            raise InputError(f"{path}: is empty; copy or export it again")
        return reader(path, name, looping)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file{_similar(path)}") from error
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"{path}: cannot be read ({reason}); check the path and its permissions") from error


def _similar(path):
    """A remedy: up to three clips of nearly that name in the same folder."""
    if not path.parent.is_dir():
        return f", and no folder {path.parent}; check the path"
    clips = [entry.name for entry in path.parent.iterdir() if entry.suffix.lower() in _READERS]
    close = difflib.get_close_matches(path.name, sorted(clips), n=3, cutoff=0.4)
    return f"; did you mean {', '.join(close)}?" if close else "; its folder holds no clip of a similar name"
