"""Cycles are closed at their seam, with the least change that makes no jump."""

import numpy as np
import pytest

from motion import rotations, skeleton
from motion.errors import InputError
from motion.formats import poses
from tests.motion.formats.files import almost_cyclic


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
