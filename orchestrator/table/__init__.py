"""The table of a sweep, beside the paper's Table 1: Markdown, CSV, LaTeX, HTML and JSON. docs/table.md explains it."""

import json
from pathlib import Path

from learner.storage import replace_file
from orchestrator.table.columns import COLUMNS, METHODS, PAPER, cell
from orchestrator.table.content import collect
from orchestrator.table.delimited import comma_separated
from orchestrator.table.html_page import fragment, page
from orchestrator.table.latex import latex
from orchestrator.table.markdown import markdown

__all__ = [
    "COLUMNS", "METHODS", "PAPER", "cell", "collect", "comma_separated", "fragment", "latex", "markdown", "page",
    "write",
]  # fmt: skip


def write(out, content):
    """Write table.md, .csv, .tex, .html and .json into a sweep's folder; returns their paths."""
    texts = {
        "md": markdown(content),
        "csv": comma_separated(content),
        "tex": latex(content),
        "html": page(content),
        "json": json.dumps(content, indent=2) + "\n",
    }
    paths = []
    for suffix, text in texts.items():
        path = Path(out) / f"table.{suffix}"
        replace_file(path, text.encode())
        paths.append(path)
    return paths
