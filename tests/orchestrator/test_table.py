"""The table: four rows of 13 columns, ours beside the paper's, in three formats."""

import csv
import json
from pathlib import Path

from orchestrator import table
from orchestrator.plan import Run, run_name
from orchestrator.settings import build, command_line

ROWS = ("ours", "no_sbc", "no_urp", "no_tr")


def runs_of(folder, rows=ROWS, seeds=(0,)):
    out = []
    for seed in seeds:
        for row in rows:
            config = build([command_line(["scale=smoke", f"row={row}", f"seed={seed}"])])
            out.append(Run(config, Path(folder) / run_name(row, seed)))
    return out


def finish(run, shift=0.0, **values):
    metrics = {column: 1.0 + shift for column in table.COLUMNS} | {"MS": None, "IRFA": None} | values
    content = {
        "metrics": metrics,
        "trained": metrics,
        "tasks": 8,
        "samples": 192,
        "tightenings": 2,
        "final_tightenings": 34,
    }
    run.folder.mkdir(parents=True, exist_ok=True)
    (run.folder / "evaluation.json").write_text(json.dumps(content))


def test_four_rows_of_thirteen_columns_beside_the_papers(tmp_path):
    runs = runs_of(tmp_path)
    for run in runs:
        finish(run)
    content = table.collect(runs, {})
    paths = table.write(tmp_path, content)
    assert sorted(path.name for path in paths) == ["table.csv", "table.json", "table.md"]
    text = (tmp_path / "table.md").read_text()
    header = text.splitlines()[0]
    assert [cell.strip() for cell in header.split("|")[2:-1]] == list(table.COLUMNS)
    for method in table.METHODS.values():
        lines = [line for line in text.splitlines() if line.startswith((f"| {method} ", f"| {method} (paper)"))]
        assert len(lines) == 3  # measured, the paper's, and at the thresholds that training reached
        assert all(line.count("|") == 15 for line in lines)
    paper = next(line for line in text.splitlines() if line.startswith("| Ours (paper)"))
    cells = [cell.strip() for cell in paper.split("|")[2:-1]]
    assert cells == [
        "0.0038", "0.6556", "0.1677", "0.0513", "0.1071", "3.2404", "-0.1677", "71.90", "12.02", "e^-3.7", "1.000",
        "10362", "5.4027",
    ]  # fmt: skip
    with open(tmp_path / "table.csv") as file:
        lines = list(csv.DictReader(file))
    assert [line["row"] for line in lines if line["source"] == "measured"] == list(ROWS)
    assert float(lines[0]["FRPD"]) == 1.0 and lines[0]["IRFA"] == "" and lines[0]["status"] == "finished"
    stored = json.loads((tmp_path / "table.json").read_text())
    assert [len(row["measured"]) for row in stored["rows"]] == [13] * 4


def test_the_caption_says_under_what_conditions(tmp_path):
    runs = runs_of(tmp_path)
    for run in runs:
        finish(run)
    caption = table.collect(runs, {})["caption"]
    for words in ("9 clips (builtin)", "192 samples", "seed 0", "8 evaluation tasks", "4,000,000,000", "Ours 2 of 34"):
        assert words in caption


def test_mean_over_seeds(tmp_path):
    runs = runs_of(tmp_path, ["ours"], seeds=(0, 1))
    finish(runs[0], shift=0.0, MS=-3.3, IRFA=10)
    finish(runs[1], shift=1.0, MS=-3.7, IRFA=None)
    row = table.collect(runs, {})["rows"][0]
    assert row["measured"]["FRPD"] == 1.5
    assert row["measured"]["MS"] == -3.7  # the noise that every seed bears
    assert row["measured"]["IRFA"] is None  # one seed never came there
    assert "seeds 0, 1 (mean)" in table.collect(runs, {})["caption"]


def test_failed_and_missing_rows_are_marked_with_the_reason(tmp_path):
    runs = runs_of(tmp_path)
    for run in runs[:2]:
        finish(run)
    content = table.collect(runs, {"no_urp-seed0": "ValueError: no good"})
    text = table.markdown(content)
    assert "| No URP (failed) " in text and "| No TR (missing) " in text
    assert "* no_urp-seed0: failed: ValueError: no good" in text
    assert "* no_tr-seed0: missing: not run to its end" in text
    status = {line.split(",")[0]: line.rsplit(",", 1)[1] for line in table.comma_separated(content).splitlines()[1:5]}
    assert status == {"ours": "finished", "no_sbc": "finished", "no_urp": "failed", "no_tr": "missing"}


def test_one_of_two_seeds_failed(tmp_path):
    runs = runs_of(tmp_path, ["ours"], seeds=(0, 1))
    finish(runs[0])
    content = table.collect(runs, {"ours-seed1": "died"})
    assert content["rows"][0]["measured"]["FRPD"] == 1.0
    assert "* ours-seed1: failed: died" in table.markdown(content)


def test_rows_of_ones_own_have_no_paper(tmp_path):
    runs = runs_of(tmp_path, ["mine"])
    finish(runs[0])
    text = table.markdown(table.collect(runs, {}))
    assert "| mine " in text and "(paper)" not in text
