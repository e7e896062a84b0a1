"""What a run's checkpoint holds: its content as the loop's objects, and back."""

from dataclasses import asdict
from pathlib import Path

from learner import checkpoint, storage
from motion.errors import InputError
from orchestrator import folder as run_folder
from orchestrator.curriculum import CurriculumState
from orchestrator.settings import flatten
from orchestrator.validate import disagreement
from workers.types import Policy, Thresholds, WorkerState

# keys that give the numbers their meaning and that older checkpoints do not name: what was so in all of them
_ONCE = {
    "observation.target": "absolute", "network.value_hidden": None, "policy.independent_from": None,
    "task.training_steps": None, "ppo.natural_epochs": None, "physics.sole": 0.0, "arrival.weight": 0.0,
    "ppo.first_updates": 0, "ppo.policy_after": 0,
}  # fmt: skip


def place(folder, config):
    """Where the checkpoints of a run go: its folder, or, with `checkpoint.storage`, the last two names of it there."""
    folder = Path(folder).absolute()
    if config.checkpoint.storage is None:
        return folder / "checkpoints"
    return storage.join(config.checkpoint.storage, folder.parent.name, folder.name)


def content_of(config, clips, iteration, learner, curriculum, workers, policies, thresholds):
    """A checkpoint's content, for `learner.checkpoint.save`; the arguments are values, not handles.

    clips: `StateMachine.clips_hash`. learner: `LearnerState.state_dict()`; curriculum: `CurriculumState`; workers,
    policies, thresholds: lists.
    """
    return {
        "iteration": iteration,
        "config": numbers_of(config),
        "clips": clips,
        "learner": learner,
        "curriculum": asdict(curriculum),
        "workers": [vars(state) for state in workers],
        "policies": [vars(policy) for policy in policies],
        "thresholds": [vars(item) for item in thresholds],
    }


def policy_content(saved, config):
    """Content of a policy file: a checkpoint for use, not for going on; for `learner.checkpoint.encode`.

    It has the policy that is evaluated, the critics that a run that begins with it goes on from, where the curriculum
    stood, the clips' hash and a configuration to evaluate it with. saved: as from `load_latest`. config: the run's.
    """
    learner = saved["parts"][0]
    other = (*run_folder.FREE, "device", "motions.dir", "start.")  # and no paths
    return {
        "iteration": saved["iteration"],
        "config": {key: value for key, value in flatten(asdict(config)) if not key.startswith(other)},
        "clips": saved["clips"],
        "learner": None,
        "critics": {
            "value": learner["value"], "returns": learner["returns"],
            "cost_to_go": (learner.get("cost_to_go") or {}).get("network"),
        },
        "curriculum": asdict(saved["parts"][1]),
        "workers": [],
        "policies": [vars(saved["policies"][-1].averaged())],
        "thresholds": [],
    }  # fmt: skip


def load_latest(folder, config=None):
    """(content of the newest readable checkpoint of a run's folder, its path), or (None, None) if there is none yet.

    content: iteration, config and clips (see `check_same_run`; empty and None in older ones), parts (learner's and
    curriculum's state), critics (of a policy file, None in older ones), workers, policies, thresholds. With a
    `Config` its `checkpoint.storage` is searched, too. A broken one is passed over with a warning; InputError if all
    are broken.
    """
    places = [Path(folder) / "checkpoints"]
    if config is not None and config.checkpoint.storage is not None:
        places.append(place(folder, config))
    content, path = checkpoint.load_newest(*places)
    return (None, None) if content is None else (_objects(content), path)


def load_file(path):
    """What `load_latest` gives, of one checkpoint file. InputError if it cannot be read."""
    return _objects(checkpoint.load(path))


def _objects(content):
    curriculum = arrays(content["curriculum"])
    curriculum["window"] = _pairs(curriculum["window"])
    curriculum["tracks"] = tuple((_pairs(window), cuts) for window, cuts in curriculum.get("tracks", ()))
    config = content.get("config", {})
    if config:
        config = {**_ONCE, **config}
    return {
        "iteration": content["iteration"],
        "config": config,
        "clips": content.get("clips"),
        "parts": (content["learner"], CurriculumState(**curriculum)),
        "critics": content.get("critics"),
        "workers": [WorkerState(**arrays(item)) for item in content["workers"]],
        "policies": [Policy(**arrays(item)) for item in content["policies"]],
        "thresholds": [Thresholds(**arrays(item)) for item in content["thresholds"]],
    }


def _pairs(window):
    return tuple(map(tuple, window))


def check_same_run(saved, config, clips, path):
    """InputError if what `load_latest` found at `path` is of a run with other numbers; a storage may hold many runs.

    clips: `StateMachine.clips_hash` of the clips as they are now.
    """
    if saved["parts"][0] is None:
        raise InputError(f"{path}: holds a policy to use, not the state of a run; choose another out=")
    check_same_clips(saved["clips"], clips, path)
    other = disagreement(saved["config"], numbers_of(config))
    if other is not None:
        raise InputError(f"{path}: of a run with {other}; choose another out= or checkpoint.storage=")


def check_same_clips(trained, clips, path):
    """InputError unless a checkpoint's hash of its clips (None: of an older version) is that of the clips now."""
    if trained is not None and trained != clips:
        raise InputError(
            f"{path}: trained with other clips of the same names: their poses have changed since; "
            "give the folder with the old ones as motions.dir=, or choose another out="
        )


def numbers_of(config):
    """{dotted key: value} of the keys that the numbers of a run's training depend on."""
    other = (*run_folder.FREE, *run_folder.BUDGET, *run_folder.EVALUATION, "device")
    return {key: value for key, value in flatten(asdict(config)) if not key.startswith(other)}


def arrays(item):
    """Tensors of a checkpoint as numpy arrays, lists of them as tuples."""
    out = {}
    for name, value in item.items():
        if isinstance(value, list):
            value = tuple(part.numpy() if hasattr(part, "numpy") else part for part in value)
        elif hasattr(value, "numpy"):
            value = value.numpy()
        out[name] = value
    return out
