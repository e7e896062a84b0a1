"""The table's content as plain data: what every format is written from, and what table.json holds."""

import json

from orchestrator import folder as run_folder
from orchestrator.table import statistics
from orchestrator.table.columns import COLUMNS, METHODS, PAPER, PAPER_SAMPLES, PAPER_TASKS, REFERENCE

FINISHED, SHORT, MISSING, FAILED = "finished", "short", "missing", "failed"

# parts of evaluation.json: with noise at the final accuracy, at the thresholds of training; both without noise
PARTS = {
    "measured": "metrics",
    "trained": "trained",
    "deterministic": "deterministic",
    "trained_deterministic": "trained_deterministic",
}
COMPARED = {"measured": "", "trained": "trained_"}  # parts with intervals and marks, and the prefixes of their keys
FEW = 10  # runs below which the interval holds the mean in less than 90 % of cases (docs/table.md)
BULKY = ("states", "groups", "by_rotation", "by_moment", "by_accuracy")  # of an evaluation: not the table's


def collect(runs, failures):
    """The table's content of a sweep's `plan.Run`s. failures: reason by name, of those that failed."""
    results = {}
    for run in runs:
        results.setdefault(run.config.row, []).append(result_of(run, failures.get(run.name)))
    config = runs[0].config
    rows = [row_content(row, found) for row, found in results.items()]
    for part, prefix in COMPARED.items():
        compare(rows, part, prefix)
    for row in rows:
        row.pop("values")
    content = {
        "columns": list(COLUMNS),
        "motions": config.motions.name,
        "clips": len(config.motions.clips),
        "scale": config.scale,
        "seeds": sorted({run.config.seed for run in runs}),
        "reference": METHODS.get(REFERENCE, REFERENCE),
        "rows": rows,
    }
    return {**content, "caption": caption(content), "notes": notes(content)}


def result_of(run, failure):
    """One run: its evaluation, whether it is of the whole budget, or why there is none."""
    base, path = {"run": run.name, "seed": run.config.seed}, run_folder.evaluation_path(run.folder)
    total = run.config.total_iterations
    if failure is not None:
        return {**base, "status": FAILED, "reason": failure}
    if not path.exists():
        done = run_folder.iterations_done(run.folder)
        reason = f"not run to its end ({done} of {total} iterations)" if done else "not run to its end"
        return {**base, "status": MISSING, "reason": reason}
    evaluation = {key: value for key, value in json.loads(path.read_text()).items() if key not in BULKY}
    base["task_intervals"] = {
        part: statistics.rate_interval(evaluation[PARTS[part]]["TTAR"], evaluation["tasks"]) for part in COMPARED
    }
    done = evaluation.get("iterations", total)
    if done < total:
        reason = f"evaluated after {done} of {total} iterations"
        return {**base, "status": SHORT, "reason": reason, "evaluation": evaluation}
    return {**base, "status": FINISHED, "evaluation": evaluation}


def row_content(row, results):
    """One row: means over its finished runs; where there is none, over those that missed their budget, which it says.

    `values` (part -> column -> values of the runs) is for `compare`.
    """
    used = [r for r in results if r["status"] == FINISHED] or [r for r in results if r["status"] == SHORT]
    done = [result["evaluation"] for result in used]
    values = {}
    for part, key in PARTS.items():
        known = bool(done) and all(key in e for e in done)
        values[part] = {column: [e[key][column] for e in done] for column in COLUMNS} if known else None
    means = {part: found and {column: mean(column, found[column]) for column in COLUMNS}
             for part, found in values.items()}  # fmt: skip
    measured = values["measured"] or {column: [] for column in COLUMNS}
    return {
        "row": row,
        "method": METHODS.get(row, row),
        **means,
        "paper": dict(zip(COLUMNS, PAPER[row], strict=True)) if row in PAPER else None,
        "runs_behind": {column: len(done) - measured[column].count(None) * (column != "MS") for column in COLUMNS},
        "status": used[0]["status"] if used else results[0]["status"],
        "note": note(results, used),
        "samples": sorted({e["samples"] for e in done}),
        "tasks": sorted({e["tasks"] for e in done}),
        "tightenings": [e["tightenings"] for e in done],
        "final_tightenings": done[0]["final_tightenings"] if done else None,
        "runs": results,
        "values": values,
    }


def mean(column, values):
    """Mean over runs; None where one has none (IRFA: never reached the final accuracy).

    MS is the smallest of the runs': the noise at which every one of them still reaches all tasks.
    """
    if None in values:
        return None
    return min(values) if column == "MS" else sum(values) / len(values)


