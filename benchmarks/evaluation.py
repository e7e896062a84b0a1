"""How much of the machine's physics an evaluation turns into episodes: both measured side by side, in one run.

    python -m benchmarks.evaluation [--json] [--rounds 5] [--tasks 1024] [--run FOLDER] [key=value ...]

Prints policy steps/s of physics alone and of an evaluation (episodes, policy, noise, two accuracies, statistics), in
one process and over Ray workers, one per core, and how long the paper's 460,278 tasks at 12 steps each take at that
rate. Physics alone repeats the very steps of the evaluation's episodes, from the recorded states before each. Rounds
alternate between the two, so that a neighbour on a shared machine slows both; medians are compared. In one process CPU
seconds are compared, which a neighbour changes less.
"""

import argparse
import json
import os
import statistics
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import ray
from mujoco.batch import Batch

from benchmarks.throughput import build_config, seconds
from learner.state import LearnerState
from motion.state_machine import build_state_machine
from orchestrator import settings
from orchestrator.cluster import start_here
from orchestrator.evaluation.episodes import Ladder
from orchestrator.evaluation.evaluator import LEVELS, Evaluator
from orchestrator.evaluation.pools import RayPool
from orchestrator.evaluation.statistics import sums
from orchestrator.evaluation.subject import Subject, load_newest
from orchestrator.tasks import TaskGrid
from workers.humanoid import build_model
from workers.library import build_library

PAPER_STEPS = 460_278 * 12


class Timed(Evaluator):
    """One pass with noise over a block of tasks, judged at both accuracies: what the evaluation does most of all."""

    def measure(self, numbers):
        """(policy steps, CPU seconds)."""
        begun = time.process_time()
        ladder = Ladder(self._rungs, len(numbers))
        outcomes = self._simulator.run(
            self._grid.tasks(numbers), numbers, [self._levels[name] for name in LEVELS], self._log_sigma, ladder
        )
        self._breakdown.count(outcomes[1], outcomes[0], ladder.met, len(self._rungs))
        total = sums(outcomes[1])
        return int(total[-3]), time.process_time() - begun


def record_steps(evaluator, numbers):
    """[(rows, their states)] before every step of an evaluation, controls included."""
    evaluator.measure(numbers)
    batch, recorded = evaluator._simulator._env._batch, []
    original = batch.step

    def step(ids, nstep):
        recorded.append((ids.copy(), batch.state[ids].copy()))
        original(ids, nstep=nstep)

    batch.step = step
    evaluator.measure(numbers)
    del batch.step
    return recorded


def physics_alone(config, recorded, threads):
    """A function that does the recorded steps' physics and nothing else."""
    batch = Batch(build_model(config.physics), config.evaluation.num_envs, threads)

    def run():
        for ids, states in recorded:
            batch.state[ids] = states
            batch.step(ids, nstep=config.physics.substeps)

    run()
    return run


def over_ray(config, subject, blocks):
    """A function giving the policy steps/s of one evaluation over as many actors as there are blocks."""
    start_here(num_cpus=len(blocks), include_dashboard=False, log_to_driver=False, object_store_memory=200 * 2**20)
    pool = RayPool(config, subject, [1] * len(blocks), Timed)

    def run():
        begun = time.perf_counter()
        steps = sum(result[0] for _, result in pool.run([("measure", (numbers,)) for numbers in blocks]))
        return steps / (time.perf_counter() - begun)

    run()
    return run


def cpu_seconds(call):
    """CPU time of one call in this process."""
    begun = time.process_time()
    call()
    return time.process_time() - begun


def main():
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one last line with every figure")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--tasks", type=int, default=1024, help="tasks of a round")
    parser.add_argument(
        "--run", type=Path, help="a run's folder, whose policy is evaluated; default: one that has not learned"
    )
    parser.add_argument("overrides", nargs="*", help="configuration, key=value")
    options = parser.parse_args()
    if options.run:
        config = settings.load(options.run / "config.yaml", ["device=cpu", *options.overrides])
        subject = load_newest(options.run, config)
    else:
        config = build_config(options.overrides)
        policy = LearnerState(config, config.seed).snapshot().averaged()
        subject = Subject(policy, 0, None, 0, "none")
    cores = os.cpu_count()
    config = replace(config, evaluation=replace(config.evaluation, max_tasks=options.tasks * cores))
    grid = TaskGrid(build_library(build_state_machine(config.motions)), config.evaluation)
    blocks = np.array_split(grid.numbers(0, len(grid)), cores)
    evaluator = Timed(config, subject.policy, subject.tightenings)
    recorded = record_steps(evaluator, blocks[0])
    steps = sum(len(ids) for ids, _ in recorded)
    one, every = physics_alone(config, recorded, 1), physics_alone(config, recorded, cores)
    spread = over_ray(config, subject, blocks)
    names = ("physics_one", "evaluation_one", "physics_all", "evaluation_all")
    rates = {name: [] for name in names}
    for _ in range(options.rounds):
        rates["physics_one"].append(steps / cpu_seconds(one))
        done, taken = evaluator.measure(blocks[0])
        rates["evaluation_one"].append(done / taken)
        rates["physics_all"].append(steps / seconds(every))
        rates["evaluation_all"].append(spread())
    ray.shutdown()
    rate = {name: statistics.median(values) for name, values in rates.items()}
    figures = {
        **{f"{name}_steps_per_second": round(value) for name, value in rate.items()},
        **{
            f"share_{who}": statistics.median(
                e / p for e, p in zip(rates[f"evaluation_{who}"], rates[f"physics_{who}"], strict=True)
            )
            for who in ("one", "all")
        },
        "steps_per_task": steps / len(blocks[0]),
        "paper_minutes": PAPER_STEPS / rate["evaluation_all"] / 60,
        "cores": cores,
        "rounds": options.rounds,
    }
    print(f"{len(blocks[0])} tasks a round and process, {figures['steps_per_task']:.1f} steps each")
    print(f"physics only, 1 thread        {rate['physics_one']:8.0f} steps/s")
    print(f"evaluation, 1 process         {rate['evaluation_one']:8.0f}   {figures['share_one']:.2f} of it")
    print(f"physics only, {cores} threads       {rate['physics_all']:8.0f} steps/s")
    print(f"evaluation, {cores} Ray workers     {rate['evaluation_all']:8.0f}   {figures['share_all']:.2f} of it")
    print(f"the paper's grid at 12 steps a task: {figures['paper_minutes']:.1f} min for one pass")
    if options.json:
        print(json.dumps(figures))


if __name__ == "__main__":
    main()
