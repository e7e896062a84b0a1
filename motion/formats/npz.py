"""The project's own clip file, `.npz`: arrays only, never a pickle.

| field | content |
|---|---|
| format_version | 1 |
| joint_names | (13,) names, in the order of `joints` |
| fps | frames per second |
| looping | whether the last frame is the first one again |
| root_position | (T, 3) m, z up |
| root_quaternion | (T, 4) wxyz |
| joints | (T, 31) exponential maps of spherical joints, angles of hinges, rad |
"""

import os
from pathlib import Path

import numpy as np

from motion import skeleton
from motion.errors import InputError
from motion.formats.poses import make_clip

FORMAT_VERSION = 1

_SHAPES = {"root_position": 3, "root_quaternion": 4, "joints": skeleton.NUM_DOF}


def write(clip, path):
    """Writes the clip, so that a reader sees the whole file or none. Raises InputError where it cannot be written."""
    path = Path(path)
    if path.suffix != ".npz":
        raise InputError(f"{path}: a clip is written as a .npz file; give a name that ends so")
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with open(partial, "wb") as file:
            np.savez(
                file,
                format_version=FORMAT_VERSION,
                joint_names=np.array(skeleton.JOINT_NAMES),
                fps=clip.fps,
                looping=clip.looping,
                root_position=clip.qpos[:, :3],
                root_quaternion=clip.qpos[:, 3:7],
                joints=clip.joints,
            )
        os.replace(partial, path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); give a folder that exists") from error
    finally:
        partial.unlink(missing_ok=True)


def read(path, name=None, looping=None):
    """The clip in `path`; `looping` None takes the file's. Raises InputError (naming the file) for anything else."""
    data = _load(path)
    missing = [field for field in ("format_version", "joint_names", "fps", "looping", *_SHAPES) if field not in data]
    if missing:
        raise InputError(f"{path}: field '{missing[0]}' is missing: not a clip that this program wrote")
    version = data["format_version"]
    if version.shape != () or version != FORMAT_VERSION:
        raise InputError(f"{path}: has format version {version}, this program reads {FORMAT_VERSION}; write it again")
    names = [str(joint) for joint in np.atleast_1d(data["joint_names"])]
    if names != list(skeleton.JOINT_NAMES):
        both = zip(names, skeleton.JOINT_NAMES, strict=False)
        first = next((f"{own!r}, not {ours!r}" for own, ours in both if own != ours), f"{len(names)} joints, not 13")
        raise InputError(f"{path}: is of another skeleton ({first}); retarget the clip")
    for field in ("fps", "looping"):
        if data[field].shape != () or data[field].dtype.kind not in "fiub":
            raise InputError(f"{path}: '{field}' is not one number; write the clip again")
    for field, width in _SHAPES.items():
        array = data[field]
        if array.dtype.kind != "f" or array.shape != (len(data["joints"]), width):
            found = f"{array.dtype} {array.shape}"
            raise InputError(f"{path}: '{field}' is {found}, not floats (T, {width}); write the clip again")
    qpos = skeleton.assemble_qpos(data["root_position"], data["root_quaternion"], data["joints"])
    looping = bool(data["looping"]) if looping is None else looping
    return make_clip(path, name, qpos, float(data["fps"]), looping)


def _load(path):
    try:
        # opened here, because numpy leaves a damaged file open
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as fields:
            return {field: fields[field] for field in fields.files}
    except OSError:
        raise
    except Exception as error:  # zipfile, zlib, numpy and struct each have their own errors for a damaged file
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:120]
        raise InputError(f"{path}: is not a readable npz file ({reason}); write it again") from error
