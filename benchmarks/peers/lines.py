"""How many lines a user of each library writes."""

import tokenize
from pathlib import Path

_LAYOUT = {
    tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENCODING,
    tokenize.ENDMARKER,
}  # fmt: skip


def count_lines(path):
    """Lines of a file that are not blank, comment or docstring; of a text file, those that are not blank or comment."""
    path = Path(path)
    if path.suffix != ".py":
        return len(arguments(path))
    with open(path, "rb") as file:
        tokens = list(tokenize.tokenize(file.readline))
    lines, begins = set(), True
    for token in tokens:
        if token.type == tokenize.NEWLINE:
            begins = True
        elif token.type not in _LAYOUT:
            if not (begins and token.type == tokenize.STRING):
                lines.update(range(token.start[0], token.end[0] + 1))
            begins = False
    return len(lines)


def arguments(path):
    """The lines of a text file that are not blank or comment."""
    lines = (line.strip() for line in Path(path).read_text().splitlines())
    return [line for line in lines if line and not line.startswith("#")]
