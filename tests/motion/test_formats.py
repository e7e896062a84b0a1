"""Clip files: real ones are read right, ours round trip, and bad ones are refused on one line and never executed."""

import json
import os
import pickle
from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from motion import rotations, skeleton
from motion.clip import Clip
from motion.errors import InputError
from motion.formats import npz, poses, read_clip

MOTIONS = Path(__file__).parents[2].parent / "shared/motions"
REALLUSION = MOTIONS / "reallusion"
DEEPMIMIC = MOTIONS / "deepmimic"
real = pytest.mark.skipif(not MOTIONS.is_dir(), reason="the real clips (shared/motions) are not on this machine")

NINE = (
    "Idle_Battle", "WalkForward02", "RunForward", "Dodge_Backward",
    "Atk_Stab", "Atk_SlashUp", "Atk_SlashDown", "Atk_SlashLeft", "Atk_ShieldSwipe01",
)  # fmt: skip


def refusal(path, **options):
    """The message with which the file is refused: one line that names the file."""
    with pytest.raises(InputError) as caught:
        read_clip(path, **options)
    message = str(caught.value)
    assert Path(path).name in message
    assert "\n" not in message
    return message


# ---- poselib -------------------------------------------------------------------------------------------------------


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


def test_a_poselib_clip_keeps_its_rotations_and_places(tmp_path):
    data = poselib()
    clip = read_clip(save(tmp_path / "Move.npy", data))
    assert (clip.name, clip.frames, clip.fps, clip.looping) == ("Move", 6, 30.0, False)
    np.testing.assert_array_equal(clip.qpos[:, :3], data["root_translation"]["arr"])
    np.testing.assert_allclose(clip.bodies[0], places(data), atol=1e-6)


def places(data):
    """World positions (T, 17, 3) straight from the dictionary, with scipy."""
    rotation, tree = data["rotation"]["arr"], data["skeleton_tree"]
    position, turned = [data["root_translation"]["arr"]], [Rotation.from_quat(rotation[:, 0])]
    for i in range(1, 17):
        parent = tree["parent_indices"]["arr"][i]
        position.append(position[parent] + turned[parent].apply(tree["local_translation"]["arr"][i]))
        turned.append(turned[parent] * Rotation.from_quat(rotation[:, i]))
    return np.stack(position, axis=1)


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


def change(data, *keys, value):
    for key in keys[:-1]:
        data = data[key]
    data[keys[-1]] = value


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


@pytest.mark.parametrize("content", [[1, 2], "text", None])
def test_another_pickled_object_is_refused(tmp_path, content):
    refusal(save(tmp_path / "a.npy", content))


def test_a_plain_array_is_refused(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((5, 47)))
    assert "(5, 47)" in refusal(tmp_path / "a.npy")


@pytest.mark.parametrize("share", [0.0001, 0.01, 0.05, 0.5, 0.9, 0.999])
def test_a_truncated_pickle_is_refused(tmp_path, share):
    path = save(tmp_path / "a.npy", poselib())
    content = path.read_bytes()
    path.write_bytes(content[: max(1, int(len(content) * share))])
    refusal(path)


def test_a_damaged_pickle_is_refused_or_read_but_never_fails_otherwise(tmp_path):
    path = save(tmp_path / "a.npy", poselib(3))
    content = bytearray(path.read_bytes())
    generator = np.random.default_rng(0)
    for _ in range(150):
        spoiled = content.copy()
        for place in generator.integers(128, 700, 3):
            spoiled[place] = generator.integers(256)
        path.write_bytes(spoiled)
        try:
            read_clip(path)
        except InputError as error:
            assert "\n" not in str(error)


