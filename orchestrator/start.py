"""What a run begins with that does not begin from scratch: the learner of another run's checkpoint, or a policy."""

from pathlib import Path

from motion.errors import InputError
from orchestrator import saved
from orchestrator.curriculum import CurriculumState, final_tightenings
from orchestrator.settings import shipped_policies
from orchestrator.validate import disagreement

# Keys that give the networks' sizes and their numbers' meaning
_MEANING = ("network.", "observation.", "action.")


def check(config):
    """InputError unless the run of a `Config` can begin with what its `start` names."""
    if config.start.checkpoint is not None:
        _read(config)


def content(config, clips):
    """(content of the run's checkpoint 0, path of the one that its learner is from). InputError if that does not fit.

    clips: `StateMachine.clips_hash` of the run's. There are no workers' states in it: simulations begin anew.
    """
    source, path = _read(config)
    tightenings = config.start.tightenings
    if tightenings is None:
        tightenings = source["parts"][1].tightenings
    learner = {**(source["parts"][0] or _around(config, source)), "updates": 0, "skipped": 0}
    curriculum = CurriculumState(tightenings=min(tightenings, final_tightenings(config.curriculum)))
    return saved.content_of(config, clips, 0, learner, curriculum, [], source["policies"][-1:], []), path


def _read(config):
    """(content, path) of the checkpoint, checked."""
    place = Path(config.start.checkpoint)
    if place.is_dir():
        source, path = saved.load_latest(place)
    else:
        source, path = (saved.load_file(place), place) if place.exists() else (None, None)
    if source is None:
        raise InputError(
            f"start.checkpoint={place}: no checkpoint there; give a run's folder, a file in it or a policy that comes "
            f"with Segue ({', '.join(shipped_policies())})"
        )
    meaning, critics = _MEANING, source["parts"][0] or source["critics"]
    if config.arrival.weight and critics and critics.get("cost_to_go"):  # that network goes on, too
        meaning += ("arrival.hidden",)
    other = disagreement(
        source["config"], saved.numbers_of(config),
        lambda key: key.startswith(meaning) and (critics or key != "network.value_hidden"),
    )  # fmt: skip
    if other is not None:
        raise InputError(f"start.checkpoint={path}: of a run with {other}")
    return source, path


def _around(config, source):
    """State of a learner with the policy of a policy file and, but in older ones, its critics: all else is fresh."""
    from learner.state import LearnerState  # torch, which who begins from scratch need not wait for

    trained, state = source["config"], LearnerState(config, config.seed)
    samples = source["iteration"] * trained["num_envs"] * trained["horizon"]
    state.take_policy(source["policies"][-1], samples)
    if source["critics"]:
        state.take_critics(source["critics"])
    return state.state_dict()
