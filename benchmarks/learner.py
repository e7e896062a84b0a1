"""How long an update of the learner takes, on the CPU and on a GPU, side by side.

    python -m benchmarks.learner [--json] [--rounds 5] [key=value ...]

Collects one chunk of the configuration (scale=laptop unless overridden) and times `learner.update.update` on it with
Adam and with K-FAC, one round after the other on each device; medians. A learner on a GPU pays for many small steps:
larger minibatches (`ppo.minibatch_size`) show what it can do.
"""

import argparse
import json
import statistics
import time
from dataclasses import replace

import torch

from benchmarks.throughput import build_config
from learner.state import LearnerState
from learner.update import update
from orchestrator.curriculum import thresholds
from workers.worker import RolloutWorker


def main():
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one last line with every figure")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("overrides", nargs="*", help="configuration, key=value")
    options = parser.parse_args()
    config = build_config(options.overrides)
    torch.set_num_threads(config.learner_threads)
    devices = ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]
    figures = measure(config, devices, options.rounds)
    samples = config.samples_per_iteration
    print(f"{samples} samples, {config.ppo.epochs} epochs, minibatches of {config.ppo.minibatch_size}")
    for name, duration in figures.items():
        print(f"{name:12s} {1000 * duration:9.1f} ms   {samples / duration:9.0f} samples/s")
    if options.json:
        print(json.dumps(figures))


def measure(config, devices, rounds):
    """{"adam cpu": median seconds of an update, ...}."""
    chunk = one_chunk(config)
    states = {}
    for method in ("adam", "kfac"):
        chosen = replace(config, ppo=replace(config.ppo, optimizer=method, kfac_after=0))
        for device in devices:
            state = LearnerState(chosen, chosen.seed, device)
            states[f"{method} {device}"], _ = update(state, [chunk])  # warm: kernels are loaded, normalizers set
    times = {name: [] for name in states}
    for _ in range(rounds):
        for name, state in states.items():
            begun = time.perf_counter()
            update(state, [chunk])  # ends with numbers on the CPU: all of it has been computed
            times[name].append(time.perf_counter() - begun)
    return {name: statistics.median(durations) for name, durations in times.items()}


def one_chunk(config):
    """A chunk of a new policy, past the synchronised start."""
    worker = RolloutWorker(config, config.num_envs)
    policy = LearnerState(config, config.seed).snapshot()
    limits = thresholds(config.curriculum, config.reach, 0)
    state = worker.initial_state(0)
    for _ in range(3):
        chunk, _, state = worker.collect(state, policy, limits)
    return chunk


if __name__ == "__main__":
    main()
