"""Compiles the kernels into their cache, for `make test`: else every process of the tests does so at the same time.

Two processes side by side: one-hop search, and a tiny run with its evaluation.
"""

import multiprocessing
import tempfile


def one_hop():
    """The kernels of the search: both regimes, two hops (which begin with one)."""
    from motion import builtin
    from motion.onehop.clips import ClipSet
    from motion.onehop.search import SearchConfig, build

    clips = ClipSet.from_clips([builtin.load(name) for name in ("idle", "stab")], fps=60)
    for regime in ("start", "fixed"):
        build(clips, "all", SearchConfig(weight=3e-4, regime=regime, hops=2))


def run():
    """The kernels of a run."""
    from orchestrator.evaluate import evaluate_run
    from orchestrator.run import train
    from orchestrator.settings import build, command_line

    config = build([command_line(["scale=smoke", "runtime=local", "budget.iterations=2", "evaluation.max_tasks=4"])])
    with tempfile.TemporaryDirectory() as folder:
        train(config, folder)
        evaluate_run(folder, config)


def main():
    """Compile; a failure here is left for the tests to report."""
    processes = [multiprocessing.get_context("spawn").Process(target=target) for target in (one_hop, run)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()


if __name__ == "__main__":
    main()
