"""Checkpoints: plain tensors and plain data in one file, written so that a crash never leaves half of one."""

import os
import re
from pathlib import Path

import numpy as np
import torch

from motion.errors import InputError

SCHEMA = 1


def save(folder, iteration, content, keep):
    """Write `content` (nested dicts and lists of numbers, strings, arrays) as checkpoint `iteration` of a folder.

    Atomic: temporary file, fsync, rename. The newest `keep` checkpoints stay. Returns the path.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{iteration:08d}.pt"
    temporary = path.with_suffix(".tmp")
    with open(temporary, "wb") as file:
        torch.save({"schema": SCHEMA, "content": _plain(content)}, file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)
    for old in sorted(paths(folder))[:-keep]:
        old.unlink()
    return path


def paths(folder):
    """The checkpoints of a folder, oldest first."""
    return sorted(p for p in Path(folder).glob("*.pt") if re.fullmatch(r"\d{8}", p.stem))


def load(path):
    """The content of a checkpoint, arrays as tensors. Runs no code from the file. InputError if it is broken."""
    try:
        stored = torch.load(path, map_location="cpu", weights_only=True)
        if stored["schema"] != SCHEMA:
            raise InputError(f"{path}: checkpoint schema {stored['schema']}; this version reads {SCHEMA}")
        return stored["content"]
    except InputError:
        raise
    except Exception as error:
        raise InputError(
            f"{path}: not a readable checkpoint ({type(error).__name__}); delete it to continue from the one before"
        ) from error


def _plain(value):
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return torch.from_numpy(np.array(value))  # a copy: what Ray hands out is read-only
    if isinstance(value, np.generic):
        return value.item()
    return value
