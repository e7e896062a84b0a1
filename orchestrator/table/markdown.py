"""The table as Markdown, which is also what the terminal shows."""

import textwrap

from orchestrator.table.columns import COLUMNS
from orchestrator.table.lines import TITLES, lines_of


def markdown(content):
    """The two tables, caption and notes."""
    out = []
    for part, title in TITLES.items():
        rows = [[line.method, *line.cells(), line.runs] for line in lines_of(content, part)]
        out += [f"{title}:", ""] * bool(out) + grid(["Method", *COLUMNS, "Runs"], rows) + [""]
    out += textwrap.wrap(content["caption"], 120)
    out += [""] * bool(content["notes"]) + [f"* {note}" for note in content["notes"]]
    return "\n".join(out) + "\n"


def grid(header, rows):
    """A Markdown table with aligned columns."""
    widths = [max(len(line[i]) for line in [header, *rows]) for i in range(len(header))]

    def line(values):
        rest = (value.rjust(width) for value, width in zip(values[1:], widths[1:], strict=True))
        return "| " + " | ".join([values[0].ljust(widths[0]), *rest]) + " |"

    rule = "|" + "|".join("-" * (w + 2) if i == 0 else "-" * (w + 1) + ":" for i, w in enumerate(widths)) + "|"
    return [line(header), rule, *map(line, rows)]
