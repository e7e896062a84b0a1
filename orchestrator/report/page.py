"""The report's HTML."""

import base64
import time
from html import escape

from motion.page import data_table, document, figure
from orchestrator import table
from orchestrator.progress import duration, parts
from orchestrator.report import charts, curves, heat, machine
from orchestrator.report.render import CELL, PANE
from orchestrator.report.style import sheet

FIGURE_WIDTH = 0.63 * CELL[0]  # CSS pixels of one figure of a strip
WORST = (
    "<h3>The worst of {} tasks</h3><p>Not reached, and farthest from the target at the end (d<sup>kp</sup>, the sum "
    "over six bodies); if all were reached, the slowest.</p>"
)
VIDEO_WIDTH = PANE[0]


def page(sweep, films, pictures, notes):
    """The whole page (text).

    sweep: `data.SweepData`. films: `assembly.Films`. pictures: {name: SVG} of `assembly.draw_curves`. notes: what is
    missing, lines of text.
    """
    sections = [head(sweep), results(sweep), accuracy(sweep, pictures), training(sweep, pictures)]
    sections += [*strips(films), *videos(films), *failures(sweep, pictures), *baselines(sweep), environment(sweep)]
    if notes:
        lines = "".join(f"<li>{escape(note)}</li>" for note in notes)
        sections.append(f"<h2>What is missing</h2>\n<ul>{lines}</ul>")
    return document(f"Sweep {sweep.out.name}", sheet(), sections)


def head(sweep):
    content, runs = sweep.table, sweep.runs
    seeds = ", ".join(map(str, content["seeds"]))
    samples = [samples for _, _, samples, _, _ in machine.efforts(runs)]
    amount = f", {max(samples):,} samples per run" if samples else ""
    names = ", ".join(row["method"] for row in content["rows"])
    return f"""<h1>Sweep {escape(sweep.out.name)}</h1>
<p>{escape(names)}; seed{"s" * (len(content["seeds"]) > 1)} {seeds}; {content["clips"]} clips
({escape(content["motions"])}), {content["clips"] ** 2} pairs of source and target; scale
{escape(content["scale"])}{amount}.</p>"""


def results(sweep):
    return f"<h2>Results</h2>\n{table.fragment(sweep.table)}"


def accuracy(sweep, pictures):
    """What lies between the accuracies of the two tables; nothing without its picture."""
    if "accuracy" not in pictures:
        return ""
    words = "Share of the evaluation's tasks that came below the thresholds after so many reductions, with noise."
    picture = figure(pictures["accuracy"], words)
    return f"<h3>From the first thresholds to the final accuracy</h3>\n{legend(sweep)}{picture}"


def training(sweep, pictures):
    """Fig. 4 with a tab per axis; nothing without its pictures."""
    if not pictures:
        return ""
    tabs, panels = [], []
    for number, axis in enumerate(curves.AXES):
        checked = " checked" if number == 1 else ""
        tabs.append(
            f'<input type="radio" name="axis" id="axis-{axis}"{checked}><label for="axis-{axis}">'
            f"{charts.LABELS[axis]}</label>"
        )
        both = "".join(
            figure(pictures[f"{quantity}-{axis}"], f"({letter}) {words}")
            for letter, quantity, words in (
                ("a", "return", "Mean return of the episodes that ended, running mean."),
                ("b", "reductions", "How often the curriculum cut the thresholds."),
            )
        )
        panels.append(f'<div class="panel side {axis}">{both}</div>')
    several = any(len(runs) > 1 for runs in sweep.rows.values())
    band = " Line: mean over seeds; band: from the lowest to the highest seed." if several else ""
    return f"""<h2>Training</h2>
<p>The paper's Fig. 4, against iterations, samples and time.{band}</p>
{legend(sweep)}
<div class="tabs">{"".join(tabs)}
{"".join(panels)}</div>"""


def legend(sweep):
    """The rows' names with their lines."""
    keys = []
    for number, name in enumerate(sweep.methods[row] for row in sweep.rows):
        style = charts.line_style(number)
        lengths = "" if style["ls"] == "-" else " ".join(f"{2 * length:g}" for length in style["ls"][1])
        dash = f' stroke-dasharray="{lengths}"' if lengths else ""
        line = (
            f'<svg class="line" viewBox="0 0 30 12" aria-hidden="true"><path d="M0 6H30" fill="none" '
            f'stroke="var(--row{number % charts.ROWS})" stroke-width="2.5"{dash}/></svg>'
        )
        keys.append(f"<span>{line}{escape(name)}</span> ")
    return f'<p class="keys">{"".join(keys)}</p>'


