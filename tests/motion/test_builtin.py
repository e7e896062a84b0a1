"""The built-in clips are physically sane: nothing under the floor, planted feet still, limits, seams, balance."""

import subprocess
import sys

import numpy as np
import pytest

from motion import builtin, rotations, skeleton
from motion.clip import shift_cycle
from motion.errors import InputError

INDEX = skeleton.BODY_INDEX
LOOPS = ("idle", "walk", "run")
ATTACKS = ("stab", "slash_up", "slash_down", "slash_left", "shield_bash")
# kg, rounded from a 51.7 kg figure: for the centre of mass only; offsets (m) to each body's own centre
MASSES = {
    "pelvis": (6.0, (0, 0, 0.07)), "torso": (14.0, (0, 0, 0.12)), "head": (2.0, (0, 0, 0.175)),
    "right_upper_arm": (1.6, (0, 0, -0.14)), "right_lower_arm": (1.1, (0, 0, -0.12)), "right_hand": (0.4, (0, 0, 0)),
    "sword": (1.0, (-0.3, 0, 0)), "left_upper_arm": (1.6, (0, 0, -0.14)), "left_lower_arm": (1.1, (0, 0, -0.12)),
    "shield": (1.5, (0, 0, 0)), "left_hand": (0.4, (0, 0, 0)),
    "right_thigh": (5.0, (0, 0, -0.21)), "right_shin": (3.0, (0, 0, -0.2)), "right_foot": (1.0, (0.045, 0, -0.022)),
    "left_thigh": (5.0, (0, 0, -0.21)), "left_shin": (3.0, (0, 0, -0.2)), "left_foot": (1.0, (0.045, 0, -0.022)),
}  # fmt: skip
FOOT_HALF, FOOT_CENTRE = np.array([0.0885, 0.045, 0.0275]), np.array([0.045, 0, -0.0225])
SIGNS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
# joint: lowest and highest exponential map (rad), the ranges of recorded clips rounded outwards
LIMITS = {
    "abdomen": ((-0.6, -0.3, -0.9), (0.6, 1.2, 0.9)),
    "neck": ((-0.9, -0.9, -1.5), (0.9, 0.9, 1.5)),
    "right_shoulder": ((-2.3, -2.2, -2.0), (0.0, 1.2, 2.1)),
    "right_hand": ((-2.35,) * 3, (2.35,) * 3),
    "left_shoulder": ((0.0, -1.1, -1.7), (2.3, 0.7, 0.7)),
    "right_hip": ((-0.9, -1.9, -0.9), (0.9, 0.74, 0.9)),
    "left_hip": ((-0.9, -1.9, -0.9), (0.9, 0.74, 0.9)),
    "right_elbow": ((-2.1,), (-0.05,)),
    "left_elbow": ((-2.1,), (-0.05,)),
    "right_knee": ((0.05,), (2.6,)),
    "left_knee": ((0.05,), (2.6,)),
}


def every_clip(function):
    return pytest.mark.parametrize("name", builtin.NAMES)(function)


def points(clip, body, local):
    """World places (T, K, 3) of a body's points (K, 3)."""
    position, rotation = clip.bodies
    i = INDEX[body]
    return position[:, i, None] + rotations.rotate(rotation[:, i, None], np.atleast_2d(np.asarray(local, float)))


def corners(clip, side):
    return points(clip, f"{side}_foot", FOOT_CENTRE + SIGNS * FOOT_HALF)


def centre_of_mass(clip):
    total = sum(mass for mass, _ in MASSES.values())
    return sum(mass * points(clip, body, centre)[:, 0] for body, (mass, centre) in MASSES.items()) / total


def joint_rows(clip, name):
    joint = skeleton.JOINTS[skeleton.JOINT_INDEX[name]]
    first = skeleton.JOINT_DOF[skeleton.JOINT_INDEX[name]]
    return clip.joints[:, first : first + joint.dof]


def lowest(clip):
    """Lowest height (m) over the clip of feet, shins, hands, sword and shield."""
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    rim = 0.3 * np.stack([np.cos(turn), 0 * turn, np.sin(turn)], axis=-1)
    blade = np.linspace(0, 1.04, 12)[:, None] * [1, 0, 0]
    return {
        "feet": min(corners(clip, side)[..., 2].min() for side in ("right", "left")),
        "shins": min(
            points(clip, f"{side}_shin", [[0, 0, 0], [0, 0, -0.3]])[..., 2].min() - 0.05 for side in ("right", "left")
        ),
        "hands": min(points(clip, f"{side}_hand", [0, 0, 0])[..., 2].min() - 0.04 for side in ("right", "left")),
        "sword": points(clip, "right_hand", blade)[..., 2].min(),
        "shield": points(clip, "shield", rim)[..., 2].min(),
    }  # fmt: skip


