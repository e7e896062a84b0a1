"""The table as HTML: a fragment for the report, and a page of its own. No script, nothing from elsewhere."""

from html import escape

from motion.page import document, style
from orchestrator.table.columns import COLUMNS, HIGHER, MEANINGS, cell
from orchestrator.table.lines import CAME_FROM, PREFIXES, TITLES

# besides what `motion.page` has for every table
STYLE = """
.results { overflow-x: auto; margin: 1em 0; }
.results caption { text-align: left; font-weight: 600; padding-bottom: .4em; }
.results th, .results td { vertical-align: top; white-space: nowrap; border-bottom: none; }
.results tr.row > * { border-top: 1px solid var(--grid); }
.results th:first-child { position: sticky; left: 0; background: var(--paper); }
.results small { display: block; color: var(--faint); font-weight: normal; }
.results tr.paper > * { color: var(--faint); font-style: italic; font-weight: normal; }
.results .differs { font-weight: 700; }
"""


def page(content, title="Results"):
    """A page of its own."""
    sheet = style("", "", STYLE + "body { max-width: 100rem; }\n")
    return document(title, sheet, [f"<h1>{escape(title)}</h1>", fragment(content)])


def fragment(content):
    """Both tables, caption and notes, to stand in a page of `motion.page.style` with `STYLE`."""
    out = [table(content, part, title) for part, title in TITLES.items()]
    out.append(f"<p>{escape(content['caption'])}</p>\n")
    if content["notes"]:
        out.append("<ul>\n" + "".join(f"<li>{escape(note)}</li>\n" for note in content["notes"]) + "</ul>\n")
    return "".join(out)


def table(content, part, title):
    """One part's table."""
    head = "".join(
        f'<th scope="col" title="{escape(MEANINGS[column])}">{column} {"↑" if column in HIGHER else "↓"}</th>'
        for column in COLUMNS
    )
    body = []
    for row in content["rows"]:
        note = f"<small>{escape(row['note'])}</small>" if row["note"] else ""
        cells = "".join(value(row, part, column) for column in COLUMNS)
        runs = row["runs_behind"]["FRPD"]
        body.append(f'<tr class="row"><th scope="row">{escape(row["method"])}{note}</th>{cells}<td>{runs}</td></tr>\n')
        if CAME_FROM[part] and row["paper"]:
            cells = "".join(f"<td>{cell(column, row['paper'][column])}</td>" for column in COLUMNS)
            body.append(f'<tr class="paper"><th scope="row">paper</th>{cells}<td>1</td></tr>\n')
    return (
        f'<div class="results"><table>\n<caption>{escape(title)}</caption>\n'
        f'<thead><tr><th scope="col">Method</th>{head}<th scope="col">Runs</th></tr></thead>\n'
        f"<tbody>\n{''.join(body)}</tbody>\n</table></div>\n"
    )


def value(row, part, column):
    """One cell of ours: mean, mark, and the interval below."""
    if row[part] is None:
        return "<td></td>"
    prefix = PREFIXES[part]
    pair, differs = row[f"{prefix}intervals"][column], row[f"{prefix}differs"][column]
    below = f"<small>{'<br>'.join(cell(column, end) for end in pair)}</small>" if pair else ""
    kind = ' class="differs"' if differs else ""
    return f"<td{kind}>{cell(column, row[part][column])}{'*' * differs}{below}</td>"
