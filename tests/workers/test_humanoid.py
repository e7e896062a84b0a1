"""The MuJoCo model against section 7: skeleton, masses, gains, what may touch what."""

import itertools

import mujoco
import numpy as np
import pytest
import reference

from motion import skeleton
from workers.config import PhysicsConfig
from workers.humanoid import EXCLUDED, build_model
from workers.planner import ground

BALL, HINGE, FREE = (mujoco.mjtJoint.mjJNT_BALL, mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_FREE)


def test_sizes_and_mass_are_the_specs(model):
    assert (model.nq, model.nv, model.nu) == (47, 37, 31)
    assert model.body_subtreemass[0] == pytest.approx(51.7, abs=1e-9)
    assert (model.body_mass[1:] > 0).all()


def test_bodies_and_joints_are_in_the_skeletons_order(model):
    assert [model.body(i + 1).name for i in range(17)] == list(skeleton.BODY_NAMES)
    for i, body in enumerate(skeleton.BODIES):
        assert model.body_parentid[i + 1] == body.parent + 1
        np.testing.assert_allclose(model.body_pos[i + 1], body.offset, atol=1e-12)
    assert model.jnt_type[0] == FREE and model.njnt == 14
    for j, (name, kind, _) in enumerate(reference.JOINTS):
        joint = model.joint(j + 1)
        assert joint.name == name
        assert model.jnt_type[j + 1] == (BALL if kind == "ball" else HINGE)
        assert model.jnt_qposadr[j + 1] == 7 + skeleton.JOINT_QPOS[j]
        assert model.jnt_dofadr[j + 1] == 6 + skeleton.JOINT_DOF[j]
        assert skeleton.BODY_NAMES[model.jnt_bodyid[j + 1] - 1] == {r[3]: r[0] for r in reference.FIGURE}[name]
        if kind == "hinge":
            np.testing.assert_array_equal(model.jnt_axis[j + 1], [0, 1, 0])


def test_gains_are_the_specs_with_damping_in_the_joints_and_force_limits_of_one_and_a_half_kp(model):
    at = 0
    for name, kind, _ in reference.JOINTS:
        kp, kd = reference.GAINS[name]
        dofs = 3 if kind == "ball" else 1
        start = model.joint(name).dofadr[0]
        np.testing.assert_array_equal(model.dof_damping[start : start + dofs], kd)
        for axis in range(dofs):
            assert model.actuator_trnid[at, 0] == model.joint(name).id
            np.testing.assert_array_equal(model.actuator_gear[at, :3], np.eye(3)[axis] if dofs == 3 else [1, 0, 0])
            assert model.actuator_gainprm[at, 0] == kp
            # a position servo without damping of its own
            np.testing.assert_array_equal(model.actuator_biasprm[at, :3], [0, -kp, 0])
            assert model.actuator_forcelimited[at]
            np.testing.assert_allclose(model.actuator_forcerange[at], [-1.5 * kp, 1.5 * kp])
            assert not model.actuator_ctrllimited[at]
            at += 1
    assert at == model.nu
    np.testing.assert_array_equal(model.dof_damping[:6], 0)


def test_physics_run_at_120_hz_and_the_policy_at_30(model):
    physics = PhysicsConfig()
    assert model.opt.timestep == 1 / 120 and physics.substeps == 4
    assert model.opt.solver == mujoco.mjtSolver.mjSOL_NEWTON
    assert (model.opt.iterations, model.opt.ls_iterations) == (10, 10)
    assert build_model(PhysicsConfig(timestep=1 / 240)).opt.timestep == 1 / 240


def may_touch(model, a, b):
    """Whether MuJoCo would test bodies a and b (names, or "floor") for contact, by bits and exclusions."""
    ids = [0 if name == "floor" else model.body(name).id for name in (a, b)]
    first, second = ([g for g in range(model.ngeom) if model.geom_bodyid[g] == body] for body in ids)
    bits = any(
        model.geom_contype[g] & model.geom_conaffinity[h] or model.geom_contype[h] & model.geom_conaffinity[g]
        for g in first
        for h in second
    )
    excluded = {tuple(sorted(((int(s) >> 16) & 0xFFFF, int(s) & 0xFFFF))) for s in model.exclude_signature}
    return bits and tuple(sorted(ids)) not in excluded


def test_weapons_touch_the_floor_and_nothing_else(model):
    for weapon in ("sword", "shield"):
        assert may_touch(model, weapon, "floor")
        assert not any(may_touch(model, weapon, other) for other in skeleton.BODY_NAMES if other != weapon)


