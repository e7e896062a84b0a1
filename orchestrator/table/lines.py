"""The table's lines in the order in which every text format shows them."""

from dataclasses import dataclass

from orchestrator.table.columns import COLUMNS, cell

VALUE, LOW, HIGH, PAPER = "value", "low", "high", "paper"
TITLES = {"measured": "At the final accuracy", "trained": "At the thresholds that training reached"}
PREFIXES = {"measured": "", "trained": "trained_"}
CAME_FROM = {"measured": True, "trained": False}  # whether the paper has such numbers


@dataclass(frozen=True)
class Line:
    """kind: of whose numbers. method: the first cell. values, marks: by column. runs: text of the last cell."""

    kind: str
    method: str
    values: dict
    marks: dict
    runs: str = ""

    def cells(self, mark="*"):
        """The 13 cells as text, empty where there is no number to expect."""
        if self.values is None:
            return [""] * len(COLUMNS)
        empty = self.kind in (LOW, HIGH)
        return [
            "" if empty and self.values[column] is None
            else cell(column, self.values[column]) + mark * self.marks.get(column, False)
            for column in COLUMNS
        ]  # fmt: skip


def lines_of(content, part):
    """[Line] of one part: per row its means, where there are several runs the interval, then the paper's row."""
    found = []
    for row in content["rows"]:
        intervals, marks = row[f"{PREFIXES[part]}intervals"], row[f"{PREFIXES[part]}differs"]
        method = row["method"] + (f" ({row['note']})" if row["note"] else "")
        found.append(Line(VALUE, method, row[part], marks, str(row["runs_behind"]["FRPD"])))
        if any(intervals.values()):
            for kind, end, words in ((LOW, 0, "from"), (HIGH, 1, "to")):
                values = {column: pair and pair[end] for column, pair in intervals.items()}
                found.append(Line(kind, f"  95 % {words}", values, {}))
        if CAME_FROM[part] and row["paper"]:
            found.append(Line(PAPER, f"{row['method']} (paper)", row["paper"], {}, "1"))
    return found
