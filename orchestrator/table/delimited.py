"""The table as CSV: a line per row and source of its numbers."""

import csv
import io

from orchestrator.table.columns import COLUMNS, PAPER_SAMPLES
from orchestrator.table.content import COMPARED, FINISHED, PARTS, SHORT

ENDS = {"low": 0, "high": 1}


def comma_separated(content):
    """Sources: measured (at the final accuracy) and trained (at the thresholds of training), each with the ends of
    its interval (measured_low, ...) and what differs from the reference row (measured_differs: true or false); the
    same without noise (deterministic, trained_deterministic) where it was evaluated; paper. `runs`: behind the line.
    """
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(["row", "source", *COLUMNS, "runs", "seeds", "samples", "tasks", "tightenings", "status"])
    for part in PARTS:
        for row in content["rows"]:
            for source, values in sources(row, part):
                writer.writerow([row["row"], source, *(blank(values and values[c]) for c in COLUMNS), *behind(row)])
    for row in content["rows"]:
        if row["paper"]:
            numbers = [blank(row["paper"][column]) for column in COLUMNS]
            writer.writerow([row["row"], "paper", *numbers, 1, "", PAPER_SAMPLES, "", "", ""])
    return file.getvalue()


def sources(row, part):
    """(source, values by column) of one row's lines of a part."""
    if part in COMPARED or row[part]:
        yield part, row[part]
    if part in COMPARED:
        prefix = COMPARED[part]
        intervals = row[f"{prefix}intervals"]
        if any(intervals.values()):
            for name, end in ENDS.items():
                yield f"{part}_{name}", {column: pair and pair[end] for column, pair in intervals.items()}
            yield f"{part}_differs", {column: str(value).lower() for column, value in row[f"{prefix}differs"].items()}


def behind(row):
    """The cells after the 13 columns."""
    done = [str(run["seed"]) for run in row["runs"] if run["status"] in (FINISHED, SHORT)]
    status = "; ".join(sorted({run["status"] for run in row["runs"]}))
    several = (" ".join(map(str, row[key])) for key in ("samples", "tasks", "tightenings"))
    return [row["runs_behind"]["FRPD"], " ".join(done), *several, status]


def blank(value):
    """Nothing for None, the number as it is otherwise."""
    return "" if value is None else value
