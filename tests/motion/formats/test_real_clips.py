"""The real clips, where they are on this machine, are read right."""

from pathlib import Path

import numpy as np
import pytest

from motion import rotations, skeleton
from motion.formats import npz, read_clip
from tests.motion.formats.files import places

MOTIONS = Path(__file__).parents[3].parent / "shared/motions"
REALLUSION = MOTIONS / "reallusion"
DEEPMIMIC = MOTIONS / "deepmimic"
real = pytest.mark.skipif(not MOTIONS.is_dir(), reason="the real clips (shared/motions) are not on this machine")

NINE = (
    "Idle_Battle", "WalkForward02", "RunForward", "Dodge_Backward",
    "Atk_Stab", "Atk_SlashUp", "Atk_SlashDown", "Atk_SlashLeft", "Atk_ShieldSwipe01",
)  # fmt: skip


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
