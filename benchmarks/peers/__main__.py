"""Segue beside other libraries' PPO: the same environment, numbers and machine, one after the other in one run.

    python -m benchmarks.peers --python PEERS/bin/python [--samples 500000] [--seconds S] [--only segue,sb3] [--json]
                               [key=value ...]

Prints samples/s (learning included), CPU use, memory, the lines that a user writes, the achievement rate at training
noise after equal samples and after equal time, and how long equal learning took: the time to the rate at equal samples,
in that of the first line; then what no library could beat on this machine. docs/peers.md says what is compared and how
to install the other libraries into an environment of their own (benchmarks/peers/requirements.txt).
"""

import argparse
import json
import os
import signal
import sys
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.peers import measure, shadow
from benchmarks.peers.ceiling import ceilings
from benchmarks.peers.child import POLICIES
from benchmarks.peers.libraries import build_lines
from benchmarks.peers.task import WARM_UP, build_config
from motion.errors import InputError

WINDOW = 10  # iterations over which an achievement rate is taken, at least


def main():
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python", default=sys.executable, help="interpreter that has the other libraries")
    parser.add_argument("--samples", type=float, default=500_000, help="equal samples: each library trains on so many")
    parser.add_argument(
        "--seconds", type=float, help="equal time after the warm-up; default: what the fastest takes for the samples"
    )
    parser.add_argument("--pilot", type=int, default=10, help="iterations to choose among a library's variants")
    parser.add_argument("--only", default="segue,segue_plain,sb3,rsl,rllib", help="lines, in this order")
    parser.add_argument("--folder", type=Path, help="keep records and logs there")
    parser.add_argument("--json", action="store_true", help="print one last line with every figure")
    parser.add_argument("overrides", nargs="*", help="configuration of all, key=value")
    options = parser.parse_intermixed_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that the library that runs is ended, too
    try:
        config = build_config(options.overrides)
    except InputError as error:
        parser.error(str(error))
    lines = build_lines(options.python, config.scale)
    unknown = [name for name in options.only.split(",") if name not in lines]
    if unknown:
        parser.error(f"--only {options.only}: {unknown[0]!r} is none of {','.join(lines)}")
    with tempfile.TemporaryDirectory() as scratch:
        folder = (options.folder or Path(scratch)).absolute()
        runs, chosen = {}, {}
        for name in options.only.split(","):
            try:
                runs[name], chosen[name] = compete(lines[name], folder / name, config, options)
            except (measure.Missing, FileNotFoundError) as error:
                print(f"{lines[name].title}: skipped, {lines[name].python} does not have it ({error})", flush=True)
        if not runs:
            sys.exit("nothing to compare: see docs/peers.md for how to install the libraries")
        figures = compare(runs, config, options)
    figures["ceilings"] = ceilings(config)
    for name, entry in figures["lines"].items():
        entry |= {"title": lines[name].title, "user_lines": lines[name].user_lines, **chosen[name]}
    show(figures)
    if options.json:
        print(json.dumps(figures))


def compete(line, folder, config, options):
    """(`measure.Run` of a line in its fastest variant, what was tried)."""
    rates, best = {}, line.variants[0]
    if len(line.variants) > 1:
        samples = (options.pilot + WARM_UP) * config.samples_per_iteration
        for i, variant in enumerate(line.variants):
            rates[variant] = measure.run(line, variant, folder / f"pilot{i}", samples, 0, options.overrides).rate()
            print(f"{line.title}: {rates[variant]:.0f} samples/s with {variant}", flush=True)
        best = max(rates, key=rates.get)
    run = measure.run(line, best, folder / "run", options.samples, options.seconds or 0, options.overrides)
    print(f"{line.title}: {run.rate():.0f} samples/s", flush=True)
    tried = {str(variant): round(rate) for variant, rate in rates.items()}
    return run, {"variant": str(best) if rates else "as configured", "pilot_samples_per_second": tried}


