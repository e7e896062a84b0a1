"""Pictures of a page as SVG text whose colours are the page's: they follow its light and dark theme.

matplotlib draws with placeholder colours, which are then replaced by CSS variables (`var(--ink)` ...).
"""

import io
import re
from contextlib import contextmanager

COMMON = ("ink", "faint", "grid", "paper")  # variables that every page has: text, axes, grid lines, background


def palette(*names):
    """{variable: placeholder colour} of a page's `COMMON` variables and `names`: what to draw with."""
    return {name: f"#0102{number:02x}" for number, name in enumerate((*COMMON, *names), start=3)}


def style(colours):
    """matplotlib's settings for small pictures in a page, for a `palette`."""
    ink, faint = colours["ink"], colours["faint"]
    return {
        "svg.fonttype": "none", "font.family": "sans-serif", "font.size": 9, "axes.titlesize": 9, "axes.labelsize": 9,
        "xtick.labelsize": 8, "ytick.labelsize": 8, "legend.fontsize": 8, "legend.frameon": False,
        "text.color": ink, "axes.edgecolor": faint, "axes.labelcolor": ink, "xtick.color": faint, "ytick.color": faint,
        "xtick.labelcolor": ink, "ytick.labelcolor": ink, "grid.color": colours["grid"], "axes.spines.top": False,
        "axes.spines.right": False, "axes.axisbelow": True, "lines.linewidth": 1.3, "path.simplify": True,
    }  # fmt: skip


@contextmanager
def drawing(colours, name, title, width, height, **keywords):
    """(figure, axes, out), out["svg"] afterwards. name: unique on the page. title: for screen readers. Inches.

    colours: the page's `palette`. keywords: of matplotlib's `Figure.subplots`.
    """
    import matplotlib  # only a report needs it

    with matplotlib.rc_context({**matplotlib.rcParamsDefault, **style(colours), "svg.hashsalt": name, "svg.id": name}):
        from matplotlib.backends.backend_svg import FigureCanvasSVG
        from matplotlib.figure import Figure

        figure, out = Figure(figsize=(width, height), layout="constrained"), {}
        FigureCanvasSVG(figure)
        yield figure, figure.subplots(**keywords), out
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
        out["svg"] = _inline(buffer.getvalue(), colours, title, width)


def _inline(text, colours, title, width):
    """The svg element of an SVG file, with the page's colours and without the ids that nothing refers to."""
    text = text[text.index("<svg") :]
    used = set(re.findall(r'#([^")]+)[")]', text))
    text = re.sub(r' id="([^"]+)"', lambda match: match[0] if match[1] in used else "", text)
    text = re.sub(r"<metadata>.*?</metadata>\s*", "", text, flags=re.S)
    text = re.sub(r"<!--.*?-->\s*", "", text, flags=re.S)
    for variable, colour in colours.items():
        text = text.replace(colour, f"var(--{variable})")
    # an element's size is the page's affair; its shape is in the viewBox
    head, _, rest = text.partition(">")
    head = re.sub(r' (width|height)="[^"]*"', "", head)
    return f'{head} role="img" aria-label="{title}" style="--width:{width * 96:.0f}px">{rest}'
