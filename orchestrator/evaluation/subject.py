"""What is evaluated: the policy of a checkpoint, and whether it fits the configuration that it is evaluated with."""

from dataclasses import asdict, dataclass

from motion.errors import InputError
from motion.state_machine import build_state_machine
from orchestrator import saved
from orchestrator.settings import flatten
from orchestrator.validate import disagreement
from workers.kinematics import NUM_DOF
from workers.observation import OBSERVATION_SIZE
from workers.types import Policy

# Keys that give the policy's numbers their meaning; what else a checkpoint was trained with may differ
_MEANING = ("observation.", "action.", "network.")
# Keys of clips that only say which tasks there are
_TASKS = (".cancel", ".beats", ".genre")


@dataclass(frozen=True)
class Subject:
    """policy: `workers.types.Policy` that acts in evaluation. tightenings: cuts of the thresholds when it was saved.

    irfa: iteration that achieved the final accuracy, or None. iteration: of the checkpoint, whose file is `name`.
    """

    policy: Policy
    tightenings: int
    irfa: int | None
    iteration: int
    name: str


def load_newest(folder, config, other_clips=False):
    """The `Subject` of a run's folder: its newest readable checkpoint. InputError if none is there or fits.

    other_clips: the configuration's clips need not be those that it was trained with.
    """
    content, path = saved.load_latest(folder, config)
    if content is None:
        raise InputError(f"{folder}: holds no checkpoint; train it first (python -m orchestrator.train out={folder})")
    return _subject(content, config, path, other_clips)


def load_file(path, config, other_clips=False):
    """The `Subject` of one checkpoint file. InputError if it is none, broken, or does not fit `config`."""
    return _subject(saved.load_file(path), config, path, other_clips)


def _subject(content, config, path, other_clips):
    policy = content["policies"][-1].averaged()
    check(policy, content["config"], config, path)
    if not other_clips:
        check_clips(content, config, path)
    curriculum = content["parts"][1]
    return Subject(
        policy, curriculum.tightenings, curriculum.achieved_at, content["iteration"], str(path).rpartition("/")[2]
    )


def check(policy, trained, config, path):
    """InputError unless a policy fits a `Config`. trained: {dotted key: value} of its training; none of schema 1."""
    inputs, outputs = policy.weights[0].shape[0], policy.weights[-1].shape[1]
    if (inputs, outputs) != (OBSERVATION_SIZE, NUM_DOF):
        raise InputError(
            f"{path}: of another character: its network turns {inputs} numbers into {outputs}, this one's "
            f"{OBSERVATION_SIZE} into {NUM_DOF}; evaluate it with the version that trained it"
        )
    _agree(trained, dict(flatten(asdict(config))), _MEANING, path)


def check_clips(content, config, path):
    """InputError unless the clips of a `Config` are those that a policy was trained with, pose for pose."""
    trained, wanted = content["config"], dict(flatten(asdict(config)))
    if trained and clips_of(trained) != clips_of(wanted):
        raise InputError(
            f"{path}: trained with the clips {', '.join(clips_of(trained))}, asked for {', '.join(clips_of(wanted))}; "
            "how far it goes with others says --motions FILE"
        )
    _agree(trained, wanted, ("motions.clips.",), path)
    saved.check_same_clips(content["clips"], build_state_machine(config.motions).clips_hash, path)


def _agree(trained, wanted, keys, path):
    other = disagreement(trained, wanted, lambda key: key.startswith(keys) and not key.endswith(_TASKS))
    if other is not None:
        raise InputError(f"{path}: trained with {other}; evaluate a policy with what it was trained with")


def clips_of(values):
    """Names of the clips in their order, of {dotted key: value}."""
    return list(dict.fromkeys(key.split(".")[2] for key in values if key.startswith("motions.clips.")))
