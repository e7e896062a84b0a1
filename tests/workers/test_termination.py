"""Ends of episodes: falls against MuJoCo's contacts, strict reach, time-out, and which of them goes first."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import reference
from hypothesis import given
from hypothesis import strategies as st

from motion.skeleton import BODY_INDEX, BODY_NAMES, FOOT_BODIES
from workers.termination import fall_mask, lowest, reached, terminate
from workers.types import CONTINUES, FELL, REACHED, TIMED_OUT

FEET = ("right_foot", "left_foot")
WEAPONS = ("sword", "shield")
NOWHERE = np.zeros(17, dtype=bool)


def only(*names):
    mask = NOWHERE.copy()
    mask[[BODY_INDEX[name] for name in names]] = True
    return mask


def contacts(model, data, qpos):
    """Depth of the deepest contact of every body with the floor, by name, as MuJoCo finds them."""
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)
    floor, depth = model.geom("floor").id, {}
    for contact in data.contact[: data.ncon]:
        if floor in (contact.geom1, contact.geom2):
            geom = contact.geom1 + contact.geom2 - floor
            name = model.body(model.geom_bodyid[geom]).name
            depth[name] = min(depth.get(name, 0.0), contact.dist)
    return depth


@pytest.fixture(scope="module")
def low_poses(random_poses, clip_poses, trajectories):
    """Poses (n, 47) in which many bodies are near the floor: tumbling ones, those of rollouts, and lowered clips."""
    tumbling, _ = random_poses(250, seed=7)
    tumbling[:, 2] = np.random.default_rng(7).uniform(0.0, 0.8, len(tumbling))
    ended = np.concatenate([chunk.next_pose[chunk.end == FELL] for chunk in trajectories.chunks])[:, :47]
    running = np.concatenate([chunk.pose[::3, :, :47].reshape(-1, 47) for chunk in trajectories.chunks])
    lowered = [clip_poses[0] - depth * np.eye(47)[2] for depth in (0.0, 0.1, 0.4, 0.8)]
    return np.concatenate([tumbling, ended, running, *lowered]).astype(np.float64)


def test_a_body_is_below_the_floor_when_mujoco_finds_its_contact(low_poses, model, bodies_of):
    data = mujoco.MjData(model)
    position, rotation = bodies_of(low_poses)
    touched = {name: 0 for name in BODY_NAMES}
    for i, qpos in enumerate(low_poses):
        depth = contacts(model, data, qpos)
        for name in BODY_NAMES:
            height, body = lowest(position[i], rotation[i], only(name))
            assert body == BODY_INDEX[name]
            if abs(height) > 1e-6:
                assert (height < 0) == (name in depth), (i, name, height)
            if name in depth:
                assert height == pytest.approx(depth[name], abs=1e-6)
                touched[name] += 1
    assert len(low_poses) > 500 and min(touched.values()) > 20, touched


@pytest.mark.parametrize("ignored", [(), WEAPONS, ("right_hand", "left_shin")])
def test_a_fall_is_a_contact_of_anything_but_feet_and_ignored_bodies(ignored, low_poses, model, bodies_of):
    position, rotation = bodies_of(low_poses)
    mask, far = fall_mask(ignored), np.full(7, 9.0)
    falls, some = 0, range(0, len(low_poses), 3)
    for i in some:
        qpos = low_poses[i]
        if abs(lowest(position[i], rotation[i], mask)[0]) < 1e-6:
            continue
        floor = model.geom("floor").id
        touching = reference.touching_bodies(mujoco, model, qpos, floor, (*FEET, *ignored))
        end, body = terminate(far, (0.0,) * 4, position[i], rotation[i], mask, 1, 60)
        assert end == (FELL if touching else CONTINUES)
        assert BODY_NAMES[body] in touching if touching else body == -1
        falls += bool(touching)
    assert 50 < falls < len(some)


def test_the_default_fall_ignores_feet_sword_and_shield(make_config):
    mask = fall_mask(make_config().fall.ignore_bodies)
    assert {BODY_NAMES[i] for i in np.flatnonzero(~mask)} == {*FEET, *WEAPONS}
    assert {BODY_NAMES[i] for i in np.flatnonzero(~fall_mask([]))} == set(FEET)


@given(values=st.lists(st.floats(0, 4), min_size=7, max_size=7), which=st.integers(0, 3))
def test_reached_means_strictly_below_every_threshold(values, which):
    deviation = np.array(values)
    columns = [0, 3, 4, 2]  # d^rp, d^kp, d^q, d^rq
    above = np.nextafter(deviation[columns], np.inf)
    assert reached(deviation, tuple(above))
    at = above.copy()
    at[which] = deviation[columns[which]]
    assert not reached(deviation, tuple(at))
    assert reached(deviation, (*above[:3], np.inf))


@given(
    values=st.lists(st.floats(0, 4), min_size=7, max_size=7),
    limits=st.lists(st.floats(0, 4), min_size=3, max_size=3),
)
def test_reach_is_the_references_criterion(values, limits):
    after = SimpleNamespace(rp=values[0], kp=values[3], q=values[4])
    assert reached(np.array(values), (*limits, np.inf)) == reference.reached(after, limits)


@pytest.fixture(scope="module")
def standing(machine, bodies_of):
    """(bodies, rotations) of a pose with only the feet near the ground, and of the same one lying below it."""
    qpos = machine.states[0].clip.qpos[:1].copy()
    high, low = qpos.copy(), qpos.copy()
    low[0, 2] = 0.0
    return [tuple(array[0] for array in bodies_of(pose)) for pose in (high, low)]


def test_time_is_up_after_max_steps_and_not_before(standing):
    up, _ = standing
    far, mask = np.full(7, 9.0), fall_mask(WEAPONS)
    ends = [terminate(far, (1.0,) * 4, *up, mask, steps, 60)[0] for steps in range(1, 62)]
    assert ends == [CONTINUES] * 59 + [TIMED_OUT] * 2


def test_a_fall_goes_before_a_reach_and_a_reach_before_a_time_out(standing):
    up, down = standing
    mask, near, limits = fall_mask(WEAPONS), np.zeros(7), (1.0,) * 4
    assert terminate(near, limits, *down, mask, 60, 60)[0] == FELL
    assert terminate(near, limits, *up, mask, 60, 60) == (REACHED, -1)
    assert terminate(near, limits, *up, mask, 1, 60) == (REACHED, -1)


def test_feet_in_the_ground_are_no_fall(standing, bodies_of, machine):
    qpos = machine.states[0].clip.qpos[:1].copy()
    qpos[0, 2] -= 0.03
    position, rotation = bodies_of(qpos)
    assert lowest(position[0], rotation[0], only(*FEET))[0] < -0.02
    far, mask = np.full(7, 9.0), fall_mask(WEAPONS)
    assert terminate(far, (1.0,) * 4, position[0], rotation[0], mask, 1, 60) == (CONTINUES, -1)
    assert set(FOOT_BODIES) == {BODY_INDEX[name] for name in FEET}
