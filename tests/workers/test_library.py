"""The flat library of clips against the clips themselves."""

import numpy as np
import pytest

from motion.state_machine import State, StateMachine
from workers.library import build_library, sample_pose


def sampled(library, state, time):
    qpos, qvel = np.full(47, np.nan), np.full(37, np.nan)
    sample_pose(
        library.qpos, library.qvel, library.first[state], library.frames[state], library.fps[state], time, qpos, qvel
    )
    return qpos, qvel


def assert_samples_are_the_clips(library, clips):
    generator = np.random.default_rng(0)
    for i, clip in enumerate(clips):
        frames = np.arange(clip.frames) / clip.fps
        times = [
            *frames[:3],
            frames[-2],
            clip.duration,
            -1.0,
            clip.duration + 5,
            *generator.uniform(0, clip.duration, 50),
        ]
        for time in times:
            qpos, qvel = sampled(library, i, time)
            wanted_qpos, wanted_qvel = clip.sample(time)
            np.testing.assert_allclose(qpos, wanted_qpos, atol=1e-12)
            np.testing.assert_allclose(qvel, wanted_qvel, atol=1e-12)


def test_sample_pose_is_the_clips_own_sample(machine, library):
    assert_samples_are_the_clips(library, [state.clip for state in machine.states])


def test_sample_pose_is_the_clips_own_sample_on_real_clips(real_clips):
    states = tuple(State(clip.name, clip, 0.0, (0.0, clip.duration)) for clip in real_clips)
    library = build_library(StateMachine(states, np.array([[0, 0]]), (-1.0, 1.0)))
    assert_samples_are_the_clips(library, real_clips)


def test_the_library_holds_the_state_machine(machine, library):
    assert library.first.tolist() == [0, *np.cumsum([state.clip.frames for state in machine.states])[:-1]]
    assert library.cancel.tolist() == [list(state.cancel) for state in machine.states]
    assert library.start.tolist() == [state.start for state in machine.states]
    np.testing.assert_array_equal(library.groups, machine.groups)
    assert tuple(library.rotation) == machine.rotation
    assert len(library.qpos) == len(library.qvel) == sum(library.frames)


def test_sampled_quaternions_have_unit_length(library):
    for time in np.linspace(0, 2, 23):
        qpos, _ = sampled(library, 2, time)
        assert np.linalg.norm(qpos[3:7]) == pytest.approx(1.0, abs=1e-15)
