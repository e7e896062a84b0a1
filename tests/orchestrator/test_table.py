"""The table's content: rows beside the paper's, means, what is said of runs that are not what they should be."""

import json
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import pytest

from orchestrator import table
from orchestrator.plan import Run, run_name
from orchestrator.settings import build, command_line

ROWS = ("ours", "no_sbc", "no_urp", "no_tr")


@lru_cache
def smoke():
    return build([command_line(["scale=smoke"])])  # 3 iterations


def runs_of(folder, rows=ROWS, seeds=(0,)):
    return [
        Run(replace(smoke(), row=row, seed=seed), Path(folder) / run_name(row, seed)) for seed in seeds for row in rows
    ]


def finish(run, shift=0.0, iterations=3, deterministic=None, **values):
    metrics = {column: 1.0 + shift for column in table.COLUMNS} | {"MS": None, "IRFA": None, "TTAR": 0.5} | values
    content = {
        "metrics": metrics,
        "trained": {**metrics, "TTAR": 0.75},
        "tasks": 8,
        "samples": 64 * iterations,
        "iterations": iterations,
        "tightenings": 2,
        "final_tightenings": 34,
        "groups": ["long"],
        **({"deterministic": deterministic} if deterministic else {}),
    }
    run.folder.mkdir(parents=True, exist_ok=True)
    (run.folder / "evaluation.json").write_text(json.dumps(content))


def test_four_rows_of_thirteen_columns_beside_the_papers(tmp_path):
    runs = runs_of(tmp_path)
    for run in runs:
        finish(run)
    content = table.collect(runs, {})
    assert [row["row"] for row in content["rows"]] == list(ROWS)
    for row in content["rows"]:
        assert list(row["measured"]) == list(row["trained"]) == list(row["paper"]) == list(table.COLUMNS)
        assert row["runs_behind"] == {**dict.fromkeys(table.COLUMNS, 1), "IRFA": 0}
        assert (row["status"], row["note"]) == ("finished", "")
        assert "groups" not in row["runs"][0]["evaluation"]
    json.dumps(content)


def test_the_caption_says_under_what_conditions(tmp_path):
    runs = runs_of(tmp_path)
    for run in runs:
        finish(run)
    caption = table.collect(runs, {})["caption"]
    for words in (
        "9 clips (builtin)", "192 samples", "seed 0", "8 evaluation tasks", "nine other clips", "4,000,000,000",
        "460,278", "Ours 2 of 34", "One run per row: no interval, and no difference",
    ):  # fmt: skip
        assert words in caption


def test_mean_over_seeds(tmp_path):
    runs = runs_of(tmp_path, ["ours"], seeds=(0, 1))
    finish(runs[0], shift=0.0, MS=-3.3, IRFA=10)
    finish(runs[1], shift=1.0, MS=-3.7, IRFA=None)
    content = table.collect(runs, {})
    (row,) = content["rows"]
    assert row["measured"]["FRPD"] == 1.5
    assert row["intervals"]["FRPD"] == [1.0, 2.0]  # all that two runs can span
    assert row["measured"]["MS"] == -3.7  # the noise that every seed bears
    assert row["intervals"]["MS"] is None  # a minimum is no mean
    assert row["measured"]["IRFA"] is None and row["intervals"]["IRFA"] is None  # one seed never came there
    assert (row["runs_behind"]["FRPD"], row["runs_behind"]["IRFA"], row["runs_behind"]["MS"]) == (2, 1, 2)
    assert "Ours: 1 of 2 runs came to the final accuracy, hence no IRFA" in content["notes"]
    assert "seeds 0, 1 (mean)" in content["caption"] and "too narrow for so few" in content["caption"]


def test_no_interval_and_no_mark_with_one_run_however_far_apart(tmp_path):
    runs = runs_of(tmp_path)
    for number, run in enumerate(runs):
        finish(run, shift=100.0 * number)
    for row in table.collect(runs, {})["rows"]:
        for prefix in ("", "trained_"):
            assert set(row[f"{prefix}intervals"].values()) == {None}
            assert set(row[f"{prefix}differs"].values()) == {False}


