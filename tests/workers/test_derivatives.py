"""Derivatives of a policy step and of the state, against one simulation after the other by MuJoCo's own functions."""

import mujoco
import numpy as np
import pytest
import reference
from hypothesis import given
from hypothesis import strategies as st

from workers.action import MODES, act_batch
from workers.derivatives import TANGENT, Derivatives, push
from workers.environment import Environment, new_observations
from workers.humanoid import build_model
from workers.inference import PolicyNetwork
from workers.kinematics import NUM_DOF, NV
from workers.types import Thresholds

NEVER = Thresholds(0.0, 0.0, 0.0)
SIZE = 1e-4
SMALL = 1e-6  # of a push on both sides, for what is exact but for kinks
SOLES = {"physics.sole": 0.02, "action.scale": 2.5, "physics.tolerance": 1e-10}


@pytest.fixture(scope="module")
def states(library, make_policy, make_config):
    """(configuration, environment with 6 figures on soles on their way, their next actions)."""
    config = make_config(SOLES)
    env, ids = Environment(config, library, 6), np.arange(6)
    env.plan(3, ids, np.full(6, -1), ids)
    env.begin(ids)
    network, generator = PolicyNetwork(make_policy(), 6), np.random.default_rng(0)

    def action():
        mean = network.mean(env.observe(new_observations(6)))
        return (mean + generator.normal(0.0, 0.02, mean.shape)).astype(np.float32)

    for _ in range(3):
        env.step(action(), NEVER)
    return config, env, action()


def integrated(model, qpos, change):
    """qpos after a change (37,) of its tangent coordinates, by MuJoCo."""
    out = qpos.copy()
    mujoco.mj_integratePos(model, out, change, 1.0)
    return out


def difference(model, qpos, qvel, other_qpos, other_qvel):
    """The change (74,) of tangent coordinates from one state to another, by MuJoCo."""
    out = np.empty(TANGENT)
    mujoco.mj_differentiatePos(model, out[:NV], 1.0, qpos, other_qpos)
    out[NV:] = other_qvel - qvel
    return out


def after(config, model, physics, action, target_qpos, change):
    """(qpos, qvel) a policy step after a change (74,) of the state."""
    data = mujoco.MjData(model)
    mujoco.mj_setState(model, data, physics, mujoco.mjtState.mjSTATE_INTEGRATION)
    data.qpos[:] = integrated(model, data.qpos, change[:NV])
    data.qvel[:] += change[NV:]
    ctrl = np.empty((1, NUM_DOF))
    act_batch(
        action[None], MODES[config.action.mode], config.action.scale, data.qpos[None].copy(), target_qpos[None],
        np.empty_like(ctrl), ctrl,
    )  # fmt: skip
    data.ctrl[:] = ctrl[0]
    for _ in range(config.physics.substeps):
        mujoco.mj_step(model, data)
    return data.qpos.copy(), data.qvel.copy()


@given(st.integers(0, 2**32 - 1), st.integers(0, TANGENT - 1))
def test_a_push_is_mujocos(model, random_pose, seed, coordinate):
    qpos, qvel = random_pose(seed)
    pushed, speed, change = qpos.copy(), qvel.copy(), np.zeros(TANGENT)
    push(pushed, speed, coordinate, 0.01)
    change[coordinate] = 0.01
    np.testing.assert_allclose(pushed, integrated(model, qpos, change[:NV]), atol=1e-12)
    np.testing.assert_allclose(speed, qvel + change[NV:], atol=1e-12)


def pushed(config, model, physics, action, target_qpos, k):
    """Column k of the derivatives (74,): a slow simulation pushed on both sides."""
    ends = []
    for size in (SMALL, -SMALL):
        change, acted = np.zeros(TANGENT), action.astype(np.float64)
        if k < TANGENT:
            change[k] = size
        else:
            acted[k - TANGENT] += size / config.action.scale
        ends.append(after(config, model, physics, acted, target_qpos, change))
    return difference(model, *ends[1], *ends[0]) / (2 * SMALL if k < TANGENT else 2 * SMALL / config.action.scale)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("by_state", (True, False))
def test_they_are_those_of_one_simulation_after_the_other(states, make_config, mode, by_state):
    _, env, action = states
    config = make_config({**SOLES, "action.mode": mode})
    model = build_model(config.physics)
    found = Derivatives(config, 1).of(env.physics, action, env.target_qpos, by_state)
    assert found.shape == (6, TANGENT, (TANGENT if by_state else 0) + NUM_DOF)
    for m in (0, 3):
        for column in range(0, found.shape[2], 7):
            k = column if by_state else column + TANGENT
            expected = pushed(config, model, env.physics[m], action[m], env.target_qpos[m], k)
            np.testing.assert_allclose(found[m, :, column], expected, atol=1e-3 * np.abs(expected).max())


