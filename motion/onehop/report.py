"""The report: one HTML page without links to anything outside, readable on a phone, in light and dark."""

import html
from dataclasses import replace

import numpy as np

from motion.onehop import figures
from motion.onehop.report_data import BARS, KINDS, TRADE_OFF_PAIRS, distance_map, effects, trigger
from motion.onehop.report_measures import JUMP_TIME, foot_speed
from motion.onehop.search import build
from motion.page import data_table, document, figure, style

SPACING = 0.15  # s between two figures of a film strip
STRIP_WEIGHTS = (10.0, 1.0, 0.1)  # Fig. 11, from responsive to smooth

STYLE = style(
    """--source: #0f8f9c; --hop: #c98a00; --second: #7a6ff0; --destination: #c2388f;
  --direct: #8a939c; --onehop: #1f6fd1; --twohop: #1f9d62; --wait: #e07b39;""",
    """--source: #45c7d4; --hop: #f0b52e; --second: #a79cff; --destination: #f06cbd;
  --direct: #99a3ad; --onehop: #5ea3f7; --twohop: #4ccb8d; --wait: #f39a5d;""",
)


def page(study, name):
    """The whole page (text) of a `report_data.Study`; name: what the set of clips is called."""
    sections = [_head(study, name), _costs(study)]
    if study.triggers:
        sections += [_strips(study), _weights(study), _distances(study)]
    return document(f"One-hop transitions: {name}", STYLE, sections)


def _head(study, name):
    clips, table, total = study.clips, study.tables["one-hop"], study.summary
    config = table.config
    seconds = sum(clip.duration for clip in clips.clips)
    regime = {
        "start": "the destination's first frame is at the trigger (<i>start</i>)",
        "fixed": "source and destination keep one offset per pair (<i>fixed</i>)",
    }[config.regime]
    one, two = total["one-hop"], total["two-hop"]
    return f"""<h1>One-hop transitions: {html.escape(name)}</h1>
<p>{len(clips)} clips, {seconds:.1f} s at {clips.fps:g} frames per second; {len(table.pairs)} pairs,
{total["triggers"]} trigger frames. Blends of {config.blend} frames, stays of up to {config.max_stay}; {regime};
w = {study.weight:.3g} m² per frame. D is the mean squared distance of the 17 body points after the best horizontal
alignment of both windows, m².</p>
<p>In the mean, the best one-hop transition costs {_percent(1 - one["cost"] / total["direct"]["cost"])} less than the
direct one, two hops {_percent(1 - two["cost"] / total["direct"]["cost"])} less.
{total["without"]} triggers have no candidate (the clip ends too soon); {total["compared"]} have a direct and a one-hop
transition and are compared below.</p>"""


def _costs(study):
    total = study.summary
    lines = [
        ("cost S + wR, m²", "cost", "{:.4f}"), ("S, m²", "smooth", "{:.4f}"), ("time to arrival, s", "time", "{:.2f}"),
        ("better than direct", "better", None), ("cost, hops charged, m²", "charged", "{:.4f}"),
        ("better, hops charged", "charged_better", None),
    ]  # fmt: skip
    rows = []
    for words, key, form in lines:
        numbers = [total[kind].get(key) for kind in KINDS]
        shown = ["–" if x is None else form.format(x) if form else _percent(x) for x in numbers]
        rows.append([words, *shown])
    out = f"""<h2>Cost</h2>
{data_table(["", *KINDS], rows)}
<p>Means over all triggers. The paper's R counts only the frames that a clip is played alone. <i>Charged</i>: every
further blend costs w b too, as if its frames were waited; where the direct transition is then cheaper, it is taken.
{_percent(total["two-hop"]["second"])} of the two-hop optima use a second hop.</p>"""
    if not study.triggers:
        return out + "<p>No trigger has both a direct and a one-hop transition: the clips are too short.</p>"
    chosen = [study.triggers[i] for i in np.unique(np.linspace(0, len(study.triggers) - 1, BARS).astype(int))]
    bars = figures.cost_bars(
        "bars", [{"direct": t.cost["direct"], "one": t.parts["one-hop"], "two": t.parts["two-hop"]} for t in chosen]
    )
    names = "; ".join(f"{i + 1}: {_trigger_words(t, study.clips.fps)}" for i, t in enumerate(chosen))
    case = study.cases[0][1]
    table = study.tables["one-hop"]
    pair = (study.clips.index(case.source), study.clips.index(case.destination))
    here = table.first[pair] + np.arange(study.clips.period(pair[0]))
    curves = {
        "direct": table.result.direct[here], "one-hop": table.result.cost[here],
        "two-hop": study.tables["two-hop"].result.cost[here],
    }  # fmt: skip
    curve = figures.cost_curves("curve", np.arange(len(here)) / study.clips.fps, curves)
    return f"""{out}
<div class="side">
{figure(bars, "A few triggers, evenly spread over all (the paper's Fig. 10).")}
{figure(curve, f"Every trigger frame of {html.escape(case.source)} → {html.escape(case.destination)}.")}
</div>
<details><summary>Which triggers</summary><p>{names}.</p></details>"""


