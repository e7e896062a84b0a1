"""Reader of DeepMimic's motions: JSON with `Loop` ("wrap" or "none") and `Frames`, rows of 44 numbers.

A row: duration (s), root position (3, m), root quaternion (wxyz), then chest, neck, right hip, right knee (1), right
ankle, right shoulder, right elbow (1), left hip, left knee (1), left ankle, left shoulder, left elbow (1); quaternions
where no width is given. DeepMimic's y is up and its z points right, so that (x, y, z) is (x, -z, y) here, for positions
and for the vector parts of quaternions. Its hinges turn about its z, which is our -y. Limbs are as long as here.
"""

import json

import numpy as np

from motion import rotations, skeleton
from motion.errors import InputError
from motion.formats.poses import make_clip

COLUMNS = 44
RATE_TOLERANCE = 0.01  # of the frame's duration

_JOINTS = (
    "abdomen", "neck", "right_hip", "right_knee", "right_ankle", "right_shoulder", "right_elbow",
    "left_hip", "left_knee", "left_ankle", "left_shoulder", "left_elbow",
)  # fmt: skip


def read(path, name=None, looping=None):
    """The clip in `path`; `looping` None takes the file's `Loop`. The right hand, which DeepMimic lacks, is straight.

    Raises InputError (naming the file) for other JSON, other columns, and frame times that are not even.
    """
    frames, wrap = _load(path)
    # the last frame is no interval: its duration is 0 or repeats the others'
    durations = frames[:-1, 0] if len(frames) > 1 else frames[:, 0]
    duration = float(np.median(durations))
    if not duration > 0:
        raise InputError(f"{path}: frame durations are {duration} s; they must be positive")
    if np.any(np.abs(durations - duration) > RATE_TOLERANCE * duration):
        frame = int(np.argmax(np.abs(durations - duration) > RATE_TOLERANCE * duration))
        raise InputError(
            f"{path}: frame {frame} lasts {durations[frame]} s and others {duration} s; resample the clip evenly"
        )
    looping = wrap if looping is None else looping
    # DeepMimic moves a cycle by its displacement and never turns it
    return make_clip(path, name, _poses(frames), 1 / duration, looping, turning=False)


def _poses(frames):
    """qpos (T, 47) of rows (T, 44)."""
    qpos = np.empty((len(frames), skeleton.NQ))
    qpos[:, :3] = frames[:, [1, 3, 2]] * [1, -1, 1]
    qpos[:, 3:7] = _quaternion(frames[:, 4:8])
    hand = 7 + skeleton.JOINT_QPOS[skeleton.JOINT_INDEX["right_hand"]]
    qpos[:, hand : hand + 4] = rotations.IDENTITY
    column = 8
    for name in _JOINTS:
        joint = skeleton.JOINT_INDEX[name]
        start = 7 + skeleton.JOINT_QPOS[joint]
        if skeleton.JOINTS[joint].dof == 3:
            qpos[:, start : start + 4] = _quaternion(frames[:, column : column + 4])
            column += 4
        else:
            qpos[:, start] = -frames[:, column]
            column += 1
    return qpos


def _quaternion(wxyz):
    return wxyz[:, [0, 1, 3, 2]] * [1, 1, -1, 1]


def _load(path):
    """Rows (T, 44) and whether the file says that the motion loops."""
    try:
        with open(path, encoding="utf-8") as file:
            data = json.load(file)
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not text; give a DeepMimic motion (JSON)") from error
    except (json.JSONDecodeError, RecursionError) as error:
        raise InputError(f"{path}: is not valid JSON ({error}); give a DeepMimic motion") from error
    if not isinstance(data, dict) or not isinstance(data.get("Frames"), list):
        raise InputError(f"{path}: has no list 'Frames': not a DeepMimic motion")
    loop = data.get("Loop", "none")
    if loop not in ("wrap", "none"):
        raise InputError(f"{path}: 'Loop' is {loop!r}; it must be 'wrap' or 'none'")
    if not data["Frames"]:
        raise InputError(f"{path}: 'Frames' is empty; velocities need at least two frames")
    try:
        frames = np.array(data["Frames"], dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: 'Frames' is not rows of {COLUMNS} numbers; export the motion again") from error
    if frames.ndim != 2 or frames.shape[1] != COLUMNS:
        raise InputError(
            f"{path}: a frame has {frames.shape[-1]} numbers, not {COLUMNS}: not DeepMimic's humanoid3d figure"
        )
    return frames, loop == "wrap"
