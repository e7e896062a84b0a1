"""Evaluate a trained policy on the grid of tasks: the 13 metrics of Table 1 (section 6), and where it fails.

usage: python -m orchestrator.evaluate RUN_OR_POLICY [--config FILE] [--motions FILE] [key=value ...]
       python -m orchestrator.evaluate RUN_OR_POLICY --replay N [--final] [--deterministic] [--save FILE.npz]

  python -m orchestrator.evaluate runs/ablation/ours-seed0
  python -m orchestrator.evaluate runs/ablation/ours-seed0 evaluation.max_tasks=0       the whole grid
  python -m orchestrator.evaluate runs/ablation/ours-seed0/checkpoints/00000480.pt      another than the newest
  python -m orchestrator.evaluate builtin                                               a policy that comes with Segue
  python -m orchestrator.evaluate nine --motions mine.yaml motions.dir=FOLDER           on clips that it does not know
  python -m orchestrator.evaluate runs/ablation/ours-seed0 --replay 1234                a task of failures.csv again

Of a run's folder the newest checkpoint is evaluated; evaluation.json, failures.csv and the finished shards
(evaluation/) go there. Of a checkpoint's file they go to a folder beside it, NAME-evaluation/; of a policy that comes
with Segue (`builtin`), to runs/NAME-evaluation/; with other clips to a folder on-MOTIONS/ in there. The same
command goes on where it was interrupted. Spread over Ray (runtime=ray; RAY_ADDRESS for a cluster) or in this process
(runtime=local): the numbers are the same.

--config FILE     the run's configuration; default: config.yaml of the run's folder, or what the checkpoint holds of it
--motions FILE    clips that it has not been trained with: a state machine's file or the name of one of configs/motions
--replay N        play the task of number N alone, at the thresholds reached in training and with the evaluation's noise
--final           --replay at the final accuracy
--deterministic   --replay without noise
--save FILE.npz   where --replay puts the motion
"""

import json
import math
import sys
from pathlib import Path

from learner.storage import replace_file
from motion.errors import InputError
from motion.state_machine import build_state_machine
from orchestrator import folder as run_folder
from orchestrator.console import catch_signals, run_command
from orchestrator.evaluation.bar import Bar
from orchestrator.evaluation.evaluator import levels
from orchestrator.evaluation.failures import ended
from orchestrator.evaluation.grid import FAILURES, KEPT, evaluate
from orchestrator.evaluation.pools import LocalPool, of_cluster, within_run
from orchestrator.evaluation.subject import load_file, load_newest
from orchestrator.saved import load_file as load_checkpoint
from orchestrator.settings import complete, load, shipped_policies
from orchestrator.tasks import TaskGrid
from workers.library import build_library

PATIENCE = 10.0  # seconds to wait for another evaluation in the same folder, which may be about to end
VALUED = ("--config", "--motions", "--replay", "--save")  # options that take a value
OPTIONS = (*VALUED, "--final", "--deterministic")
TITLES = {"metrics": "final accuracy", "trained": "as trained"}


def evaluate_run(folder, config, make_pool=within_run, show=None):
    """Evaluate the newest checkpoint of a run's folder; writes evaluation.json there and returns its content.

    make_pool, show: see `evaluation.grid.evaluate`; by default on the CPUs that the run was trained on, in silence.
    """
    return write_evaluation(Path(folder), config, load_newest(folder, config), make_pool, show)


def write_evaluation(out, config, subject, make_pool, show):
    """Evaluate a `Subject` into the folder `out`; returns evaluation.json's content."""
    (out / KEPT).mkdir(parents=True, exist_ok=True)
    with run_folder.exclusive(out / KEPT, PATIENCE):
        content = {
            "checkpoint": subject.name,
            "samples": subject.iteration * config.samples_per_iteration,
            "iterations": subject.iteration,
            **evaluate(config, subject, out, make_pool, show),
        }
        # last of all: whoever finds it knows that the evaluation is whole
        replace_file(out / "evaluation.json", (json.dumps(content, indent=2) + "\n").encode())
    return content


def main(arguments):
    """Command line; see the module's docstring."""
    where, options, overrides = parse(arguments)
    where, out = locate(where)
    config, elsewhere = configuration(where, options, ["device=cpu", *overrides]), "--motions" in options
    subject = (load_file if where.suffix == ".pt" else load_newest)(where, config, elsewhere)
    if elsewhere:  # beside what it does on its own clips
        out = out / f"on-{config.motions.name}"
    if "--replay" in options:
        return replay(config, subject, options)
    conclude(out, run(out, config, subject))
    return 0


def locate(where):
    """(folder or checkpoint, folder for the results) of a path or the name of a policy that comes with Segue."""
    if where.suffix == ".pt" and where.is_file():
        return where, where.with_name(f"{where.stem}-evaluation")
    if where.is_dir():
        return where, where
    shipped = shipped_policies()
    if str(where) in shipped:
        return shipped[str(where)], Path("runs", f"{where}-evaluation")
    what = "checkpoint" if where.suffix == ".pt" else "folder"
    raise InputError(f"{where}: no such {what}, nor a policy that comes with Segue ({', '.join(shipped)})")


