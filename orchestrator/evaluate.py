"""Evaluate a trained policy on the grid of tasks: the 13 metrics of Table 1 (section 6).

usage: python -m orchestrator.evaluate RUN_FOLDER [key=value ...]

  python -m orchestrator.evaluate runs/ablation/ours-seed0
  python -m orchestrator.evaluate runs/ablation/ours-seed0 evaluation.max_tasks=0      the whole grid

Evaluates the newest checkpoint in the folder and writes evaluation.json there.
"""

import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from learner.storage import replace_file
from motion.errors import InputError
from motion.state_machine import build_state_machine
from orchestrator.console import run_command
from orchestrator.curriculum import final_tightenings, thresholds
from orchestrator.saved import load_latest
from orchestrator.settings import load
from orchestrator.tasks import task_grid
from workers.config import RewardConfig
from workers.counter_random import EVALUATION, fill_normal
from workers.environment import Environment, new_observations
from workers.inference import PolicyNetwork
from workers.kinematics import NUM_DOF
from workers.library import build_library
from workers.reward import W_UPPER_BODY
from workers.rollout import outcomes
from workers.types import REACHED, REWARD_PARTS, concatenate_outcomes


def run_tasks(config, library, policy, tasks, limits, log_sigma):
    """The `Outcomes` of tasks (M, 4), one episode each, ordered as the tasks; `environment` holds the task's number.

    The actions' noise is a function of (seed, task, step): the numbers do not depend on how many simulations run at a
    time. log_sigma: log of the actions' deviation in radians; -inf for none. limits: `Thresholds`.
    """
    count = min(config.evaluation.num_envs, len(tasks))
    threads = config.learner_threads + config.num_workers * config.worker_threads
    # "Return: always with the full reward" (section 6), whatever the row was trained with
    full = replace(config, reward=RewardConfig(key_body_frame=config.reward.key_body_frame))
    env = Environment(full, library, count, threads)
    network = PolicyNetwork(policy, count)
    sigma = math.exp(log_sigma) / config.action.scale
    number = np.arange(count)
    env.task[:] = tasks[:count]
    env.begin(number)
    waiting, active, ended = count, np.arange(count), []
    action, noise = np.zeros((count, NUM_DOF), dtype=np.float32), np.empty((count, NUM_DOF))
    while len(active):
        rows = len(active)
        mean = network.mean(env.observe(new_observations(rows), active))
        fill_normal(config.seed, EVALUATION, number[active], env.steps[active], noise[:rows])
        action[active] = mean + sigma * noise[:rows]
        env.step(action, limits, active)
        done = active[env.end[active] != 0]
        if not len(done):
            continue
        ended.append(outcomes(env, 0, number, done, limits))
        again = done[: len(tasks) - waiting]
        number[again] = np.arange(waiting, waiting + len(again))
        waiting += len(again)
        env.task[again] = tasks[number[again]]
        env.begin(again)
        active = np.setdiff1d(active, done[len(again) :], assume_unique=True)
    return concatenate_outcomes(ended)


def table_metrics(episodes):
    """Columns of Table 1 (section 6) of the `Outcomes` of all tasks: all but MS and IRFA."""
    d = episodes.deviations.mean(axis=0)
    return {
        "FRPD": d[0], "FRVD": d[1], "FRRD": d[2], "FKPD": d[3], "FJRD": d[4], "FJAD": d[6],
        # the reward's part without its weight in Eq. 1
        "SURI": episodes.parts[:, REWARD_PARTS.index("upper_body")].mean() / W_UPPER_BODY,
        "TC": episodes.trembles.mean(),
        "TS": episodes.steps.mean(),
        "TTAR": (episodes.end == REACHED).mean(),
        "Return": episodes.parts.sum(axis=1).mean(),
    }  # fmt: skip


def robustness(config, reached_all):
    """MS: log of the largest noise of `evaluation.robustness_log_sigmas` at which all tasks are reached, else None.

    reached_all: log sigma -> bool. Noises are tried from the smallest on, up to the first that fails.
    """
    best = None
    for log_sigma in sorted(config.evaluation.robustness_log_sigmas):
        if not reached_all(log_sigma):
            break
        best = log_sigma
    return best


def evaluate_policy(config, policy, tightenings, irfa):
    """evaluation.json's content (dict) of a policy: at the final accuracy, and at the thresholds that training reached.

    metrics: the 13 columns at the final accuracy, the paper's criterion. trained: the same at the thresholds of so many
    `tightenings`. A policy with a short training reaches little of the first and shows what it learned in the second.
    """
    library = build_library(build_state_machine(config.motions))
    tasks = task_grid(library, config.evaluation)
    if not len(tasks):
        raise InputError("evaluation: the grid holds no task; lower evaluation.moment_spacing or widen a cancel range")
    final = final_tightenings(config.curriculum)
    content = {"tasks": len(tasks), "tightenings": tightenings, "final_tightenings": final}
    for name, cuts in (("metrics", final), ("trained", tightenings)):
        limits = thresholds(config.curriculum, config.reach, cuts)
        content[name] = {**evaluate_at(config, library, policy, tasks, limits), "IRFA": irfa}
        content[f"{name}_thresholds"] = [limits.root_position, limits.key_bodies, limits.joint_rotation]
    return content


def evaluate_at(config, library, policy, tasks, limits):
    """The columns of Table 1 but IRFA (dict of float; MS may be None) at the given `Thresholds`."""
    rates = {}

    def reached_all(log_sigma):
        if log_sigma not in rates:
            rates[log_sigma] = run_tasks(config, library, policy, tasks, limits, log_sigma).end == REACHED
        return bool(rates[log_sigma].all())

    episodes = run_tasks(config, library, policy, tasks, limits, config.evaluation.log_sigma)
    rates[config.evaluation.log_sigma] = episodes.end == REACHED
    metrics = {key: float(value) for key, value in table_metrics(episodes).items()}
    return {**metrics, "MS": robustness(config, reached_all)}


def evaluate_run(folder, config):
    """Evaluate the newest checkpoint of a run's folder; writes evaluation.json there and returns its content."""
    folder = Path(folder)
    saved, path = load_latest(folder, config)
    if saved is None:
        raise InputError(f"{folder}: holds no checkpoint; train it first (python -m orchestrator.train out={folder})")
    curriculum = saved["parts"][1]
    content = {
        "checkpoint": str(path).rpartition("/")[2],
        "samples": saved["iteration"] * config.samples_per_iteration,
        "iterations": saved["iteration"],
        **evaluate_policy(config, saved["policies"][-1].averaged(), curriculum.tightenings, curriculum.achieved_at),
    }
    replace_file(folder / "evaluation.json", (json.dumps(content, indent=2) + "\n").encode())
    return content


def main(arguments):
    """Command line; see the module's docstring."""
    if not arguments:
        raise InputError("no run folder given; e.g. python -m orchestrator.evaluate runs/ablation/ours-seed0")
    folder = Path(arguments[0])
    content = evaluate_run(folder, load(folder / "config.yaml", arguments[1:]))
    print(f"{content['tasks']} tasks, checkpoint {content['checkpoint']}, {content['samples']} samples")
    for name in ("metrics", "trained"):
        limits = ", ".join(f"{value:.3g}" for value in content[f"{name}_thresholds"])
        print(f"thresholds {limits}" + (" (final accuracy)" if name == "metrics" else " (reached in training)"))
        print("  " + "  ".join(f"{key} {'x' if v is None else format(v, '.4g')}" for key, v in content[name].items()))
    print(f"written: {folder / 'evaluation.json'}")
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main, __doc__, sys.argv[1:]))
