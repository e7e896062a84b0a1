"""What an evaluation has finished, kept in a folder, so that one that was interrupted goes on where it was."""

import hashlib
import json
import shutil
from dataclasses import asdict
from pathlib import Path

import mujoco
import numpy as np

from learner.storage import replace_file
from workers.config import EnvConfig

SCHEMA = 2  # to be raised when the same inputs give other numbers or another content of a shard


def key_of(config, subject, machine, levels, size):
    """Hash of all that the numbers of a shard depend on (str).

    config: `Config`; subject: `evaluation.subject.Subject`; machine: `StateMachine`; levels: {name: `Thresholds`};
    size: tasks per shard.
    """
    environment = {name: value for name, value in asdict(config).items() if name in EnvConfig.__dataclass_fields__}
    environment["reward"] = {"key_body_frame": config.reward.key_body_frame}  # the others are not the row's own here
    del environment["physics"]["max_unstable_share"]  # stops training
    grid = config.evaluation
    content = {
        "schema": SCHEMA,
        "mujoco": mujoco.__version__,
        "policy": policy_digest(subject.policy),
        "clips": machine.content_hash,
        "environment": environment,
        "levels": {name: vars(level) for name, level in levels.items()},
        "grid": [grid.moment_spacing, grid.rotation_spacing, grid.max_tasks, size],
        "noise": [config.seed, grid.log_sigma],
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def policy_digest(policy):
    """Hash of what a policy's mean actions depend on."""
    digest = hashlib.sha256()
    for array in (*policy.weights, *policy.biases, policy.observation_mean, policy.observation_scale):
        array = np.ascontiguousarray(array)
        digest.update(repr((array.dtype.str, array.shape)).encode() + array.tobytes())
    return digest.hexdigest()


class Kept:
    """Finished shards of the evaluation `key` in a folder. With folder=None they are kept in memory."""

    def __init__(self, folder, key):
        self._all = None if folder is None else Path(folder)
        self._folder = folder and self._all / key
        self._memory = {}
        if self._folder:
            self._folder.mkdir(parents=True, exist_ok=True)

    def names(self):
        """Names of what is kept (a set)."""
        if self._folder is None:
            return set(self._memory)
        return {path.name.removesuffix(".json") for path in self._folder.glob("*.json")}

    def read(self, name):
        """What was kept under a name; None if nothing was, or nothing that can be read."""
        if self._folder is None:
            return self._memory.get(name)
        try:
            return json.loads((self._folder / f"{name}.json").read_text())
        except (FileNotFoundError, ValueError):
            return None

    def write(self, name, content):
        """Keep plain data under a name, whole or not at all."""
        if self._folder is None:
            self._memory[name] = content
        else:
            replace_file(self._folder / f"{name}.json", json.dumps(content).encode())

    def forget_others(self):
        """Remove what evaluations of other checkpoints or settings have left in the folder."""
        for other in self._all.iterdir() if self._all else ():
            if other.is_dir() and other != self._folder:
                shutil.rmtree(other, ignore_errors=True)


def shard_name(index):
    """Name of a shard of the main passes."""
    return f"shard-{index:06d}"
