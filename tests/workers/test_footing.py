"""Targets that no figure can stand at are found, and no others."""

import numpy as np
import pytest

from motion.clip import Clip
from motion.formats import npz
from motion.state_machine import ClipConfig, MotionsConfig, build_state_machine
from workers.footing import FLOATS, floating_targets


@pytest.fixture
def raised(tmp_path):
    """A function of (height in m) giving the path of the built-in idle clip, raised."""
    idle = build_state_machine(MotionsConfig("one", clips={"idle": ClipConfig("builtin:idle")})).states[0].clip

    def make(height):
        qpos = idle.qpos.copy()
        qpos[:, 2] += height
        path = tmp_path / f"{height:.3f}.npz"
        npz.write(Clip.from_poses("idle", qpos, idle.fps), path)
        return str(path)

    return make


def machine(groups="all", **clips):
    clips = {name: ClipConfig(**clip) for name, clip in clips.items()}
    return build_state_machine(MotionsConfig("some", dir="/", groups=groups, clips=clips))


def test_a_clip_above_the_floor_floats_by_as_much(raised):
    made = machine(low={"file": raised(FLOATS - 0.01)}, high={"file": raised(0.13)})
    ((name, height),) = floating_targets(made)
    assert name == "high" and height == pytest.approx(0.13, abs=2e-3)


def test_only_the_start_of_a_target_counts(raised):
    """The built-in dodge jumps, but not at its start; who is no target may float."""
    assert floating_targets(machine(dodge={"file": "builtin:dodge_back"})) == []
    middle = machine(dodge={"file": "builtin:dodge_back"}).states[0].clip
    top = float(np.argmax(middle.qpos[:, 2]) / middle.fps)
    jumps = floating_targets(machine(dodge={"file": "builtin:dodge_back", "start": top}))
    assert [name for name, _ in jumps] == ["dodge"] and jumps[0][1] > FLOATS
    clips = {"low": {"file": "builtin:idle"}, "high": {"file": raised(0.2)}}
    assert floating_targets(machine([["high", "low"]], **clips)) == []
    assert [name for name, _ in floating_targets(machine([["low", "high"]], **clips))] == ["high"]
