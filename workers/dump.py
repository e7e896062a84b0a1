"""What is kept of a simulation that exploded: its last states and actions, enough to replay it without the clips.

Rollouts store nothing for this. A chunk is a pure function of (worker state, policy, thresholds) in which no
environment knows of its neighbours: the one in question is collected again, alone, and comes out with the same bits.
"""

import io
import json
import zipfile
from dataclasses import asdict, dataclass, fields, replace

import numpy as np
from omegaconf import OmegaConf

from motion.errors import InputError
from workers.config import EnvConfig
from workers.rollout import Rollout
from workers.types import FELL, Thresholds, WorkerState

_STATE = "state."  # prefix of the worker state's arrays in a file


@dataclass(frozen=True)
class Dump:
    """The last steps of one environment, K of them, the last of which exploded.

    state: `WorkerState` with one row, before them. action: (K, 31) float32. pose: (K, 84) float32, qpos and qvel before
    each step. config: `EnvConfig`. thresholds: of its task. seed, iteration: of the run, and which of its iterations.
    """

    state: WorkerState
    action: np.ndarray
    pose: np.ndarray
    config: EnvConfig
    thresholds: Thresholds
    seed: int
    iteration: int


def unstable(outcomes):
    """The `Outcomes` among some that a simulation's explosion ended."""
    return outcomes.take(np.flatnonzero((outcomes.end == FELL) & (outcomes.fell_on < 0)))


def record(config, library, state, policy, thresholds, environment, clock, steps, iteration):
    """The `Dump` of an episode that exploded during a chunk, or None if it does not when collected again.

    state, policy, thresholds: what the chunk was collected from; environment, clock, steps: of the episode's `Outcomes`
    (the end's clock, the episode's length). Holds the whole episode, or what of it lay in this chunk.
    """
    row = _row(state, int(np.flatnonzero(state.environment == environment)[0]))
    begin = max(row.clock, clock - steps)

    def collect(length):
        return Rollout(config, library, 1, length, config.seed).collect(row, policy, thresholds)

    if begin > row.clock:
        _, row = collect(begin - row.clock)
    chunk, _ = collect(clock - begin)
    if chunk.outcomes.end.tolist() != [FELL] or chunk.outcomes.fell_on[0] >= 0:
        return None
    parts = {field.name: getattr(config, field.name) for field in fields(EnvConfig)}
    if thresholds.groups:  # a replay has no clips and knows no groups
        *limits, tightenings = thresholds.of(library.group_of(row.task))[0].tolist()
        thresholds = Thresholds(*limits, tightenings=int(tightenings))
    return Dump(row, chunk.action[:, 0], chunk.pose[:, 0], EnvConfig(**parts), thresholds, config.seed, iteration)


def to_bytes(dump):
    """A dump as the bytes of a .npz file."""
    about = {
        "config": asdict(dump.config), "thresholds": asdict(dump.thresholds),
        "seed": dump.seed, "iteration": dump.iteration,
    }  # fmt: skip
    arrays = {_STATE + name: value for name, value in vars(dump.state).items()}
    file = io.BytesIO()
    np.savez(file, about=json.dumps(about), action=dump.action, pose=dump.pose, **arrays)
    return file.getvalue()


def read(path):
    """The `Dump` in a file of `to_bytes`. Runs no code from it. InputError if it is none."""
    try:
        with np.load(path, allow_pickle=False) as file:
            about = json.loads(str(file["about"]))
            state = {name.removeprefix(_STATE): file[name] for name in file.files if name.startswith(_STATE)}
            action, pose = file["action"], file["pose"]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: not a recorded simulation ({type(error).__name__})") from error
    config = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(EnvConfig), about["config"]))
    state = WorkerState(**{**state, "clock": int(state["clock"])})
    return Dump(state, action, pose, config, Thresholds(**about["thresholds"]), about["seed"], about["iteration"])


def _row(state, i):
    """The worker state of row i alone."""
    return replace(state, **{k: v[i : i + 1] for k, v in vars(state).items() if isinstance(v, np.ndarray)})
