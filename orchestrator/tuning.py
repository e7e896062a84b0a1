"""A sweep's runs as trials of Ray Tune, which places them: as many at a time as the cluster holds."""

import logging
import os
import re
import shutil
from pathlib import Path

from orchestrator import folder as run_folder
from orchestrator.console import stopping
from orchestrator.progress import DONE, EVALUATING, FAILED, RUNNING, WAITING

FOLDER = ".tune"  # Ray Tune's own files, below the sweep's folder; nothing of ours is read from there

# What the terminal needs of an iteration's metrics
SHOWN = (
    "iteration",
    "return/mean",
    "achievement",
    "thresholds/root_position",
    "thresholds/key_bodies",
    "thresholds/joint_rotation",
    "thresholds/tightenings",
    "perf/samples_per_second",
)


def prepare_environment():
    """Make Ray and Tune quiet. To be called before they are imported and before their processes inherit this."""
    os.environ |= {
        "RAY_AIR_NEW_OUTPUT": "0",
        "RAY_CHDIR_TO_TRIAL_DIR": "0",
        "RAY_USAGE_STATS_ENABLED": "0",
        "TUNE_DISABLE_AUTO_CALLBACK_LOGGERS": "1",
        "TUNE_DISABLE_SIGINT_HANDLER": "1",
        "TUNE_PRINT_ALL_TRIAL_ERRORS": "0",
        "TUNE_WARN_INSUFFICENT_RESOURCE_THRESHOLD_S": "86400",  # checked before; queued rows wait as long as it takes
    }


def tune_runs(out, runs, tracking, progress):
    """Run `plan.Run`s, whose folders are prepared, and show their `Progress`; returns {run name: reason} of failures.

    out: the sweep's folder. tracking: `trial.Tracking`. Bundles are those of the first run: rows differ in no size.
    """
    from ray import tune

    from orchestrator import cluster
    from orchestrator.trial import trainable

    logging.getLogger("ray.tune").setLevel(logging.CRITICAL)
    shutil.rmtree(out / FOLDER, ignore_errors=True)
    for run in runs:
        run_folder.stop_path(run.folder).unlink(missing_ok=True)
    watch = make_watch(tune.Callback, progress, [run.folder for run in runs])
    jobs = [{"name": run.name, "folder": str(run.folder)} for run in runs]
    # Tune writes its param_space to disk, but not parameters: an address may hold a password
    function = tune.with_parameters(trainable, tracking=tracking)
    tuner = tune.Tuner(
        tune.with_resources(function, tune.PlacementGroupFactory([{}, *cluster.bundles(runs[0].config)])),
        param_space={"job": tune.grid_search(jobs)},
        tune_config=tune.TuneConfig(trial_name_creator=name_of, trial_dirname_creator=name_of),
        run_config=tune.RunConfig(
            name=FOLDER, storage_path=str(out), verbose=0, callbacks=[watch],
            # of trials whose process died: those that fail otherwise say so and end as if they had finished
            failure_config=tune.FailureConfig(max_failures=runs[0].config.faults.restarts),
        ),
    )
    with stopping(watch.stop):
        tuner.fit()
    if watch.stopping:
        raise KeyboardInterrupt
    for run in runs:
        if run.name not in watch.failures and not run_folder.evaluation_path(run.folder).exists():
            watch.failures[run.name] = "ended without an evaluation"
    return watch.failures


def name_of(trial):
    """The run's name of a Tune trial."""
    return trial.config["job"]["name"]


def make_watch(base, progress, folders):
    """A Tune callback (a subclass of `base`) that passes on to `progress` what trials report, and keeps failures.

    folders: of all runs, for `stop()`, which asks those that run to write a checkpoint and end.
    """

    class Watch(base):
        def __init__(self):
            self.failures, self._reported, self._running, self.stopping = {}, {}, set(), False

        def __reduce__(self):
            return base, ()  # Tune stores its callbacks on disk; this one is of no use there

        def stop(self):
            self.stopping = True
            for folder in folders:
                run_folder.stop_path(folder).touch()

        def on_trial_start(self, iteration, trials, trial, **info):
            self._running.add(name_of(trial))
            progress.state(name_of(trial), RUNNING)

        def on_trial_result(self, iteration, trials, trial, result, **info):
            name = name_of(trial)
            if "failure" in result:
                self._reported[name] = result["failure"]
            elif "notice" in result:
                progress.say(f"{name}: {result['notice']}")
            elif "phase" in result:
                progress.state(name, EVALUATING)
            elif "iteration" in result:
                progress.update(name, {key: result.get(key) for key in SHOWN})

        def on_trial_complete(self, iteration, trials, trial, **info):
            name = name_of(trial)
            if name in self._reported:
                self._fail(trial)
            elif not self.stopping:
                progress.state(name, DONE)
            self._left(trial)

        def on_trial_recover(self, iteration, trials, trial, **info):
            progress.say(f"{name_of(trial)}: its process died; goes on from its newest checkpoint when there is room")
            progress.state(name_of(trial), WAITING)
            self._left(trial)

        def on_trial_error(self, iteration, trials, trial, **info):
            self._fail(trial)
            self._left(trial)

        def _fail(self, trial):
            name = name_of(trial)
            self.failures[name] = self._reported.get(name) or unreported(trial)
            progress.state(name, FAILED, self.failures[name])

        def _left(self, trial):
            self._running.discard(name_of(trial))
            if self.stopping and not self._running:
                raise KeyboardInterrupt  # before the next row starts

    return Watch()


def unreported(trial):
    """Why a trial ended that could not say so itself, its process having died. Keeps Ray's words in error.txt."""
    text = Path(trial.error_file).read_text() if trial.error_file else ""
    (Path(trial.config["job"]["folder"]) / "error.txt").write_text(text)
    errors = re.findall(r"^\w+(?:Error|Exception): .+$", text, re.MULTILINE)
    return errors[-1][:300] if errors else "its process died"