def segment_distance(a, b, c, d, samples=24):
    """Smallest distance (T,) between segments a-b and c-d, each end (T, 3), by sampling."""
    s = np.linspace(0, 1, samples)[:, None, None]
    first, second = a + s * (b - a), c + s * (d - c)
    return np.linalg.norm(first[:, None] - second[None], axis=-1).min(axis=(0, 1))


def blade_clearance(clip):
    """Smallest gap (m) from the blade to each part of the body, a capsule of the part's thickness."""
    hilt, tip = points(clip, "right_hand", [[0.12, 0, 0], [1.04, 0, 0]]).swapaxes(0, 1)
    parts = {
        "torso": ("torso", (0, 0, 0), (0, 0, 0.2), 0.11),
        "pelvis": ("pelvis", (0, 0, 0), (0, 0, 0.1), 0.10),
        "head": ("head", (0, 0, 0.175), (0, 0, 0.176), 0.1025),
        "right_thigh": ("right_thigh", (0, 0, 0), (0, 0, -0.42), 0.055),
        "left_thigh": ("left_thigh", (0, 0, 0), (0, 0, -0.42), 0.055),
        "right_shin": ("right_shin", (0, 0, 0), (0, 0, -0.41), 0.05),
        "left_shin": ("left_shin", (0, 0, 0), (0, 0, -0.41), 0.05),
        "left_upper_arm": ("left_upper_arm", (0, 0, 0), (0, 0, -0.27), 0.045),
        "left_lower_arm": ("left_lower_arm", (0, 0, 0), (0, 0, -0.26), 0.04),
    }
    return {
        part: (segment_distance(hilt, tip, *points(clip, body, [a, b]).swapaxes(0, 1)) - radius).min()
        for part, (body, a, b, radius) in parts.items()
    }


def support_distance(clip):
    """Horizontal distance (T,) of the centre of mass from the hull of the soles on the ground; NaN in flight."""
    com = centre_of_mass(clip)[:, :2]
    out = np.full(clip.frames, np.nan)
    soles = np.concatenate([corners(clip, side) for side in ("right", "left")], axis=1)
    angles = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    for t in range(clip.frames):
        down = soles[t][soles[t, :, 2] < 0.01][:, :2]
        if len(down):  # the hull's signed distance from its supporting lines: positive outside
            out[t] = (normals @ com[t] - (down @ normals.T).max(axis=0)).max()
    return out


