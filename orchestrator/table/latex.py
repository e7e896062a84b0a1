r"""The table as LaTeX: a `table*` for \input, with the packages booktabs and (for the caption's symbols) none else."""

import re

from orchestrator.table.columns import COLUMNS, HIGHER
from orchestrator.table.lines import HIGH, LOW, PAPER, TITLES, VALUE, lines_of

SPECIAL = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": "$<$", ">": "$>$", "|": "$|$",
}  # fmt: skip
STYLES = {VALUE: "{}", LOW: r"\scriptsize {}", HIGH: r"\scriptsize {}", PAPER: r"\itshape {}"}


def latex(content):
    r"""One `table*` with both parts; needs \usepackage{booktabs}."""
    width = len(COLUMNS) + 2
    arrows = [f"{column} $\\{'uparrow' if column in HIGHER else 'downarrow'}$" for column in COLUMNS]
    out = [
        "% \\usepackage{booktabs}", "\\begin{table*}[t]", "\\centering", "\\footnotesize",
        "\\setlength{\\tabcolsep}{3pt}", f"\\caption{{{escape(caption(content))}}}", "\\label{tab:ablation}",
        f"\\begin{{tabular}}{{l*{{{width - 1}}}{{r}}}}", "\\toprule",
        line(["Method", *arrows, "Runs"]),
    ]  # fmt: skip
    for part, title in TITLES.items():
        out += ["\\midrule", f"\\multicolumn{{{width}}}{{l}}{{{escape(title)}}} \\\\"]
        for each in lines_of(content, part):
            cells = [escape(each.method.strip()), *map(number, each.cells()), each.runs]
            out.append(line([STYLES[each.kind].format(text) if text else "" for text in cells]))
    out += ["\\bottomrule", "\\end{tabular}", "\\end{table*}"]
    return "\n".join(out) + "\n"


def line(cells):
    """A line of a tabular."""
    return " & ".join(cells) + " \\\\"


def caption(content):
    """The caption with the notes."""
    return " ".join([content["caption"], *(f"{note}." for note in content["notes"])])


def number(text):
    """A cell's text: powers and minus signs as mathematics, the mark raised."""
    if match := re.fullmatch(r"e\^(-?[\d.]+)", text):
        return f"$e^{{{match[1]}}}$"
    text, mark = text.removesuffix("*"), "$^{*}$" if text.endswith("*") else ""
    return "--" if text == "-" else text.replace("-", "$-$") + mark


def escape(text):
    """Text with LaTeX's special characters as themselves."""
    return "".join(SPECIAL.get(character, character) for character in text)