def parse(arguments):
    """(path, {option: value}, key=value arguments) of the command line. InputError if it is wrong."""
    options, rest, waiting = {}, [], list(arguments)
    while waiting:
        argument = waiting.pop(0)
        name, equals, value = argument.partition("=")
        if not name.startswith("--"):
            rest.append(argument)
            continue
        if name not in OPTIONS:
            raise InputError(f"{name}: no such option; there are {', '.join(OPTIONS)}")
        if name in VALUED and not equals:
            if not waiting:
                raise InputError(f"{name}: needs a value")
            value = waiting.pop(0)
        options[name] = value
    if not rest or "=" in rest[0]:
        raise InputError("no run folder or checkpoint given; e.g. python -m orchestrator.evaluate runs/mine/ours-seed0")
    for name in ("--save", "--final", "--deterministic"):
        if name in options and "--replay" not in options:
            raise InputError(f"{name}: goes with --replay N")
    return Path(rest[0]), options, rest[1:]


def configuration(where, options, arguments):
    """The `Config` to evaluate a run's folder or a checkpoint with: of --config, of the run, or of the checkpoint.

    arguments: key=value, over it. InputError if there is none.
    """
    motions = options.get("--motions")
    if "--config" in options:
        return load(options["--config"], arguments, motions)
    of_file = where.suffix == ".pt"
    path = run_folder.config_path(where.absolute().parent.parent if of_file else where)
    if path.exists():
        return load(path, arguments, motions)
    content = load_checkpoint(where) if of_file else {"config": None}
    if not content["config"]:
        what = ", neither in it nor two levels above" if of_file else " there"
        raise InputError(f"{where}: no configuration{what}; give the run's config.yaml with --config FILE")
    # training's budget is not among the numbers of a checkpoint
    return complete({"budget.iterations": max(content["iteration"], 1), **content["config"]}, where, arguments, motions)


def run(out, config, subject):
    """Evaluate on Ray or in this process, with a bar."""
    if config.runtime == "local":
        return write_evaluation(out, config, subject, lambda *_: LocalPool(config, subject), Bar)
    from orchestrator import tuning

    tuning.prepare_environment()
    import ray

    from orchestrator import cluster

    cluster.connect(1)
    catch_signals()
    try:
        return write_evaluation(out, config, subject, of_cluster, Bar)
    finally:
        ray.shutdown()


def conclude(out, content):
    """Print the columns, where the policy fails, and what was written."""
    whole = content["grid"]["whole"]
    of = "" if whole == content["tasks"] else f" of the grid's {whole:,}"
    print(f"{content['tasks']:,} tasks{of}, checkpoint {content['checkpoint']}, {content['samples']:,} samples")
    lines = [["", "noise", *content["metrics"]]]
    for level, title in TITLES.items():
        limits = "/".join(f"{value:.3g}" for value in content[f"{level}_thresholds"])
        without = "deterministic" if level == "metrics" else "trained_deterministic"
        for name, noise in ((level, f"exp({content['log_sigma']:g})"), (without, "none")):
            values = ("x" if value is None else f"{value:.4g}" for value in content[name].values())
            lines.append([f"{title} {limits}", noise, *values])
    widths = [max(map(len, column)) for column in zip(*lines)]
    for first, *rest in lines:
        print("  ".join([first.ljust(widths[0]), *(v.rjust(w) for v, w in zip(rest, widths[1:]))]))
    rungs = content["by_accuracy"]
    shares = (f"{rung['reached'] / content['tasks']:.1%} after {rung['tightenings']}" for rung in rungs[::5])
    print(f"reached: {', '.join(shares)} of {rungs[-1]['tightenings']} cuts of the thresholds")
    worst = sorted((g for g in content["groups"] if g["tasks"]), key=lambda g: g["reached_trained"] / g["tasks"])[:3]
    names = content["states"]
    print("worst:   " + ", ".join(
        f"{names[g['source']]} to {names[g['target']]} {g['reached_trained'] / g['tasks']:.1%}" for g in worst
    ) + " reached (thresholds as trained)")  # fmt: skip
    print(f"written: {out / 'evaluation.json'}")
    print(f"         {out / FAILURES}  (one again: python -m orchestrator.evaluate ... --replay TASK)")


def replay(config, subject, options):
    """Play one task again and print it; returns the exit status."""
    from orchestrator.evaluation.replay import record, save

    machine = build_state_machine(config.motions)
    library = build_library(machine)
    grid = TaskGrid(library, config.evaluation)
    try:
        number = int(options["--replay"])
    except ValueError:
        number = -1
    if not 0 <= number < grid.whole:
        raise InputError(f"--replay {options['--replay']}: no task; numbers go from 0 to {grid.whole - 1}")
    task = grid.tasks([number])[0]
    limits = levels(config, subject.tightenings)["metrics" if "--final" in options else "trained"]
    log_sigma = -math.inf if "--deterministic" in options else config.evaluation.log_sigma
    motion = record(config, library, subject.policy, task, limits, log_sigma, number)
    names = [state.name for state in machine.states]
    source, target = names[int(task[0])], names[int(task[2])]
    print(f"task {number}: {source} at {task[1]:.3f} s to {target}, turned by {task[3]:.4f} rad")
    print(f"thresholds {limits.root_position:.3g} m, {limits.key_bodies:.3g} m, {limits.joint_rotation:.3g} rad")
    print("step  d^rp (m)  d^kp (m)  d^q (rad)")
    for step, deviations in enumerate(motion.deviations):
        print(f"{step:>4}  {deviations[0]:8.4f}  {deviations[3]:8.4f}  {deviations[4]:9.4f}")
    how, body = ended(motion.end, motion.fell_on)
    print(f"{how}{' on ' * bool(body)}{body} after {len(motion.pd_target)} steps")
    if "--save" in options:
        save(motion, options["--save"])
        print(f"written: {options['--save']}")
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main, __doc__, sys.argv[1:]))
