"""The table of a sweep, beside the paper's Table 1: Markdown, CSV and JSON."""

import csv
import io
import json
import textwrap
from pathlib import Path

from learner.storage import replace_file
from orchestrator.folder import evaluation_path

COLUMNS = ("FRPD", "FRVD", "FRRD", "FKPD", "FJRD", "FJAD", "SURI", "TC", "TS", "MS", "TTAR", "IRFA", "Return")
FORMATS = {"TC": ".2f", "TS": ".2f", "TTAR": ".3f", "IRFA": ".0f"}  # the others: .4f
METHODS = {"ours": "Ours", "no_sbc": "No SBC", "no_urp": "No URP", "no_tr": "No TR"}
PAPER_SAMPLES = 4_000_000_000

# Table 1 of the paper, MS as log sigma. The scan reads 7190 for the first TC.
PAPER = {
    "ours": (0.0038, 0.6556, 0.1677, 0.0513, 0.1071, 3.2404, -0.1677, 71.90, 12.02, -3.7, 1.000, 10362, 5.4027),
    "no_sbc": (0.0306, 0.6741, 0.2080, 0.1585, 0.1484, 2.5384, -0.1685, 76.15, 12.99, None, 0.889, 14809, 4.5615),
    "no_urp": (0.0237, 0.6906, 0.1699, 0.0903, 0.1284, 3.3104, -0.3873, 81.20, 14.09, None, 0.889, 13157, 4.1353),
    "no_tr": (0.0048, 0.7548, 0.1045, 0.0613, 0.0592, 1.2915, 0.0482, 154.27, 10.23, -3.3, 1.000, 3010, 2.8425),
}  # fmt: skip


def collect(runs, failures):
    """The table's content (plain data) of a sweep's `plan.Run`s. failures: reason by name, of those that failed."""
    rows = {}
    for run in runs:
        rows.setdefault(run.config.row, []).append(result_of(run, failures.get(run.name)))
    config = runs[0].config
    content = {
        "columns": list(COLUMNS),
        "motions": config.motions.name,
        "clips": len(config.motions.clips),
        "scale": config.scale,
        "seeds": sorted({run.config.seed for run in runs}),
        "rows": [row_content(row, results) for row, results in rows.items()],
    }
    return {**content, "caption": caption(content)}


def result_of(run, failure):
    """One run: its evaluation, or why there is none."""
    path = evaluation_path(run.folder)
    base = {"run": run.name, "seed": run.config.seed}
    if failure is None and path.exists():
        return {**base, "status": "finished", "evaluation": json.loads(path.read_text())}
    return {**base, "status": "failed" if failure else "missing", "reason": failure or "not run to its end"}


def row_content(row, results):
    """One row: the mean over its finished seeds, at the final accuracy and at the thresholds that training reached."""
    done = [result["evaluation"] for result in results if result["status"] == "finished"]
    return {
        "row": row,
        "method": METHODS.get(row, row),
        "measured": mean([e["metrics"] for e in done]),
        "trained": mean([e["trained"] for e in done]),
        "paper": dict(zip(COLUMNS, PAPER[row], strict=True)) if row in PAPER else None,
        "samples": sorted({e["samples"] for e in done}),
        "tasks": sorted({e["tasks"] for e in done}),
        "tightenings": [e["tightenings"] for e in done],
        "final_tightenings": done[0]["final_tightenings"] if done else None,
        "runs": results,
    }


def mean(metrics):
    """Mean of each column over seeds; null where a seed has none (IRFA: never reached the final accuracy).

    MS is the smallest of the seeds': the noise at which every seed still reaches all tasks.
    """
    if not metrics:
        return None
    out = {}
    for column in COLUMNS:
        values = [m[column] for m in metrics]
        known = None not in values
        out[column] = (min(values) if column == "MS" else sum(values) / len(values)) if known else None
    return out


