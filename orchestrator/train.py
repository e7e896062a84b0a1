"""Train and evaluate one run.

usage: python -m orchestrator.train [key=value ...]

  python -m orchestrator.train scale=demo                       the built-in clips on two cores
  python -m orchestrator.train sbc.enabled=false row=no_sbc seed=3 out=runs/mine
  python -m orchestrator.train runtime=local scale=smoke        everything in this process, for debugging

The same command continues a run that was interrupted; so does resume=FOLDER, with the configuration in that folder.
out= is the run's folder, default runs/train/ROW-seedK. MLflow and Ray as for a sweep (python -m orchestrator.sweep
--help). All keys: python -m orchestrator.settings
"""

import sys
import threading
from pathlib import Path

from motion.errors import InputError
from motion.state_machine import build_state_machine
from orchestrator import folder as run_folder
from orchestrator import mlflow_store, start
from orchestrator.console import catch_signals, run_command, stopping
from orchestrator.plan import Run, run_name
from orchestrator.progress import DONE, EVALUATING, FAILED, RUNNING, Progress, Row, clips, parts, samples
from orchestrator.settings import Layer, build, command_line, load
from orchestrator.sweep import with_device
from orchestrator.table import COLUMNS, cell
from orchestrator.tracking import Tracking

EXPERIMENT = "train"
RESUME = "resume="


def main(arguments):
    """Command line; returns the exit status, 0 only if the run finished."""
    config, folder = resumed(arguments) if any(map(is_resume, arguments)) else configured(arguments)
    build_state_machine(config.motions)
    run_folder.check_writable(folder)
    run = Run(config, folder)
    state = run_folder.state_of(folder, config)
    if state == run_folder.NEW:
        start.check(config)
    announce(run, state)
    if state != run_folder.FINISHED and not train_run(run):
        return 1
    conclude(run)
    return 0


def configured(arguments):
    """(configuration, folder) of a new run, or of one that the same command began."""
    command = command_line(arguments)
    config = build([command])
    folder = Path(config.out or Path("runs", "train", run_name(config.row, config.seed))).absolute()
    return build([command, Layer({"out": str(folder)}, "default")]), folder


def is_resume(argument):
    """Whether an argument is resume=FOLDER."""
    return argument.startswith(RESUME)


def resumed(arguments):
    """(configuration, folder) of the run in the folder that resume= names; other arguments lie over it."""
    folder = Path(next(filter(is_resume, arguments)).removeprefix(RESUME)).expanduser().absolute()
    path = run_folder.config_path(folder)
    if not path.exists():
        raise InputError(f"{RESUME}{folder}: holds no config.yaml; give the folder of a run, e.g. runs/NAME/ours-seed0")
    return load(path, [argument for argument in arguments if not is_resume(argument)]), folder


def announce(run, state):
    """Say what will run, on what, and where it goes."""
    config = run.config
    print(f"{run.name}: scale {config.scale}; " + "\n".join(clips(config)))
    total = config.total_iterations * config.samples_per_iteration
    print(
        f"  {samples(total)} samples: {config.total_iterations} iterations of "
        f"{config.num_envs} simulations x {config.horizon} steps"
    )
    print(f"  {parts(config)}")
    print(f"  folder {run.folder} ({state})")
    if config.tracking.enabled:
        print(f"  MLflow {mlflow_store.without_password(mlflow_store.address(config))}")
    sys.stdout.flush()


def train_run(run):
    """Train and evaluate an unfinished run; whether it finished."""
    from orchestrator.trial import Throttle, execute, reason

    run = place(run)
    run_folder.prepare(run.folder, run.config)
    config = run.config
    uri = mlflow_store.address(config) if config.tracking.enabled else None
    row = Row(run.name, config.total_iterations, config.samples_per_iteration, run_folder.iterations_done(run.folder))
    asked = threading.Event()
    with Progress([row]) as progress:

        def show(message):
            if "phase" in message:
                progress.state(run.name, EVALUATING)
            else:
                progress.update(run.name, message)

        progress.state(run.name, RUNNING)
        try:
            with stopping(asked.set):
                execute(
                    config, run.folder, Tracking(uri, EXPERIMENT), Throttle(show, 0.2), progress.say, stop=asked.is_set
                )
        except Exception as error:
            progress.state(run.name, FAILED, f"{reason(error)} (all of it: {run.folder / 'error.txt'})")
            return False
        progress.state(run.name, DONE)
    return True


def place(run):
    """The run with its device decided; with runtime=ray the cluster is connected and has room for it."""
    if run.config.runtime == "local":
        return with_device(run)
    from orchestrator import tuning

    tuning.prepare_environment()
    from orchestrator import cluster

    cluster.connect(run.config.samples_per_iteration)
    catch_signals()
    run = with_device(run)
    cluster.check_placeable(run.config, cluster.alive_nodes())
    return run


def conclude(run):
    """Print the run's metrics and where everything is."""
    import json

    evaluation = json.loads(run_folder.evaluation_path(run.folder).read_text())
    for title, part in (("at the final accuracy", "metrics"), ("at the thresholds that training reached", "trained")):
        print(f"{title}: " + "  ".join(f"{column} {cell(column, evaluation[part][column])}" for column in COLUMNS))
    print(f"written: {run.folder}")
    if run.config.tracking.enabled:
        print(f"MLflow:  {mlflow_store.ui_hint(mlflow_store.address(run.config))}")


if __name__ == "__main__":
    sys.exit(run_command(main, __doc__, sys.argv[1:]))
