"""State machines: what a config means, and that every wrong value is refused by its key."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

from motion import rotations, skeleton
from motion.clip import Clip
from motion.errors import InputError
from motion.formats import npz
from motion.state_machine import ClipConfig, MotionsConfig, build_state_machine

PROJECT = Path(__file__).parents[2]
CONFIGS = PROJECT / "configs/motions"
MOTIONS = PROJECT.parent / "shared/motions"
real = pytest.mark.skipif(not MOTIONS.is_dir(), reason="the real clips (shared/motions) are not on this machine")

DURATION = 2.0  # s, 20 frames/s


@pytest.fixture
def folder(tmp_path):
    """Three clips: idle, stab, run."""
    phase = np.linspace(0, 2 * np.pi, 41)[:, None]
    for i, name in enumerate(("idle", "stab", "run")):
        joints = 0.2 * np.sin(phase + np.arange(31) + i)
        clip = Clip.from_poses(name, skeleton.assemble_qpos([0, 0, 0.9], rotations.IDENTITY, joints), 20.0)
        npz.write(clip, tmp_path / f"{name}.npz")
    return tmp_path


@pytest.fixture
def config(folder):
    clips = {name: ClipConfig(f"{name}.npz") for name in ("idle", "stab", "run")}
    return MotionsConfig("three", str(folder), clips=clips)


def refusal(config):
    with pytest.raises(InputError) as caught:
        build_state_machine(config)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_all_groups_are_every_pair_in_sorted_order(config):
    machine = build_state_machine(config)
    assert [state.name for state in machine.states] == ["idle", "stab", "run"]
    assert machine.groups.tolist() == [[a, b] for a in range(3) for b in range(3)]
    assert machine.rotation == (-math.pi / 2, math.pi / 2)


def test_named_groups_are_sorted_and_each_once(config):
    config.groups = [["run", "idle"], ["idle", "stab"], ["run", "idle"], ["stab", "stab"]]
    assert build_state_machine(config).groups.tolist() == [[0, 1], [1, 1], [2, 0]]


def test_states_hold_the_clip_its_start_and_its_range(config):
    config.clips["stab"] = ClipConfig("stab.npz", looping=True, start=0.5, cancel=[1.0, 1.5])
    state = build_state_machine(config).states[1]
    assert (state.start, state.cancel) == (0.5, (1.0, 1.5))
    assert (state.clip.name, state.clip.duration, state.clip.looping) == ("stab", DURATION, True)


def test_an_empty_cancel_range_is_the_whole_clip(config):
    assert build_state_machine(config).states[0].cancel == (0.0, DURATION)


def test_times_up_to_a_frame_past_the_end_are_the_end(config):
    config.clips["stab"] = ClipConfig("stab.npz", start=DURATION + 0.049, cancel=[1.0, DURATION + 0.049])
    state = build_state_machine(config).states[1]
    assert (state.start, state.cancel) == (DURATION, (1.0, DURATION))


def test_a_state_machine_cannot_be_changed(config):
    machine = build_state_machine(config)
    with pytest.raises(dataclasses.FrozenInstanceError):
        machine.rotation = (0, 0)
    with pytest.raises(ValueError, match="read-only"):
        machine.groups[0, 0] = 1


def test_the_hash_follows_everything_that_a_run_depends_on(config, folder):
    def hash_with(**changes):
        return build_state_machine(dataclasses.replace(config, **changes)).content_hash

    def stab(**changes):
        return hash_with(clips=config.clips | {"stab": ClipConfig(**({"file": "stab.npz"} | changes))})

    same = hash_with()
    assert same == hash_with(name="other") == hash_with(dir=str(folder / ".." / folder.name))
    assert same == hash_with(groups=[[a, b] for a in reversed(config.clips) for b in config.clips])
    others = [
        hash_with(rotation=[-1.0, 1.0]),
        hash_with(groups=[["idle", "stab"]]),
        hash_with(clips=dict(reversed(config.clips.items()))),
        stab(start=0.5),
        stab(cancel=[0.0, 1.0]),
        stab(looping=True),
        stab(file="run.npz"),
    ]
    assert len({same, *others}) == 8


@pytest.mark.parametrize(
    ("clip", "key", "words"),
    [
        ({"cancel": [1.5, 1.0]}, "cancel", "give [1, 1.5]"),
        ({"cancel": [1.0, 2.06]}, "cancel", "it lasts 2.000 s"),
        ({"cancel": [-0.1, 1.0]}, "cancel", "it lasts 2.000 s"),
        ({"cancel": [float("nan"), 1.0]}, "cancel", "it lasts 2.000 s"),
        ({"cancel": [1.0]}, "cancel", "1 values"),
        ({"cancel": [0.0, 1.0, 2.0]}, "cancel", "3 values"),
        ({"start": 3.0}, "start", "it lasts 2.000 s"),
        ({"start": -1.0}, "start", "it lasts 2.000 s"),
        ({"file": "stub.npz"}, "file", "did you mean stab.npz"),
        ({"file": "stab.bvh"}, "file", ".npy, .txt, .npz"),
        ({"file": "builtin:stabb"}, "file", "stab"),
        ({"file": "run_twice.npz", "looping": True}, "file", "run"),
    ],
)
def test_a_wrong_value_of_a_clip_is_refused_by_its_key(config, clip, key, words):
    config.clips["Atk_Stab"] = ClipConfig(**({"file": "stab.npz"} | clip))
    message = refusal(config)
    assert message.startswith(f"motions.clips.Atk_Stab.{key}: ")
    assert words in message


@pytest.mark.parametrize(
    ("changes", "key", "words"),
    [
        ({"clips": {}}, "motions.clips", "at least one"),
        ({"dir": None}, "motions.dir", "give motions.dir=FOLDER"),
        ({"dir": "/no/such/folder"}, "motions.dir", "give motions.dir=FOLDER"),
        ({"groups": []}, "motions.groups", "at least one"),
        ({"groups": "some"}, "motions.groups", "'some'"),
        ({"groups": None}, "motions.groups", "None"),
        ({"groups": [["idle", "stb"]]}, "motions.groups[0]", "did you mean stab?"),
        ({"groups": [["idle", "stab"], ["xxxx", "idle"]]}, "motions.groups[1]", "idle, stab, run"),
        ({"groups": [["idle"]]}, "motions.groups[0]", "pair"),
        ({"groups": ["idle"]}, "motions.groups[0]", "pair"),
        ({"groups": [3]}, "motions.groups[0]", "pair"),
        ({"rotation": [1.0, -1.0]}, "motions.rotation", "give [-1, 1]"),
        ({"rotation": [-90.0, 90.0]}, "motions.rotation", "radians"),
        ({"rotation": [0.0, float("nan")]}, "motions.rotation", "radians"),
        ({"rotation": [1.0]}, "motions.rotation", "1 values"),
    ],
)
def test_a_wrong_value_of_the_set_is_refused_by_its_key(config, changes, key, words):
    message = refusal(dataclasses.replace(config, **changes))
    assert message.startswith(f"{key}: ")
    assert words in message


def test_a_rotation_rounded_just_beyond_pi_is_pi(config):
    config.rotation = [-3.1416, 3.1416]
    assert build_state_machine(config).rotation == (-math.pi, math.pi)


def load(name):
    """A config file under the schema, as OmegaConf gives it."""
    return OmegaConf.merge(OmegaConf.structured(MotionsConfig), OmegaConf.load(CONFIGS / f"{name}.yaml"))


@pytest.mark.parametrize("name", [path.stem for path in sorted(CONFIGS.glob("*.yaml"))])
def test_every_config_file_fits_the_schema_and_names_itself(name):
    assert OmegaConf.to_object(load(name)).name == name


def test_the_schema_refuses_an_unknown_key():
    with pytest.raises(Exception, match="cancle"):
        OmegaConf.merge(OmegaConf.structured(MotionsConfig), {"clips": {"stab": {"file": "a.npy", "cancle": [0, 1]}}})


def test_the_builtin_set_needs_no_folder_and_its_clips_are_called_as_in_the_config():
    machine = build_state_machine(OmegaConf.to_object(load("builtin")))
    assert len(machine.states) == 9
    assert machine.groups.shape == (81, 2)
    assert all(state.clip.name == state.name for state in machine.states)
    assert {state.name for state in machine.states if state.clip.looping} == {"idle", "walk", "run"}


def test_a_builtin_clip_loops_only_where_the_config_says_so():
    clips = {"once": ClipConfig("builtin:walk"), "again": ClipConfig("builtin:walk", looping=True)}
    once, again = build_state_machine(MotionsConfig("walks", clips=clips)).states
    assert (once.clip.looping, again.clip.looping) == (False, True)
    np.testing.assert_allclose(once.clip.bodies[0], again.clip.bodies[0], atol=1e-9)


@real
@pytest.mark.parametrize(
    ("name", "folder", "clips"),
    [
        ("reallusion", "reallusion", 9), ("three", "reallusion", 3), ("reallusion_all", "reallusion", 23),
        ("deepmimic", "deepmimic", 6),
    ],
)
def test_the_real_sets_load_fully_connected(name, folder, clips):
    config = OmegaConf.to_object(load(name))
    config.dir = str(MOTIONS / folder)
    machine = build_state_machine(config)
    assert len(machine.states) == clips
    assert machine.groups.shape == (clips**2, 2)
    # every range can be left: a transition needs moments to choose from
    assert all(state.cancel[1] - state.cancel[0] > 0.3 for state in machine.states)


def test_three_and_all_have_the_same_ranges_as_the_nine():
    nine, three, every = (OmegaConf.to_object(load(name)) for name in ("reallusion", "three", "reallusion_all"))
    assert all(nine.clips[name] == clip for name, clip in three.clips.items())
    assert all(every.clips[name] == clip for name, clip in nine.clips.items())