def caption(content):
    """Under what conditions the numbers came about, one paragraph."""
    samples = {count for row in content["rows"] for count in row["samples"]}
    tasks = sorted({count for row in content["rows"] for count in row["tasks"]})
    amount = " to ".join(f"{n:,}" for n in sorted({min(samples), max(samples)})) if samples else "no"
    reached = ", ".join(
        f"{row['method']} {'/'.join(map(str, row['tightenings']))} of {row['final_tightenings']}"
        for row in content["rows"]
        if row["tightenings"]
    )
    seeds = content["seeds"]
    return (
        f"Conditions: {content['clips']} clips ({content['motions']}), scale {content['scale']}, "
        f"{amount} samples per run, seed{'s' * (len(seeds) > 1)} {', '.join(map(str, seeds))}"
        f"{' (mean)' * (len(seeds) > 1)}, {' to '.join(map(str, tasks)) or 'no'} evaluation tasks. "
        f"The paper: nine other clips, {PAPER_SAMPLES:,} samples per row, 460,278 tasks. The first table counts a task "
        "as reached at the final accuracy, as the paper does; the second at the thresholds to which training came "
        f"(cuts of the thresholds: {reached or 'none'})."
    )


def cell(column, value):
    """A table cell: e^-3.7 or x for MS, a dash for what is not known."""
    if column == "MS":
        return "x" if value is None else f"e^{value:g}"
    return "-" if value is None else format(value, FORMATS.get(column, ".4f"))


def cells(metrics):
    """The 13 cells of a row; empty ones if there are no metrics."""
    return [cell(column, metrics[column]) for column in COLUMNS] if metrics else [""] * len(COLUMNS)


def markdown(content):
    """The two tables, caption and notes."""
    final, trained = [], []
    for row in content["rows"]:
        finished = row["measured"] is not None
        final.append([row["method"], *cells(row["measured"])] if finished else failed_line(row))
        if row["paper"]:
            final.append([f"{row['method']} (paper)", *cells(row["paper"])])
        trained.append([row["method"], *cells(row["trained"])] if finished else failed_line(row))
    lines = grid(["Method", *COLUMNS], final)
    lines += ["", "At the thresholds that training reached:", "", *grid(["Method", *COLUMNS], trained), ""]
    lines += textwrap.wrap(content["caption"], 120)
    notes = [
        f"* {result['run']}: {result['status']}: {result['reason']}"
        for row in content["rows"]
        for result in row["runs"]
        if result["status"] != "finished"
    ]
    return "\n".join(lines + [""] * bool(notes) + notes) + "\n"


def failed_line(row):
    """A row without a finished run."""
    return [f"{row['method']} ({row['runs'][0]['status']})", *cells(None)]


def grid(header, rows):
    """A Markdown table with aligned columns."""
    widths = [max(len(line[i]) for line in [header, *rows]) for i in range(len(header))]

    def line(values):
        rest = (value.rjust(width) for value, width in zip(values[1:], widths[1:], strict=True))
        return "| " + " | ".join([values[0].ljust(widths[0]), *rest]) + " |"

    rule = "|" + "|".join("-" * (w + 2) if i == 0 else "-" * (w + 1) + ":" for i, w in enumerate(widths)) + "|"
    return [line(header), rule, *map(line, rows)]


def comma_separated(content):
    """One line per row and source: measured (at the final accuracy), trained (at its own thresholds), paper."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(["row", "source", *COLUMNS, "seeds", "samples", "tightenings", "status"])
    for source in ("measured", "trained", "paper"):
        for row in content["rows"]:
            values = row[source]
            if source == "paper" and values is None:
                continue
            numbers = [blank(values and values[column]) for column in COLUMNS]
            rest = ["", f"{PAPER_SAMPLES}", "", ""] if source == "paper" else measured_columns(row)
            writer.writerow([row["row"], source, *numbers, *rest])
    return file.getvalue()


def measured_columns(row):
    """Seeds, samples, tightenings and status of a row of ours."""
    done = [str(r["seed"]) for r in row["runs"] if r["status"] == "finished"]
    status = "; ".join(sorted({r["status"] for r in row["runs"]}))
    return [" ".join(done), " ".join(map(str, row["samples"])), " ".join(map(str, row["tightenings"])), status]


def blank(value):
    """Nothing for None, the number as it is otherwise."""
    return "" if value is None else value


def write(out, content):
    """Write table.md, table.csv and table.json into a sweep's folder; returns their paths."""
    texts = {"md": markdown(content), "csv": comma_separated(content), "json": json.dumps(content, indent=2) + "\n"}
    paths = []
    for suffix, text in texts.items():
        path = Path(out) / f"table.{suffix}"
        replace_file(path, text.encode())
        paths.append(path)
    return paths
