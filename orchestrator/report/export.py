"""The report's figures as files, for documents: SVG curves, WebP strips and videos."""

import re
from html import escape
from pathlib import Path

from learner.storage import replace_file
from motion import page
from orchestrator.folder import check_writable
from orchestrator.report import charts
from orchestrator.report.style import LIGHT_OWN

WIDER = 1.4  # times as large as in the page


def export(folder, sweep, films, pictures):
    """Write them into `folder`, made if it is not there; returns their paths. InputError if it cannot be written.

    Names: return-AXIS.svg, reductions-AXIS.svg, rotation.svg, accuracy.svg, stripN-METHOD, videoN, worstN (.webp, or
    .svg for stick figures). sweep: `data.SweepData`; films: `assembly.Films`; pictures: {name: SVG}.
    """
    folder = Path(folder).expanduser()
    check_writable(folder)
    labels = [sweep.methods[row] for row in sweep.rows]
    files = {f"{name}.svg": alone(svg, labels).encode() for name, svg in pictures.items()}
    for number, (_, rows) in enumerate(films.strips):
        for title, picture, _ in rows:
            name = f"strip{number}-{title.partition(':')[0].lower()}"
            rendered = isinstance(picture, bytes)
            files[f"{name}.{'webp' if rendered else 'svg'}"] = picture if rendered else alone(picture).encode()
    counts = {}
    for _, picture, _, bad in films.videos:
        kind = "worst" if bad else "video"
        counts[kind] = counts.get(kind, -1) + 1
        files[f"{kind}{counts[kind]}.webp"] = picture
    for name, content in files.items():
        replace_file(folder / name, content)
    return [folder / name for name in files]


def alone(svg, labels=()):
    """An SVG of the page as a file: with the page's light colours on white, and with a legend of rows below."""
    values = " ".join((page.LIGHT, LIGHT_OWN, *(f"--row{i}: {value};" for i, value in enumerate(charts.LIGHT))))
    for name, value in re.findall(r"--(\w+): (#\w+)", values):
        svg = svg.replace(f"var(--{name})", value)
    width, height = map(float, re.search(r'viewBox="0 0 ([\d.]+) ([\d.]+)"', svg).groups())
    more, marks, at = 14.0 if labels else 0.0, [], 6.0
    for number, label in enumerate(labels):
        colour = charts.LIGHT[number % charts.ROWS]
        marks.append(
            f'<rect x="{at:g}" y="{height + 3:g}" width="12" height="4" fill="{colour}"/>'
            f'<text x="{at + 15:g}" y="{height + 8:g}" style="font: 8px sans-serif">{escape(label)}</text>'
        )
        at += 24 + 5 * len(label)
    svg = re.sub(r'viewBox="[^"]*"', f'viewBox="0 0 {width:g} {height + more:g}"', svg, count=1)
    svg = re.sub(r' style="--width:[^"]*"', f' width="{WIDER * width:.0f}"', svg, count=1)
    head, _, rest = svg.partition(">")
    background = '<rect width="100%" height="100%" fill="#ffffff"/>'
    return f"{head}>\n{background}{rest[: rest.rindex('</svg>')]}{''.join(marks)}</svg>\n"
