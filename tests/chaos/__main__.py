"""Kill processes of runs and compare the numbers with those of a run that nobody disturbed.

usage: python -m tests.chaos [--kills 100] [--each 8] [--seed 0] [--folder DIR]

  --kills N    faults to inject in all; --each of them into one run
Prints a row per kind of victim and ends with status 1 unless every run is identical.
"""

import argparse
import statistics
import sys
import tempfile
from pathlib import Path

from tests.chaos.killer import VICTIMS, disturbed, plan, undisturbed


def main():
    """Command line; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default, kind in (("kills", 100, int), ("each", 8, int), ("seed", 0, int), ("folder", None, Path)):
        parser.add_argument(f"--{name}", default=default, type=kind)
    options = parser.parse_args()
    folder = options.folder or Path(tempfile.mkdtemp(prefix="chaos-"))
    reference = undisturbed(folder / "undisturbed")
    reports, left, number = [], options.kills, 0
    while left > 0 and number < 2 * options.kills:
        kills = plan(options.seed + number, min(options.each, left))
        report = disturbed(folder / f"run{number}", kills, reference)
        reports.append(report)
        left -= len(report.recovery)
        print(
            f"run {number}: {len(report.recovery)} faults, {report.starts} starts of the command, "
            f"{report.wrong_lines} wrong lines, {report.wrong_steps} wrong steps in MLflow, "
            f"{'identical' if report.identical else 'DIFFERENT'}, {report.seconds:.0f} s",
            flush=True,
        )
        number += 1
    print(f"\n{'victim':18s} {'faults':>6s} {'recovery, median':>17s} {'longest':>9s}")
    for victim in VICTIMS:
        times = [seconds for report in reports for name, seconds in report.recovery if name == victim]
        if times:
            print(f"{victim:18s} {len(times):6d} {statistics.median(times):15.1f} s {max(times):7.1f} s")
    faults = sum(len(report.recovery) for report in reports)
    same = sum(report.identical for report in reports)
    lost = sum(report.wrong_lines + report.wrong_steps for report in reports)
    print(f"\n{faults} faults in {len(reports)} runs: {same} runs identical, {lost} steps lost, doubled or changed")
    print(f"left in {folder}")
    return 0 if same == len(reports) else 1


if __name__ == "__main__":
    sys.exit(main())
