"""Values that a configuration may have. `orchestrator.settings` has already checked names and types of its keys.

Clips and state machine (`motions.*`) are checked by `motion.state_machine.build_state_machine`.
"""

import math
import operator
import os
import re

from motion.errors import InputError
from motion.skeleton import BODY_NAMES


def at_least(low):
    return f"at least {low}", lambda v: v >= low


def above(low):
    return f"above {low}", lambda v: v > low


def choice(*names):
    return "one of " + ", ".join(map(str, names)), lambda v: v in names


def every(rule, length=None):
    """A list with entries that each obey `rule`, and `length` of them if given, else at least one."""
    text, accept = rule
    size = f"{length} numbers" if length else "a list of at least one number"
    return f"{size}, each {text}", lambda v: (len(v) == length if length else len(v) > 0) and all(map(accept, v))


PROBABILITY = "from 0 to 1", lambda v: 0 <= v <= 1
FINITE = "finite", lambda v: True  # every number must be finite, see `check_values`
FACTOR = "above 0 and below 1", lambda v: 0 < v < 1

# What each key may be: words for the user, and the test. Null is left to the key's type.
RULES = {
    "reward.key_body_frame": choice("common", "own"),
    "reward.failure": FINITE,
    "reward.tremble_ramp": at_least(0),
    "reach.heading_start": above(0),
    "reach.heading_floor": above(0),
    "fall.ignore_bodies": (
        "a list of bodies among " + ", ".join(BODY_NAMES),
        lambda v: all(name in BODY_NAMES for name in v),
    ),
    "rotation.reference": choice("source", "world"),
    "task.focus": PROBABILITY,
    "task.stay_probability": PROBABILITY,
    "task.transition_time": above(0),
    "task.max_steps": at_least(1),
    "task.training_steps": at_least(1),
    "observation.target": choice("absolute", "difference"),
    "action.mode": choice("absolute", "target", "current"),
    "action.scale": above(0),
    "physics.timestep": above(0),
    "physics.substeps": at_least(1),
    "physics.iterations": at_least(1),
    "physics.ls_iterations": at_least(1),
    "physics.tolerance": above(0),
    "physics.sole": at_least(0),
    "physics.max_speed": above(0),
    "physics.max_unstable_share": PROBABILITY,
    "network.hidden": every(at_least(1)),
    "network.value_hidden": every(at_least(1)),
    "network.output_scale": at_least(0),
    "policy.log_sigma": FINITE,
    "policy.noise_window": at_least(1),
    "policy.independent_from": at_least(0),
    "policy.judges": ("0 or at least 2", lambda v: v == 0 or v >= 2),
    "policy.judge_log_sigma": FINITE,
    "policy.sigma_factor": ("above 0, at most 1", lambda v: 0 < v <= 1),
    "policy.average": ("from 0 to below 1", lambda v: 0 <= v < 1),
    "ppo.gamma": PROBABILITY,
    "ppo.gae_lambda": PROBABILITY,
    "ppo.clip": above(0),
    "ppo.epochs": at_least(1),
    "ppo.natural_epochs": at_least(1),
    "ppo.minibatch_size": at_least(1),
    "ppo.optimizer": choice("adam", "kfac"),
    "ppo.kfac_after": at_least(0),
    "ppo.policy_after": at_least(0),
    "ppo.damping": above(0),
    "ppo.natural_rate": above(0),
    "ppo.learning_rate": above(0),
    "ppo.target_kl": above(0),
    "ppo.final_kl": above(0),
    "ppo.kl_updates": at_least(0),
    "ppo.first_updates": at_least(0),
    "ppo.first_kl": above(0),
    "ppo.first_clip": above(0),
    "ppo.max_grad_norm": above(0),
    "ppo.max_skipped": at_least(1),
    "ppo.timeout": choice("terminal", "bootstrap"),
    "sbc.weight": at_least(0),
    "sbc.gap_weighting": choice("balanced", "inverse", "uniform"),
    "sbc.batch_size": at_least(0),
    "sbc.reduction": choice("sum", "mean"),
    "arrival.weight": at_least(0),
    "arrival.after": at_least(0),
    "arrival.share": PROBABILITY,
    "arrival.windows": at_least(1),
    "arrival.lead": at_least(0),
    "arrival.noise": at_least(0),
    "arrival.draws": at_least(1),
    "arrival.discount": FACTOR,
    "arrival.ends": above(0),
    "arrival.time": at_least(0),
    "arrival.steps": at_least(1),
    "arrival.batch_size": at_least(1),
    "arrival.target_kl": above(0),
    "arrival.final_kl": above(0),
    "arrival.hidden": every(at_least(1)),
    "row": (
        "a name of letters, digits, '_', '-' and '.'",
        lambda v: re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]*", v) is not None,
    ),
    "seed": at_least(0),
    "out": ("the path of a folder", lambda v: v.strip() != ""),
    "runtime": choice("ray", "local"),
    "device": choice("auto", "cpu", "cuda"),
    "num_envs": at_least(1),
    "num_workers": at_least(1),
    "worker_threads": at_least(1),
    "spare_threads": at_least(0),
    "learner_threads": at_least(1),
    "horizon": at_least(1),
    "pipeline_depth": choice(0, 1),
    "budget.samples": at_least(1),
    "budget.iterations": at_least(1),
    "start.checkpoint": ("the path of a checkpoint, of a run's folder or of a policy", lambda v: v.strip() != ""),
    "start.tightenings": at_least(0),
    "curriculum.start": every(above(0), 3),
    "curriculum.floor": every(above(0), 3),
    "curriculum.factor": FACTOR,
    "curriculum.achievement": PROBABILITY,
    "curriculum.window": at_least(1),
    "curriculum.window_unit": choice("iterations", "episodes"),
    "curriculum.scope": choice("run", "source", "group"),
    "checkpoint.every": at_least(1),
    "checkpoint.keep": at_least(1),
    "checkpoint.storage": (
        "a URL such as file:///mnt/x or s3://bucket/x, without a password (credentials come from the environment)",
        lambda v: re.match(r"[a-z][a-z0-9+.-]*:/", v) is not None and not re.search(r"://[^@]*:[^@]*@", v),
    ),
    "faults.restarts": at_least(0),
    "faults.hang_timeout": above(0),
    "evaluation.moment_spacing": above(0),
    "evaluation.rotation_spacing": above(0),
    "evaluation.max_tasks": at_least(0),
    "evaluation.num_envs": at_least(1),
    "evaluation.log_sigma": FINITE,
    "evaluation.robustness_bracket": every(FINITE, 2),
    "evaluation.robustness_resolution": above(0),
    "evaluation.num_workers": at_least(0),
    "report.strips": at_least(0),
    "report.videos": at_least(0),
    "report.tasks": at_least(0),
    "report.figures": ("the path of a folder", lambda v: v.strip() != ""),
    "tracking.uri": ("an address such as sqlite:///mlflow.db or http://host:5000", lambda v: v.strip() != ""),
}


