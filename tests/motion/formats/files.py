"""Clip files to test with: sound ones of every kind, to be damaged, and how a bad one has to be refused."""

import json
from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from motion import rotations, skeleton
from motion.errors import InputError
from motion.formats import read_clip


def refusal(path, **options):
    """The message with which the file is refused: one line that names the file."""
    with pytest.raises(InputError) as caught:
        read_clip(path, **options)
    message = str(caught.value)
    assert Path(path).name in message
    assert "\n" not in message
    return message


def poselib(frames=6):
    """A SkeletonMotion's dictionary: every joint moves, elbows and knees about y."""
    generator = np.random.default_rng(0)
    vector = generator.uniform(-1, 1, (1, 17, 3)) * np.linspace(0, 1, frames)[:, None, None]
    for name in ("sword", "shield", "left_hand"):
        vector[:, skeleton.BODY_INDEX[name]] = 0
    for joint in skeleton.JOINTS:
        if joint.dof == 1:
            vector[:, joint.body, [0, 2]] = 0
    local = skeleton.OFFSETS.astype(np.float32)
    local[0] = [0, 0, 1]
    return OrderedDict(
        rotation=tensor(Rotation.from_rotvec(vector.reshape(-1, 3)).as_quat().reshape(frames, 17, 4)),
        root_translation=tensor(np.linspace([0, 0, 0.9], [0.3, 0.1, 0.8], frames)),
        skeleton_tree=OrderedDict(
            node_names=list(skeleton.BODY_NAMES),
            parent_indices=tensor(skeleton.PARENTS.copy()),
            local_translation=tensor(local),
        ),
        is_local=True,
        fps=np.float64(30),
    )


def tensor(array):
    return {"arr": array, "context": {"dtype": array.dtype.name}}


def save(path, content):
    array = np.empty((), dtype=object)
    array[()] = content
    np.save(path, array, allow_pickle=True)
    return path


def save_pickle(path, program):
    """A npy object array whose pickle is `program`."""
    with open(path, "wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "|O", "fortran_order": False, "shape": ()})
        file.write(program)
    return path


def deepmimic(frames=8):
    """A motion's dictionary: a straight figure that walks one metre ahead."""
    rows = np.zeros((frames, 44))
    rows[:, 0] = 1 / 30
    rows[:, 1] = np.linspace(0, 1, frames)
    rows[:, 2] = 0.88
    for start in (4, 8, 12, 16, 21, 25, 30, 35, 39):
        rows[:, start] = 1
    rows[-1, 0] = 0
    return {"Loop": "wrap", "Frames": rows.tolist()}


def save_json(path, data):
    path.write_text(json.dumps(data))
    return path


def almost_cyclic(gap, turn=0.0):
    """Poses (31, 47) at 30 frames/s whose joints end `gap` rad away from where they began."""
    phase = np.linspace(0, 1, 31)[:, None]
    joints = 0.3 * np.sin(2 * np.pi * phase + np.arange(31)) + gap / np.sqrt(3) * phase**3
    quaternion = rotations.about_z(turn * phase[:, 0])
    return skeleton.assemble_qpos(np.concatenate([phase, 0.1 * phase, 0.9 + 0.02 * phase], 1), quaternion, joints)


def change(data, *keys, value):
    for key in keys[:-1]:
        data = data[key]
    data[keys[-1]] = value


def places(data):
    """World positions (T, 17, 3) straight from the dictionary, with scipy."""
    rotation, tree = data["rotation"]["arr"], data["skeleton_tree"]
    position, turned = [data["root_translation"]["arr"]], [Rotation.from_quat(rotation[:, 0])]
    for i in range(1, 17):
        parent = tree["parent_indices"]["arr"][i]
        position.append(position[parent] + turned[parent].apply(tree["local_translation"]["arr"][i]))
        turned.append(turned[parent] * Rotation.from_quat(rotation[:, i]))
    return np.stack(position, axis=1)