def compare(runs, config, options):
    """The figures of all runs. Times count from each run's own end of warm-up."""
    window = max(WINDOW * config.samples_per_iteration, 0.1 * options.samples)
    seconds = options.seconds or min(run.record.when(options.samples) - run.begin for run in runs.values())
    entries = {}
    for name, run in runs.items():
        moments = {"samples": run.record.when(options.samples), "time": run.begin + seconds}
        entries[name] = {
            "samples_per_second": run.rate(),
            "cpu": run.cores(),
            "memory_mb": run.peak_memory(),
            "seconds_to_samples": moments["samples"] - run.begin,
            "samples_at_equal_time": run.record.at(moments["time"])[0],
            "versions": run.versions,
        }
        for what, moment in moments.items():
            for key, value in achievements(run, config, moment, window).items():
                entries[name][f"{key}_equal_{what}"] = value
    first, run = next(iter(runs.items()))
    curve = achievement_curve(run, config, options.samples, window)
    for entry in entries.values():
        wanted = entry["achievement_equal_samples"]
        entry["first_line_seconds"] = next((at for at, rate in curve if rate >= wanted), None)
    entries[first]["first_line_seconds"] = entries[first]["seconds_to_samples"]  # played twice, two rates
    return {
        "first_line": first,
        "curve": curve,
        "lines": entries,
        "samples": options.samples,
        "seconds": seconds,
        "window_samples": window,
        "warm_up_iterations": WARM_UP,
        "num_envs": config.num_envs,
        "horizon": config.horizon,
        "motions": config.motions.name,
        "overrides": options.overrides,
        "cores": os.cpu_count(),
    }


def achievements(run, config, moment, window):
    """Achievement rate over `window` samples before a time, also by averaged weights where a run keeps them."""
    folder = run.folder / POLICIES
    if not folder.is_dir():
        return {"achievement": run.record.achievement(moment, window)}
    iterations = round(window / config.samples_per_iteration)
    last = int(run.record.at(moment)[0] // config.samples_per_iteration)
    return {
        "achievement": shadow.achievement(config, folder, last, iterations),
        "averaged_achievement": shadow.achievement(config, folder, last, iterations, averaged=True),
    }


def achievement_curve(run, config, samples, window):
    """[(seconds since the warm-up, achievement rate over `window` samples before)] at the end of each iteration."""
    first, end = round(window / config.samples_per_iteration), run.record.when(samples)
    moments, folder = [moment for moment in run.record.begins[first:] if moment <= end], run.folder / POLICIES
    if folder.is_dir():
        sums = shadow.counts(config, folder, range(1, first + len(moments))).cumsum(axis=0)
        ended, reached = (sums[first - 1 :] - np.vstack([[0, 0], sums[: -first]])).T
        rates = reached / np.maximum(ended, 1)
    else:
        rates = [run.record.achievement(moment, window) for moment in moments]
    return [(moment - run.begin, float(rate)) for moment, rate in zip(moments, rates)]


def show(figures):
    """The table, in Markdown."""

    def rate(value):
        return "-" if value is None else f"{value:.3f}"

    def sooner(entry):
        """How many times sooner the first line had learned as much."""
        seconds = entry["first_line_seconds"]
        return "-" if seconds is None else f"{entry['seconds_to_samples'] / seconds:.1f}"

    print(
        f"\n{figures['num_envs']} environments, horizon {figures['horizon']}, {figures['cores']} cores; achievement "
        f"after {figures['samples']:.0f} samples and after {figures['seconds']:.0f} s, over the last "
        f"{figures['window_samples']:.0f} samples\n"
    )
    first = figures["lines"][figures["first_line"]]["title"]
    print(
        "| library | samples/s | CPU | memory, MB | user's lines | at equal samples | at equal time "
        f"| its time to the former, in that of {first} | threads |"
    )
    print("|---|---:|---:|---:|---:|---:|---:|---:|---|")
    for entry in figures["lines"].values():
        print(
            f"| {entry['title']} | {entry['samples_per_second']:.0f} | {entry['cpu']:.2f} | {entry['memory_mb']:.0f} "
            f"| {entry['user_lines']} | {rate(entry['achievement_equal_samples'])} "
            f"| {rate(entry['achievement_equal_time'])} | {sooner(entry)} | {entry['variant']} |"
        )
    print("\nAt most, if every core did nothing else: " + ", ".join(
        f"{name} {samples:.0f} samples/s" for name, samples in figures["ceilings"].items()
    ))  # fmt: skip


if __name__ == "__main__":
    main()