def check_values(config, source):
    """Raise InputError unless every value of a `Config` is allowed; `source(key)` says where a value came from."""
    for key, (text, accept) in RULES.items():
        value = operator.attrgetter(key)(config)
        if value is None:
            continue
        numbers = [v for v in (value if isinstance(value, list) else [value]) if isinstance(v, float)]
        if not all(map(math.isfinite, numbers)) or not accept(value):
            raise InputError(f"{source(key)}: {key}={shown(value)} must be {text}")
    check_relations(config, source)


def check_relations(config, source):
    """Rules between keys, and between keys and this machine."""
    if config.budget.samples is None and config.budget.iterations is None:
        raise InputError("no budget: set budget.samples or budget.iterations, e.g. budget.samples=2e6")
    if config.num_workers > config.num_envs:
        raise InputError(
            f"{source('num_workers')}: num_workers={config.num_workers} is more than num_envs={config.num_envs}; "
            "every worker needs a simulation: lower num_workers"
        )
    if config.start.tightenings and config.start.checkpoint is None:
        raise InputError(
            f"{source('start.tightenings')}: start.tightenings={config.start.tightenings} is for a run that "
            "begins with another's learner: set start.checkpoint, too"
        )
    if config.ppo.first_updates and config.start.checkpoint is not None:
        raise InputError(
            f"{source('ppo.first_updates')}: ppo.first_updates={config.ppo.first_updates} is for fresh networks; such "
            "long steps would undo the learner of start.checkpoint: set ppo.first_updates=0"
        )
    if config.task.focus and not config.policy.judges:
        raise InputError(
            f"{source('task.focus')}: task.focus={config.task.focus} needs judging environments, whose tasks stay "
            "uniform and move the curriculum: set policy.judges, e.g. policy.judges=8"
        )
    if config.arrival.weight and not config.physics.sole:
        raise InputError(
            f"{source('arrival.weight')}: arrival.weight={config.arrival.weight} differentiates the ground's contact, "
            "which hard feet make and break at once: set physics.sole, e.g. physics.sole=0.02, or arrival.weight=0"
        )
    if config.arrival.weight and config.arrival.steps > config.task.time_limit:
        raise InputError(
            f"{source('arrival.steps')}: arrival.steps={config.arrival.steps} is more than an episode's "
            f"{config.task.time_limit} steps (task.training_steps, task.max_steps): lower it"
        )
    if config.arrival.weight and config.reward.key_body_frame != "common":
        raise InputError(
            f"{source('arrival.weight')}: arrival.weight={config.arrival.weight} follows key bodies in the common "
            "frame only: set reward.key_body_frame=common, or arrival.weight=0"
        )
    if config.reach.heading_floor > config.reach.heading_start:
        raise InputError(
            f"{source('reach.heading_floor')}: reach.heading_floor={config.reach.heading_floor} must not be above "
            f"reach.heading_start={config.reach.heading_start}"
        )
    low, high = config.evaluation.robustness_bracket
    if low > high:
        raise InputError(
            f"{source('evaluation.robustness_bracket')}: evaluation.robustness_bracket={shown([low, high])} is "
            f"reversed; use {shown([high, low])}"
        )
    for low, high in zip(config.curriculum.floor, config.curriculum.start, strict=True):
        if low > high:
            raise InputError(
                f"{source('curriculum.floor')}: curriculum.floor={shown(config.curriculum.floor)} must not be above "
                f"curriculum.start={shown(config.curriculum.start)}"
            )
    # On a cluster the learner may be on another machine; orchestrator.cluster asks the cluster for its GPUs.
    if config.device == "cuda" and not (config.runtime == "ray" and os.environ.get("RAY_ADDRESS")):
        import torch

        if not torch.cuda.is_available():
            raise InputError(f"{source('device')}: device=cuda, but torch finds no CUDA device; use device=cpu or auto")


def disagreement(held, wanted, matters=lambda key: True):
    """The first key that two mappings {dotted key: value} share and disagree in, in words for a message; or None.

    held: what something was made with, wanted: what is asked of it. Keys that do not matter are passed over.
    """
    for key, value in held.items():
        if key in wanted and wanted[key] != value and matters(key):
            return f"{key}={shown(value)}, asked for {key}={shown(wanted[key])}"
    return None


def shown(value):
    """A value as one would type it on the command line."""
    if isinstance(value, list):
        return "[" + ",".join(map(shown, value)) + "]"
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return str(value)