def test_names_and_speed():
    code = (
        "import time; from motion import builtin; t = time.process_time(); "
        "[builtin.load(n) for n in builtin.NAMES]; print(time.process_time() - t); "
        "import sys; assert not {'scipy', 'torch', 'mujoco'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert float(done.stdout) < 0.5
    assert builtin.NAMES == (
        "idle", "walk", "run", "dodge_back", "stab", "slash_up", "slash_down", "slash_left", "shield_bash",
    )  # fmt: skip
    assert builtin.load("run") is builtin.load("run")


def test_unknown_name():
    with pytest.raises(InputError, match="did you mean 'stab'"):
        builtin.load("stabb")
    with pytest.raises(InputError, match="idle, walk"):
        builtin.load("zzz")


def test_same_bits_every_time():
    for name in builtin.NAMES:
        assert builtin.MOTIONS[name].clip().content_hash == builtin.load(name).content_hash


@every_clip
def test_nothing_under_the_floor(name):
    for part, height in lowest(builtin.load(name)).items():
        assert height > -0.01, part


@every_clip
def test_planted_feet_are_flat_and_still(name):
    clip, planted = builtin.load(name), builtin.MOTIONS[name].planted()
    assert planted.shape == (clip.frames, 2)
    for side, down in zip(("right", "left"), planted.T):
        places = corners(clip, side)
        moved = np.linalg.norm(np.diff(places, axis=0), axis=-1).max(axis=-1)
        assert moved[down[1:] & down[:-1]].max(initial=0) < 0.002
        assert np.abs(places[down].min(axis=1)[:, 2]).max(initial=0) < 1e-6
        assert down.mean() > {"run": 0.12, "walk": 0.25}.get(name, 0.35)


@every_clip
def test_legs_reach_their_feet(name):
    motion, clip = builtin.MOTIONS[name], builtin.load(name)
    for side, keys in (("right", motion.right), ("left", motion.left)):
        ankle, _, _ = builtin.feet.track(keys, motion.times, motion.period, motion.stride)
        assert np.abs(clip.bodies[0][:, INDEX[f"{side}_foot"]] - ankle).max() < 1e-6


@every_clip
def test_joint_limits(name):
    clip = builtin.load(name)
    for joint, (low, high) in LIMITS.items():
        rows = joint_rows(clip, joint)
        assert (rows >= low).all(), (joint, rows.min(axis=0))
        assert (rows <= high).all(), (joint, rows.max(axis=0))
    for ankle in ("right_ankle", "left_ankle"):
        assert np.linalg.norm(joint_rows(clip, ankle), axis=-1).max() < 1.0


@every_clip
def test_speeds_and_accelerations(name):
    clip = builtin.load(name)
    assert np.abs(clip.qvel[:, 6:]).max() < 25
    assert np.linalg.norm(clip.qvel[:, 3:6], axis=-1).max() < 8
    acceleration = np.diff(clip.qpos[:, :3], 2, axis=0) * clip.fps**2
    assert np.linalg.norm(acceleration, axis=-1).max() < 3 * 9.81
    average = (clip.qpos[-1, :3] - clip.qpos[0, :3]) / clip.duration
    assert average[0] == pytest.approx({"walk": 1.2, "run": 3.0, "dodge_back": -0.5}.get(name, 0.0), abs=0.05)


@pytest.mark.parametrize("name", LOOPS)
def test_loops_have_no_seam(name):
    clip = builtin.load(name)
    assert clip.looping
    joined = np.concatenate([clip.qpos, shift_cycle(clip.qpos[1:], clip.qpos, 1)])
    assert np.abs(shift_cycle(clip.qpos[0], clip.qpos, 1) - clip.qpos[-1]).max() < 1e-9
    assert np.abs(clip.qvel[0] - clip.qvel[-1]).max() < 1e-9
    # the seam is no rougher than the rest of the cycle
    jump = np.abs(np.diff(skeleton.velocities(joined, clip.fps), axis=0)).max(axis=1)
    seam = clip.frames - 1
    assert jump[seam - 2 : seam + 2].max() <= 1.01 * np.delete(jump, range(seam - 2, seam + 2))[1:-1].max()


@pytest.mark.parametrize("name", ATTACKS + ("dodge_back",))
def test_from_stance_to_stance_at_rest(name):
    clip, guard = builtin.load(name), builtin.load("idle").qpos[0]
    assert not clip.looping
    np.testing.assert_allclose(clip.qpos[0], guard, atol=1e-9)
    np.testing.assert_allclose(clip.qpos[-1, 1:], guard[1:], atol=1e-6)
    assert np.abs(clip.qvel[[0, -1]]).max() < 1e-6
    assert 1.2 <= clip.duration <= 2.5


@pytest.mark.parametrize("name", ATTACKS)
def test_attack_strikes_forward_after_a_wind_up(name):
    clip = builtin.load(name)
    position = clip.bodies[0]
    weapon = INDEX["shield" if name == "shield_bash" else "sword"]
    speed = np.linalg.norm(np.gradient(position[:, weapon], 1 / clip.fps, axis=0), axis=-1)
    fastest = speed.argmax() / clip.fps
    assert speed.max() > (2.0 if name == "shield_bash" else 4.0)
    assert 0.4 < fastest < 1.0
    reach = position[:, weapon, 0].argmax() / clip.fps
    assert abs(reach - fastest) < 0.35


@every_clip
def test_balance_in_slow_moments(name):
    clip = builtin.load(name)
    com = centre_of_mass(clip)
    velocity = np.gradient(com, 1 / clip.fps, axis=0)[:, :2]
    slow = np.linalg.norm(velocity, axis=-1) < 0.25
    outside = support_distance(clip)[slow]
    assert (np.nan_to_num(outside, nan=1.0) < 0.03).all()


@every_clip
def test_blade_stays_out_of_the_body(name):
    for part, gap in blade_clearance(builtin.load(name)).items():
        assert gap > 0.0, part


@every_clip
def test_blade_does_not_go_through_the_shield(name):
    clip = builtin.load(name)
    position, rotation = (values[:, INDEX["shield"], None] for values in clip.bodies)
    blade = points(clip, "right_hand", [[0.05, 0, 0], [1.04, 0, 0]])
    hilt, tip = rotations.rotate(rotations.conjugate(rotation), blade - position).swapaxes(0, 1)
    # where the blade's line meets the plane of the disc, whose normal is y
    share = hilt[:, 1] / (hilt[:, 1] - tip[:, 1])
    place = hilt + share[:, None] * (tip - hilt)
    meets = (share > 0) & (share < 1) & (np.linalg.norm(place, axis=-1) < 0.3)
    assert not meets.any(), np.flatnonzero(meets)


def test_run_has_a_flight_phase():
    clip = builtin.load("run")
    heights = np.min([corners(clip, side)[..., 2].min(axis=1) for side in ("right", "left")], axis=0)
    assert 0.1 < (heights > 0.008).mean() < 0.6


def test_hop_leaves_the_ground_and_falls_freely():
    clip = builtin.load("dodge_back")
    heights = np.min([corners(clip, side)[..., 2].min(axis=1) for side in ("right", "left")], axis=0)
    air = heights > 0.02
    assert 0.1 < air.sum() / clip.fps < 0.35
    acceleration = np.gradient(np.gradient(centre_of_mass(clip)[:, 2], 1 / clip.fps), 1 / clip.fps)
    assert acceleration[air].mean() == pytest.approx(-9.81, abs=3.0)