def note(results, used):
    """What a row's name in the table says of its runs; empty if all ran to their end."""
    if not used:
        return ", ".join(dict.fromkeys(result["status"] for result in results))
    some = f"{len(used)} of {len(results)} runs" if len(used) < len(results) else ""
    short = used[0]["reason"].removeprefix("evaluated ") if used[0]["status"] == SHORT else ""
    return ", ".join(filter(None, (some, short)))


def compare(rows, part, prefix):
    """Add to each row of a part `intervals`, `p_values` and `differs` (from the reference row), by column.

    MS has none: it is a minimum on a short list of noises. Only runs of the whole budget are compared.
    """
    reference = next((row for row in rows if row["row"] == REFERENCE), None)
    p_values = {}
    for row in rows:
        values = row["values"][part]
        row[f"{prefix}intervals"] = {
            column: statistics.interval(values[column]) if values and column != "MS" else None for column in COLUMNS
        }
        comparable = reference not in (None, row) and all(
            one["values"][part] and one["status"] == FINISHED for one in (row, reference)
        )
        for column in COLUMNS:
            p = None
            if comparable and column != "MS":
                p = statistics.p_value(values[column], reference["values"][part][column])
            p_values[row["row"], column] = p
    marks = statistics.marked(p_values)
    for row in rows:
        row[f"{prefix}p_values"] = {column: p_values[row["row"], column] for column in COLUMNS}
        row[f"{prefix}differs"] = {column: marks[row["row"], column] for column in COLUMNS}


def caption(content):
    """Under what conditions the numbers came about, one paragraph."""
    rows, seeds = content["rows"], content["seeds"]
    samples = sorted({count for row in rows for count in row["samples"]})
    tasks = sorted({count for row in rows for count in row["tasks"]})
    amount = " to ".join(f"{n:,}" for n in sorted({samples[0], samples[-1]})) if samples else "no"
    reached = ", ".join(
        f"{row['method']} {'/'.join(map(str, row['tightenings']))} of {row['final_tightenings']}"
        for row in rows
        if row["tightenings"]
    )
    return (
        f"Conditions: {content['clips']} clips ({content['motions']}), scale {content['scale']}, "
        f"{amount} samples per run, seed{'s' * (len(seeds) > 1)} {', '.join(map(str, seeds))}"
        f"{' (mean)' * (len(seeds) > 1)}, {' to '.join(f'{n:,}' for n in tasks) or 'no'} evaluation tasks. "
        f"The paper: nine other clips, {PAPER_SAMPLES:,} samples per row, {PAPER_TASKS:,} tasks. The first table "
        "counts a task as reached at the final accuracy, as the paper does; the second at the thresholds to which "
        f"training came (cuts of the thresholds: {reached or 'none'}). {support(content)}"
    )


def support(content):
    """What the numbers of runs allow to be said, in a sentence or two."""
    used = [row["runs_behind"]["FRPD"] for row in content["rows"]]
    most = max(used, default=0)
    if most == 0:
        return ""
    rate = f"TTAR of one run is known to within {rate_error(content):.2g} (95 %), its tasks being a sample."
    if most == 1:
        return f"One run per row: no interval, and no difference between rows is supported. {rate}"
    words = [f"From, to: 95 % bootstrap interval of the mean over runs{', too narrow for so few' * (most < FEW)}."]
    if {REFERENCE} < {row["row"] for row in content["rows"]}:
        fewest, reference = statistics.FEWEST, content["reference"]
        if most < fewest:
            words.append(f"No difference from {reference} can be supported by fewer than {fewest} runs a row.")
        else:
            share = f"{100 * statistics.RATE:g} %"
            test = f"permutation test over runs; at most {share} of the marks false"
            words.append(f"*: differs from {reference} ({test}).")
    return " ".join([*words, rate])


def rate_error(content):
    """Half of the widest of the runs' intervals of TTAR over tasks."""
    runs = [run["task_intervals"] for row in content["rows"] for run in row["runs"] if "task_intervals" in run]
    return max((high - low) / 2 for intervals in runs for low, high in intervals.values())


def notes(content):
    """One line for everything that a reader must know of single runs and cells."""
    lines = [
        f"{result['run']}: {result['status']}: {result['reason']}"
        for row in content["rows"]
        for result in row["runs"]
        if result["status"] != FINISHED
    ]
    for row in content["rows"]:
        behind, of = row["runs_behind"]["IRFA"], row["runs_behind"]["FRPD"]
        if 0 < behind < of:
            lines.append(f"{row['method']}: {behind} of {of} runs came to the final accuracy, hence no IRFA")
    return lines