def test_every_body_touches_the_floor_and_the_body_itself_but_for_the_excluded_pairs(model):
    assert all(may_touch(model, name, "floor") for name in skeleton.BODY_NAMES)
    body = [name for name in skeleton.BODY_NAMES if name not in ("sword", "shield")]
    excluded = {frozenset(pair[:2]) for pair in EXCLUDED}
    for a, b in itertools.combinations(body, 2):
        assert may_touch(model, a, b) == (frozenset((a, b)) not in excluded), (a, b)
    assert all(len(reason.split()) > 3 for _, _, reason in EXCLUDED)


def test_joint_limits_hold_every_frame_of_the_clips(model, all_clips):
    for clip in all_clips:
        for joint, start in zip(skeleton.JOINTS, skeleton.JOINT_DOF, strict=True):
            own = model.joint(joint.name)
            if not model.jnt_limited[own.id]:
                continue
            angles = clip.joints[:, start : start + joint.dof]
            angles = np.linalg.norm(angles, axis=1) if joint.dof == 3 else angles[:, 0]
            low, high = own.range
            assert low - 1e-6 <= angles.min() and angles.max() <= high + 1e-6, (clip.name, joint.name)


def test_the_figure_stands_for_half_a_second_when_its_controllers_hold_the_pose(model, machine):
    qpos = machine.states[0].clip.qpos[0].copy()
    ground(qpos, np.empty((17, 3)), np.empty((17, 4)))
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    data.ctrl[:] = skeleton.joint_coordinates(qpos)
    for _ in range(60):
        mujoco.mj_step(model, data)
    assert data.qpos[2] == pytest.approx(qpos[2], abs=0.05)
    assert abs(data.qvel).max() < 2.0


def standing(physics, height):
    """(model, data) of a figure at rest, its feet level and `height` m above the floor, its PD targets met."""
    model = build_model(physics)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    feet = [g for g in range(model.ngeom) if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_BOX]
    data.qpos[2] += height - min(data.geom_xpos[g][2] - model.geom_size[g][2] for g in feet)
    return model, data


def ground_force(physics, height):
    """N, of the floor on a figure `standing` over it."""
    model, data = standing(physics, height)
    mujoco.mj_forward(model, data)
    total, wrench = 0.0, np.zeros(6)
    for k in range(data.ncon):
        mujoco.mj_contactForce(model, data, k, wrench)
        total += wrench[0]
    return total


@pytest.mark.parametrize("sole", (0.01, 0.02))
def test_the_ground_takes_hold_of_a_sole_little_by_little_and_of_a_hard_foot_at_once(sole):
    heights = np.linspace(sole / 2 + 1e-4, -sole / 2, 41)
    force = [ground_force(PhysicsConfig(sole=sole), height) for height in heights]
    weight = build_model(PhysicsConfig()).body_subtreemass[0] * 9.81
    assert force[0] == 0.0 and (np.diff(force) >= 0.0).all()
    assert np.diff(force).max() < 0.4 * weight and force[-1] > weight
    assert ground_force(PhysicsConfig(), 1e-6) == 0.0
    assert ground_force(PhysicsConfig(), -1e-6) > 0.5 * weight


def test_a_figure_with_soles_stands_where_it_stands_without():
    def height(sole):
        model, data = standing(PhysicsConfig(sole=sole), 0.0)
        for _ in range(30):
            mujoco.mj_step(model, data)
        return data.qpos[2]

    assert height(0.01) == pytest.approx(height(0.0), abs=0.002)
    assert height(0.02) == pytest.approx(height(0.0), abs=0.002)


@pytest.mark.parametrize("sole", (0.0, 0.02))
def test_neither_the_cheaper_integrator_nor_islands_change_a_bit_of_figures_that_fall(sole):
    fast, full = build_model(PhysicsConfig(sole=sole)), build_model(PhysicsConfig(sole=sole))
    full.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    full.opt.disableflags = 0
    contacts = 0
    for seed in range(8):
        random, ends = np.random.default_rng(seed), []
        start, controls = random.normal(size=fast.nv), random.normal(size=(120, fast.nu))
        for model in (fast, full):
            data = mujoco.MjData(model)
            data.qpos[2], data.qvel[:] = 1.0, start
            for k in range(120):
                data.ctrl[:] = controls[k // 4]
                mujoco.mj_step(model, data)
                contacts += data.ncon
            ends.append(np.concatenate([data.qpos, data.qvel]))
        np.testing.assert_array_equal(*ends)
    assert contacts > 120
