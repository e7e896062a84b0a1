"""Draws the pictures of docs/onehop.md from the built-in clips: `python docs/make_onehop_figures.py [--out FOLDER]`.

The pictures are those of the report (`python -m motion.onehop report`), in its light colours.
"""

import argparse
import re
from pathlib import Path

import numpy as np

from motion import builtin
from motion.onehop import figures
from motion.onehop.clips import ClipSet
from motion.onehop.report import SPACING, STYLE
from motion.onehop.report_data import BARS, distance_map, study
from motion.onehop.types import SearchConfig


def standalone(svg):
    """The text of an SVG file: fixed colours and size, white behind."""
    light = dict(re.findall(r"--(\w+): (#\w+)", STYLE.split("@media")[0]))
    svg = re.sub(r"var\(--(\w+)\)", lambda match: light[match[1]], svg)
    head, _, rest = svg.partition(">")
    width = re.search(r"--width:(\d+)px", head)[1]
    head = re.sub(r' style="[^"]*"', "", head)
    return f'{head} width="{width}">\n<rect width="100%" height="100%" fill="#ffffff"/>{rest}\n'


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parent / "images")
    out = parser.parse_args().out
    clips = ClipSet.from_clips([builtin.load(name) for name in builtin.NAMES], 60)
    found = study(clips, "all", SearchConfig())
    case = dict(found.cases)["feet"]
    rows = [
        (f"{kind}: cost {case.cost[kind]:.3f} m², {case.played[kind].arrival:.2f} s", case.played[kind])
        for kind in ("direct", "one-hop")
    ]
    chosen = [found.triggers[i] for i in np.unique(np.linspace(0, len(found.triggers) - 1, BARS).astype(int))]
    bars = [{"direct": t.cost["direct"], "one": t.parts["one-hop"], "two": t.parts["two-hop"]} for t in chosen]
    pair = [clips.index(name) for name in (case.source, case.destination)]
    values, first, second = distance_map(clips, *pair, found.tables["one-hop"].config)
    extent = (0, second[-1] / clips.fps, 0, first[-1] / clips.fps)
    pictures = {
        "onehop_strip": figures.film_strip("strip", rows, SPACING),
        "onehop_costs": figures.cost_bars("bars", bars),
        "onehop_distance": figures.distance_map("map", values, extent, (case.destination, case.source)),
    }
    for name, svg in pictures.items():
        (out / f"{name}.svg").write_text(standalone(svg), encoding="utf-8")
    print(f"{case.source} at {case.frame / clips.fps:.2f} s to {case.destination}")


if __name__ == "__main__":
    main()
