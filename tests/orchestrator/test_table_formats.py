"""Markdown, CSV, LaTeX, HTML and JSON of one table: the same numbers, each format well formed."""

import csv
import json
import re
from html.parser import HTMLParser

import pytest

from orchestrator import table
from tests.orchestrator.test_table import ROWS, finish, runs_of

PAPER_OURS = [
    "0.0038", "0.6556", "0.1677", "0.0513", "0.1071", "3.2404", "-0.1677", "71.90", "12.02", "e^-3.7", "1.000",
    "10362", "5.4027",
]  # fmt: skip


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """(content, {suffix: text}) of four rows: five runs, one of them failed; short; odd names; with a mark."""
    folder = tmp_path_factory.mktemp("table")
    runs = runs_of(folder, seeds=range(5))
    for run in runs:
        finish(run, shift=3.0 * (run.config.row == "no_sbc") + 0.1 * run.config.seed,
               iterations=2 if run.config.row == "no_tr" else 3)  # fmt: skip
    content = table.collect(runs, {"no_urp-seed3": "ValueError: 50 % of {a_b} & <c> ~ #1 \\ $5 ^"})
    paths = table.write(folder, content)
    assert sorted(path.name for path in paths) == [f"table.{s}" for s in ("csv", "html", "json", "md", "tex")]
    return content, {path.suffix[1:]: path.read_text() for path in paths}


def markdown_rows(text):
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("|")]


def test_markdown(made):
    content, texts = made
    rows = markdown_rows(texts["md"])
    assert rows[0] == ["Method", *table.COLUMNS, "Runs"] and {len(row) for row in rows} == {15}
    found = {}
    for row in rows:
        found.setdefault(row[0], []).append(row[1:])
    assert found["Ours (paper)"] == [[*PAPER_OURS, "1"]]
    assert len(found["Ours"]) == 2 and found["Ours"][0][0] == "1.2000" and found["Ours"][0][-1] == "5"
    assert found["No SBC"][0][0] == "4.2000*"  # differs
    assert found["No URP (4 of 5 runs)"][0][-1] == "4"
    assert found["No TR (after 2 of 3 iterations)"]
    assert len(found["95 % from"]) == len(found["95 % to"]) == 8
    assert "* no_urp-seed3: failed: ValueError" in texts["md"] and "4,000,000,000" in texts["md"]
    assert all(len(line) <= 120 for line in texts["md"].split("Conditions:")[1].splitlines()[:3])


def test_csv(made):
    content, texts = made
    lines = list(csv.DictReader(texts["csv"].splitlines()))
    of = {(line["row"], line["source"]): line for line in lines}
    assert len(of) == len(lines)
    assert [line["row"] for line in lines if line["source"] == "paper"] == list(ROWS)
    assert float(of["ours", "measured"]["FRPD"]) == pytest.approx(1.2) and of["ours", "measured"]["IRFA"] == ""
    assert float(of["ours", "measured_low"]["FRPD"]) < 1.2 < float(of["ours", "measured_high"]["FRPD"])
    assert (of["no_sbc", "measured_differs"]["FRPD"], of["no_sbc", "measured_differs"]["TTAR"]) == ("true", "false")
    assert of["no_urp", "trained"]["runs"] == "4" and of["no_urp", "trained"]["seeds"] == "0 1 2 4"
    assert of["no_urp", "measured"]["status"] == "failed; finished" and of["no_tr", "measured"]["status"] == "short"


def test_json_is_the_content(made):
    content, texts = made
    assert json.loads(texts["json"]) == json.loads(json.dumps(content))


def test_latex_is_well_formed(made):
    """No LaTeX runs here: braces, environments, columns of every line, no special character that is not meant."""
    text = made[1]["tex"]
    body = "\n".join(line for line in text.splitlines() if not line.startswith("%"))
    depth = 0
    for brace in re.findall(r"(?<!\\)[{}]", body):
        depth += 1 if brace == "{" else -1
        assert depth >= 0
    assert depth == 0
    assert re.findall(r"\\(begin|end)\{([\w*]+)\}", body) == [
        ("begin", "table*"), ("begin", "tabular"), ("end", "tabular"), ("end", "table*")
    ]  # fmt: skip
    assert len(re.findall(r"(?<!\\)\$", body)) % 2 == 0
    inside = body.split("\\toprule")[1].split("\\bottomrule")[0]
    lines = [line for line in inside.splitlines() if "&" in line]
    assert all(len(re.findall(r"(?<!\\)&", line)) == 14 and line.endswith(r" \\") for line in lines)
    assert len(lines) == 1 + 2 * 4 * 3 + 4  # head; twice four rows with two lines of interval; the paper's
    assert [rule for rule in re.findall(r"\\(\w+rule)", body)] == ["toprule", "midrule", "midrule", "bottomrule"]
    outside_maths = re.sub(r"(?<!\\)\$[^$]*\$", "", body)
    assert not re.search(r"(?<!\\)[#_^~%<>]", outside_maths)
    assert r"50 \% of \{a\_b\} \& $<$c$>$ \textasciitilde{} \#1 \textbackslash{} \$5 \textasciicircum{}" in body
    assert "$e^{-3.7}$" in body and "$-$0.1677" in body and "4.2000$^{*}$" in body


class Outline(HTMLParser):
    """Checks that tags nest; keeps the cells of each table's rows and what would be fetched."""

    def __init__(self):
        super().__init__()
        self.open, self.tables, self.fetched = [], [], []

    def handle_starttag(self, tag, attributes):
        self.fetched += [value for name, value in attributes if name in ("src", "href") and value != "data:,"]
        if tag not in ("meta", "link", "br"):
            self.open.append(tag)
        if tag == "table":
            self.tables.append([])
        if tag == "tr":
            self.tables[-1].append([])
        if tag in ("td", "th"):
            self.tables[-1][-1].append("")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and {"td", "th"} & set(self.open) and "small" not in self.open:
            self.tables[-1][-1][-1] += data


def test_html_is_well_formed_and_alone(made):
    outline = Outline()
    outline.feed(made[1]["html"])
    assert outline.open == [] and outline.fetched == [] and "<script" not in made[1]["html"]
    final, trained = outline.tables
    assert {len(row) for row in final + trained} == {15} and (len(final), len(trained)) == (9, 5)
    assert final[2] == ["paper", *PAPER_OURS, "1"] and final[3][1] == "4.2000*"
    assert "{a_b} &amp; &lt;c&gt;" in made[1]["html"]
    assert table.fragment(made[0]) in made[1]["html"]


def test_a_table_without_any_run(tmp_path):
    runs = runs_of(tmp_path)
    content = table.collect(runs, {"ours-seed0": "died"})
    table.write(tmp_path, content)
    rows = markdown_rows((tmp_path / "table.md").read_text())
    assert rows[2] == ["Ours (failed)", *[""] * 13, "0"] and rows[4][0] == "No SBC (missing)"
