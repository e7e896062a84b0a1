"""Timing of the search: `python -m motion.onehop bench`.

Next to it, in the same run: the paper's exhaustive search with pruning (compiled too, with the same float64 distance)
on a sample of triggers, and the least time that this machine needs for the same matrix products and one read of their
result.

The ratio is that of processor times per trigger, both on one thread, for the same pair, regime and weight, and for the
same exact optima: the exhaustive search's mean over its sample, and the whole fast search of the pair (features,
distances, all) divided by its triggers that have a candidate.
"""

import argparse
import json
import os
import resource
import tempfile
import time
from pathlib import Path

import numpy as np

from motion.onehop import exhaustive
from motion.onehop.features import DEGREE, ROWS, TILE
from motion.onehop.player import measure_step
from motion.onehop.search import SearchConfig, Searcher, build, solve
from motion.onehop.synthetic import clips_of_length
from motion.onehop.table import LookupTable

WEIGHT = 9e-4  # m^2 per frame; near the default weight of real clips, so that the figures compare between machines


def main(arguments=None):
    """Runs the benchmark; prints one line per figure, and with --json one last line with all of them."""
    parser = argparse.ArgumentParser(
        prog="python -m motion.onehop bench",
        description="Times the search on synthetic clips of the paper's size: 20 clips of 20 s at 60 fps.",
        epilog="examples:\n  python -m motion.onehop bench --json\n  python -m motion.onehop bench --full --hops 2",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--clips", type=int, default=20, help="number of clips (default 20)")
    parser.add_argument("--seconds", type=float, default=20.0, help="length of each, s (default 20)")
    parser.add_argument("--repeat", type=int, default=3, help="runs of which the fastest counts (default 3)")
    parser.add_argument("--sample", type=int, default=3, help="triggers of the exhaustive search, or 0 (default 3)")
    parser.add_argument("--full", action="store_true", help="also all pairs of clips, all triggers")
    parser.add_argument("--hops", type=int, default=1, choices=(1, 2), help="hops of --full (default 1)")
    parser.add_argument("--threads", type=int, default=None, help="threads (default: all cores)")
    parser.add_argument("--seed", type=int, default=0, help="of the synthetic clips (default 0)")
    parser.add_argument("--json", action="store_true", help="print one last line of JSON with every figure")
    options = parser.parse_args(arguments)
    figures = measure(options)
    if options.json:
        print(json.dumps(figures, sort_keys=True))
    return 0


def measure(options):
    """{figure: number}; prints them on the way. s are wall-clock, cpu_s processor time of all threads, mb of the
    process's peak so far."""
    figures = {"threads": options.threads or os.cpu_count(), "load_average": os.getloadavg()[0]}

    def note(**new):
        figures.update(new)
        for key, value in new.items():
            print(f"{key:32s} {value:.4g}" if isinstance(value, float) else f"{key:32s} {value}", flush=True)

    note(**figures)
    clips = clips_of_length(options.clips, options.seconds, seed=options.seed)
    frames = sum(clips.frames(i) for i in range(len(clips)))
    pair = [(0, min(1, len(clips) - 1))]
    note(frames=frames, triggers=clips.period(0), memory_before_mb=_peak())
    for regime in ("start", "fixed"):
        config = SearchConfig(weight=WEIGHT, regime=regime)
        runs = [_timed(solve, clips, pair, config, None, options.threads) for _ in range(options.repeat)]
        note(**{
            f"one_pair_{regime}_s": min(run[0] for run in runs),
            f"one_pair_{regime}_cpu_s": min(run[1] for run in runs),
            f"one_pair_{regime}_peak_mb": _peak(),
        })  # fmt: skip
    config = SearchConfig(weight=WEIGHT)
    note(**_limits(clips, config))
    note(**_runtime(options))
    if options.sample:
        note(**_exhaustive(clips, pair[0], config, options))
    if options.full:
        config = SearchConfig(weight=WEIGHT, hops=options.hops)
        wall, cpu, result = _timed(solve, clips, "all", config, None, options.threads)
        kind = "one_hop" if options.hops == 1 else "two_hops"
        note(**{
            f"all_pairs_{kind}_s": wall, f"all_pairs_{kind}_cpu_s": cpu, f"all_pairs_{kind}_peak_mb": _peak(),
            "all_pairs_triggers": len(result.cost),
        })  # fmt: skip
    note(load_average_after=os.getloadavg()[0])
    return figures


def _timed(function, *arguments):
    wall, cpu = time.perf_counter(), time.process_time()
    result = function(*arguments)
    return time.perf_counter() - wall, time.process_time() - cpu, result


def _peak():
    """Peak resident memory of the process, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000


def _limits(clips, config):
    """What the machine needs for the products and one read of the distances: of one pair, and of all pairs."""
    b, points = config.blend, len(config.points)
    # the shapes of the search itself
    rows, frames = ROWS + b - 1, TILE + b - 1
    rng = np.random.default_rng(0)
    a, c = (rng.random(shape, np.float32) for shape in ((2 * rows, 2 * points), (2 * points, frames)))
    out = np.empty((2 * rows, frames), np.float32)
    repeats = 200
    cpu = min(_timed(lambda: [np.dot(a, c, out=out) for _ in range(repeats)])[1] for _ in range(3))
    gflops = 2 * out.size * 2 * points * repeats / cpu / 1e9
    table = np.ones(64_000_000, np.float32)
    cpu = min(_timed(lambda: table.sum(dtype=np.float32))[1] for _ in range(3))
    bandwidth = table.nbytes / cpu / 1e9
    columns = sum(clips.windows(i, b) for i in range(len(clips)))
    ends = 2 * config.max_stay + 1
    one, full = columns * (clips.windows(0, b) + ends), columns * (columns + ends * len(clips))
    # per pair of windows one product of P terms (heights), two of 2 P (points), two of 2 DEGREE (paths)
    each = 2 * (5 * points + 4 * DEGREE) / gflops / 1e9 + 4 / bandwidth / 1e9
    return {
        "distances": one, "products_gflops": gflops, "read_gb_per_s": bandwidth, "one_pair_limit_cpu_s": one * each,
        "all_pairs_limit_cpu_s": full * each,
    }  # fmt: skip


def _runtime(options):
    """Microseconds of a query of a memory-mapped table and of a player's step."""
    clips = clips_of_length(3, 4.0, seed=options.seed)
    table = build(clips, "all", SearchConfig(weight=WEIGHT), threads=options.threads)
    count = 10_000
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "table.onehop"
        table.save(path)
        opened = LookupTable.open(path, clips)
        wall = min(_timed(lambda: [opened.query(0, 1, 100) for _ in range(count)])[0] for _ in range(3))
    return {"query_us": 1e6 * wall / count, "step_us": 1e6 * measure_step(clips, table, 200)}


def _exhaustive(clips, pair, config, options):
    """The paper's strategy on a sample of triggers spread over the source, and how much longer it takes per trigger."""
    triggers = np.linspace(0, clips.windows(pair[0], config.blend) - 1, options.sample + 2)[1:-1].astype(int)
    runs = [_timed(solve, clips, [pair], config, None, 1) for _ in range(options.repeat)]
    _, cpu, fast = min(runs, key=lambda run: run[1])
    with Searcher(clips, config, 1) as searcher:
        exhaustive.optimum(searcher, *pair, clips.frames(pair[0]))  # compiles: no window, so no work
        _, slow_cpu, found = _timed(lambda: [exhaustive.optimum(searcher, *pair, int(t)) for t in triggers])
    if any(cost != fast.cost[t] for t, (cost, _) in zip(triggers, found)):
        raise AssertionError("the exhaustive search found another optimum; please report this")
    each, fast_each = slow_cpu / len(triggers), cpu / np.isfinite(fast.cost).sum()
    return {
        "exhaustive_cpu_s_per_trigger": each,
        "exhaustive_distances_per_trigger": float(np.mean([computed for _, computed in found])),
        "search_one_thread_cpu_s": cpu,
        "search_cpu_us_per_trigger": 1e6 * fast_each,
        "ratio": each / fast_each,
    }
