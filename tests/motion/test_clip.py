"""Clips: sampling, cutting, seams, and what a clip refuses."""

import dataclasses

import numpy as np
import pytest

from motion import rotations, skeleton
from motion.clip import Clip, shift_cycle
from motion.errors import InputError

FPS = 30.0


def swinging(frames=31, turn=0.0, seed=0):
    """Poses (frames, 47) of one cycle in which everything swings, along a straight line or an arc of `turn` rad."""
    phase = np.linspace(0, 2 * np.pi, frames)[:, None]
    generator = np.random.default_rng(seed)
    joints = generator.uniform(-0.4, 0.4, 31) * np.sin(phase + generator.uniform(0, 6, 31))
    yaw = turn * phase / (2 * np.pi)
    tilt = rotations.from_exponential_map(np.concatenate([0.1 * np.sin(phase), 0.2 * np.cos(phase), 0 * phase], axis=1))
    if turn:
        path = np.concatenate([np.sin(yaw) / turn, (1 - np.cos(yaw)) / turn, 0.9 + 0.02 * np.sin(phase)], axis=1)
    else:
        path = np.concatenate([phase / 6, 0.03 * np.sin(phase), 0.9 + 0.02 * np.sin(phase)], axis=1)
    return skeleton.assemble_qpos(path, rotations.multiply(rotations.about_z(yaw[:, 0]), tilt), joints)


def standing(frames=10, height=0.88):
    return skeleton.assemble_qpos([0, 0, height], rotations.IDENTITY, np.zeros((frames, 31)))


def test_samples_at_frames_are_the_frames():
    clip = Clip.from_poses("swing", swinging(), FPS)
    qpos, qvel = clip.sample(np.arange(clip.frames) / FPS)
    np.testing.assert_allclose(qpos, clip.qpos, atol=1e-12)
    np.testing.assert_allclose(qvel, clip.qvel, atol=1e-12)


def test_samples_between_frames_lie_half_way_and_are_unit_rotations():
    clip = Clip.from_poses("swing", swinging(), FPS)
    qpos, qvel = clip.sample(4.5 / FPS)
    np.testing.assert_allclose(qpos[:3], (clip.qpos[4, :3] + clip.qpos[5, :3]) / 2, atol=1e-12)
    np.testing.assert_allclose(qvel, (clip.qvel[4] + clip.qvel[5]) / 2, atol=1e-12)
    quaternion = skeleton.joint_quaternions(qpos)
    np.testing.assert_allclose(np.linalg.norm(quaternion, axis=-1), 1, atol=1e-12)
    ends = skeleton.joint_quaternions(clip.qpos[4:6])
    angle = rotations.angle_between(ends[0], ends[1])
    np.testing.assert_allclose(rotations.angle_between(quaternion, ends[0]), angle / 2, atol=1e-9)


def test_samples_outside_the_clip_are_its_ends():
    clip = Clip.from_poses("swing", swinging(), FPS)
    np.testing.assert_allclose(clip.sample(-1.0)[0], clip.qpos[0], atol=1e-12)
    np.testing.assert_allclose(clip.sample(99.0)[0], clip.qpos[-1], atol=1e-12)


def test_samples_keep_the_shape_of_the_times():
    qpos, qvel = Clip.from_poses("swing", swinging(), FPS).sample(np.zeros((2, 3)))
    assert qpos.shape == (2, 3, 47)
    assert qvel.shape == (2, 3, 37)


def test_a_slice_keeps_poses_and_velocities_and_does_not_loop():
    clip = Clip.from_poses("swing", swinging(), FPS, looping=True)
    part = clip.slice(0.2, 0.5)
    np.testing.assert_array_equal(part.qpos, clip.qpos[6:16])
    np.testing.assert_array_equal(part.qvel, clip.qvel[6:16])
    assert part.duration == pytest.approx(0.3)
    assert not part.looping


@pytest.mark.parametrize(("start", "end"), [(-0.1, 0.5), (0.5, 0.4), (0.5, 0.5), (0.2, 1.5)])
def test_a_slice_outside_the_clip_is_refused(start, end):
    with pytest.raises(InputError, match="swing"):
        Clip.from_poses("swing", swinging(), FPS).slice(start, end)


@pytest.mark.parametrize("fps", [12.7, 30.0, 47.0, 120.0])
def test_resampling_keeps_the_duration_and_the_path(fps):
    clip = Clip.from_poses("swing", swinging(), FPS)
    other = clip.resample(fps)
    assert clip.duration - 1 / fps < other.duration <= clip.duration + 1e-9
    assert other.fps == fps
    time = np.arange(other.frames) / fps
    np.testing.assert_allclose(other.qpos, clip.sample(time)[0], atol=1e-12)


@pytest.mark.parametrize("fps", [12.7, 30.0, 47.0, 120.0])
def test_resampling_a_looping_clip_keeps_its_seam_exactly(fps):
    clip = Clip.from_poses("swing", swinging(), FPS, looping=True)
    other = clip.resample(fps)
    assert other.duration == pytest.approx(clip.duration, abs=1e-12)
    assert other.fps == pytest.approx(fps, rel=0.05)
    np.testing.assert_allclose(other.qpos[[0, -1]], clip.qpos[[0, -1]], atol=1e-12)
    assert other.looping


