"""Compare the trained policy with kinematic transitions on the same tasks, by the same measures (docs/baselines.md).

usage: python -m orchestrator.baselines RUN_OR_SWEEP_FOLDER [key=value ...]
       python -m orchestrator.baselines [motions=NAME] [key=value ...] out=FOLDER      the kinematic methods alone

  python -m orchestrator.baselines runs/ablation/ours-seed0
  python -m orchestrator.baselines runs/ablation report.tasks=500         its row ours, 500 tasks
  python -m orchestrator.baselines motions=builtin out=baselines

Of a run's folder the newest checkpoint acts, without noise, until the thresholds that its training had reached. The
tasks are `report.tasks` of the evaluation's grid, always the same ones. Writes baselines.json and baselines.md into the
folder.
"""

import contextlib
import json
import math
import sys
from functools import partial
from pathlib import Path

import numpy as np

from learner.storage import replace_file
from motion.baselines import DESCRIPTIONS, LABELS, METHODS, Placement, make_scene
from motion.errors import InputError
from motion.state_machine import build_state_machine
from orchestrator import settings
from orchestrator.console import run_command
from orchestrator.curriculum import thresholds
from orchestrator.evaluation.bar import Bar
from orchestrator.evaluation.replay import load_policy, record
from orchestrator.tasks import TaskGrid
from orchestrator.transition_scores import METRICS, score, shown
from workers.library import build_library
from workers.plausibility import Judge, model_residual, physics_steps
from workers.types import REACHED

OURS, CLIPS = "ours", "clips"
PIECE = 0.4  # s of a clip that the reference row plays
CHECKED = 20  # tasks whose simulation is differentiated at the physics' rate, too

_LABELS = {OURS: "Ours (physics)", **LABELS, CLIPS: "Clips alone"}
_DESCRIPTIONS = {
    OURS: "the trained policy, simulated, without noise, from the source pose until the target counts as reached",
    **DESCRIPTIONS,
    CLIPS: "no transition: 0.4 s of the source clip from the same moment, for comparison",
}


def compare(folder, config, policy, limits, max_tasks, show=None):
    """Content (dict) of baselines.json, which is written to `folder` with baselines.md.

    policy: `workers.types.Policy`, or None for the kinematic methods alone. limits: `Thresholds` at which the policy's
    tasks count as reached. max_tasks: how many of the grid's tasks. show: a function of the number of transitions to
    make and to score, giving a context manager with `advance(count)`. InputError if there is no task.

    tasks, fps, clips; thresholds: [d^rp, d^kp, d^q] or null; compared: the tasks behind `metrics`, those that the
    policy reached (all, if there is none or it reached none). methods: [{method, label, reached_share, duration,
    metrics, metrics_all}], metrics: {name: {mean, median, p95}} over the compared tasks, the same for every method,
    metrics_all: over all tasks, failed ones up to their failure. units, descriptions: of metrics; about: of methods;
    skipped: [{method, reason}]; differentiation: see `_physics_rate`.
    """
    machine = build_state_machine(config.motions)
    library, judge = build_library(machine), Judge(config.physics)
    numbers, tasks = _tasks(library, config.evaluation, max_tasks)
    placement = Placement(config.task.transition_time, config.rotation.reference)
    fps = 1 / (config.physics.timestep * config.physics.substeps)
    scenes = [make_scene(machine.states, task, placement) for task in tasks]
    rows, scores, skipped, motions = {}, {}, [], []
    with (show or _Silent)(2 * len(tasks) * (len(METHODS) + 1 + (policy is not None))) as bar:

        def each(function, *columns):
            out = []
            for row in zip(*columns):
                out.append(function(*row))
                bar.advance(1)
            return out

        if policy is not None:
            motions = each(
                lambda number, task: record(config, library, policy, task, limits, -math.inf, number), numbers, tasks
            )
            rows[OURS] = [_simulated(scene, motion, fps) for scene, motion in zip(scenes, motions)]
        for name, method in METHODS.items():
            make = partial(method, machine.states, fps=fps, placement=placement)
            try:
                made = each(make, tasks)
            except InputError as error:  # of the method, not of a task: it says so at the first one
                bar.advance(2 * len(tasks))
                skipped.append({"method": name, "reason": str(error)})
                continue
            rows[name] = [_kinematic(scene, qpos, fps) for scene, qpos in zip(scenes, made)]
        rows[CLIPS] = each(lambda scene: _clip_alone(scene, fps), scenes)
        for name, items in rows.items():
            scores[name] = each(lambda item: score(item, judge), items)
    reached = np.array([motion.end == REACHED for motion in motions], dtype=bool)
    every = np.ones(len(tasks), dtype=bool)
    compared = reached if reached.any() else every
    content = {
        "tasks": len(tasks),
        "compared": int(compared.sum()),
        "fps": fps,
        "clips": [state.name for state in machine.states],
        "thresholds": policy and [limits.root_position, limits.key_bodies, limits.joint_rotation],
        "methods": [
            {
                "method": name,
                "label": _LABELS[name],
                "reached_share": float(reached.mean()) if name == OURS else None,
                "duration": float(np.mean([item.duration for item, take in zip(rows[name], compared) if take])),
                "metrics": _summary(scores[name], compared),
                "metrics_all": _summary(scores[name], every),
            }
            for name in rows
        ],
        "units": {name: unit for name, (unit, _) in METRICS.items()},
        "descriptions": {name: line for name, (_, line) in METRICS.items()},
        "about": {name: _DESCRIPTIONS[name] for name in rows},
        "skipped": skipped,
        "differentiation": _physics_rate(config.physics, judge, motions, fps),
    }
    folder = Path(folder)
    replace_file(folder / "baselines.json", (json.dumps(content, indent=2, allow_nan=False) + "\n").encode())
    replace_file(folder / "baselines.md", markdown(content).encode())
    return content


