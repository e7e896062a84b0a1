"""What a sweep's folder holds, as the report reads it."""

import contextlib
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from motion.errors import InputError
from orchestrator import folder as run_folder
from orchestrator import table
from orchestrator.plan import Run
from orchestrator.settings import load

TABLE, BASELINES = "table.json", "baselines.json"
CURVES = (
    "iteration", "samples", "return/mean", "thresholds/tightenings", "perf/seconds",
    "perf/samples_per_second", "perf/time",
)  # fmt: skip


@dataclass(frozen=True)
class RunData:
    """One run. curves: {name of CURVES: (n,) float, NaN where a line has none}. evaluation: evaluation.json's content
    or None."""

    name: str
    row: str
    seed: int
    folder: Path
    config: object
    curves: dict
    evaluation: dict | None


@dataclass(frozen=True)
class SweepData:
    """A sweep's folder. runs: of `RunData`, row by row. table: table.json's content. baselines: baselines.json's, or
    None."""

    out: Path
    runs: tuple
    table: dict
    baselines: dict | None

    @property
    def rows(self):
        """{row: its runs}, in the table's order."""
        out = {}
        for run in self.runs:
            out.setdefault(run.row, []).append(run)
        return out

    @property
    def methods(self):
        """{row: the name that the table gives it}."""
        return {row["row"]: row["method"] for row in self.table["rows"]}


def find_runs(out):
    """The `plan.Run`s in a sweep's folder, or the one whose folder it is. InputError if there are none."""
    out = Path(out).absolute()
    if not out.is_dir():
        raise InputError(f"{out}: is not a folder; give a sweep's, e.g. runs/ablation")
    paths = sorted(out.glob("*/config.yaml")) or sorted(out.glob("config.yaml"))
    if not paths:
        raise InputError(f"{out}: holds no run (a folder with config.yaml); give a sweep's folder, e.g. runs/ablation")
    runs = [Run(load(path), path.parent) for path in paths]
    known = list(table.METHODS)
    return sorted(runs, key=lambda run: (
        known.index(run.config.row) if run.config.row in known else len(known), run.config.row, run.config.seed
    ))  # fmt: skip


def read(out, runs):
    """The `SweepData` of a folder and its `plan.Run`s."""
    out = Path(out)
    data = []
    for run in runs:
        evaluation = read_json(run_folder.evaluation_path(run.folder))
        curves = read_curves(run_folder.metrics_path(run.folder))
        data.append(RunData(run.name, run.config.row, run.config.seed, run.folder, run.config, curves, evaluation))
    rows = list(dict.fromkeys(run.row for run in data))
    content = read_json(out / TABLE)
    if content is None or "notes" not in content or [row["row"] for row in content["rows"]] != rows:
        content = table.collect(runs, {})  # there is none, or of another version, or of other rows
    return SweepData(out, tuple(sorted(data, key=lambda run: rows.index(run.row))), content, read_json(out / BASELINES))


def read_json(path):
    """A JSON file's content, None if it is not there or broken."""
    with contextlib.suppress(OSError, ValueError):
        return json.loads(Path(path).read_text())
    return None


def read_curves(path):
    """{name of CURVES: (n,)} of a metrics.jsonl; empty arrays if there is none. A line that was cut off is left out."""
    lines = []
    with contextlib.suppress(FileNotFoundError):
        for line in path.read_bytes().split(b"\n")[:-1]:
            with contextlib.suppress(ValueError):
                lines.append(json.loads(line))
    rows = [[line.get(name) for name in CURVES] for line in lines]
    values = np.array(rows, dtype=np.float64).reshape(-1, len(CURVES))  # None becomes NaN
    return dict(zip(CURVES, values.T))
