"""Derivatives of inverse dynamics in closed form, against differences of MuJoCo's own inverse dynamics."""

import functools

import mujoco
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from workers.config import PhysicsConfig
from workers.constraint_derivatives import add_reactions
from workers.humanoid import build_model
from workers.inverse_derivatives import InverseDerivatives
from workers.kinematics import NUM_DOF, NV
from workers.spatial import BODY, COUNT, HANGS, TIP, cross, cross_force, momentum, summed

FLOOR, LIMIT, EDGE = 0, mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT, mujoco.mjtConstraint.mjCNSTR_CONTACT_PYRAMIDAL
SMALL = 1e-7


@functools.cache
def feet_only(sole):
    """The figure, of which only the feet meet the floor, with a solver that goes on until it is done."""
    model = build_model(PhysicsConfig(sole=sole, iterations=200, ls_iterations=100, tolerance=1e-14))
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_INVDISCRETE
    others = (model.geom_type != mujoco.mjtGeom.mjGEOM_BOX) & (np.arange(model.ngeom) != FLOOR)
    model.geom_contype[others] = model.geom_conaffinity[others] = 0
    feet = model.geom_type == mujoco.mjtGeom.mjGEOM_BOX
    model.geom_conaffinity[feet] = 0  # not each other
    return model


def placed(model, random_pose, seed, depth):
    """Data of a random pose whose lowest foot is `depth` m in the floor, with torques."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = random_pose(seed)
    data.qvel[:] *= 0.3
    data.qpos[2] = 5.0
    mujoco.mj_forward(model, data)
    corners = []
    for geom in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_BOX):
        turn = data.geom_xmat[geom].reshape(3, 3)
        corners.append(data.geom_xpos[geom, 2] - np.abs(turn[2]) @ model.geom_size[geom])
    data.qpos[2] -= min(corners) + depth
    data.ctrl[:] = np.random.default_rng(seed).normal(0.0, 1.0, NUM_DOF)
    return data


def residual(model, data, qpos, qvel, acceleration):
    """r (37,) by MuJoCo."""
    data.qpos[:], data.qvel[:], data.qacc[:] = qpos, qvel, acceleration
    mujoco.mj_inverse(model, data)
    mujoco.mj_fwdActuation(model, data)
    return data.qfrc_inverse - data.qfrc_actuator


def jacobian(data):
    """J (nefc, 37), dense."""
    out = np.zeros((data.nefc, NV))
    for row in range(data.nefc):
        for i in range(data.efc_J_rowadr[row], data.efc_J_rowadr[row] + data.efc_J_rownnz[row]):
            out[row, data.efc_J_colind[i]] = data.efc_J[i]
    return out


@pytest.mark.parametrize("sole", (0.0, 0.02))
@settings(max_examples=100, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_they_are_differences_of_mujocos_inverse_dynamics(random_pose, sole, seed):
    """Anywhere, at joints' limits, on corners of the feet; the acceleration is what the step had."""
    model = feet_only(sole)
    data = placed(model, random_pose, seed, np.random.default_rng(seed).uniform(-0.01, 0.03))
    qpos, qvel = data.qpos.copy(), data.qvel.copy()
    mujoco.mj_step(model, data)
    assume(not data.warning.number.any() and np.abs(data.qvel).max() < 300)  # has not exploded
    acceleration = (data.qvel - qvel) / model.opt.timestep
    limited = np.abs(data.actuator_force) >= model.actuator_forcerange[:, 1]
    stiffness = np.where(limited, 0.0, model.actuator_gainprm[:, 0])
    by_acceleration, react, turned = np.zeros((NV, NV)), np.zeros((NV, 2 * NV)), np.zeros((NV, NV))
    mujoco.mj_fullM(model, data, by_acceleration)
    mass, active = by_acceleration.copy(), data.efc_force > 0
    add_reactions(
        data.efc_force, data.efc_D, data.efc_KBIP, data.efc_J_rownnz, data.efc_J_rowadr, data.efc_J_colind, data.efc_J,
        by_acceleration, react[:, NV:],
    )  # fmt: skip
    j = jacobian(data)[active]
    np.testing.assert_allclose(by_acceleration, mass + (j.T * data.efc_D[active]) @ j, rtol=1e-9, atol=1e-9)
    assert InverseDerivatives(model).add(data, qpos, qvel, acceleration, stiffness, react, turned)
    react[:, :NV] -= by_acceleration @ np.linalg.solve(mass, turned)

    expected, moved = np.empty((NV, 2 * NV)), np.empty_like(qpos)
    for k in range(NV):
        ends = []
        for size in (SMALL, -SMALL):
            change = size * (np.arange(NV) == k)
            moved[:] = qpos
            mujoco.mj_integratePos(model, moved, change, 1.0)
            states = (moved, qvel), (qpos, qvel + change)
            ends.append([residual(model, data, *state, acceleration) for state in states])
        expected[:, k], expected[:, NV + k] = ((up - down) / (2 * SMALL) for up, down in zip(*ends, strict=True))
    for half in (slice(0, NV), slice(NV, 2 * NV)):
        scale = np.abs(expected[:, half]).max()
        np.testing.assert_allclose(react[:, half], expected[:, half], rtol=0, atol=2e-5 * scale)


