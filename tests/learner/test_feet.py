"""`learner.feet`: the soles' corners are where MuJoCo has them and as fast, whatever the pose."""

import mujoco
import numpy as np
import pytest
import torch

from learner.feet import SIZE, contact, corners
from motion import rotations
from motion.skeleton import NQ
from workers.humanoid import build_model


def slow(model, qpos, qvel):
    """Heights (8,) and velocities in the heading frame (8, 3), of the boxes that the model has as feet."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_forward(model, data)
    to_heading = rotations.about_z(-rotations.heading(qpos[3:7]))
    heights, velocities = [], []
    for name in ("right_foot", "left_foot"):
        body = model.body(name).id
        (geom,) = np.flatnonzero(model.geom_bodyid == body)
        for x in (-1, 1):
            for y in (-1, 1):
                half = model.geom_size[geom] * [x, y, -1]
                place = data.geom_xpos[geom] + data.geom_xmat[geom].reshape(3, 3) @ half
                jacobian = np.zeros((3, model.nv))
                mujoco.mj_jac(model, data, jacobian, None, place, body)
                heights.append(place[2])
                velocities.append(rotations.rotate(to_heading, jacobian @ data.qvel))
    return np.array(heights), np.array(velocities)


def test_corners_are_mujocos(lessons, make_config):
    chunk, model = lessons[0], build_model(make_config().physics)
    poses = chunk.pose.reshape(-1, chunk.pose.shape[-1]).astype(np.float64)
    seen = torch.as_tensor(np.ascontiguousarray(chunk.observation).reshape(len(poses), -1)[:, :140])
    height, velocity = corners(seen)
    assert np.ptp(height.numpy()) > 0.1  # feet are lifted, too
    for i in range(0, len(poses), 7):
        heights, velocities = slow(model, poses[i, :NQ], poses[i, NQ:])
        np.testing.assert_allclose(height[i], heights, atol=1e-5)
        np.testing.assert_allclose(velocity[i], velocities, atol=1e-4)


def test_who_is_far_off_the_floor_does_not_touch_it_and_how_high_does_not_count(lessons):
    seen = torch.as_tensor(np.ascontiguousarray(lessons[0].observation[0, :, :140])).clone()
    low, high = seen.clone(), seen.clone()
    low[:, 0] += 2.0
    high[:, 0] += 3.0
    found = contact(low)
    assert found.shape == (len(seen), SIZE)
    torch.testing.assert_close(found, contact(high))
    assert (found[:, 8:16] < 1e-6).all() and (found[:, 40:].abs() < 1e-3).all()
    sunk = contact(torch.cat([seen[:, :1] * 0 - 3.0, seen[:, 1:]], dim=1))
    torch.testing.assert_close(sunk[:, 8:16], torch.ones(len(seen), 8))
    assert found[:, 16:40].numpy() == pytest.approx(sunk[:, 40:].numpy())  # who touches, does so with its velocity