@pytest.mark.parametrize("seeds, supported", [(3, False), (5, True)])
def test_a_difference_is_marked_once_enough_runs_support_it(tmp_path, seeds, supported):
    runs = runs_of(tmp_path, ["ours", "no_sbc", "no_tr"], seeds=range(seeds))
    for run in runs:
        shift = {"ours": 0.0, "no_sbc": 5.0, "no_tr": 0.05}[run.config.row]
        finish(run, shift=shift + 0.1 * run.config.seed)
    content = table.collect(runs, {})
    ours, no_sbc, no_tr = content["rows"]
    for prefix in ("", "trained_"):
        assert not any(ours[f"{prefix}differs"].values())  # the row that they are compared with
        assert not any(no_tr[f"{prefix}differs"].values())
        assert no_sbc[f"{prefix}differs"]["FRPD"] is supported
        assert no_sbc[f"{prefix}differs"]["TTAR"] is False  # the same in all runs
    words = "*: differs from Ours" if supported else "No difference from Ours can be supported by fewer than 4 runs"
    assert words in content["caption"]


def test_failed_missing_and_short_runs_say_so(tmp_path):
    runs = runs_of(tmp_path)
    finish(runs[0])
    finish(runs[1], iterations=2)
    (runs[3].folder).mkdir()
    (runs[3].folder / "metrics.jsonl").write_text('{"iteration": 1}\n')
    content = table.collect(runs, {"no_urp-seed0": "ValueError: no good"})
    assert [row["note"] for row in content["rows"]] == ["", "after 2 of 3 iterations", "failed", "missing"]
    assert [row["status"] for row in content["rows"]] == ["finished", "short", "failed", "missing"]
    assert content["notes"] == [
        "no_sbc-seed0: short: evaluated after 2 of 3 iterations",
        "no_urp-seed0: failed: ValueError: no good",
        "no_tr-seed0: missing: not run to its end (1 of 3 iterations)",
    ]
    assert content["rows"][1]["measured"]["FRPD"] == 1.0 and content["rows"][2]["measured"] is None


def test_short_and_failed_runs_stand_behind_no_mean_of_finished_ones(tmp_path):
    runs = runs_of(tmp_path, ["ours"], seeds=(0, 1, 2))
    finish(runs[0])
    finish(runs[2], shift=9.0, iterations=1)
    content = table.collect(runs, {"ours-seed1": "died"})
    (row,) = content["rows"]
    assert row["measured"]["FRPD"] == 1.0 and row["runs_behind"]["FRPD"] == 1
    assert row["note"] == "1 of 3 runs"
    assert [note.split(":")[1] for note in content["notes"]] == [" failed", " short"]


def test_a_row_that_missed_its_budget_is_compared_with_none(tmp_path):
    runs = runs_of(tmp_path, ["ours", "no_sbc"], seeds=range(5))
    for run in runs:
        short = run.config.row == "no_sbc"
        finish(run, shift=9.0 * short + 0.1 * run.config.seed, iterations=2 if short else 3)
    row = table.collect(runs, {})["rows"][1]
    assert row["intervals"]["FRPD"] and not any(row["differs"].values())


def test_evaluations_with_and_without_their_deterministic_part(tmp_path):
    runs = runs_of(tmp_path, ["ours"], seeds=(0, 1))
    quiet = {column: 0.25 for column in table.COLUMNS}
    finish(runs[0], deterministic=quiet)
    finish(runs[1], deterministic=quiet)
    assert table.collect(runs, {})["rows"][0]["deterministic"]["TTAR"] == 0.25
    finish(runs[1])
    assert table.collect(runs, {})["rows"][0]["deterministic"] is None


def test_rows_of_ones_own_have_no_paper_and_need_no_reference(tmp_path):
    runs = runs_of(tmp_path, ["mine", "other"], seeds=range(5))
    for run in runs:
        finish(run, shift=run.config.seed)
    content = table.collect(runs, {})
    assert [row["paper"] for row in content["rows"]] == [None, None]
    assert not any(any(row["differs"].values()) for row in content["rows"])
    assert "differs" not in content["caption"]


def test_the_same_runs_give_the_same_table(tmp_path):
    runs = runs_of(tmp_path, ["ours", "no_tr"], seeds=range(4))
    for run in runs:
        finish(run, shift=0.37 * run.config.seed**2)
    assert table.collect(runs, {}) == table.collect(runs, {})
