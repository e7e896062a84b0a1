"""How much of the machine's physics a run turns into training: everything measured side by side, in one run.

    python -m benchmarks.throughput [--json] [--rounds 3] [key=value ...]

Prints samples/s (policy steps of one environment) of physics alone, of rollouts (environment + policy), and end to end
(PPO + SBC included) at scale=laptop, as ratios, with the memory of all processes. Rounds alternate between the parts,
so that a neighbour on a shared machine slows all of them; medians are compared.
"""

import argparse
import json
import os
import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import ray
from mujoco.batch import Batch

from benchmarks import processes
from learner.state import LearnerState
from motion.state_machine import build_state_machine
from orchestrator import settings
from orchestrator.curriculum import thresholds
from orchestrator.run import train
from workers.humanoid import build_model
from workers.library import build_library
from workers.rollout import Rollout


def build_config(overrides, **changes):
    """The laptop's configuration, on the built-in clips unless overridden."""
    layers = [settings.Layer({"tracking.enabled": False}, "benchmark"), settings.command_line(overrides)]
    return replace(settings.build(layers), **changes)


def rollout_parts(config):
    """(one chunk by `collect` on one thread, the same physics alone on n threads), as callables.

    Physics alone repeats the very steps of that chunk, from the recorded states before each: figures that are left to
    themselves would lie on the floor soon, where a step costs more.
    """
    library = build_library(build_state_machine(config.motions))
    rollout = Rollout(config, library, config.num_envs, config.horizon, config.seed, threads=1)
    policy = LearnerState(config, config.seed).snapshot()
    limits = thresholds(config.curriculum, config.reach, 0)
    # past the synchronised start, so that episodes end throughout
    state = rollout.initial_state(0)
    for _ in range(4):
        _, state = rollout.collect(state, policy, limits)

    def collect():
        rollout.collect(state, policy, limits)

    recorded = record_states(rollout, collect)

    def physics(threads):
        batch = Batch(build_model(config.physics), config.num_envs, threads)

        def step():
            for before in recorded:
                batch.state[:] = before
                batch.step(nstep=config.physics.substeps)

        step()
        return step

    return collect, physics


def record_states(rollout, collect):
    """MuJoCo's states (controls included) before each of the steps that `collect` does."""
    batch, recorded = rollout._environment._batch, []
    original = batch.step

    def step(*arguments, **options):
        recorded.append(batch.state.copy())
        original(*arguments, **options)

    batch.step = step
    collect()
    del batch.step
    return recorded


def seconds(call):
    """Wall time of one call."""
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def training_rate(config, iterations=10, measure_memory=False):
    """(samples/s of a run by its median iteration, peak memory in MB of this process and its descendants, or 0)."""
    config = replace(config, budget=replace(config.budget, samples=None, iterations=iterations + 2))
    times, memory = [], [0.0]
    with tempfile.TemporaryDirectory() as folder:

        def note(metrics):
            times.append(time.perf_counter())
            if measure_memory:  # walks /proc, which takes a while
                memory.append(processes.memory(processes.tree(os.getpid())))

        train(config, Path(folder), note)
    time.sleep(2.0)  # actors that end would share the cores with what is measured next
    # the first iteration compiles and fills the pipeline, the last one has nothing to overlap with
    iteration = statistics.median(b - a for a, b in zip(times[:-2], times[1:-1]))
    return config.samples_per_iteration / iteration, max(memory)


def main():
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one last line with every figure")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("overrides", nargs="*", help="configuration, key=value")
    options = parser.parse_args()
    config = build_config(options.overrides)
    cores = os.cpu_count()
    ray.init(num_cpus=max(cores, 2), include_dashboard=False, log_to_driver=False, object_store_memory=400 * 2**20)

    collect, physics = rollout_parts(config)
    one, every = physics(1), physics(cores)
    samples = config.samples_per_iteration
    names = ("physics_one", "physics_all", "rollout_one", "train_ray", "serial_ray", "serial_local")
    rates = {name: [] for name in names}
    for _ in range(options.rounds):
        for _ in range(3):
            rates["physics_one"].append(samples / seconds(one))
            rates["rollout_one"].append(samples / seconds(collect))
            rates["physics_all"].append(samples / seconds(every))
        rates["train_ray"].append(training_rate(replace(config, runtime="ray", pipeline_depth=1))[0])
        # as many threads as `local` has: what differs is Ray
        rates["serial_ray"].append(training_rate(replace(config, runtime="ray", pipeline_depth=0, spare_threads=0))[0])
        rates["serial_local"].append(training_rate(replace(config, runtime="local", pipeline_depth=0))[0])
    memory = training_rate(replace(config, runtime="ray", num_envs=512), iterations=3, measure_memory=True)[1]
    rate = {name: statistics.median(values) for name, values in rates.items()}
    figures = {
        **{f"{name}_samples_per_second": round(value) for name, value in rate.items()},
        "rollout_over_physics": rate["rollout_one"] / rate["physics_one"],
        "end_to_end_over_physics": rate["train_ray"] / rate["physics_all"],
        "ray_overhead": rate["serial_local"] / rate["serial_ray"] - 1,
        "memory_512_mb": memory,
        "cores": cores,
        "rounds": options.rounds,
    }
    print(f"physics only, 1 thread      {rate['physics_one']:8.0f} samples/s")
    print(f"rollout, 1 thread           {rate['rollout_one']:8.0f}   {figures['rollout_over_physics']:.2f} of it")
    print(f"physics only, {cores} threads     {rate['physics_all']:8.0f} samples/s")
    print(f"end to end, runtime=ray     {rate['train_ray']:8.0f}   {figures['end_to_end_over_physics']:.2f} of it")
    print(f"in turns, runtime=local     {rate['serial_local']:8.0f} samples/s (pipeline_depth=0)")
    print(f"in turns, runtime=ray       {rate['serial_ray']:8.0f}   {figures['ray_overhead']:+.1%} time")
    print(f"memory at 512 environments  {memory:8.0f} MB, all processes")
    if options.json:
        print(json.dumps(figures))


if __name__ == "__main__":
    main()
