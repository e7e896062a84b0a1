"""What the tests share: clips, state machines, random poses, small configurations, chunks of real rollouts.

Fixtures that are functions (`make_...`, `random_...`) are session-scoped, so that hypothesis may call them many times.
"""

import dataclasses
import itertools
import operator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import reference
from hypothesis import settings
from scipy.spatial.transform import Rotation

from learner.state import LearnerState
from motion.formats import read_clip
from motion.state_machine import ClipConfig, MotionsConfig, State, StateMachine, build_state_machine
from orchestrator.config import Config
from workers import windows
from workers.config import PhysicsConfig
from workers.humanoid import build_model
from workers.kinematics import forward_kinematics_batch
from workers.library import build_library
from workers.rollout import Rollout
from workers.types import Policy, Thresholds

settings.register_profile("segue", deadline=None, max_examples=30, derandomize=True)
settings.load_profile("segue")

REAL = Path(__file__).resolve().parents[1].parent / "shared/motions/reallusion"
REAL_CLIPS = ("Idle_Battle", "Atk_Stab", "RunForward")


def motions():
    """Three built-in clips with all nine transitions: one at rest, one periodic and fast, one that strikes."""
    return MotionsConfig(
        name="three",
        clips={
            "idle": ClipConfig(file="builtin:idle", looping=True, cancel=[0.0, 2.96]),
            "run": ClipConfig(file="builtin:run", looping=True, cancel=[0.0, 0.66]),
            "stab": ClipConfig(file="builtin:stab", cancel=[0.84, 1.7]),
        },
    )


@pytest.fixture(scope="session")
def machine():
    """The state machine of `motions`."""
    return build_state_machine(motions())


@pytest.fixture(scope="session")
def library(machine):
    return build_library(machine)


@pytest.fixture(scope="session")
def real_clips():
    """Clips of the paper's set, where this machine has them."""
    if not REAL.is_dir():
        pytest.skip("the real clips (shared/motions) are not on this machine")
    return [read_clip(REAL / f"RL_Avatar_{name}_Motion.npy", name) for name in REAL_CLIPS]


@pytest.fixture(scope="session")
def real_library(real_clips):
    """All transitions between the real clips, each left anywhere in its second half."""
    states = tuple(State(c.name, c, 0.0, (c.duration / 2, c.duration)) for c in real_clips)
    groups = np.array([(source, target) for source in range(len(states)) for target in range(len(states))])
    return build_library(StateMachine(states, groups, (-np.pi / 2, np.pi / 2)))


@pytest.fixture(scope="session")
def all_clips(machine, request):
    """The built-in clips of `motions`, and the real ones where there are any."""
    return [state.clip for state in machine.states] + (request.getfixturevalue("real_clips") if REAL.is_dir() else [])


@pytest.fixture(scope="session")
def clip_poses(all_clips):
    """(qpos (n, 47), qvel (n, 37)) of frames of `all_clips`."""
    rows = [np.linspace(0, clip.frames - 1, 4).astype(int) for clip in all_clips]
    return tuple(
        np.concatenate([getattr(c, name)[r] for c, r in zip(all_clips, rows, strict=True)]) for name in ("qpos", "qvel")
    )


@pytest.fixture(scope="session")
def model():
    """The figure's MuJoCo model."""
    return build_model(PhysicsConfig())


# ------------------------------------------------------------------------------------------------------ random poses


def _random_pose(seed, largest=3.1):
    """(qpos, qvel) of a random pose: anywhere, any orientation, joints from nearly neutral to nearly half a turn."""
    generator = np.random.default_rng(seed)
    qpos = [generator.normal(size=3), reference.quaternion(Rotation.random(rng=generator))]
    for _, kind, _ in reference.JOINTS:
        angle = generator.choice([1e-9, generator.uniform(0, largest), largest])
        if kind == "ball":
            axis = generator.normal(size=3)
            sign = generator.choice([-1, 1])  # a quaternion and its negative are the same rotation
            qpos.append(sign * reference.quaternion(Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))))
        else:
            qpos.append([angle * generator.choice([-1, 1])])
    qvel = generator.normal(size=37) * generator.choice([0.0, 1.0, 10.0])
    return np.concatenate(qpos), qvel


@pytest.fixture(scope="session")
def random_pose():
    """A function of (seed) giving one random pose: (qpos (47,), qvel (37,))."""
    return _random_pose


@pytest.fixture(scope="session")
def random_poses():
    """A function of (count, seed) giving random poses: (qpos (count, 47), qvel (count, 37))."""

    def make(count, seed=0, **keywords):
        poses = [_random_pose([seed, i], **keywords) for i in range(count)]
        return tuple(np.array(array) for array in zip(*poses, strict=True))

    return make


def _bodies(qpos):
    """World positions (n, 17, 3) and quaternions (n, 17, 4) of poses (n, 47), by the compiled kinematics."""
    position, rotation = np.empty((len(qpos), 17, 3)), np.empty((len(qpos), 17, 4))
    forward_kinematics_batch(np.ascontiguousarray(qpos), position, rotation)
    return position, rotation


@pytest.fixture(scope="session")
def bodies_of():
    return _bodies