class Call:
    """Pickles as the call of `function` with `arguments`."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("protocol", range(5))
def test_a_program_in_a_pickle_is_refused_and_not_run(tmp_path, protocol):
    victim = tmp_path / "victim"
    program = pickle.dumps(Call(os.system, f"touch {victim}"), protocol)
    assert "system" in refusal(save_pickle(tmp_path / "a.npy", program))
    assert not victim.exists()


def test_a_program_deep_inside_a_sound_clip_is_refused_and_not_run(tmp_path):
    victim = tmp_path / "victim"
    data = poselib()
    data["rotation"]["context"]["dtype"] = Call(eval, f"open({str(victim)!r}, 'w')")
    assert "eval" in refusal(save(tmp_path / "a.npy", data))
    assert not victim.exists()


@pytest.mark.parametrize(
    "function",
    [getattr, __import__, np.load, np.frombuffer, np.array, pickle.loads, OrderedDict.fromkeys],
)
def test_only_the_few_names_of_a_clip_are_allowed(tmp_path, function):
    assert "refused without running it" in refusal(save(tmp_path / "a.npy", Call(function, "x")))


def test_an_object_array_made_of_raw_bytes_is_not_turned_into_pointers(tmp_path):
    # numpy's own dtype takes these flags, and then the array's bytes for addresses: the process crashes or worse
    program = (
        b"\x80\x02cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85C\x01b\x87R"
        b"(K\x01K\x01\x85cnumpy\ndtype\nX\x02\x00\x00\x00O8\x89\x88\x87R"
        b"(K\x03X\x01\x00\x00\x00|NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb\x89C\x08AAAAAAAAtb."
    )
    refusal(save_pickle(tmp_path / "a.npy", program))


# ---- DeepMimic -----------------------------------------------------------------------------------------------------


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


# ---- cycles --------------------------------------------------------------------------------------------------------


def almost_cyclic(gap, turn=0.0):
    """Poses (31, 47) at 30 frames/s whose joints end `gap` rad away from where they began."""
    phase = np.linspace(0, 1, 31)[:, None]
    joints = 0.3 * np.sin(2 * np.pi * phase + np.arange(31)) + gap / np.sqrt(3) * phase**3
    quaternion = rotations.about_z(turn * phase[:, 0])
    return skeleton.assemble_qpos(np.concatenate([phase, 0.1 * phase, 0.9 + 0.02 * phase], 1), quaternion, joints)


@pytest.mark.parametrize("turn", [0.0, 0.8])
def test_a_closed_cycle_ends_in_its_first_pose_and_keeps_its_displacement(turn):
    qpos = almost_cyclic(0.4, turn)
    clip = poses.make_clip("file", "walk", qpos, 30.0, looping=True)
    np.testing.assert_allclose(clip.joints[-1], clip.joints[0], atol=1e-12)
    np.testing.assert_allclose(clip.qpos[-1, :2], qpos[-1, :2], atol=1e-12)
    assert clip.qpos[-1, 2] == pytest.approx(clip.qpos[0, 2], abs=1e-12)
    assert rotations.heading(clip.qpos[-1, 3:7]) == pytest.approx(turn, abs=1e-9)
    np.testing.assert_allclose(clip.qvel[-1, 3:], clip.qvel[0, 3:], atol=1e-9)


def test_closing_a_cycle_changes_only_its_last_quarter_of_a_second_and_makes_no_jump():
    qpos = almost_cyclic(0.4)
    clip = poses.make_clip("file", "walk", qpos, 30.0, looping=True)
    np.testing.assert_allclose(clip.joints[:-8], skeleton.joint_coordinates(qpos)[:-8], atol=1e-12)
    before = np.abs(skeleton.velocities(qpos, 30.0)).max()
    assert np.abs(clip.qvel).max() < before + 0.4 * 1.5 / poses.CLOSING_TIME


def test_a_closed_cycle_is_closed_to_itself():
    once = poses.make_clip("file", "walk", almost_cyclic(0.4), 30.0, looping=True)
    twice = poses.make_clip("file", "walk", once.qpos, 30.0, looping=True)
    np.testing.assert_allclose(twice.qpos, once.qpos, atol=1e-12)


def test_a_clip_whose_ends_are_two_poses_cannot_loop():
    with pytest.raises(InputError, match=r"file: does not end as it begins .* set looping: false"):
        poses.make_clip("file", "strike", almost_cyclic(1.5), 30.0, looping=True)


# ---- our own -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("looping", [False, True])
def test_our_own_file_round_trips(tmp_path, looping):
    clip = poses.make_clip("file", "walk", almost_cyclic(0.2, turn=0.4), 29.97, looping)
    npz.write(clip, tmp_path / "walk.npz")
    back = read_clip(tmp_path / "walk.npz")
    assert (back.name, back.fps, back.looping) == ("walk", 29.97, looping)
    np.testing.assert_allclose(back.qpos, clip.qpos, atol=1e-12)
    np.testing.assert_allclose(back.qvel, clip.qvel, atol=1e-9)
    assert [entry.name for entry in tmp_path.iterdir()] == ["walk.npz"]


def test_rotations_beyond_half_a_turn_round_trip_with_continuous_signs(tmp_path):
    joints = np.zeros((40, 31))
    joints[:, 3:6] = np.linspace(2.5, 4.5, 40)[:, None] * [0.6, 0.0, 0.8]
    qpos = skeleton.assemble_qpos([0, 0, 0.9], rotations.IDENTITY, joints)
    clip = Clip.from_poses("turn", qpos, 30.0)
    npz.write(clip, tmp_path / "turn.npz")
    np.testing.assert_allclose(read_clip(tmp_path / "turn.npz").qpos, clip.qpos, atol=1e-12)


def test_a_failed_write_leaves_the_old_file_and_no_other(tmp_path, monkeypatch):
    clip = poses.make_clip("file", "walk", almost_cyclic(0.2), 30.0, looping=False)
    path = tmp_path / "walk.npz"
    npz.write(clip, path)
    before = path.read_bytes()

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(InputError, match="No space left"):
        npz.write(clip, path)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["walk.npz"]


@pytest.mark.parametrize("place", ["walk.npy", "walk", "missing/walk.npz"])
def test_a_clip_is_written_only_as_npz_and_into_a_folder_that_exists(tmp_path, place):
    clip = poses.make_clip("file", "walk", almost_cyclic(0.2), 30.0, looping=False)
    with pytest.raises(InputError, match="walk"):
        npz.write(clip, tmp_path / place)


NPZ_FAULTS = {
    "a missing field": (lambda fields: fields.pop("joints"), "'joints' is missing"),
    "another version": (lambda fields: fields.update(format_version=np.array(2)), "format version 2"),
    "another joint": (
        lambda fields: fields.update(joint_names=np.array(["tail", *skeleton.JOINT_NAMES[1:]])),
        "'tail', not 'abdomen'",
    ),
    "fewer joints": (lambda fields: fields.update(joint_names=fields["joint_names"][:5]), "5 joints, not 13"),
    "wrong width": (lambda fields: fields.update(joints=np.zeros((31, 30))), "(31, 30)"),
    "wrong length": (lambda fields: fields.update(root_position=np.zeros((3, 3))), "(3, 3)"),
    "words": (lambda fields: fields.update(root_position=np.full((31, 3), "x")), "root_position"),
    "two rates": (lambda fields: fields.update(fps=np.ones(2)), "'fps' is not one number"),
    "zero fps": (lambda fields: fields.update(fps=np.array(0.0)), "frame rate is 0"),
    "NaN": (lambda fields: fields["joints"].__setitem__((7, 0), np.nan), "frame 7 holds nan"),
    "pickled objects": (lambda fields: fields.update(joints=np.array([{}], dtype=object)), "not a readable npz"),
    "one frame": (
        lambda fields: fields.update({key: fields[key][:1] for key in ("root_position", "root_quaternion", "joints")}),
        "has 1 frame",
    ),
}


@pytest.mark.parametrize("fault", NPZ_FAULTS)
def test_a_npz_file_that_is_no_sound_clip_is_refused(tmp_path, fault):
    spoil, expected = NPZ_FAULTS[fault]
    path = tmp_path / "walk.npz"
    npz.write(poses.make_clip("file", "walk", almost_cyclic(0.2), 30.0, looping=False), path)
    with np.load(path) as file:
        fields = dict(file)
    spoil(fields)
    np.savez(path, **fields)
    assert expected in refusal(path)


@pytest.mark.parametrize("share", [0.01, 0.5, 0.99])
def test_a_truncated_npz_file_is_refused(tmp_path, share):
    path = tmp_path / "walk.npz"
    npz.write(poses.make_clip("file", "walk", almost_cyclic(0.2), 30.0, looping=False), path)
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])
    refusal(path)


def test_a_plain_array_named_npz_is_refused(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros(3))
    (tmp_path / "a.npy").rename(tmp_path / "a.npz")
    refusal(tmp_path / "a.npz")


# ---- any file ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".npy", ".txt", ".npz"])
def test_a_missing_file_is_named_with_its_nearest_neighbours(tmp_path, suffix):
    for name in ("Atk_Stab", "Atk_Slash", "Atk_Stub", "Atk_Staff", "Zzzzz"):
        (tmp_path / f"{name}{suffix}").touch()
    message = refusal(tmp_path / f"Atk_Stb{suffix}")
    assert "no such file; did you mean" in message
    assert f"Atk_Stab{suffix}" in message
    assert message.count(suffix) == 4  # the file and three others
    assert "Zzzzz" not in message


def test_a_missing_folder_is_named(tmp_path):
    assert f"no folder {tmp_path / 'nowhere'}" in refusal(tmp_path / "nowhere/a.npy")


@pytest.mark.parametrize("suffix", [".npy", ".txt", ".npz"])
def test_an_empty_file_is_refused(tmp_path, suffix):
    (tmp_path / f"a{suffix}").touch()
    assert "is empty" in refusal(tmp_path / f"a{suffix}")


@pytest.mark.parametrize("name", ["a.npy", "folder"])
def test_a_folder_is_refused(tmp_path, name):
    (tmp_path / name).mkdir()
    assert "is a folder" in refusal(tmp_path / name)


def test_another_kind_of_file_is_refused(tmp_path):
    (tmp_path / "a.bvh").write_text("HIERARCHY")
    assert ".npy, .txt, .npz" in refusal(tmp_path / "a.bvh")


def test_a_file_without_permission_is_refused(tmp_path, monkeypatch):
    path = save(tmp_path / "a.npy", poselib())

    def locked(*_, **__):  # a file's mode does not stop root, who may run the tests
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr("builtins.open", locked)
    assert "permissions" in refusal(path)


@pytest.mark.parametrize("suffix", [".npy", ".txt", ".npz"])
def test_noise_is_refused(tmp_path, suffix):
    (tmp_path / f"a{suffix}").write_bytes(np.random.default_rng(0).bytes(4096))
    refusal(tmp_path / f"a{suffix}")


# ---- the real clips ------------------------------------------------------------------------------------------------


@real
@pytest.mark.parametrize(
    "path", sorted([*REALLUSION.glob("*.npy"), *DEEPMIMIC.glob("*.txt")]), ids=lambda path: path.stem
)
def test_every_real_clip_is_read_as_an_upright_figure(path):
    clip = read_clip(path)
    assert clip.frames > 20
    position, _ = clip.bodies
    feet = position[:, skeleton.FOOT_BODIES, 2].min(axis=1)
    assert np.all(position[:, skeleton.BODY_INDEX["head"], 2] > feet + 0.5)
    for side in ("left", "right"):
        knee, elbow = (skeleton.JOINT_DOF[skeleton.JOINT_INDEX[f"{side}_{joint}"]] for joint in ("knee", "elbow"))
        assert np.all(clip.joints[:, knee] > -0.05)  # knees bend backwards only, elbows forwards only
        assert np.all(clip.joints[:, elbow] < 0.05)
    assert np.abs(clip.qvel).max() < 40


@real
@pytest.mark.parametrize("name", NINE)
def test_the_nine_clips_stand_on_the_ground_and_begin_in_the_battle_stance(name):
    clip = read_clip(REALLUSION / f"RL_Avatar_{name}_Motion.npy")
    ankles = clip.bodies[0][:, skeleton.FOOT_BODIES, 2].min(axis=1)
    assert np.median(ankles) == pytest.approx(0.06, abs=0.025)
    assert clip.contacts()[0].all()
    assert np.linalg.norm(clip.qvel[0, :3]) < 0.15
    stance = read_clip(REALLUSION / "RL_Avatar_Idle_Battle_Motion.npy").bodies[0][0, :, 2]
    np.testing.assert_allclose(clip.bodies[0][0, :, 2], stance, atol=0.2)


@real
def test_a_real_clip_has_the_places_that_its_file_says():
    path = REALLUSION / "RL_Avatar_Atk_SlashUp_Motion.npy"
    data = np.load(path, allow_pickle=True).item()  # a file that we know
    np.testing.assert_allclose(read_clip(path).bodies[0], places(data), atol=1e-5)


@real
@pytest.mark.parametrize("name", ["Idle_Battle", "WalkForward02", "RunForward"])
def test_real_cycles_already_meet_at_the_seam(name):
    path = REALLUSION / f"RL_Avatar_{name}_Motion.npy"
    as_is, closed = read_clip(path), read_clip(path, looping=True)
    before, after = (skeleton.joint_quaternions(clip.qpos) for clip in (as_is, closed))
    assert rotations.angle_between(before, after).max() < 0.02


@real
@pytest.mark.parametrize("name", ["walk", "run"])
def test_deepmimic_gaits_go_where_they_face_with_a_foot_near_the_ground(name):
    clip = read_clip(DEEPMIMIC / f"humanoid3d_{name}.txt")
    assert clip.looping
    travel = clip.qpos[-1, :2] - clip.qpos[0, :2]
    facing = np.exp(1j * rotations.heading(clip.qpos[:, 3:7])).mean()
    assert abs(np.arctan2(travel[1], travel[0]) - np.angle(facing)) < 0.2
    assert np.linalg.norm(travel) / clip.duration > 0.8
    position, _ = clip.bodies
    assert np.abs(position[:, skeleton.FOOT_BODIES, 2].min(axis=1) - 0.06).max() < 0.15
    assert np.all(position[:, skeleton.BODY_INDEX["head"], 2] > 1.1)
    # the feet pass each other: each is ahead once
    ahead = position[:, skeleton.FOOT_BODIES[0], 0] - position[:, skeleton.FOOT_BODIES[1], 0]
    assert ahead.max() > 0.2
    assert ahead.min() < -0.2


@real
def test_real_clips_round_trip_through_our_own_file(tmp_path):
    for source in (REALLUSION / "RL_Avatar_Atk_Stab_Motion.npy", DEEPMIMIC / "humanoid3d_walk.txt"):
        clip = read_clip(source)
        npz.write(clip, tmp_path / "clip.npz")
        np.testing.assert_allclose(read_clip(tmp_path / "clip.npz").qpos, clip.qpos, atol=1e-12)