# --------------------------------------------------------------------------------------------------------------- films


def words(shown):
    """A transition's name."""
    turn = f"{abs(shown.rotation) * 57.29578:.0f}° to the {'left' if shown.rotation > 0 else 'right'}"
    return f"{clip(shown.source)} at {shown.moment:.2f} s → {clip(shown.target)}, {turn}"


def clip(name):
    return escape(name.replace("_", " "))


def colour_keys():
    keys = (("source", "source and target clips"), ("transition", "transition"))
    marks = [f'<span><i class="key" style="background: var(--{colour})"></i>{text}</span> ' for colour, text in keys]
    return f'<p class="keys">{"".join(marks)}</p>'


def strips(films):
    """Figs. 1 and 3: transitions of the policy below interpolation of the same task."""
    if not films.strips:
        return []
    how = "that were reached, with the largest turns" if films.reached else "that ended nearest to their targets"
    limits = ", ".join(f"{value:.3g} {unit}" for value, unit in zip(films.limits, ("m", "m", "rad")))
    out = [f"""<h2>Transitions</h2>
<p>{escape(films.run)}, as in the evaluation; of {films.tried} tasks played, {films.reached} were reached at the
thresholds {limits} to which training came. Shown are some {how} (the paper's Figs. 1 and 3). The camera goes with the
character. The target's clip stands where the task puts it, so what the transition missed it by is seen as a jump.</p>
{colour_keys()}"""]
    for shown, rows in films.strips:
        out.append(f"<h3>{words(shown)}</h3>")
        for title, picture, times in rows:
            out.append(strip(title, picture, times, words(shown)))
    return out


def strip(title, picture, times, alt):
    """One row of figures with the seconds below them."""
    width = FIGURE_WIDTH * len(times)
    if isinstance(picture, bytes):
        picture = f'<img src="{webp(picture)}" width="{width:.0f}" alt="{escape(title)}: {alt}">'
    labels = "".join(f"<span>{moment:.2f}</span>" for moment in times)
    return (
        f'<figure class="strip"><figcaption>{escape(title)}</figcaption><div class="scroll" tabindex="0">'
        f'<div style="width:{width:.0f}px">{picture}<div class="times">{labels}</div></div></div></figure>'
    )


def videos(films):
    if not films.videos:
        return []
    out = ["""<h2>Videos</h2>
<p>At half speed; the translucent figure is the target pose. To play a task again:
<code>python -m orchestrator.evaluate RUN --replay TASK</code></p>
<details open><summary>Show</summary>"""]
    kind = None
    for shown, picture, panes, bad in films.videos:
        if bad != kind:
            out += ["</div>"] * (kind is not None) + [WORST.format(films.tried)] * bad + ['<div class="videos">']
            kind = bad
        width = VIDEO_WIDTH * panes
        over = '<div class="pair"><span>interpolation</span><span>ours</span></div>' if panes == 2 else ""
        end = f"{escape(shown.ours.end)} after {shown.ours.duration:.2f} s, d<sup>kp</sup> {shown.deviation:.2f} m"
        out.append(
            f'<figure class="video" style="width:{width:.0f}px">{over}<img src="{webp(picture)}" '
            f'alt="{"worst" if bad else "chosen"}: {words(shown)}">'
            f"<figcaption>{words(shown)}: {end} (task {shown.number})</figcaption></figure>"
        )
    return [*out, "</div></details>"]


def webp(data):
    return "data:image/webp;base64," + base64.b64encode(data).decode()


# ------------------------------------------------------------------------------------------------------ where it fails