# -------------------------------------------------------------------------------------------- configurations, policies


def _config(values=()):
    """A configuration small enough for a test, changed by {dotted key: value}."""
    config = Config(motions=motions(), num_envs=8, horizon=8, runtime="local", device="cpu")
    changes = {
        "network.hidden": [16],
        "ppo.minibatch_size": 32,
        "ppo.epochs": 2,
        "action.mode": "target",
        "policy.log_sigma": -1.0,
        "budget.iterations": 4,
        "curriculum.window": 2,
        "checkpoint.every": 2,
        "tracking.enabled": False,
        **dict(values),
    }
    for key, value in changes.items():
        path, _, name = key.rpartition(".")
        owner = operator.attrgetter(path)(config) if path else config
        assert hasattr(owner, name), key
        setattr(owner, name, value)
    return config


@pytest.fixture(scope="session")
def make_config():
    return _config


@pytest.fixture(scope="session")
def make_policy():
    """A function of (seed, ...) giving a `workers.types.Policy` with random weights."""

    def make(seed=0, hidden=(16,), gain=0.1, log_sigma=-1.0, version=0):
        generator = np.random.default_rng(seed)
        sizes = [282, *hidden, 31]
        weights = [generator.normal(size=(a, b)) / np.sqrt(a) for a, b in itertools.pairwise(sizes)]
        weights[-1] *= gain
        return Policy(
            weights=tuple(w.astype(np.float32) for w in weights),
            biases=tuple(generator.normal(size=b).astype(np.float32) * 0.1 for b in sizes[1:]),
            observation_mean=generator.normal(size=282).astype(np.float32) * 0.1,
            observation_scale=generator.uniform(0.5, 2, 282).astype(np.float32),
            log_sigma=log_sigma,
            version=version,
        )

    return make


# thresholds that a policy which only holds the target pose reaches now and then
EASY = Thresholds(0.35, 3.0, 1.0)


@pytest.fixture(scope="session")
def easy():
    return EASY


@pytest.fixture(scope="session")
def trajectories(library, make_policy):
    """Real chunks, in which episodes end in every way: 6 chunks of 24 environments and 8 steps in sequence.

    Time is up after 16 steps, so that many episodes begin and end within a chunk. states[k] is the worker's state
    before chunks[k], states[6] after the last.
    """
    config = _config({"task.max_steps": 16})
    rollout = Rollout(config, library, 24, 8, seed=5)
    states, chunks = [rollout.initial_state(0)], []
    for k in range(6):
        chunk, state = rollout.collect(states[-1], make_policy(version=k), EASY)
        chunks.append(chunk)
        states.append(state)
    return SimpleNamespace(config=config, rollout=rollout, states=states, chunks=chunks)


@pytest.fixture(scope="session")
def lessons(library):
    """What a learner can learn from: six chunks that the policy of `learner(...)` with seed 1 collected, version 0."""
    config = _config({"task.max_steps": 16})
    rollout = Rollout(config, library, 24, 8, seed=5)
    policy = LearnerState(config, seed=1).snapshot()
    state, chunks = rollout.initial_state(0), []
    for _ in range(6):
        chunk, state = rollout.collect(state, policy, EASY)
        chunks.append(chunk)
    return chunks


# --------------------------------------------------------------------------------------------------------- comparisons


def _flat(value, path=""):
    """(path, leaf) of nested dataclasses, dicts and sequences."""
    if dataclasses.is_dataclass(value):
        value = vars(value)
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _flat(item, f"{path}.{key}")
    elif isinstance(value, (list, tuple)):
        for i, item in enumerate(value):
            yield from _flat(item, f"{path}[{i}]")
    else:
        yield path, value


def _assert_same_bits(a, b):
    """Nested data is equal to the last bit, types and shapes included."""
    a, b = dict(_flat(a)), dict(_flat(b))
    assert a.keys() == b.keys()
    for path, left in a.items():
        left, right = np.asarray(left), np.asarray(b[path])
        assert left.dtype == right.dtype and left.shape == right.shape, path
        assert left.tobytes() == right.tobytes(), path


@pytest.fixture(scope="session")
def assert_same_bits():
    return _assert_same_bits


@pytest.fixture(scope="session")
def columns():
    """A function giving the chunk of some columns (environments) of a chunk."""

    def take(chunk, where):
        where = np.asarray(where)
        ended = np.isin(chunk.outcomes.environment, chunk.environment[where])
        over_time = {
            name: np.ascontiguousarray(getattr(chunk, name)[:, where])
            for name in (
                "observation", "action", "mean", "reward", "end", "pose", "next_pose", "pd_target", "log_sigma",
            )
        }  # fmt: skip
        return dataclasses.replace(
            chunk,
            environment=chunk.environment[where],
            last_observation=chunk.last_observation[where],
            final_observation=chunk.final_observation[ended],
            outcomes=chunk.outcomes.take(np.flatnonzero(ended)),
            **over_time,
        )

    return take


@pytest.fixture(scope="module")
def everybody_is_near():
    """Windows of all episodes, however far they are from their targets."""
    kept, windows.FAR = windows.FAR, 1e9
    yield
    windows.FAR = kept
