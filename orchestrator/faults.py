"""What the run's loop does about an iteration in which simulations exploded or whose update was skipped."""

import logging
import math
from pathlib import Path

from learner import checkpoint, storage
from motion.errors import InputError
from motion.state_machine import build_state_machine
from orchestrator.saved import place
from workers import dump
from workers.library import build_library
from workers.types import concatenate_outcomes

MAX_DUMPS = 16  # files that a run keeps of simulations that exploded


def check(config, folder, metrics, start):
    """Leave evidence of what went wrong in an iteration; InputError if it is too much to go on.

    metrics: of the iteration. start: a function that gives (worker states, policy, thresholds, outcomes) of its chunks,
    as values; called only if a simulation exploded. To be called before the iteration's checkpoint is written, so that
    the newest is one from before.
    """
    iteration, exploded = metrics["iteration"], metrics["physics/unstable"]
    if exploded:
        _dump(config, folder, iteration, *start())
    allowed = math.ceil(config.physics.max_unstable_share * config.num_envs)
    if exploded > allowed:
        raise InputError(
            f"{folder}: {exploded} of {config.num_envs} simulations exploded in iteration {iteration}, "
            f"physics.max_unstable_share={config.physics.max_unstable_share} allows {allowed} (to see how: python -m "
            f"workers.replay {folder}/faults/FILE). {_newest(config, folder)}: raise that share to continue, or start "
            "a run with a smaller physics.timestep or policy.log_sigma"
        )
    skipped = metrics["update/skipped"]
    if skipped >= config.ppo.max_skipped:
        learners = ("loss/", "gradient/", "policy/", "value/")
        wrong = ", ".join(name for name, value in metrics.items() if value is None and name.startswith(learners))
        raise InputError(
            f"{folder}: iteration {iteration} was number {skipped} in a row whose update was skipped "
            f"(ppo.max_skipped={config.ppo.max_skipped}); not finite: {wrong or 'the new parameters'}. "
            f"{_newest(config, folder)}: raise that number to continue, or start a run with a smaller "
            "ppo.learning_rate or ppo.max_grad_norm"
        )


def _newest(config, folder):
    """Says which checkpoint stands."""
    found = checkpoint.paths(place(folder, config))
    return f"The last checkpoint is {found[-1]}" if found else "There is no checkpoint yet"


def _dump(config, folder, iteration, states, policy, thresholds, outcomes):
    """Write faults/unstable-<iteration>-<environment>.npz for the run's first simulations that exploded."""
    faults = storage.LocalFolder(Path(folder) / "faults")
    episodes = dump.unstable(concatenate_outcomes(outcomes))
    library = None
    for environment, clock, steps in zip(episodes.environment, episodes.clock, episodes.steps):
        name, names = f"unstable-{iteration:08d}-{environment:08d}.npz", faults.names()
        if name in names:  # its second explosion in these steps, or an iteration that is done again
            continue
        if len(names) >= MAX_DUMPS:
            break
        library = library or build_library(build_state_machine(config.motions))
        state = next(state for state in states if environment in state.environment)
        recorded = dump.record(config, library, state, policy, thresholds, environment, clock, steps, iteration)
        if recorded is None:
            logging.getLogger(__name__).warning("%s: environment %d does not explode again", folder, environment)
        else:
            faults.write(name, dump.to_bytes(recorded))
