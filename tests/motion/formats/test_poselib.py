"""Pose-library files: right rotations and places, and what is no clip of this figure is refused on one line."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from motion import skeleton
from motion.formats import read_clip
from tests.motion.formats.files import change, places, poselib, refusal, save


def test_a_poselib_clip_keeps_its_rotations_and_places(tmp_path):
    data = poselib()
    clip = read_clip(save(tmp_path / "Move.npy", data))
    assert (clip.name, clip.frames, clip.fps, clip.looping) == ("Move", 6, 30.0, False)
    np.testing.assert_array_equal(clip.qpos[:, :3], data["root_translation"]["arr"])
    np.testing.assert_allclose(clip.bodies[0], places(data), atol=1e-6)


def test_quaternion_signs_are_continuous_whatever_the_file_holds(tmp_path):
    data = poselib()
    data["rotation"]["arr"][1::2] *= -1
    clip = read_clip(save(tmp_path / "a.npy", data))
    for joint, start in zip(skeleton.JOINTS, 7 + skeleton.JOINT_QPOS, strict=True):
        if joint.dof == 3:
            part = clip.qpos[:, start : start + 4]
            assert np.all(np.sum(part[1:] * part[:-1], axis=1) > 0)
            assert part[0, 0] >= 0
    np.testing.assert_allclose(clip.bodies[0], places(data), atol=1e-6)


@pytest.mark.parametrize("angle", [-3.0, -1.8, 0.0, 2.6, 3.1])
@pytest.mark.parametrize("sign", [1, -1])
def test_hinge_angles_are_signed_and_within_pi(tmp_path, angle, sign):
    data = poselib()
    knee = skeleton.JOINT_INDEX["left_knee"]
    data["rotation"]["arr"][:, skeleton.JOINTS[knee].body] = sign * Rotation.from_euler("y", angle).as_quat()
    clip = read_clip(save(tmp_path / "a.npy", data))
    np.testing.assert_allclose(clip.qpos[:, 7 + skeleton.JOINT_QPOS[knee]], angle, atol=1e-12)


def tilted(data, name, axis, angle):
    data["rotation"]["arr"][3, skeleton.BODY_INDEX[name]] = Rotation.from_euler(axis, angle).as_quat()


POSELIB_FAULTS = {
    "another name": (
        lambda data: change(data, "skeleton_tree", "node_names", 3, value="spine"),
        "body 3 is 'spine', not 'right_upper_arm'",
    ),
    "a body too few": (lambda data: data["skeleton_tree"]["node_names"].pop(), "body 16 is missing, not 'left_foot'"),
    "a body too many": (lambda data: data["skeleton_tree"]["node_names"].append("tail"), "a body more, 'tail'"),
    "another parent": (
        lambda data: change(data, "skeleton_tree", "parent_indices", "arr", 6, value=1),
        "the parent of 'sword' is body 1, not 5",
    ),
    "longer shins": (
        lambda data: change(data, "skeleton_tree", "local_translation", "arr", (13, 2), value=-0.45),
        "'right_foot'",
    ),
    "NaN offsets": (
        lambda data: change(data, "skeleton_tree", "local_translation", "arr", (13, 2), value=np.nan),
        "'right_foot'",
    ),
    "a bent knee axis": (lambda data: tilted(data, "left_shin", "x", 0.2), "left_knee turns about another axis than y"),
    "a loose sword": (lambda data: tilted(data, "sword", "z", 0.2), "sword turns against the body it is fixed to"),
    "global rotations": (lambda data: change(data, "is_local", value=False), "local rotations"),
    "no fps": (lambda data: data.pop("fps"), "'fps' is missing"),
    "zero fps": (lambda data: change(data, "fps", value=0.0), "frame rate is 0"),
    "fps in words": (lambda data: change(data, "fps", value="fast"), "'fast'"),
    "NaN": (lambda data: change(data, "rotation", "arr", (2, 1, 0), value=np.nan), "frame 2 holds nan"),
    "NaN off a hinge's axis": (
        lambda data: change(data, "rotation", "arr", (2, 4, 0), value=np.nan),
        "frame 2 holds nan",
    ),
    "infinite place": (lambda data: change(data, "root_translation", "arr", (2, 0), value=np.inf), "frame 2 holds inf"),
    "absurd place": (lambda data: change(data, "root_translation", "arr", (2, 0), value=1e200), "frame 2 holds 1e+200"),
    "zero quaternion": (lambda data: change(data, "rotation", "arr", (2, 1), value=0.0), "no unit quaternion"),
    "no rotation": (lambda data: data.pop("rotation"), "'rotation' is missing"),
    "a list for an array": (lambda data: change(data, "rotation", "arr", value=[1.0]), "not an array"),
    "frames that differ": (
        lambda data: change(data, "root_translation", "arr", value=np.zeros((5, 3))),
        "root_translation (5, 3)",
    ),
    "one frame": (lambda data: data.update(poselib(1)), "has 1 frame"),
}


@pytest.mark.parametrize("fault", POSELIB_FAULTS)
def test_a_poselib_file_that_is_no_clip_of_this_figure_is_refused(tmp_path, fault):
    spoil, expected = POSELIB_FAULTS[fault]
    data = poselib()
    spoil(data)
    assert expected in refusal(save(tmp_path / "a.npy", data))


def test_the_place_where_the_figure_once_stood_is_free(tmp_path):
    data = poselib()
    data["skeleton_tree"]["local_translation"]["arr"][0] = [5, 5, 5]
    read_clip(save(tmp_path / "a.npy", data))
