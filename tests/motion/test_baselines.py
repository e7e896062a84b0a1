"""Kinematic transitions: they begin and end on the clips, stand where the policy's target does, and are continuous."""

import itertools
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import reference
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from motion import rotations, skeleton
from motion.baselines import DESCRIPTIONS, LABELS, METHODS, Placement, make_scene
from motion.baselines.dead_blending import HALF_LIFE, LONGEST, SHORTEST, travel
from motion.baselines.inertialization import _guarded, exponential_rate, quintic
from motion.baselines.interpolation import path, warp
from motion.baselines.poses import blend, ease, join, split
from motion.baselines.scene import play
from motion.clip import Clip
from motion.errors import InputError
from motion.measures import joint_velocity_jump, root_velocity_jump
from motion.onehop.blend import blend_poses, weight
from motion.state_machine import State
from workers.planner import begin

BLENDS = [name for name in METHODS if name != "one_hop"]


def task_of(machine, source, target, share, rotation):
    """The task that leaves state `source` at `share` of its cancel range."""
    first, last = machine.states[source].cancel
    return np.array([source, first + share * (last - first), target, rotation])


tasks = st.tuples(st.integers(0, 2), st.integers(0, 2), st.floats(0, 1), st.floats(-np.pi, np.pi))


def same_poses(a, b, tolerance):
    """Whether poses are equal, a quaternion being its negative."""
    (linear_a, turns_a), (linear_b, turns_b) = split(a), split(b)
    turned = np.abs(np.sum(turns_a * turns_b, axis=-1))
    return np.abs(linear_a - linear_b).max() < tolerance and np.abs(turned - 1).max() < tolerance


# -------------------------------------------------------------------------------------------------- ends and place


@pytest.mark.parametrize("name", METHODS)
@hypothesis_settings(max_examples=8)
@given(values=tasks)
def test_first_and_last_pose_are_exactly_the_clips(machine, name, values):
    """The last pose is the target clip's as long after its start point as the transition lasts."""
    task = task_of(machine, *values)
    scene, qpos = make_scene(machine.states, task), METHODS[name](machine.states, task)
    assert qpos.shape[1] == 47 and len(qpos) >= 2
    assert same_poses(qpos[0], scene.source_poses([0.0])[0], 1e-12)
    assert same_poses(qpos[-1], scene.target_poses([(len(qpos) - 1) / 30])[0], 1e-12)
    assert np.linalg.norm(split(qpos)[1], axis=-1) == pytest.approx(1)


@given(values=tasks, reference_=st.sampled_from(["source", "world"]), horizon=st.floats(0, 2))
def test_the_target_stands_where_the_policys_does(machine, library, values, reference_, horizon):
    """By the environment's own code, and by the spec's Eq. 14."""
    task = task_of(machine, *values)
    scene = make_scene(machine.states, task, Placement(horizon, reference_))
    shapes = [(47,), (37,), (17, 3), (17, 4)] * 2
    qpos, qvel, bodies, turns, target_qpos, target_qvel, target_bodies, target_turns = map(np.zeros, shapes)
    begin(
        library.qpos, library.qvel, library.first, library.frames, library.fps, library.start, task, horizon,
        reference_ == "source", qpos, qvel, bodies, turns, target_qpos, target_qvel, target_bodies, target_turns,
    )  # fmt: skip
    # the environment lifts the source pose out of the floor
    first = scene.source_poses([0.0])[0]
    assert same_poses(first, np.concatenate([qpos[:2], first[2:3], qpos[3:]]), 1e-9)
    assert same_poses(scene.target_poses([0.0])[0], target_qpos, 1e-9)
    assert scene.target_velocity == pytest.approx(target_qvel)
    clip, start = scene.target.clip, scene.target.start
    slow, _ = reference.placed_target(first, qvel, *clip.sample(start), values[3], reference_, horizon)
    assert same_poses(scene.target_poses([0.0])[0], slow, 1e-9)


@given(state=st.integers(0, 2), times=st.lists(st.floats(-3, 6), min_size=1, max_size=6))
def test_a_clip_played_on_is_the_clip_within_it_and_rigid_beyond(machine, state, times):
    clip, times = machine.states[state].clip, np.array(times)
    poses = play(clip, times)
    inside = (times >= 0) & (times <= clip.duration)
    assert same_poses(poses[inside], clip.sample(times[inside])[0], 1e-12) if inside.any() else True
    if clip.looping:
        again = play(clip, times + clip.duration)
        same = [7, *range(20, 47)]  # joints do not know of the cycle
        assert again[:, 2] == pytest.approx(poses[:, 2]) and again[:, same] == pytest.approx(poses[:, same])
        step = clip.qpos[-1, :2] - clip.qpos[0, :2]
        assert again[:, :2] - poses[:, :2] == pytest.approx(np.broadcast_to(step, (len(times), 2)), abs=1e-9)
    else:
        assert same_poses(poses, clip.sample(times)[0], 1e-12)