def _strips(study):
    out = ["<h2>Film strips</h2>", _legend()]
    out.append(
        "<p>Seen by a camera that goes with the character. Below each row: how much of which clip is shown, and seconds"
        " after the trigger (the tick). The two triggers are picked from those played below: the one whose root a hop"
        " spares the largest jump of velocity, and, of another pair, the one whose planted feet it spares the longest"
        " slide.</p>"
    )
    for key, case in study.cases:
        kinds = KINDS if case.played["two-hop"].legs != case.played["one-hop"].legs else KINDS[:2]
        rows = [(_strip_title(kind, case), case.played[kind]) for kind in kinds]
        strip = figures.film_strip(f"strip-{key}", rows, SPACING)
        feet = figures.speeds(
            f"feet-{key}",
            {kind: (case.played[kind].time[1:], foot_speed(case.played[kind])) for kind in ("direct", "one-hop")},
        )
        out.append(f"<h3>{_trigger_words(case, study.clips.fps)}</h3>")
        out.append(figure(strip, "", scroll=True))
        out.append(
            f'<div class="side">{figure(feet, "Horizontal speed of planted ankles.")}<div>{_effects(effects([case]))}'
        )
        out.append("</div></div>")
    out.append(
        f"<h3>All {len(study.triggers)} played triggers, means</h3>{_effects(study.effects)}"
        "<p>A foot counts as planted where the clip with the larger share has it so (ankle below 0.10 m and slower than"
        " 0.4 m/s). Speed and slide are taken in the blends only: alone, a clip does what was captured. Jump: largest"
        f" change of the root's velocity within {JUMP_TIME:g} s, of which captured motion has some itself. Added:"
        " largest speed of the root that comes from neither clip but from the crossfade between them.</p>"
    )
    return "\n".join(out)


def _effects(means):
    rows = [
        [kind, f"{speed:.3f}", f"{100 * slide:.1f}", f"{jump:.2f}", f"{added:.2f}"]
        for kind, (speed, slide, jump, added) in means.items()
    ]
    return data_table(["", "planted feet, m/s", "slide, cm", "root's jump, m/s", "root, added, m/s"], rows)


def _weights(study):
    case = study.cases[0][1]
    clips, base = study.clips, study.tables["one-hop"]
    source, destination = clips.index(case.source), clips.index(case.destination)
    pair = (source, destination, base.pairs[source, destination]) if base.config.regime == "fixed" else (
        source, destination)  # fmt: skip
    rows, cells = [(_strip_title("direct", case), case.played["direct"])], []
    for factor in STRIP_WEIGHTS:
        config = replace(base.config, weight=factor * study.weight, hops=1)
        table = build(clips, [pair], config)
        result = trigger(
            clips, {"one-hop": table, "two-hop": table}, source, destination, case.frame, factor * study.weight
        )
        played = result.played["one-hop"]
        rows.append((f"{factor:g} w: via {_via(played)}, {played.arrival:.2f} s", played))
        distances = result.parts["one-hop"][:-1]
        cells.append([f"{factor:g} w", f"{sum(distances):.4f}", f"{played.arrival:.2f}", html.escape(_via(played))])
    cells.insert(0, ["direct", f"{case.cost['direct']:.4f}", f"{case.played['direct'].arrival:.2f}", ""])
    points = [(label, x, y, "direct" if label == "direct" else "onehop") for label, x, y in study.trade_off]
    return f"""<h2>Effect of the weight</h2>
<p>The same trigger, {_trigger_words(case, clips.fps)}, with ten times, once and a tenth of the weight (the paper's
Fig. 11): a larger one is more responsive, a smaller one smoother.</p>
{_legend()}
{figure(figures.film_strip("strip-weights", rows, SPACING), "", scroll=True)}
<div class="side">{figure(figures.trade_off("trade", points), f"Means over {TRADE_OFF_PAIRS} pairs at most.")}
<div>{data_table(["", "S, m²", "time to arrival, s", "via"], cells)}</div></div>"""


def _distances(study):
    case = study.cases[0][1]
    clips, config = study.clips, study.tables["one-hop"].config
    first, second = clips.index(case.source), clips.index(case.destination)
    values, rows, columns = distance_map(clips, first, second, config)
    extent = (0, columns[-1] / clips.fps, 0, rows[-1] / clips.fps)
    picture = figures.distance_map("map", values, extent, (case.destination, case.source))
    words = (
        f"D between the {config.blend}-frame windows that begin at these moments (the paper's Fig. 5): dark is similar."
        f" From {values.min():.4f} to {values.max():.3f} m². The direct transition can only use the column at 0 s."
    )
    if config.regime == "fixed":
        words = words.rpartition(" The direct")[0]
    return f"<h2>Distance of two clips</h2>\n{figure(picture, words)}"


# -------------------------------------------------------------------------------------------------------------- pieces


def _percent(share):
    return f"{100 * share:.0f} %"


def _legend():
    keys = (("source", "source"), ("hop", "hop"), ("second", "second hop"), ("destination", "destination"))
    marks = (f'<span><i class="key" style="background: var(--{colour})"></i>{text}</span> ' for colour, text in keys)
    return f'<p class="keys">{"".join(marks)}</p>'


def _via(played):
    """Names of the hops of a played transition."""
    return ", then ".join(played.names[1:-1])


def _strip_title(kind, case):
    played = case.played[kind]
    via = f" via {_via(played)}" if kind != "direct" else ""
    return f"{kind}{via}: cost {case.cost[kind]:.4f} m², {played.arrival:.2f} s"


def _trigger_words(case, fps):
    return f"{html.escape(case.source)} at {case.frame / fps:.2f} s → {html.escape(case.destination)}"
