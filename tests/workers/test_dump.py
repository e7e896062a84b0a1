"""A simulation that explodes is contained, and what is kept of it replays to the last bit."""

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from workers import dump
from workers.replay import replay
from workers.rollout import Rollout
from workers.types import FELL

pytestmark = pytest.mark.usefixtures("elsewhere")


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """MuJoCo writes MUJOCO_LOG.TXT to the working directory when a simulation diverges."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def coarse(make_config):
    """A configuration whose time step is so long that simulations explode all by themselves."""
    return make_config({
        "physics.timestep": 0.025, "physics.substeps": 2, "action.scale": 5.0, "task.max_steps": 8,
    })  # fmt: skip


@pytest.mark.parametrize("speed", [1e3, 1e9, 1e30])
def test_a_chunk_with_an_exploding_simulation_is_the_same_in_all_other_columns(
    speed, trajectories, make_policy, easy, columns, assert_same_bits
):
    """Bit for bit: observations, rewards, tasks, outcomes and states of the others over the whole chunk."""
    state, policy, sick = trajectories.states[2], make_policy(version=2), 5
    physics = state.physics.copy()
    env = trajectories.rollout._environment
    env.load(state)
    env.qvel[sick, 12] = speed
    physics[:] = env._batch.state
    healthy, after = trajectories.rollout.collect(state, policy, easy)
    chunk, ill = trajectories.rollout.collect(replace(state, physics=physics), policy, easy)
    assert (chunk.end[0, sick], chunk.outcomes.fell_on[0]) == (FELL, -1)
    assert len(dump.unstable(chunk.outcomes)) == 1
    assert chunk.reward[0, sick] < trajectories.config.reward.failure / 2
    rest = np.delete(np.arange(24), sick)
    assert_same_bits(columns(chunk, rest), columns(healthy, rest))
    for name, value in vars(after).items():
        if name != "clock":
            np.testing.assert_array_equal(getattr(ill, name)[rest], value[rest], err_msg=name)
    # what the learner sees of it after that step is finite
    assert np.isfinite(chunk.observation[1:]).all() and np.isfinite(chunk.final_observation).all()
    assert np.isfinite(chunk.next_pose).all() and np.isfinite(chunk.reward).all()


@pytest.fixture(scope="module")
def explosions(coarse, library, make_policy, easy, tmp_path_factory):
    """[(state before the chunk, policy, chunk, episode's outcome)] of simulations that exploded in three chunks."""
    before = os.getcwd()
    os.chdir(tmp_path_factory.mktemp("explosions"))
    try:
        rollout, found = Rollout(coarse, library, 12, 8, coarse.seed), []
        state = rollout.initial_state(4)
        for k in range(3):
            policy = make_policy(version=k)
            chunk, after = rollout.collect(state, policy, easy)
            episodes = dump.unstable(chunk.outcomes)
            found += [(state, policy, chunk, episodes.take([i])) for i in range(len(episodes))][:6]
            state = after
    finally:
        os.chdir(before)
    return found


def recorded(explosion, config, library, thresholds):
    state, policy, _, episode = explosion
    about = (getattr(episode, name)[0] for name in ("environment", "clock", "steps"))
    return dump.record(config, library, state, policy, thresholds, *about, iteration=7)


def test_what_is_recorded_is_the_end_of_the_episode_in_the_chunk(explosions, coarse, library, easy):
    """Actions and poses are those of the chunk, from the episode's begin or the chunk's on, whichever is later."""
    begins = set()
    for explosion in explosions:
        state, _, chunk, episode = explosion
        taken = recorded(explosion, coarse, library, easy)
        last = episode.clock[0] - state.clock  # steps of the chunk up to the explosion
        steps = min(last, episode.steps[0])
        column = list(chunk.environment).index(episode.environment[0])
        np.testing.assert_array_equal(taken.action, chunk.action[last - steps : last, column])
        np.testing.assert_array_equal(taken.pose, chunk.pose[last - steps : last, column])
        assert taken.state.clock == state.clock + last - steps and taken.iteration == 7
        assert taken.state.environment.tolist() == episode.environment.tolist()
        begins.add("within" if last > steps else "before" if episode.steps[0] > last else "at")
    assert begins >= {"within", "before"}


def test_a_recording_replays_to_the_last_bit_without_the_clips(explosions, coarse, library, easy, assert_same_bits):
    for explosion in explosions[:4]:
        taken = recorded(explosion, coarse, library, easy)
        with open("file.npz", "wb") as file:
            file.write(dump.to_bytes(taken))
        read = dump.read("file.npz")
        assert_same_bits(read, taken)
        speeds, same = replay(read)
        assert same and len(speeds) == len(taken.action) - 1 + coarse.physics.substeps
        limit = coarse.physics.max_speed
        assert (speeds[: -coarse.physics.substeps] <= limit).all()
        assert not speeds[-1] <= limit


def test_a_replay_that_goes_another_way_says_so(explosions, coarse, library, easy):
    taken = recorded(explosions[0], coarse, library, easy)
    assert not replay(replace(taken, pose=taken.pose + np.float32(1e-3)))[1]
    assert not replay(replace(taken, action=0 * taken.action))[1]


def test_an_episode_that_does_not_explode_again_gives_no_recording(explosions, make_config, library, easy):
    assert recorded(explosions[0], make_config({"task.max_steps": 8}), library, easy) is None


@pytest.mark.parametrize("damage", ["missing", "cut", "pickle"])
def test_a_file_that_is_no_recording_is_refused_in_one_line(damage, explosions, coarse, library, easy, capsys):
    from workers.replay import main

    data = dump.to_bytes(recorded(explosions[0], coarse, library, easy))
    if damage != "missing":
        with open("file.npz", "wb") as file:
            if damage == "cut":
                file.write(data[: len(data) // 2])
            else:
                np.savez(file, about=np.array([{}], dtype=object))
    assert main(["file.npz"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_the_command_replays_a_file(explosions, coarse, library, easy):
    with open("file.npz", "wb") as file:
        file.write(dump.to_bytes(recorded(explosions[0], coarse, library, easy)))
    done = subprocess.run(
        [sys.executable, "-m", "workers.replay", os.path.abspath("file.npz")], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "exploded as recorded" in done.stdout and "physics step 2" in done.stdout