@pytest.mark.parametrize("sole", (0.0, 0.02))
def test_they_are_so_at_the_limits_of_joints_and_actuators_and_falling(states, make_config, sole):
    """Random poses on and in the floor, fast, with actions out of reach."""
    _, env, _ = states
    config, generator = make_config({**SOLES, "physics.sole": sole}), np.random.default_rng(2)
    model = build_model(config.physics)
    data, physics = mujoco.MjData(model), env.physics.copy()
    met = set()
    for m in range(6):
        mujoco.mj_setState(model, data, physics[m], mujoco.mjtState.mjSTATE_INTEGRATION)
        data.qpos[:] = integrated(model, data.qpos, generator.normal(0.0, 0.7, NV))
        data.qpos[2] = env.qpos[m, 2] - 0.1 * m
        data.qvel[:] = generator.normal(0.0, 3.0, NV)
        mujoco.mj_forward(model, data)
        met |= {mujoco.mjtConstraint(kind) for kind in data.efc_type}
        mujoco.mj_getState(model, data, physics[m], mujoco.mjtState.mjSTATE_INTEGRATION)
    assert met == {mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT, mujoco.mjtConstraint.mjCNSTR_CONTACT_PYRAMIDAL}
    action = generator.normal(0.0, 0.3, (6, NUM_DOF))
    found = Derivatives(config, 1).of(physics, action, env.target_qpos)
    assert (np.abs(found[:, :, TANGENT:]).max(axis=1) == 0.0).any()  # actuators that are at their limits throughout
    for m in range(6):
        for k in range(0, TANGENT + NUM_DOF, 5):
            expected = pushed(config, model, physics[m], action[m], env.target_qpos[m], k)
            np.testing.assert_allclose(found[m, :, k], expected, atol=2e-3 * np.abs(expected).max())


def test_a_rows_numbers_depend_on_nothing_but_the_row(states, assert_same_bits):
    config, env, action = states
    derivatives = Derivatives(config, 2)
    physics, action, target = (np.tile(array, (5, 1)) for array in (env.physics, action, env.target_qpos))
    together = derivatives.of(physics, action, target)  # more than fit in at once
    alone = Derivatives(config, 1).of(physics[4:5], action[4:5], target[4:5])
    assert_same_bits(together[[4, 10, 28]], np.concatenate([alone, *(together[[m]] for m in (10, 28))]))
    assert_same_bits(together[10], together[28])


def test_they_foretell_what_a_larger_change_does(states):
    """On soles: a change of state and action together, to a tenth."""
    config, env, action = states
    model, generator = build_model(config.physics), np.random.default_rng(1)
    found = Derivatives(config, 1).of(env.physics, action, env.target_qpos).astype(np.float64)
    missed, moved = 0.0, 0.0
    for m in range(6):
        change, more = generator.normal(0.0, 2e-3, TANGENT), generator.normal(0.0, 2e-3, NUM_DOF)
        rest = after(config, model, env.physics[m], action[m], env.target_qpos[m], np.zeros(TANGENT))
        end = after(config, model, env.physics[m], action[m] + more, env.target_qpos[m], change)
        true = difference(model, *rest, *end)
        said = found[m] @ np.concatenate([change, more])
        missed, moved = missed + ((said - true)[:NV] ** 2).sum(), moved + (true[:NV] ** 2).sum()
    assert missed < 0.1**2 * moved


def test_where_a_simulation_explodes_numbers_are_not_finite_and_the_others_are(states, library):
    config, env, action = states
    physics = env.physics.copy()
    whole = Derivatives(config, 1).of(physics, action, env.target_qpos)
    fast = Environment(config, library, 6)
    fast.physics[:] = physics
    fast.qvel[2] = 1e12
    physics[2] = fast.physics[2]
    found = Derivatives(config, 1).of(physics, action, env.target_qpos)
    assert not np.isfinite(found[2]).all()
    np.testing.assert_array_equal(np.delete(found, 2, axis=0), np.delete(whole, 2, axis=0))


@pytest.mark.parametrize("encoding", ("absolute", "difference"))
def test_what_is_observed_changes_as_the_scalar_observation_does(model, random_poses, make_config, encoding):
    qpos, qvel = random_poses(3, seed=1)
    target_qpos, target_qvel = random_poses(3, seed=2)
    derivatives = Derivatives(make_config({"observation.target": encoding}), 2)
    found = derivatives.observed(qpos, qvel, target_qpos, target_qvel)
    for m in range(3):
        for column in range(0, TANGENT, 5):
            ends = []
            for sign in (1.0, -1.0):
                change = np.zeros(TANGENT)
                change[column] = sign * SIZE
                pose = integrated(model, qpos[m], change[:NV]), qvel[m] + change[NV:]
                ends.append(reference.observation(*pose, target_qpos[m], target_qvel[m], encoding == "difference"))
            expected = (ends[0] - ends[1]) / (2 * SIZE)
            np.testing.assert_allclose(found[m, :, column], expected, atol=2e-4, rtol=1e-3)
