"""Inverse dynamics: motions whose residual wrench is known, slow references, and the simulation as its own proof."""

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from motion import rotations, skeleton
from motion.measures import soles
from workers import plausibility
from workers.config import PhysicsConfig
from workers.environment import Environment
from workers.humanoid import FORCE_LIMIT, GAINS, MASSES
from workers.plausibility import Judge, derivatives, model_residual, physics_steps
from workers.types import Thresholds

FPS = 30
PHYSICS = PhysicsConfig()
NEVER = Thresholds(0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def judge():
    return Judge(PHYSICS)


@pytest.fixture(scope="module")
def pose(machine):
    """The idle stance with its soles on the floor."""
    out = machine.states[0].clip.qpos[0].copy()
    out[2] -= soles(out[None])[..., 2].min()
    return out


def lifted(pose, heights):
    """Frames of one pose, that high (m) above where it stands."""
    out = np.repeat(pose[None], len(heights), axis=0)
    out[:, 2] += heights
    return out


# --------------------------------------------------------------------------------------------------- known answers


def test_weight_height_and_limits_are_the_figures(judge):
    sides = {"upper_arm", "lower_arm", "hand", "thigh", "shin", "foot"}
    mass = sum(value * (2 if name in sides else 1) for name, value in MASSES.items())
    assert judge.weight == pytest.approx(mass * 9.81)
    # offsets of spec section 7, from the sole to the top of the head
    assert judge.height == pytest.approx(0.05 + 0.40987 + 0.421546 + 0.236151 + 0.223894 + 0.175 + 0.095)
    assert judge.limits[0] == FORCE_LIMIT * GAINS["abdomen"][0] and len(judge.limits) == 31


def test_free_fall_leaves_nothing(judge, pose):
    times = np.arange(7) / FPS
    verdict = judge.judge(lifted(pose, 5 - 9.81 / 2 * times**2), FPS)
    assert len(verdict.force) == 5
    assert verdict.relative_force == pytest.approx(0, abs=1e-9)
    assert verdict.relative_moment == pytest.approx(0, abs=1e-9)
    assert verdict.torques == pytest.approx(0, abs=1e-6) and not verdict.torque_excess.any()


def test_a_figure_held_in_the_air_leaves_its_body_weight(judge, pose):
    """Held at the centre of mass: a force, no moment."""
    verdict = judge.judge(lifted(pose, np.full(5, 1.0)), FPS)
    assert verdict.force == pytest.approx(judge.weight)
    assert verdict.relative_force == pytest.approx(1)
    assert verdict.relative_moment == pytest.approx(0, abs=1e-9)


def test_a_figure_that_stands_leaves_nothing(judge, pose):
    verdict = judge.judge(lifted(pose, np.zeros(5)), FPS)
    assert (verdict.relative_force < 0.01).all() and (verdict.relative_moment < 0.01).all()
    assert not verdict.torque_excess.any()


def test_a_figure_pulled_up_faster_than_it_falls_needs_a_hand(judge, pose):
    """It leaves the floor upwards at 1 g: in the air a hand has to carry two body weights."""
    times = np.arange(7) / FPS
    verdict = judge.judge(lifted(pose, 1 + 9.81 / 2 * times**2), FPS)
    assert verdict.relative_force == pytest.approx(2)


def test_a_figure_that_leans_beyond_its_feet_needs_a_hand(judge, pose):
    leaning = pose.copy()
    turn = rotations.multiply(rotations.about_z(0.0), rotations.about_y(0.6))
    leaning[3:7] = rotations.multiply(turn, leaning[3:7])
    leaning[2] -= soles(leaning[None])[..., 2].min()
    verdict = judge.judge(lifted(leaning, np.zeros(4)), FPS)
    assert (verdict.relative_moment > 0.05).all()


def test_feet_push_but_do_not_pull(judge, pose):
    """Standing, pulled down at 3 g in all: more than gravity gives, and a floor cannot."""
    times = np.arange(6) / FPS
    verdict = judge.judge(lifted(pose, 0.02 - 9.81 * 1.5 * times**2), FPS)
    assert verdict.relative_force == pytest.approx(2)


@pytest.mark.parametrize(("speed", "exceeds"), [(10, False), (18, True)])
def test_an_elbow_that_turns_too_fast_exceeds_its_actuator(judge, pose, speed, exceeds):
    """At a steady speed the torque is damping, 30 N m s/rad, but for some weight; the limit is 450 N m."""
    high = lifted(pose, np.full(6, 2.0))
    high[:, 7 + skeleton.JOINT_QPOS[skeleton.JOINT_INDEX["left_elbow"]]] -= speed * np.arange(6) / FPS
    verdict = judge.judge(high, FPS)
    joint = skeleton.JOINT_DOF[skeleton.JOINT_INDEX["left_elbow"]]
    assert verdict.torques[:, joint] == pytest.approx(-GAINS["elbow"][1] * speed, abs=30)
    assert judge.limits[joint] == 450 and (verdict.torque_excess == exceeds).all()


def test_too_few_frames_are_no_verdict(judge, pose):
    for frames in (1, 2):
        verdict = judge.judge(lifted(pose, np.zeros(frames)), FPS)
        assert len(verdict.force) == len(verdict.torque_excess) == 0


# ---------------------------------------------------------------------------------------------------------- references


@given(seed=st.integers(0, 1000))
def test_derivatives_are_mujocos_differences(model, random_poses, seed):
    qpos, _ = random_poses(4, seed)
    qvel, qacc = derivatives(qpos, FPS)
    rates = np.zeros((3, 37))
    for rate, a, b in zip(rates, qpos, qpos[1:]):
        mujoco.mj_differentiatePos(model, rate, 1 / FPS, a, b)
    assert qvel == pytest.approx(np.array([(a + b) / 2 for a, b in zip(rates, rates[1:])]), abs=1e-6)
    assert qacc == pytest.approx(np.array([(b - a) * FPS for a, b in zip(rates, rates[1:])]), abs=1e-4)


@settings(max_examples=10)
@given(seed=st.integers(0, 1000))
def test_the_best_contact_forces_are_those_of_another_solver(judge, pose, seed):
    """Each frame by slow code: all generalized forces by MuJoCo's Newton-Euler pass, contacts by a bounded solver."""
    generator = np.random.default_rng(seed)
    qpos = lifted(pose, generator.uniform(-0.01, 0.01, 3))
    qpos[:, :2] += generator.uniform(-0.01, 0.01, (3, 2))
    verdict = judge.judge(qpos, FPS)
    model, data = judge.model, mujoco.MjData(judge.model)
    model.opt.disableflags = 0
    points = {}
    for frame in qpos:
        data.qpos[:] = frame
        mujoco.mj_forward(model, data)
        for contact in data.contact:
            assert 0 in contact.geom  # with the floor
            body = model.geom_bodyid[max(contact.geom)]
            local = data.xmat[body].reshape(3, 3).T @ (contact.pos - data.xpos[body])
            points[int(body), tuple(np.round(local, 4))] = None
    qvel, qacc = derivatives(qpos, FPS)
    data.qpos[:], data.qvel[:] = qpos[1], qvel[0]
    mujoco.mj_forward(model, data)
    data.qacc[:] = qacc[0]
    need = np.zeros(37)
    mujoco.mj_rne(model, data, 1, need)
    need -= data.qfrc_passive
    need[:3], columns = need[:3], []
    root, center = data.xpos[1], data.subtree_com[0]
    turn = data.xmat[1].reshape(3, 3)

    def about_center(force):
        moment = turn @ force[3:6] + np.cross(root - center, force[:3])
        return np.concatenate([force[:3], moment, force[6:]])

    for body, local in points:
        jacobian = np.zeros((3, 37))
        place = data.xpos[body] + data.xmat[body].reshape(3, 3) @ local
        mujoco.mj_jac(model, data, jacobian, None, place, body)
        for edge in ((1, 0, 1), (-1, 0, 1), (0, 1, 1), (0, -1, 1)):
            columns.append(about_center(jacobian.T @ np.array(edge, float)))
    scale = [1 / judge.weight] * 3 + [1 / judge.weight / judge.height] * 3 + list(0.01 / judge.limits)
    scale = np.array(scale)
    matrix, wanted = np.array(columns).T * scale[:, None], about_center(need) * scale
    best = lsq_linear(matrix * judge.weight, wanted, (0, np.inf), method="bvls", tol=1e-14)
    left = (wanted - matrix * judge.weight @ best.x) / scale
    assert verdict.force[0] == pytest.approx(np.linalg.norm(left[:3]), abs=1e-3 * judge.weight)
    assert verdict.moment[0] == pytest.approx(np.linalg.norm(left[3:6]), abs=1e-3 * judge.weight)


# ---------------------------------------------------------------------------------------------------- simulated motion


@pytest.fixture(scope="module")
def episode(library, make_config):
    """A policy step by step: 20 steps of an environment that holds its target pose, from a moment of the stab."""
    env = Environment(make_config(), library, 1)
    env.task[0] = (2, 1.0, 0, 0.3)
    env.begin(np.array([0]))
    qpos, qvel, targets = [env.qpos[0].copy()], [env.qvel[0].copy()], []
    for _ in range(20):
        env.step(np.zeros((1, 31), dtype=np.float32), NEVER)
        qpos.append(env.qpos[0].copy())
        qvel.append(env.qvel[0].copy())
        targets.append(env.pd_target[0].copy())
    return np.array(qpos), np.array(qvel), np.array(targets)


def test_an_episode_simulated_again_at_the_physics_rate_is_the_same(episode):
    qpos, qvel, targets = episode
    all_qpos, all_qvel = physics_steps(PHYSICS, qpos[0], qvel[0], targets)
    assert len(all_qpos) == 20 * PHYSICS.substeps + 1
    assert all_qpos[:: PHYSICS.substeps] == pytest.approx(qpos, abs=1e-9)
    assert all_qvel[:: PHYSICS.substeps] == pytest.approx(qvel, abs=1e-7)


def test_a_simulation_solves_its_own_equation(judge, episode):
    """With MuJoCo's own contact forces nothing is left; without its contacts, the floor's push is."""
    qpos, qvel, targets = episode
    qpos, qvel = physics_steps(PHYSICS, qpos[0], qvel[0], targets)
    qacc = np.diff(qvel, axis=0) / PHYSICS.timestep
    left = model_residual(PHYSICS, qpos[:-1], qvel[:-1], qacc)
    assert np.abs(left[:, :3]).max() < 1e-3 * judge.weight
    above = qpos[:-1] + np.eye(47)[2]
    assert np.linalg.norm(model_residual(PHYSICS, above, qvel[:-1], qacc)[:, :3], axis=1).mean() > 0.5 * judge.weight


def test_a_simulated_motion_is_plausible_at_either_rate_and_a_crossfade_of_its_ends_is_not(judge, episode):
    """The best contact forces explain it, too, and differentiating at 30 instead of 120 Hz costs little."""
    qpos, qvel, targets = episode
    fine, _ = physics_steps(PHYSICS, qpos[0], qvel[0], targets)
    coarse_verdict, fine_verdict = judge.judge(qpos, FPS), judge.judge(fine, 120)
    assert coarse_verdict.relative_force.mean() < 0.05 and fine_verdict.relative_force.mean() < 0.05
    assert coarse_verdict.relative_moment.mean() < 0.05
    assert coarse_verdict.torque_excess.mean() < 0.1
    share = np.linspace(0, 1, 8)[:, None]
    hurried = qpos[0] + (qpos[-1] - qpos[0]) * share**2 + np.eye(47)[0] * 0.6 * share**2
    assert judge.judge(hurried, FPS).relative_force.mean() > 5 * coarse_verdict.relative_force.mean()


def test_the_model_of_the_simulation_is_not_touched(judge):
    """Candidates for contact are found with a margin, which must be the judge's alone."""
    assert judge.model.geom_margin.max() == plausibility.REACH
    assert not plausibility.build_model(PHYSICS).geom_margin.any()
