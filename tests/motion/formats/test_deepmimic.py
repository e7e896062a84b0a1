"""DeepMimic text files: axes become ours, and what is no sound motion is refused on one line."""

import numpy as np
import pytest

from motion import rotations, skeleton
from motion.formats import read_clip
from tests.motion.formats.files import change, deepmimic, refusal, save_json


def test_deepmimic_axes_become_ours(tmp_path):
    data = deepmimic()
    for row in data["Frames"]:
        row[3] = 0.25  # 0.25 m to the right
        row[4:8] = [np.cos(0.3), 0, np.sin(0.3), 0]  # 0.6 rad to the left
        row[20], row[34] = -0.5, -0.7  # bent knees
        row[29], row[43] = 0.9, 1.1  # bent elbows
    clip = read_clip(save_json(tmp_path / "walk.txt", data))
    np.testing.assert_allclose(clip.qpos[-1, :3], [1, -0.25, 0.88], atol=1e-12)
    np.testing.assert_allclose(rotations.heading(clip.qpos[:, 3:7]), 0.6, atol=1e-12)
    joints = dict(zip(skeleton.JOINT_NAMES, skeleton.JOINT_DOF, strict=True))
    hinges = [clip.joints[0, joints[f"{side}_{joint}"]] for joint in ("knee", "elbow") for side in ("right", "left")]
    np.testing.assert_allclose(hinges, [0.5, 0.7, -0.9, -1.1], atol=1e-12)


@pytest.mark.parametrize(
    ("loop", "asked", "looping"), [("wrap", None, True), ("none", None, False), ("none", True, True)]
)
def test_looping_is_the_files_unless_the_caller_says_otherwise(tmp_path, loop, asked, looping):
    path = save_json(tmp_path / "walk.txt", deepmimic() | {"Loop": loop})
    assert read_clip(path, looping=asked).looping is looping
    assert read_clip(path, looping=False).looping is False


def cell(row, column, value):
    return lambda data: change(data, "Frames", row, column, value=value)


DEEPMIMIC_FAULTS = {
    "no frames": (lambda data: data.pop("Frames"), "no list 'Frames'"),
    "empty frames": (lambda data: change(data, "Frames", value=[]), "'Frames' is empty"),
    "one frame": (lambda data: change(data, "Frames", value=data["Frames"][:1]), "has 1 frame"),
    "ragged rows": (lambda data: data["Frames"][2].pop(), "not rows of 44"),
    "another figure": (lambda data: change(data, "Frames", value=[row[:40] for row in data["Frames"]]), "40 numbers"),
    "words": (cell(2, 5, "x"), "not rows of 44"),
    "NaN": (cell(2, 5, float("nan")), "frame 2 holds nan"),
    "zero durations": (lambda data: [row.__setitem__(0, 0.0) for row in data["Frames"]], "must be positive"),
    "uneven durations": (cell(3, 0, 0.05), "frame 3 lasts 0.05 s"),
    "no unit quaternion": (cell(3, 8, 7.0), "abdomen is no unit quaternion"),
    "unknown loop": (lambda data: change(data, "Loop", value="maybe"), "'maybe'"),
}


@pytest.mark.parametrize("fault", DEEPMIMIC_FAULTS)
def test_a_deepmimic_file_that_is_no_sound_motion_is_refused(tmp_path, fault):
    spoil, expected = DEEPMIMIC_FAULTS[fault]
    data = deepmimic()
    spoil(data)
    assert expected in refusal(save_json(tmp_path / "walk.txt", data))


@pytest.mark.parametrize("content", [b"{", b"[1, 2]", b"\xff\xfe\x00", b"[" * 100_000, b"null"])
def test_text_that_is_no_motion_is_refused(tmp_path, content):
    (tmp_path / "walk.txt").write_bytes(content)
    refusal(tmp_path / "walk.txt")