def failures(sweep, pictures):
    """Heat maps of source x target per row, share reached per turn and per moment."""
    rows = [(sweep.methods[row], heat.groups(runs)) for row, runs in sweep.rows.items()]
    if not any(found for _, found in rows):
        return []
    tabs = "".join(
        f'<input type="radio" name="heat" id="heat-{name}"{checked}><label for="heat-{name}">{text}</label>'
        for name, checked, text in (
            ("trained", " checked", "at the thresholds of training"), ("final", "", "at the final accuracy")
        )
    )  # fmt: skip
    panels = []
    for name, key in (("trained", "reached_trained"), ("final", "reached")):
        maps = "".join(heat.matrix(title, found, key) for title, found in rows if found)
        panels.append(f'<div class="panel {name}"><div class="side">{maps}</div></div>')
    out = [f"""<h2>Where it fails</h2>
<p>Percent of the evaluation's tasks that were reached, by source (rows) and target (columns).</p>
<div class="tabs">{tabs}
{"".join(panels)}</div>"""]
    if "rotation" in pictures:
        moments = next((heat.moments(sweep.methods[row], runs) for row, runs in sweep.rows.items()
                        if heat.groups(runs)), "")  # fmt: skip
        turn = figure(pictures["rotation"], "By the turn of the target, at the thresholds of training.")
        out.append(f'{legend(sweep)}<div class="side">{turn}<div>{moments}</div></div>')
    return out


# ----------------------------------------------------------------------------------------------------------- baselines


def baselines(sweep):
    """A bar chart per measure."""
    content = sweep.baselines
    if not content:
        return []
    cards = []
    for name, unit in content["units"].items():
        values = [(row, row["metrics"].get(name, {})) for row in content["methods"]]
        top = max((value["mean"] for _, value in values if value.get("mean") is not None), default=0) or 1
        lines = []
        for row, value in values:
            mean, kind = value.get("mean"), row["method"] if row["method"] in ("ours", "clips") else ""
            bar = "" if mean is None else f'<div class="bar {kind}" style="--p:{100 * mean / top:.1f}%"></div>'
            number = "–" if mean is None else short(mean)
            more = "" if mean is None else f' title="median {value["median"]:.3g}, 95 %: {value["p95"]:.3g}"'
            lines.append(f"<tr{more}><td>{escape(row['label'])}</td><td>{bar}</td><td>{number}</td></tr>")
        title = escape(name.replace("_", " ").capitalize()) + (f", {escape(unit)}" if unit else "")
        about = escape(content["descriptions"].get(name, ""))
        cards.append(
            f"<div><h3>{title}</h3><table><tbody>{''.join(lines)}</tbody></table>"
            f"<p><small>{about}</small></p></div>"
        )
    compared = content.get("compared", content["tasks"])
    share = next((row["reached_share"] for row in content["methods"] if row.get("reached_share") is not None), None)
    reached = "" if share is None else f" The policy reached {100 * share:.0f} % of the {content['tasks']} tasks."
    about = "".join(f"<li><b>{escape(row['label'])}</b> ({row['duration']:.2f} s): "
                    f"{escape(content.get('about', {}).get(row['method'], ''))}</li>"
                    for row in content["methods"])  # fmt: skip
    return [f"""<h2>Against kinematic transitions</h2>
<p>Means over the same {compared} tasks for all, judged by the same code from the poses; less is better in all of them.
{reached} Kinematic methods arrive by construction.</p>
<div class="bars">{"".join(cards)}</div>
<details><summary>The methods</summary><ul>{about}</ul></details>"""]


def short(value):
    """A number in three digits; rounding errors are zero."""
    return "0" if abs(value) < 1e-9 else f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


# --------------------------------------------------------------------------------------------------------- environment


def environment(sweep):
    rows = [
        [escape(name), f"{iterations:,}", f"{samples:,}", f"{minutes:.1f}", f"{speed:,.0f}"]
        for name, iterations, samples, minutes, speed in machine.efforts(sweep.runs)
    ]
    config = sweep.runs[0].config
    between = machine.period(sweep.runs)
    when = ""
    if between:
        begin, end = (time.strftime("%Y-%m-%d %H:%M", time.gmtime(moment)) for moment in between)
        when = f"Trained from {begin} to {end} UTC ({duration(between[1] - between[0])}). "
    found = ", ".join(f"{escape(name)} {escape(version)}" for name, version in machine.versions())
    return f"""<h2>Environment</h2>
{data_table(["run", "iterations", "samples", "minutes", "samples/s"], rows)}
<p>{when}{config.num_envs} simulations, {escape(parts(config))}.
Page made on: {escape(machine.processor())}; {found}.</p>"""