def test_the_cases_above_have_limits_and_corners(random_pose):
    """Some of both kinds, else they would prove nothing."""
    met = []
    for seed in range(40):
        data = placed(feet_only(0.02), random_pose, seed, 0.005)
        mujoco.mj_step(feet_only(0.02), data)
        met.append([((data.efc_type == kind) & (data.efc_force > 0)).any() for kind in (LIMIT, EDGE)])
    assert (np.mean(met, axis=0) > 0.3).all()


def test_a_contact_that_is_not_known_is_told(random_pose):
    model = build_model(PhysicsConfig(sole=0.02))
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = random_pose(3)
    data.qpos[2] = 0.1  # on what is not a foot, too
    qpos, qvel = data.qpos.copy(), data.qvel.copy()
    mujoco.mj_step(model, data)
    shapes = model.geom_type[data.contact.geom]
    assert not (shapes == (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_BOX)).all()
    react, turned = np.zeros((NV, 2 * NV)), np.zeros((NV, NV))
    assert not InverseDerivatives(model).add(data, qpos, qvel, np.zeros(NV), np.zeros(NUM_DOF), react, turned)


@given(st.integers(0, 2**32 - 1))
def test_sums_along_the_tree_and_momenta_are_mujocos(model, random_pose, seed):
    """Velocities of bodies, and the kinetic energy."""
    data, energy, own = mujoco.MjData(model), 0.0, np.empty(6)
    data.qpos[:], data.qvel[:] = random_pose(seed)
    mujoco.mj_forward(model, data)
    bodies, carriers = summed(data.cdof * data.qvel[:, None], np.zeros(6))
    np.testing.assert_allclose(bodies, data.cvel, atol=1e-9)
    for j in range(6, NV):
        np.testing.assert_array_equal(carriers[j], bodies[model.body_parentid[BODY[j]]])
    np.testing.assert_allclose(carriers[3:6], [[0, 0, 0, *data.qvel[:3]]] * 3)
    assert not carriers[:3].any()
    for k in range(1, COUNT):
        momentum(data.cinert[k], bodies[k], own)
        energy += 0.5 * own @ bodies[k]
    mass = np.empty((NV, NV))
    mujoco.mj_fullM(model, data, mass)
    assert energy == pytest.approx(0.5 * data.qvel @ mass @ data.qvel, rel=1e-9)


def test_what_hangs_on_what_is_mujocos(model):
    for i in range(NV):
        assert BODY[i] == model.dof_bodyid[i] and TIP[BODY[i]] == np.flatnonzero(BODY == BODY[i])[-1]
        above, dof = set(), i
        while dof >= 0:
            above.add(dof)
            dof = model.dof_parentid[dof]
        joints = {j for j in range(NV) if any(_joint(j) == _joint(d) for d in above)}
        assert set(np.flatnonzero(HANGS[i])) == joints


def _joint(dof):
    """Of a dof; the root's place and its turn are two."""
    return (BODY[dof], dof < 3)


@given(st.lists(st.floats(-2, 2), min_size=18, max_size=18))
def test_crosses_are_those_of_matrices(numbers):
    """Of motions the matrix [w 0; v w], of forces its negative transpose, so that power is kept."""
    a, b, f = np.array(numbers).reshape(3, 6)
    matrix = np.zeros((6, 6))
    matrix[:3, :3] = matrix[3:, 3:] = np.cross(a[:3], np.eye(3)).T
    matrix[3:, :3] = np.cross(a[3:], np.eye(3)).T
    out, force = np.empty(6), np.empty(6)
    cross(a, b, out)
    cross_force(a, f, force)
    np.testing.assert_allclose(out, matrix @ b, atol=1e-12)
    np.testing.assert_allclose(force, -matrix.T @ f, atol=1e-12)
    assert out @ f + b @ force == pytest.approx(0.0, abs=1e-9)