class _Silent(contextlib.nullcontext):
    """Shows no progress."""

    def __enter__(self):
        return self

    def advance(self, count):
        """So many are done."""


def _tasks(library, config, max_tasks):
    """(numbers (M,) in the grid, tasks (M, 4)): at most max_tasks of those of the evaluation."""
    grid = TaskGrid(library, config)
    numbers = grid.numbers(0, len(grid))
    if not len(numbers):
        raise InputError("evaluation: the grid holds no task; widen a cancel range or motions.rotation")
    if max_tasks < 1:
        raise InputError(f"report.tasks: is {max_tasks}; give at least 1 task to compare on")
    if max_tasks < len(numbers):
        chosen = np.random.Generator(np.random.Philox(key=1)).permutation(len(numbers))[:max_tasks]
        numbers = numbers[np.sort(chosen)]
    return numbers, grid.tasks(numbers)


def _simulated(scene, motion, fps):
    """`Shown` of a recorded episode: it ends where the target clip's start frame is to be, if it reaches it."""
    return shown(scene, motion.qpos, fps, 0.0 if motion.end == REACHED else None)


def _kinematic(scene, qpos, fps):
    """`Shown` of what a kinematic method made: the target clip plays from its start point while it is blended in."""
    return shown(scene, qpos, fps, (len(qpos) - 1) / fps)


def _clip_alone(scene, fps):
    """`Shown` of a piece of the source clip itself; if it does not loop, the piece ends at the clip's end at latest."""
    first = 0.0
    if not scene.source.clip.looping:
        first = max(-scene.moment, min(0.0, scene.source.clip.duration - scene.moment - PIECE))
    poses = scene.source_poses(first + np.arange(round(PIECE * fps) + 1) / fps)
    return shown(scene, poses, fps)


def _summary(scores, take):
    """{metric: {mean, median, p95}} of the tasks `take` (M,) bool; None where no task has the metric."""
    out = {}
    for name in METRICS:
        values = np.array([row[name] for row, chosen in zip(scores, take) if chosen])
        values = values[np.isfinite(values)]
        numbers = (np.mean(values), np.median(values), np.percentile(values, 95)) if len(values) else (None,) * 3
        out[name] = dict(zip(("mean", "median", "p95"), (v if v is None else float(v) for v in numbers)))
    return out


def _physics_rate(physics, judge, motions, fps):
    """What differentiation at the frame rate does to the residual force of the policy's own motion, or None without.

    Mean body weights over the first CHECKED reached tasks of at least four frames: at the frame rate as in the table,
    at the physics' rate by the same code, and there by MuJoCo's own contact forces (`model_residual`): zero, as it is
    the simulation's own equation.
    """
    motions = [motion for motion in motions if motion.end == REACHED and len(motion.qpos) > 3][:CHECKED]
    if not motions:
        return None
    rate, values = 1 / physics.timestep, []
    for motion in motions:
        qpos, qvel = physics_steps(physics, motion.qpos[0], motion.qvel[0], motion.pd_target)
        own = model_residual(physics, qpos[:-1], qvel[:-1], np.diff(qvel, axis=0) * rate)
        frames, steps = (judge.judge(*args).relative_force.mean() for args in ((motion.qpos, fps), (qpos, rate)))
        values.append((frames, steps, np.linalg.norm(own[:, :3], axis=1).mean() / judge.weight))
    names = ("frame_rate", "physics_rate", "model")
    return {"tasks": len(motions), **dict(zip(names, map(float, np.mean(values, axis=0))))}


