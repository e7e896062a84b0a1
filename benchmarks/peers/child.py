"""One library's run, in a process and an interpreter of its own. Started by `python -m benchmarks.peers`."""

import argparse
import importlib
import json
import os
import signal
import sys
import time
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from benchmarks.peers import shadow
from benchmarks.peers.record import Writer, read
from benchmarks.peers.task import WARM_UP, Task, build_config, first_thresholds

MISSING = 3  # exit status: the library is not installed here
POLICIES = "policies"  # folder of the policies of a run whose log is not enough
ADAPTERS = {"sb3": "sb3", "rsl": "rsl_rl_ppo", "rllib": "rllib"}
PACKAGES = (
    "segue", "stable-baselines3", "rsl-rl-lib", "ray", "gymnasium", "torch", "numpy", "mujoco-core", "numba",
)  # fmt: skip


class Budget:
    """Whether a run has trained enough: on so many samples, for so many seconds after its warm-up."""

    def __init__(self, folder, samples, seconds):
        self._folder, self._samples, self._seconds = folder, samples, seconds

    def __call__(self):
        record = read(self._folder.glob("*.record"))
        if len(record.begins) <= WARM_UP:
            return False
        last = record.begins[-1]
        return record.at(last)[0] >= self._samples and last - record.begins[WARM_UP] >= self._seconds


@dataclass(frozen=True)
class MakeEnv:
    """Makes recorded environments, here or in another process. enough: ends the run from within, or None."""

    config: object
    folder: Path
    enough: object

    def __call__(self, num_envs, threads, autoreset_mode=None):
        from gymnasium.vector import AutoresetMode

        from benchmarks.peers.recorded_env import Recorded
        from workers.vector_env import TransitionVectorEnv

        mode = autoreset_mode or AutoresetMode.SAME_STEP
        env = TransitionVectorEnv(self.config, first_thresholds(self.config), num_envs, threads, autoreset_mode=mode)
        batch = num_envs * self.config.horizon
        return Recorded(env, self.folder / f"{os.getpid()}.record", batch, self.enough or (lambda: False))


def run_peer(name, config, folder, budget, env_runners, threads):
    """Train by one of `ADAPTERS` until the budget is used up."""
    from benchmarks.peers.recorded_env import Enough

    adapter = importlib.import_module(f"benchmarks.peers.{ADAPTERS[name]}")
    # RLlib's loop is in the adapter: it asks by itself
    inside = None if name == "rllib" else budget
    try:
        adapter.train(Task(config, MakeEnv(config, folder, inside), env_runners, threads), budget)
    except Enough:
        pass


def run_segue(arguments, folder, budget):
    """Train by Segue's own command line until the budget is used up, then interrupt it as a user would."""
    import ray

    from orchestrator import run, train
    from workers.types import REACHED

    writer, original = Writer(folder / "run.record"), run._Loop._finish

    def finish(loop, iteration, losses, summary, evidence, snapshot):
        original(loop, iteration, losses, summary, evidence, snapshot)
        if iteration == 1:
            writer.write(0, 0, 0, True, begun)
        at = time.monotonic()
        config = loop._config
        ended = reached = 0
        for outcomes in loop._runtime.value(evidence[3]):
            fresh = ~outcomes.retained
            ended, reached = ended + int(fresh.sum()), reached + int((fresh & (outcomes.end == REACHED)).sum())
        writer.write(config.samples_per_iteration, ended, reached, False, at)
        writer.write(0, 0, 0, True, at)
        if shadow.explores_otherwise(config):
            shadow.save(folder / POLICIES, iteration, loop._runtime.value(evidence[1]), config.observation)
        if not asked and budget():
            asked.append(True)  # a second signal would end the process at once
            os.kill(os.getpid(), signal.SIGINT)

    run._Loop._finish = finish
    asked, begun = [], time.monotonic()
    # a shell starts what it runs in the background with the signal ignored: the run would never end
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        train.main(arguments)
    except KeyboardInterrupt:
        ray.shutdown()


def versions():
    """Versions of the packages that matter, as far as they are installed."""
    found = {}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def main():
    """Run one library; exit status `MISSING` with one line on stderr if it is not installed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name", choices=[*ADAPTERS, "segue"])
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--samples", type=float, required=True)
    parser.add_argument("--seconds", type=float, required=True)
    parser.add_argument("--env-runners", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("overrides", nargs="*")
    options = parser.parse_intermixed_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    budget = Budget(options.folder, options.samples, options.seconds)
    try:
        if options.name in ADAPTERS:
            importlib.import_module("workers.vector_env")
            importlib.import_module(f"benchmarks.peers.{ADAPTERS[options.name]}")
        else:
            importlib.import_module("orchestrator.train")
    except ModuleNotFoundError as error:
        print(f"no module named {error.name!r}", file=sys.stderr)
        sys.exit(MISSING)
    (options.folder / "versions.json").write_text(json.dumps(versions()))
    if options.name == "segue":
        run_segue(options.overrides, options.folder, budget)
    else:
        config = build_config(options.overrides)
        run_peer(options.name, config, options.folder, budget, options.env_runners, options.threads)


if __name__ == "__main__":
    main()