# ----------------------------------------------------------------------------------------------------- continuity


@pytest.fixture(scope="module")
def smooth():
    """Two states whose clips are smooth functions of time at 3200 frames per second, far apart and fast."""
    fps, t = 3200, np.arange(3201)[:, None] / 3200

    def state(name, seed, turn):
        generator = np.random.default_rng(seed)
        joints = generator.uniform(-0.4, 0.4, 31) + 0.4 * np.sin(t * generator.uniform(2, 8, 31) + np.arange(31))
        roots = np.concatenate([1.5 * t * np.cos(turn), 1.5 * t * np.sin(turn), 0.9 + 0.05 * np.sin(9 * t)], axis=1)
        qpos = skeleton.assemble_qpos(roots, rotations.about_z(turn + 0.3 * np.sin(3 * t[:, 0])), joints)
        clip = Clip.from_poses(name, qpos, fps)
        return State(name, clip, 0.0, (0.0, clip.duration))

    return state("a", 1, 0.2), state("b", 2, 1.0)


def jumps(name, smooth, fps):
    """Largest jumps of velocity (root m/s, joints rad/s) of a transition with both clips around it."""
    task = (0, 0.5, 1, 0.7)
    qpos, scene = METHODS[name](smooth, task, fps), make_scene(smooth, task)
    before = scene.source_poses(np.arange(-3, 0) / fps)
    after = scene.target_poses((len(qpos) - 1 + np.arange(1, 4)) / fps)
    whole = np.concatenate([before, qpos, after])
    return np.array([root_velocity_jump(whole, fps).max(), joint_velocity_jump(whole, fps).max()])


@pytest.mark.parametrize("name", ["inertialization", "dead_blending", "crossfade"])
def test_position_and_velocity_are_continuous(smooth, name):
    """From frame to frame a continuous velocity changes by its acceleration times the frame's length: four times the
    frames, a quarter of the largest change, seams included. A jump would stay."""
    coarse, fine = jumps(name, smooth, 400), jumps(name, smooth, 1600)
    assert (fine < 0.3 * coarse).all()


def test_unreals_guards_give_up_the_velocity_across_the_offset(smooth):
    """What `inertialization_unreal`'s description says; it also shows that the test above can fail."""
    coarse, fine = jumps("inertialization_unreal", smooth, 400), jumps("inertialization_unreal", smooth, 1600)
    assert (fine > 0.8 * coarse).all() and fine[0] > 0.1


# ---------------------------------------------------------------------------------------------------- the formulas

numbers = st.floats(-5, 5)


@given(offset=numbers, velocity=numbers, acceleration=numbers, end=st.floats(0.05, 2))
def test_the_quintic_is_the_one_that_its_six_conditions_ask_for(offset, velocity, acceleration, end):
    powers = np.arange(6)

    def row(t, order):
        factors = np.array([np.prod(np.arange(p - order + 1, p + 1)) for p in powers])
        return factors * t ** np.maximum(powers - order, 0.0) * (powers >= order)

    matrix = np.array([row(t, order) for t in (0.0, end) for order in range(3)])
    coefficients = np.linalg.solve(matrix, [offset, velocity, acceleration, 0, 0, 0])
    times = np.linspace(0, end, 7)
    expected = [sum(c * t**p for c, p in zip(coefficients, powers)) for t in times]
    assert quintic(offset, velocity, acceleration, end, times) == pytest.approx(expected, abs=1e-6)
    assert quintic(offset, velocity, acceleration, end, np.array([end * 1.5])) == pytest.approx(0, abs=1e-9)


@given(offset=st.tuples(numbers, numbers, numbers), velocity=st.tuples(*[st.floats(-100, 100)] * 3))
def test_unreals_curve_keeps_its_direction_and_never_passes_zero_nor_grows(offset, velocity):
    offset, times = np.array([offset]), np.linspace(0, 0.4, 30)
    size = np.linalg.norm(offset)
    curve = _guarded(offset, np.array([velocity]), times)[:, 0]
    if size < 1e-3:
        return
    along = curve @ offset[0] / size
    assert np.linalg.norm(curve, axis=1) == pytest.approx(np.abs(along), abs=1e-9)
    assert (along > -1e-6 * size).all() and (np.diff(along) < 1e-6 * size).all()
    assert curve[0] == pytest.approx(offset[0]) and curve[-1] == pytest.approx(0, abs=1e-9)


@given(vector=st.tuples(*[st.floats(-1.7, 1.7)] * 3), angular=st.tuples(*[st.floats(-3, 3)] * 3))
def test_the_rate_of_an_exponential_map_is_its_derivative(vector, angular):
    step, vector, angular = 1e-6, np.array(vector), np.array(angular)
    ends = [
        (Rotation.from_rotvec(sign * step * angular) * Rotation.from_rotvec(vector)).as_rotvec() for sign in (1, -1)
    ]
    assert exponential_rate(vector, angular) == pytest.approx((ends[0] - ends[1]) / (2 * step), abs=1e-5)


