"""Train and evaluate the rows of a table, then print it beside the paper's and make a report.

usage: python -m orchestrator.sweep SWEEP.yaml [key=value ...]

  python -m orchestrator.sweep sweeps/ablation.yaml                          the four rows, scale=laptop, built-in clips
  python -m orchestrator.sweep sweeps/ablation.yaml scale=demo               the same in 10 minutes on 2 cores
  python -m orchestrator.sweep sweeps/ablation.yaml rows=[ours,no_sbc] seeds=[0,1,2]
  python -m orchestrator.sweep sweeps/ablation.yaml motions=reallusion motions.dir=CLIPS out=runs/mine
  python -m orchestrator.sweep sweeps/ablation.yaml budget.samples=1e7 num_workers=4

The same command continues a sweep that was interrupted. Folder: out=, default runs/NAME. Runs go to MLflow: to
MLFLOW_TRACKING_URI or tracking.uri=, else to mlflow.db here. With RAY_ADDRESS set (as in `ray job submit`) it runs on
that cluster, and out= must be on storage that all machines share. All keys: python -m orchestrator.settings
"""

import sys
from dataclasses import replace

from motion.errors import InputError
from motion.state_machine import build_state_machine
from orchestrator import folder as run_folder
from orchestrator import mlflow_store, report, start, table
from orchestrator.console import catch_signals, run_command
from orchestrator.plan import read_plan
from orchestrator.progress import DONE, Progress, Row, clips, parts, samples
from orchestrator.settings import command_line, load
from orchestrator.tracking import Tracking, commit_tag

MLFLOW_PATIENCE = 20.0  # seconds to wait for MLflow's first answer; making a new SQLite file takes about 5


def main(arguments):
    """Command line; returns the exit status, 0 only if every run finished."""
    if not arguments or "=" in arguments[0]:
        raise InputError("no sweep file given; e.g. python -m orchestrator.sweep sweeps/ablation.yaml")
    plan = read_plan(arguments[0], command_line(arguments[1:]))
    run_folder.check_writable(plan.out)
    with run_folder.exclusive(plan.out):
        states = check(plan)
        announce(plan, states)
        failures = {}
        parent = None
        if any(state != run_folder.FINISHED for state in states.values()):
            tracking = tracking_of(plan)
            parent = tracking.start(tracking.parent, lambda line: print(line, file=sys.stderr))
            try:
                failures = run_all(plan, states, tracking, parent)
            except BaseException as error:
                parent.finish("FAILED" if isinstance(error, Exception) else "KILLED", timeout=3.0)
                raise
        content = table.collect(plan.runs, failures)
        paths = table.write(plan.out, content)
        status = "FAILED" if failures else "FINISHED"
        try:
            paths += make_report(plan, again=parent is not None)
        except KeyboardInterrupt:
            if parent:
                parent.finish(status, files=paths, timeout=3.0)
            raise
        if parent and not parent.finish(status, files=paths):
            print(f"MLflow lacks some of it; to ship that: python -m orchestrator.tracking sync {plan.out}")
    conclude(plan, content, paths)
    for name, why in failures.items():
        print(f"failed:  {name}: {why} (all of it: {plan.out / name / 'error.txt'})", file=sys.stderr)
    return 1 if failures else 0


def check(plan):
    """State of every run's folder by run name, after all checks that need no cluster. InputError if one fails."""
    checked = []
    for run in plan.runs:
        if run.config.motions not in checked:
            build_state_machine(run.config.motions)
            checked.append(run.config.motions)
    states = {run.name: run_folder.state_of(run.folder, run.config) for run in plan.runs}
    for run in plan.runs:
        if states[run.name] == run_folder.NEW:
            start.check(run.config)
    return states


def announce(plan, states):
    """Say what will run, on what, and where it goes."""
    config = plan.runs[0].config
    total = config.total_iterations * config.samples_per_iteration
    seeds = ", ".join(map(str, plan.seeds))
    print(f"sweep {plan.name}: rows {', '.join(plan.rows)}; seed{'s' * (len(plan.seeds) > 1)} {seeds}")
    print(f"  scale {config.scale}; " + "\n".join(clips(config)))
    print(
        f"  per run {samples(total)} samples: {config.total_iterations} iterations of {config.num_envs} simulations x "
        f"{config.horizon} steps"
    )
    print(f"  {parts(config)}")
    print(f"  folder {plan.out}")
    if config.tracking.enabled:
        print(f"  MLflow {mlflow_store.without_password(mlflow_store.address(config))}")
    kept = [name for name, state in states.items() if state == run_folder.FINISHED]
    going_on = [
        f"{run.name} after iteration {done}"
        for run in plan.runs
        if states[run.name] == run_folder.UNFINISHED and (done := run_folder.iterations_done(run.folder))
    ]
    if kept:
        print(f"  finished before: {', '.join(kept)}")
    if going_on:
        print(f"  continues: {', '.join(going_on)}")
    sys.stdout.flush()