def markdown(content):
    """The text of baselines.md: a table of means, and what stands behind it."""
    names = [f"{name.replace('_', ' ')}{f' ({unit})' if unit else ''}" for name, unit in content["units"].items()]
    limits = content["thresholds"]
    which = "." if limits is None else f": those that the policy reached at the thresholds {_list(limits)}."
    lines = [
        f"# {content['compared']} of {content['tasks']} tasks, {', '.join(content['clips'])}",
        "",
        "Means over the compared tasks, the same for every row" + which,
        "",
        "| method | reached | s | " + " | ".join(names) + " |",
        "|---|--:|--:|" + "--:|" * len(names),
    ]
    for row in content["methods"]:
        share = "–" if row["reached_share"] is None else f"{row['reached_share']:.0%}"
        cells = [_cell(row["metrics"][name]["mean"]) for name in METRICS]
        lines.append(f"| {row['label']} | {share} | {row['duration']:.2f} | " + " | ".join(cells) + " |")
    lines += ["", *(f"* **{_LABELS[name]}**: {text}" for name, text in content["about"].items())]
    lines += ["", *(f"* {name}: {text}" for name, text in zip(names, content["descriptions"].values()))]
    lines += ["", *(f"Left out: {row['method']}: {row['reason']}" for row in content["skipped"])]
    check = content["differentiation"]
    if check:
        lines.append(
            f"The policy's own motion ({check['tasks']} tasks) leaves {check['frame_rate']:.2g} body weights at "
            f"{content['fps']:g} frames per second, {check['physics_rate']:.2g} at the physics' rate, and "
            f"{check['model']:.1g} with the simulation's own contact forces."
        )
    return "\n".join(lines).rstrip() + "\n"


def _cell(value):
    if value is None:
        return "–"
    return "0" if abs(value) < 5e-5 else f"{value:.3g}"


def _list(values):
    return ", ".join(f"{value:.3g}" for value in values)


class _Bar(Bar):
    """Progress of a comparison."""

    def line(self):
        return super().line().replace("evaluating", "comparing", 1).replace(" tasks", " transitions", 1)


def parse(arguments):
    """(folder to write to, `Config`, whether it is a run's folder) of the command line's arguments."""
    places = [argument for argument in arguments if "=" not in argument]
    rest = [argument for argument in arguments if "=" in argument]
    if len(places) > 1:
        raise InputError(f"command line: {places[0]} and {places[1]} are two folders; give one")
    if not places:
        config = settings.build([settings.command_line(rest)])
        if config.out is None:
            raise InputError("command line: gives no folder; give a run's folder, or out=FOLDER for the clips alone")
        return Path(config.out), None, config
    folder = Path(places[0])
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    run = _run_of(folder)
    return folder, run, settings.load(run / "config.yaml", ["device=cpu", *rest])


def _run_of(folder):
    """The run in a folder: itself, or of a sweep's the first one of the row ours, else the first one."""
    if (folder / "config.yaml").is_file():
        return folder
    runs = sorted(path.parent for path in folder.glob("*/config.yaml") if (path.parent / "checkpoints").is_dir())
    if not runs:
        raise InputError(f"{folder}: holds no run; give the folder of a run or of a sweep, or motions=NAME out=FOLDER")
    return next((run for run in runs if run.name.startswith("ours-")), runs[0])


def main(arguments):
    """Command line; see the module's docstring."""
    folder, run, config = parse(arguments)
    policy = limits = None
    if run is not None:
        policy, tightenings = load_policy(run, config)
        limits = thresholds(config.curriculum, config.reach, tightenings)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror}); give another folder") from error
    content = compare(folder, config, policy, limits, config.report.tasks, _Bar)
    print((folder / "baselines.md").read_text(encoding="utf-8"), end="")
    for row in content["skipped"]:
        print(f"left out: {row['method']}: {row['reason']}")
    print(f"written: {folder / 'baselines.json'}, {folder / 'baselines.md'}")
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main, __doc__, sys.argv[1:]))