@given(way=numbers, velocity=numbers, time=st.floats(0, 1))
def test_an_extrapolated_velocity_halves_within_its_half_life(way, velocity, time):
    """Against small steps. The half-life is that of the way over the velocity, within its limits."""
    half_life = SHORTEST
    if abs(velocity) > 1e-4:
        half_life = min(max(HALF_LIFE * way / velocity, SHORTEST), LONGEST)
    steps = 2000
    middles = (np.arange(steps) + 0.5) * time / steps
    expected = sum(velocity * 0.5 ** (middles / half_life)) * time / steps
    assert travel(np.array(way), np.array(velocity), np.array(time)) == pytest.approx(expected, abs=1e-3)


@given(seed=st.integers(0, 1000))
def test_the_time_warp_is_the_cheapest_path_in_its_steps(seed):
    """Against all paths of a small table."""
    cost = np.random.default_rng(seed).uniform(0, 1, (5, 5))

    def paths(at):
        if at == (4, 4):
            yield [at]
        for step in ((1, 1), (1, 2), (2, 1)):
            after = at[0] + step[0], at[1] + step[1]
            if max(after) <= 4:
                yield from ([at, *rest] for rest in paths(after))

    def price(pairs):
        steps = itertools.pairwise(pairs)
        return sum(cost[b] * (b[0] - a[0] + b[1] - a[1]) / 2 for a, b in steps)

    best = min(paths((0, 0)), key=price)
    found = [tuple(int(i) for i in pair) for pair in path(cost)]
    assert price(found) == pytest.approx(price(best))
    first, second = warp(cost)
    for part in (first, second):
        assert part[0] == 0 and part[-1] == 4 and (np.diff(part) > 0.5).all() and (np.diff(part) < 1.5).all()


def test_poses_are_blended_as_the_one_hop_player_does(random_poses):
    """linear, spherical by the shorter way, with the same weight."""
    a, b = (random_poses(5, seed)[0] for seed in (1, 2))
    share = np.linspace(0, 1, 5)
    expected = np.empty_like(a)
    for row in range(5):
        blend_poses(a[row], b[row], share[row], expected[row])
    assert same_poses(blend(a, b, share), expected, 1e-9)
    assert same_poses(join(*split(a)), a, 1e-12)
    assert ease((np.arange(6) + 1) / 6) == pytest.approx([weight(k, 6) for k in range(6)])


# ----------------------------------------------------------------------------------------------------------- errors


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize(
    ("task", "words"),
    [
        ((3, 0.5, 0, 0.0), "source state 3 does not exist; give one of 0 .. 2"),
        ((0, 0.5, -1, 0.0), "target state -1 does not exist"),
        ((0.5, 0.5, 0, 0.0), "source state 0.5 does not exist"),
        ((0, 9.0, 1, 0.0), "moment 9 s is outside idle; it lasts 3.000 s"),
        ((0, -0.1, 1, 0.0), "moment -0.1 s is outside idle"),
        ((0, 0.5, 1), "give source state, moment (s), target state, rotation (rad)"),
        ((0, np.nan, 1, 0.0), "give source state, moment (s)"),
    ],
)
def test_a_task_that_does_not_fit_gives_one_clear_line(machine, name, task, words):
    with pytest.raises(InputError) as caught:
        METHODS[name](machine.states, task)
    assert words in str(caught.value) and "\n" not in str(caught.value)


def test_an_empty_clip_and_no_clip_give_one_clear_line(machine):
    state = machine.states[0]
    empty = replace(state, clip=replace(state.clip, qpos=state.clip.qpos[:0], qvel=state.clip.qvel[:0]))
    with pytest.raises(InputError, match="^idle: has 0 frame"):
        METHODS["crossfade"]([empty, state], (0, 0.0, 1, 0.0))
    with pytest.raises(InputError, match="^states: there are none"):
        METHODS["crossfade"]([], (0, 0.0, 1, 0.0))


def test_one_hop_says_that_it_cannot_enter_a_clip_late(machine):
    states = (machine.states[0], replace(machine.states[2], start=0.5))
    with pytest.raises(InputError, match="^one_hop: enters clips at frame 0, stab starts later"):
        METHODS["one_hop"](states, (0, 0.5, 1, 0.0))
    assert len(METHODS["crossfade"](states, (0, 0.5, 1, 0.0))) == 16


def test_every_method_has_a_name_and_a_line():
    assert METHODS.keys() == LABELS.keys() == DESCRIPTIONS.keys()


def test_importing_the_baselines_brings_in_no_heavy_package():
    program = "import sys, motion.baselines, motion.measures; print({m.partition('.')[0] for m in sys.modules})"
    project = Path(__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", program], cwd=project, capture_output=True, text=True, check=True)
    assert "numpy" in done.stdout
    assert not {"torch", "ray", "mujoco", "omegaconf", "scipy", "numba"} & set(eval(done.stdout))