def tracking_of(plan):
    """Where and as what the sweep is logged."""
    config = plan.runs[0].config
    uri = mlflow_store.address(config) if config.tracking.enabled else None
    params = {"rows": ",".join(plan.rows), "seeds": ",".join(map(str, plan.seeds)), "scale": config.scale}
    spec = mlflow_store.RunSpec(plan.out, plan.name, {"scale": config.scale, **commit_tag()}, params)
    return Tracking(uri, plan.name, spec)


def run_all(plan, states, tracking, parent):
    """Run what is left on Ray Tune; returns {run name: reason} of the runs that failed."""
    from orchestrator import tuning

    tuning.prepare_environment()
    import ray

    from orchestrator import cluster

    cluster.connect(plan.runs[0].config.samples_per_iteration)
    catch_signals()
    try:
        nodes = cluster.alive_nodes()
        runs = [with_device(run) for run in plan.runs if states[run.name] != run_folder.FINISHED]
        for run in runs:
            cluster.check_placeable(run.config, nodes)
        concurrent = cluster.concurrent(runs[0].config, nodes)
        together, device = min(concurrent, len(runs)), runs[0].config.device
        print(f"Ray has {cluster.amount(nodes)}: {together} at a time; learner on {device}", flush=True)
        why = parent.wait_ready(MLFLOW_PATIENCE)
        if why and why.startswith("no answer"):
            print(f"MLflow: {why}; training goes on, metrics are kept in metrics.jsonl", file=sys.stderr)
        for run in runs:
            run_folder.prepare(run.folder, run.config)
        rows = [row_of(run, states) for run in plan.runs]
        with Progress(rows, concurrent) as progress:
            return tuning.tune_runs(plan.out, runs, tracking, progress)
    finally:
        ray.shutdown()


def with_device(run):
    """The run with device=auto decided: as its folder has it, else by what the cluster has."""
    from orchestrator import cluster

    path = run_folder.config_path(run.folder)
    if run.config.device == "auto" and path.exists():
        device = load(path).device
    else:
        device = cluster.resolve_device(run.config.device, run.config.runtime)
    return replace(run, config=replace(run.config, device=device))


def row_of(run, states):
    """A run's line of progress."""
    total = run.config.total_iterations
    if states[run.name] == run_folder.FINISHED:
        return Row(run.name, total, run.config.samples_per_iteration, total, DONE)
    return Row(run.name, total, run.config.samples_per_iteration, run_folder.iterations_done(run.folder))


def make_report(plan, again):
    """Make report.html where it is wanted and not there, or to be made `again`; paths of it and its data, [] without.

    Whatever goes wrong is one line: the runs are done and their results written.
    """
    config = plan.runs[0].config
    if not config.report.enabled or not again and (plan.out / report.NAME).exists():
        return []
    try:
        return report.make(plan.out, plan.runs, config, lambda line: print(f"report: {line}", flush=True))
    except Exception as error:
        why = f"{type(error).__name__}: {error}".splitlines()[0][:300]
        print(f"no report ({why}); to try again: python -m orchestrator.report {plan.out}", file=sys.stderr)
        return []


def conclude(plan, content, paths):
    """Print the table, what was made, and how to look at it."""
    config = plan.runs[0].config
    print()
    print(table.markdown(content))
    print("\n".join(f"written: {path}" for path in paths))
    print(f"runs:    {plan.out / '<row>-seed<k>'}  (config.yaml, metrics.jsonl, checkpoints, evaluation.json)")
    if config.tracking.enabled:
        print(f"MLflow:  {mlflow_store.ui_hint(mlflow_store.address(config))}")


if __name__ == "__main__":
    sys.exit(run_command(main, __doc__, sys.argv[1:]))
