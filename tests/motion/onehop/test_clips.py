"""Clips prepared for search: the seam of a loop is a rigid motion, other rates and skeletons are refused."""

from dataclasses import replace

import numpy as np
import pytest

from motion import builtin, skeleton
from motion.errors import InputError
from motion.onehop.clips import ClipSet


@pytest.mark.parametrize("name", ["walk", "run", "idle"])
def test_windows_across_the_seam_are_forward_kinematics_of_continued_poses(builtin_set, name):
    """Points of any frame, several cycles before and after, are those of the pose that `root_pose` continues."""
    i = builtin_set.index(name)
    period = builtin_set.period(i)
    for first in (-2 * period - 3, -5, period - 3, 3 * period - 2):
        points = builtin_set.window_points(i, first, 8)
        poses = np.array([builtin_set.root_pose(i, frame) for frame in range(first, first + 8)])
        np.testing.assert_allclose(points, skeleton.forward_kinematics(poses)[0], atol=1e-9)


def test_the_last_frame_of_a_loop_is_the_first_of_the_next_cycle(builtin_set):
    i = builtin_set.index("walk")
    clip = builtin_set.clips[i]
    np.testing.assert_allclose(builtin_set.root_pose(i, builtin_set.period(i))[:3], clip.qpos[-1, :3], atol=1e-9)


def test_a_turning_loop_goes_round(make_clip):
    """Four quarter turns come back to the heading and place of the start."""
    rng = np.random.default_rng(0)
    clip = make_clip(rng, "turn", 5)
    qpos = np.array(clip.qpos)
    qpos[-1] = qpos[0]
    half = np.pi / 4
    qpos[-1, 3:7] = [
        np.cos(half) * qpos[0, 3] - np.sin(half) * qpos[0, 6], np.cos(half) * qpos[0, 4] - np.sin(half) * qpos[0, 5],
        np.cos(half) * qpos[0, 5] + np.sin(half) * qpos[0, 4], np.cos(half) * qpos[0, 6] + np.sin(half) * qpos[0, 3],
    ]  # fmt: skip
    qpos[-1, 0] += 1.0
    clips = ClipSet.from_clips([type(clip).from_poses("turn", qpos, 60.0, True)])
    yaw, x, y = clips.cycle_motion(0, 4)
    assert (np.cos(yaw), x, y) == pytest.approx((1, 0, 0), abs=1e-9)
    back = clips.window_points(0, -4 * 4, 3)
    np.testing.assert_allclose(back, clips.window_points(0, 0, 3), atol=1e-9)


def test_frames_outside_a_clip_that_does_not_loop_are_refused(builtin_set):
    i = builtin_set.index("stab")
    for first, count in ((-1, 3), (builtin_set.frames(i) - 2, 3)):
        with pytest.raises(IndexError, match="stab"):
            builtin_set.window_points(i, first, count)
    with pytest.raises(IndexError, match="stab"):
        builtin_set.root_pose(i, builtin_set.frames(i))


def test_bad_clips_are_one_clear_line(make_clip):
    rng = np.random.default_rng(0)
    a, b = make_clip(rng, "a", 9), make_clip(rng, "b", 9)
    spoiled = np.array(b.qpos)
    spoiled[4, 9] = np.nan
    cases = [
        ([], "no clips|none"), ([a, a], "a: two clips"), ([a, replace(b, fps=30.0)], "b: has 30 .*fps=60"),
        ([a, replace(b, qpos=spoiled)], "b: frame 4"), ([a, replace(b, qpos=b.qpos[:, :40])], "b: poses have shape"),
        ([a, replace(b, qpos=b.qpos[:1])], "b: has 1 frame"),
    ]  # fmt: skip
    for clips, message in cases:
        with pytest.raises(InputError, match=message) as error:
            ClipSet.from_clips(clips)
        assert "\n" not in str(error.value)
    with pytest.raises(InputError, match="^a: beats"):
        ClipSet.from_clips([a, b], beats=[[5.0], []])
    with pytest.raises(InputError, match="^genres"):
        ClipSet.from_clips([a, b], genres=["jazz"])
    with pytest.raises(InputError, match="'c'"):
        ClipSet.from_clips([a, b]).index("c")


def test_other_rates_are_resampled_on_request():
    clips = ClipSet.from_clips([builtin.load("stab").resample(30), builtin.load("run")], fps=60)
    assert clips.fps == 60
    assert clips.clips[0].fps == 60
    assert clips.clips[1].fps == pytest.approx(60, rel=0.02)
