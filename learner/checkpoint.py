"""Checkpoints: plain tensors and plain data in one file, written so that a crash never leaves half of one.

A file is a line of text and a payload:

    segue checkpoint, schema 4, 79214 bytes, sha256 3f0c...
    (torch.save of {"schema": 4, "content": ...}: tensors, numbers, strings, lists, dicts)

so that a file that was cut off, or in which a bit has turned, is known as such before anything is made of it. Files of
schema 1 are the payload alone. What each schema changed in the content stands at `_UPGRADES`.
"""

import hashlib
import io
import logging
import re

import numpy as np
import torch

from learner import storage
from motion.errors import InputError

SCHEMA = 4

_HEADER = re.compile(rb"segue checkpoint, schema (\d+), (\d+) bytes, sha256 ([0-9a-f]{64})\n")
_NAME = re.compile(r"\d{8}\.pt")


def save(folder, iteration, content, keep):
    """Write `content` (nested dicts and lists of numbers, strings, arrays) as checkpoint `iteration` of a folder.

    folder: a path or a URL (`learner.storage`). Whole or not at all, and on the disk when this returns. Of the
    checkpoints up to this one the newest `keep` stay. Returns the path (or URL). InputError if it cannot be written,
    with those before it intact.
    """
    folder = storage.folder(folder)
    name = f"{iteration:08d}.pt"
    folder.write(name, encode(content))
    names = folder.names()
    # one of a later iteration stays: it is either broken, or of a future that will be computed again
    old = [other for other in names if _NAME.fullmatch(other) and other <= name][:-keep]
    for other in old + [other for other in names if re.fullmatch(r"\d{8}(\.pt)?\.tmp", other)]:
        folder.remove(other)
    return folder.path(name)


def encode(content):
    """The bytes of a checkpoint's file; `content` as in `save`."""
    payload = io.BytesIO()
    torch.save({"schema": SCHEMA, "content": _plain(content)}, payload)
    payload = payload.getvalue()
    digest = hashlib.sha256(payload).hexdigest()
    return f"segue checkpoint, schema {SCHEMA}, {len(payload)} bytes, sha256 {digest}\n".encode() + payload


def paths(folder):
    """The checkpoints of a folder (paths or URLs), oldest first."""
    folder = storage.folder(folder)
    return [folder.path(name) for name in folder.names() if _NAME.fullmatch(name)]


def load(path):
    """The content of a checkpoint in today's schema, arrays as tensors. Runs no code from the file.

    InputError, with the reason, if it is broken or of a schema that this version does not know.
    """
    try:
        folder, name = storage.split(path)
        stored = _stored(folder.read(name))
        schema, content = stored["schema"], stored["content"]
    except Exception as error:
        reason = str(error) if isinstance(error, _Broken) else type(error).__name__
        raise InputError(f"{path}: not a readable checkpoint ({reason})") from error
    for older in range(schema, SCHEMA):
        _UPGRADES[older](content)
    return content


def load_newest(*folders):
    """(content, path) of the newest checkpoint in any of the folders that can be read; (None, None) if there is none.

    Of two from the same iteration, that of the later folder. One that is broken is passed over with a warning that
    names it and the one that is used instead. InputError if none of them can be read.
    """
    found = sorted(
        ((storage.split(path)[1], order, path) for order, folder in enumerate(folders) for path in paths(folder)),
        key=lambda item: item[:2],
    )
    broken = []
    for _, _, path in reversed(found):
        try:
            content = load(path)
        except InputError as error:
            broken.append(error)
            continue
        for error in broken:
            logging.getLogger(__name__).warning("%s; continuing from %s", error, path)
        return content, path
    if broken:
        raise InputError(
            f"{folders[-1]}: none of its {len(broken)} checkpoints can be read (the newest: {broken[0]}); "
            "put a copy of one there, or delete the run's folder to start again"
        )
    return None, None


class _Broken(Exception):
    """Why a file is no checkpoint, in a few words."""


def _stored(data):
    """What was stored in a file's bytes; raises if they are not what was written, or would run code."""
    if data.startswith(b"PK"):  # a zip archive: torch's own format, schema 1
        stored = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
        if stored["schema"] != 1:
            raise _Broken(f"no header, yet schema {stored['schema']}")
        return stored
    header = _HEADER.match(data[:200])
    if header is None:
        raise _Broken("empty" if not data else "no checkpoint's header")
    schema, size, digest = int(header[1]), int(header[2]), header[3].decode()
    payload = data[header.end() :]
    if len(payload) != size:
        raise _Broken(f"cut off: {len(payload)} of {size} bytes")
    if hashlib.sha256(payload).hexdigest() != digest:
        raise _Broken("wrong checksum: its bytes have changed since it was written")
    if schema not in (SCHEMA, *_UPGRADES):
        raise _Broken(f"schema {schema}; this version reads up to {SCHEMA}")
    stored = torch.load(io.BytesIO(payload), map_location="cpu", weights_only=True)
    if stored["schema"] != schema:
        raise _Broken(f"its header says schema {schema}, its content {stored['schema']}")
    return stored


def _from_schema_1(content):
    """Schema 2 counts the updates that were skipped in a row, and names the configuration (absent here)."""
    if "learner" in content:
        content["learner"]["skipped"] = 0


def _from_schema_2(content):
    """Schema 3 may hold averaged weights, and a tally of failed tasks (both absent here)."""
    if "learner" in content:
        content["learner"]["average"] = None


def _from_schema_3(content):
    """Schema 4 may hold thresholds of every group, the curriculum's tracks and `sigma_factor` (all absent here)."""


# schema -> what turns its content, in place, into that of the next one
_UPGRADES = {1: _from_schema_1, 2: _from_schema_2, 3: _from_schema_3}


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