@pytest.mark.parametrize("fps", [0.0, -30.0, np.nan, np.inf])
def test_resampling_to_an_impossible_rate_is_refused(fps):
    with pytest.raises(InputError, match="swing"):
        Clip.from_poses("swing", swinging(), FPS).resample(fps)


@pytest.mark.parametrize("turn", [0.0, 0.7, -2.5])
def test_velocities_at_the_seam_are_those_of_the_repeated_motion(turn):
    poses = swinging(turn=turn)
    clip = Clip.from_poses("swing", poses, FPS, looping=True)
    repeated = np.concatenate([shift_cycle(poses[:-1], poses, -1), poses, shift_cycle(poses[1:], poses, 1)])
    expected = skeleton.velocities(repeated, FPS)[len(poses) - 1 : 2 * len(poses) - 1]
    np.testing.assert_allclose(clip.qvel, expected, atol=1e-9)
    # the same speeds on both sides of the seam, but for the turn of the world velocity
    np.testing.assert_allclose(clip.qvel[-1, 3:], clip.qvel[0, 3:], atol=1e-9)
    moved = rotations.rotate(rotations.about_z(turn), clip.qvel[0, :3])
    np.testing.assert_allclose(clip.qvel[-1, :3], moved, atol=1e-9)


@pytest.mark.parametrize("turn", [0.0, 0.7, -2.5])
def test_shifting_by_a_cycle_continues_the_clip_and_shifting_back_undoes_it(turn):
    poses = swinging(turn=turn)
    ahead = shift_cycle(poses, poses, 1)
    np.testing.assert_allclose(ahead[0, :3], poses[-1, :3], atol=1e-12)
    np.testing.assert_allclose(rotations.angle_between(ahead[0, 3:7], poses[-1, 3:7]), 0, atol=1e-7)
    np.testing.assert_allclose(shift_cycle(ahead, poses, -1), poses, atol=1e-12)


def test_standing_feet_are_in_contact_and_lifted_or_sliding_feet_are_not():
    assert Clip.from_poses("stand", standing(), FPS).contacts().all()
    assert not Clip.from_poses("float", standing(height=1.2), FPS).contacts().any()
    sliding = standing()
    sliding[:, 0] = np.arange(10) / FPS  # 1 m/s
    assert not Clip.from_poses("slide", sliding, FPS).contacts().any()


def test_contacts_tell_right_from_left():
    poses = standing()
    knee = 7 + skeleton.JOINT_QPOS[skeleton.JOINT_INDEX["right_knee"]]
    poses[:, knee] = 1.5
    assert (Clip.from_poses("flamingo", poses, FPS).contacts() == [False, True]).all()


def test_a_clip_cannot_be_changed_and_does_not_share_its_input():
    poses = swinging()
    clip = Clip.from_poses("swing", poses, FPS)
    poses[:] = 0
    assert clip.qpos.any()
    with pytest.raises(ValueError, match="read-only"):
        clip.qpos[0, 0] = 1
    with pytest.raises(ValueError, match="read-only"):
        clip.slice(0.1, 0.5).qvel[0, 0] = 1
    with pytest.raises(dataclasses.FrozenInstanceError):
        clip.fps = 60.0


def test_the_hash_is_that_of_the_content_and_not_of_the_name():
    clip = Clip.from_poses("a", swinging(), FPS)
    assert clip.content_hash == Clip.from_poses("b", swinging(), FPS).content_hash
    moved = swinging()
    moved[3, 0] += 1e-9
    others = [
        Clip.from_poses("a", moved, FPS),
        Clip.from_poses("a", swinging(), FPS + 1),
        Clip.from_poses("a", swinging(), FPS, looping=True),
    ]
    assert len({clip.content_hash, *(other.content_hash for other in others)}) == 4


def test_frames_duration_and_bodies_agree_with_the_poses():
    clip = Clip.from_poses("swing", swinging(16), FPS)
    assert (clip.frames, clip.duration) == (16, 0.5)
    np.testing.assert_array_equal(clip.bodies[0], skeleton.forward_kinematics(clip.qpos)[0])
    np.testing.assert_array_equal(clip.joints, skeleton.joint_coordinates(clip.qpos))


def broken(value):
    poses = standing()
    poses[4, 9] = value
    return poses


@pytest.mark.parametrize(
    ("poses", "fps", "word"),
    [
        (np.zeros((5, 46)), FPS, "skeleton"),
        (np.zeros(47), FPS, "skeleton"),
        (standing(1), FPS, "two"),
        (standing(0), FPS, "two"),
        (broken(np.nan), FPS, "frame 4"),
        (broken(np.inf), FPS, "frame 4"),
        (standing(), 0.0, "frame rate"),
        (standing(), -1.0, "frame rate"),
        (standing(), np.nan, "frame rate"),
    ],
)
def test_bad_poses_are_refused_on_one_line_that_names_the_clip(poses, fps, word):
    with pytest.raises(InputError) as caught:
        Clip.from_poses("swing", poses, fps)
    message = str(caught.value)
    assert message.startswith("swing: ")
    assert word in message
    assert "\n" not in message
