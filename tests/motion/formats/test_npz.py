"""Segue's own file: round trips, whole or not at all, and what is no sound clip is refused on one line."""

import numpy as np
import pytest

from motion import rotations, skeleton
from motion.clip import Clip
from motion.errors import InputError
from motion.formats import npz, poses, read_clip
from tests.motion.formats.files import almost_cyclic, refusal


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
