"""Make the report of a sweep: one HTML page with its table, curves, films and comparisons.

usage: python -m orchestrator.report SWEEP_FOLDER [report.key=value ...]

  python -m orchestrator.report runs/ablation
  python -m orchestrator.report runs/ablation report.videos=8 report.strips=5
  python -m orchestrator.report runs/ablation report.figures=docs/images      curves, strips and videos as files, too

Writes report.html into the folder; a folder of one run will do, too. Trains nothing, and works while a sweep is under
way. Rendered films need OpenGL without a screen, else the strips are stick figures: docs/report.md.
"""

import sys
import time
from pathlib import Path

from motion.errors import InputError
from orchestrator import report
from orchestrator.console import run_command
from orchestrator.report.data import find_runs
from orchestrator.settings import command_line, load


def main(arguments):
    """Command line; returns the exit status."""
    if not arguments or "=" in arguments[0]:
        raise InputError("no sweep folder given; e.g. python -m orchestrator.report runs/ablation")
    for key in command_line(arguments[1:]).values:
        if not key.startswith("report."):
            raise InputError(f"command line: {key}= is a run's; the report only takes report.* keys")
    runs, begun = find_runs(arguments[0]), time.monotonic()
    config = load(runs[0].folder / "config.yaml", arguments[1:])
    written = report.make(Path(arguments[0]).absolute(), runs, config, lambda line: print(f"{line} ...", flush=True))
    for path in written:
        print(f"written: {path} ({path.stat().st_size / 1e6:.1f} MB)")
    print(f"{time.monotonic() - begun:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main, __doc__, sys.argv[1:]))
