"""Whole steps of the environment against the spec's scalar version, and what becomes of a simulation that diverges."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import reference
from mujoco.batch import SimulationError

from motion.skeleton import BODY_NAMES
from workers.environment import Environment
from workers.types import CONTINUES, FELL, NUM_PARTS, REACHED, REWARD_PARTS, TIMED_OUT, Thresholds

MAX_STEPS = 10


def start(config, library, n, seed=3):
    env = Environment(config, library, n)
    env.plan(seed, np.arange(n), np.full(n, -1), np.arange(n))
    env.begin(np.arange(n))
    return env


def actions(n, size=0.3, push=0.0, seed=0):
    """A function giving actions (n, 31): noise, and in every other environment a constant push that makes it fall."""
    generator = np.random.default_rng(seed)
    constant = push * generator.normal(size=(n, 31))
    constant[::2] = 0.0
    return lambda: (constant + size * generator.normal(size=(n, 31))).astype(np.float32)


def poses(env, i):
    return env.qpos[i].copy(), env.qvel[i].copy(), env.target_qpos[i].copy(), env.target_qvel[i].copy()


@pytest.mark.parametrize(
    "clips, changes",
    [
        ("library", {}),
        ("real_library", {"action.mode": "absolute"}),
        ("library", {"reward.upper_body_penalty": False, "reward.key_body_frame": "own"}),
        ("library", {"reward.tremble": False, "fall.ignore_bodies": []}),
    ],
    ids=["paper", "paper_real_clips", "no_urp_own_frames", "no_tr_weapons_count"],
)
def test_every_step_is_the_references(clips, changes, make_config, easy, request):
    """Reward, tremble count and end, followed through whole episodes with the slow code alone."""
    library = request.getfixturevalue(clips)
    config = make_config({"task.max_steps": MAX_STEPS, **changes})
    n, first_trembles = 6, 90
    env, act = start(config, library, n), actions(n, push=1.5)
    model = env._batch.model
    floor = model.geom("floor").id
    seen = set()
    limits = (easy.root_position, easy.key_bodies, easy.joint_rotation)
    # the count begins at 90, so that the penalty of Eq. 12 sets in within the episode
    env.trembles[:] = first_trembles
    steps, trembles, returns = np.zeros(n, int), np.full(n, first_trembles), np.zeros(n)
    frame = config.reward.key_body_frame
    deviations = [reference.deviations(*poses(env, i), frame) for i in range(n)]
    for _ in range(18):
        before = [poses(env, i) for i in range(n)]
        env.step(act(), easy)
        ended = []
        for i in range(n):
            now = poses(env, i)
            assert (now[2] == before[i][2]).all() and (now[3] == before[i][3]).all()
            d0, d1 = deviations[i], reference.deviations(*now, frame)
            deviations[i] = d1
            changed = reference.direction_changes(before[i][1][6:], now[1][6:])
            steps[i] += 1
            trembles[i] += changed
            ignored = ("right_foot", "left_foot", *config.fall.ignore_bodies)
            touching = reference.touching_bodies(mujoco, model, now[0], floor, ignored)
            if touching:
                end, cause = FELL, "failure"
            elif reference.reached(d1, limits):
                end, cause = REACHED, "success"
            elif steps[i] >= MAX_STEPS:
                end, cause = TIMED_OUT, "failure"
            else:
                end, cause = CONTINUES, None
            assert env.end[i] == end
            assert BODY_NAMES[env.fell_on[i]] in touching if touching else env.fell_on[i] == -1
            reward = reference.reward(
                d0, d1, cause, changed, trembles[i], config.reward.upper_body_penalty, config.reward.tremble
            )
            assert env.parts[i].sum() == pytest.approx(reward, abs=1e-7)
            returns[i] += reward
            assert (env.steps[i], env.trembles[i]) == (steps[i], trembles[i])
            assert env.totals[i].sum() == pytest.approx(returns[i], abs=1e-6)
            np.testing.assert_allclose(env.deviations[i], [d1.rp, d1.rv, d1.rq, d1.kp, d1.q, d1.lq, d1.qv], atol=1e-7)
            seen.add(end)
            if end != CONTINUES:
                ended.append(i)
        env.begin(np.array(ended, dtype=np.int64))
        env.trembles[ended] = first_trembles
        steps[ended], trembles[ended], returns[ended] = 0, first_trembles, 0.0
        for i in ended:
            deviations[i] = reference.deviations(*poses(env, i), frame)
    assert seen >= {CONTINUES, REACHED, TIMED_OUT} and (FELL in seen or clips == "real_library")


def test_a_step_is_four_physics_steps_of_mujoco_at_120_hz(library, make_config, easy):
    env = start(make_config(), library, 4)
    data = [env._batch.get_data(i) for i in range(4)]
    env.step(actions(4)(), easy)
    for i in range(4):
        data[i].ctrl[:] = env._ctrl[i]
        for _ in range(4):
            mujoco.mj_step(env._batch.model, data[i])
        np.testing.assert_array_equal(data[i].qpos, env.qpos[i])
        np.testing.assert_array_equal(data[i].qvel, env.qvel[i])


def test_only_the_asked_rows_are_stepped(library, make_config, easy):
    env, other = (start(make_config(), library, 6) for _ in range(2))
    names = ("qpos", "qvel", "steps", "trembles", "totals", "deviations", "joints", "bodies")
    before = {name: getattr(env, name).copy() for name in names}
    rows, rest = np.array([1, 4]), np.array([0, 2, 3, 5])
    action = actions(6)()
    env.step(action, easy, rows)
    other.step(action, easy)
    for name in names:
        np.testing.assert_array_equal(getattr(env, name)[rest], before[name][rest], err_msg=name)
        np.testing.assert_array_equal(getattr(env, name)[rows], getattr(other, name)[rows], err_msg=name)


def test_beginning_an_episode_leaves_nothing_of_the_last_one(library, make_config, easy, assert_same_bits):
    n = 5
    env, fresh = (start(make_config(), library, n) for _ in range(2))
    act = actions(n)
    for _ in range(7):
        env.step(act(), easy)
    env.begin(np.arange(n))
    save = (np.arange(n), np.zeros(n, dtype=np.int64), 0)
    assert_same_bits(env.save(*save), fresh.save(*save))
    assert not env.steps.any() and not env.trembles.any() and not env.totals.any()


def test_saving_and_loading_continue_the_same_simulation(library, make_config, easy, assert_same_bits):
    n, act = 5, actions(5)
    env, other = start(make_config(), library, n), Environment(make_config(), library, n)
    for _ in range(3):
        env.step(act(), easy)
    save = (np.arange(n), np.zeros(n, dtype=np.int64), 3)
    other.load(env.save(*save))
    action = act()
    for e in (env, other):
        e.step(action, easy)
    assert_same_bits(env.save(*save), other.save(*save))
    np.testing.assert_array_equal(env.parts, other.parts)
    np.testing.assert_array_equal(env.end, other.end)


def test_no_threshold_is_met_by_heading_unless_it_is_asked_for(library, make_config):
    far = Thresholds(9.0, 90.0, 9.0)
    env = start(make_config(), library, 8)
    env.step(actions(8, 0.0)(), far)
    assert (env.end == REACHED).all()
    env = start(make_config(), library, 8)
    env.step(actions(8, 0.0)(), Thresholds(9.0, 90.0, 9.0, heading=0.3))
    np.testing.assert_array_equal(env.end == REACHED, env.deviations[:, 2] < 0.3)
    assert 0 < (env.end == REACHED).sum() < 8


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """MuJoCo writes MUJOCO_LOG.TXT to the working directory when a simulation diverges."""
    monkeypatch.chdir(tmp_path)


@pytest.mark.usefixtures("elsewhere")
@pytest.mark.parametrize("poison", [np.nan, np.inf, 1e12])
def test_a_diverged_simulation_ends_as_a_fall_on_no_body_and_leaves_the_others_alone(
    poison, library, make_config, easy
):
    n, sick = 6, 2
    env, healthy = (start(make_config(), library, n) for _ in range(2))
    env.qvel[sick, 10] = poison
    action = actions(n)()
    env.step(action, easy)
    healthy.step(action, easy)
    assert env.end[sick] == FELL and env.fell_on[sick] == -1
    rest = np.delete(np.arange(n), sick)
    for name in ("qpos", "qvel", "end", "fell_on", "parts", "totals", "deviations", "steps", "trembles"):
        np.testing.assert_array_equal(getattr(env, name)[rest], getattr(healthy, name)[rest], err_msg=name)
    # and begins again as if nothing had been
    env.begin(np.array([sick]))
    healthy.begin(np.array([sick]))
    for e in (env, healthy):
        e.step(action, easy)
    for name in ("qpos", "qvel", "end", "parts", "steps"):
        np.testing.assert_array_equal(getattr(env, name), getattr(healthy, name), err_msg=name)


@pytest.mark.usefixtures("elsewhere")
def test_a_simulation_that_diverges_during_a_step_keeps_its_last_pose_and_a_finite_reward(library, make_config, easy):
    env = start(make_config(), library, 3)
    env.qvel[1] = 1e8  # MuJoCo gives up on it after a substep or two
    before = SimpleNamespace(qpos=env.qpos.copy(), qvel=env.qvel.copy())
    env.step(actions(3)(), easy)
    assert (env.end[1], env.fell_on[1]) == (FELL, -1)
    np.testing.assert_array_equal(env.qpos[1], before.qpos[1])
    np.testing.assert_array_equal(env.qvel[1], before.qvel[1])
    assert np.isfinite(env.parts).all() and np.isfinite(env.observe(np.empty((3, 282), np.float32))).all()
    assert env.parts.shape == (3, NUM_PARTS) and env.parts[1, REWARD_PARTS.index("end")] == -3.0


@pytest.mark.usefixtures("elsewhere")
@pytest.mark.parametrize("limit, explodes", [(60.0, True), (1e9, False)])
def test_a_simulation_faster_than_the_limit_has_exploded(limit, explodes, library, make_config, easy):
    env = start(make_config({"physics.max_speed": limit}), library, 3)
    env.qvel[1, 0] = 100.0  # m/s; it flies off, which MuJoCo takes for nothing unusual
    env.step(actions(3)(), easy)
    speed = np.abs(env.qvel).max(axis=1)
    assert (env.fell_on[1] == -1 and env.end[1] == FELL) == explodes
    assert explodes or 60.0 < speed[1] < 1e9
    assert (speed[[0, 2]] < 60.0).all() and not ((env.end == FELL) & (env.fell_on < 0))[[0, 2]].any()


def test_a_simulation_that_mujoco_refuses_to_step_ends_as_a_fall_on_no_body(library, make_config, easy, monkeypatch):
    """MuJoCo's errors (its memory is full) come as an exception after all others have been stepped."""
    env, other = (start(make_config(), library, 4) for _ in range(2))
    step, action = env._batch.step, actions(4)()

    def refuses(ids=None, nstep=1):
        kept = env._batch.state[2].copy()
        step(ids, nstep=nstep)
        env._batch.state[2] = kept
        raise SimulationError(np.array([2]), "out of memory")

    monkeypatch.setattr(env._batch, "step", refuses)
    env.step(action, easy)
    other.step(action, easy)
    assert (env.end[2], env.fell_on[2]) == (FELL, -1)
    for name in ("qpos", "qvel", "end", "fell_on", "parts", "totals"):
        np.testing.assert_array_equal(getattr(env, name)[[0, 1, 3]], getattr(other, name)[[0, 1, 3]], err_msg=name)
