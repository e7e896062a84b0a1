"""The report's pictures (`motion.picture`): SVG text in the page's colours."""

from functools import partial

import numpy as np

from motion import rotations
from motion.onehop import render
from motion.picture import drawing, palette

COLOURS = palette("source", "hop", "destination", "second", "direct", "onehop", "twohop", "wait")
_figure = partial(drawing, COLOURS)
SIDE, THREE_QUARTERS = (-90.0, 4.0), (-55.0, 12.0)  # azimuth and elevation of the camera, degrees


def cost_bars(name, rows):
    """Fig. 10 of the paper: cost of a few triggers, direct, one-hop and two-hop, taken apart.

    rows: [{"direct": D, "one": [D ..., w R], "two": [D ..., w R]}, ...].
    """
    with _figure(name, "Cost of direct, one-hop and two-hop transitions", 4.6, 3.1) as (_, axis, out):
        at = np.arange(len(rows))
        axis.bar(at - 0.28, [row["direct"] for row in rows], 0.26, color=COLOURS["direct"], label="direct: D")
        for shift, key, colour, label in ((0.0, "one", "onehop", "one-hop"), (0.28, "two", "twohop", "two-hop")):
            base, words = np.zeros(len(rows)), f"{label}: D of each blend"
            for part, alpha in enumerate((1.0, 0.7, 0.45)):
                # a two-hop optimum may do with one hop, so with two distances
                high = np.array([row[key][part] if part < len(row[key]) - 1 else 0.0 for row in rows])
                axis.bar(at + shift, high, 0.26, base, color=COLOURS[colour], alpha=alpha, label=words)
                base, words = base + high, None
            words = "w R" if key == "two" else None
            axis.bar(at + shift, [row[key][-1] for row in rows], 0.26, base, color=COLOURS["wait"], label=words)
        axis.set_xticks(at, [str(i + 1) for i in at])
        axis.set_xlabel("trigger")
        axis.set_ylabel("cost (m²)")
        axis.grid(axis="y", lw=0.6)
        axis.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, borderaxespad=0.2)
    return out["svg"]


def cost_curves(name, time, curves):
    """Cost over every trigger of one pair. time: (T,) s. curves: {"direct", "one-hop", "two-hop": (T,) m^2 or inf}."""
    with _figure(name, "Cost of every trigger frame of a pair", 4.6, 2.7) as (_, axis, out):
        for label, values in curves.items():
            values = np.where(np.isfinite(values), values, np.nan)
            axis.plot(time, values, color=COLOURS[label.replace("-", "")], label=label)
        axis.set_xlabel("trigger (s)")
        axis.set_ylabel("cost (m²)")
        axis.set_ylim(bottom=0)
        axis.set_xlim(time[0], time[-1])
        axis.grid(lw=0.6)
        axis.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=3, borderaxespad=0.2)
    return out["svg"]


def distance_map(name, values, extent, labels):
    """Fig. 5: colour map of D (rows: first clip). extent: (left, right, bottom, top) s. labels: (x, y) clips' names."""
    with _figure(name, "Distance of every pair of frames of two clips", 4.6, 3.3) as (figure, axis, out):
        image = axis.imshow(values, origin="lower", extent=extent, aspect="auto", cmap="viridis", interpolation="none")
        axis.set_xlabel(f"{labels[0]} (s)")
        axis.set_ylabel(f"{labels[1]} (s)")
        figure.colorbar(image, ax=axis, label="D (m²)", pad=0.02)
    return out["svg"]


def trade_off(name, points):
    """Smoothness against time, a point per weight. points: [(label, mean duration s, mean S m^2, colour's name)]."""
    with _figure(name, "Smoothness against duration for several weights", 4.6, 2.9) as (_, axis, out):
        line = [(x, y) for _, x, y, kind in points if kind == "onehop"]
        axis.plot(*zip(*line), color=COLOURS["onehop"], lw=1, alpha=0.6)
        for k, (label, x, y, kind) in enumerate(points):
            axis.plot([x], [y], "o", ms=5, color=COLOURS[kind])
            # by turns above and below, because neighbours may lie close together
            axis.annotate(label, (x, y), xytext=(5, (4, -10)[k % 2]), textcoords="offset points", fontsize=8)
        axis.set_xlabel("mean time from trigger to arrival (s)")
        axis.set_ylabel("mean S (m²)")
        axis.margins(x=0.16, y=0.14)
        axis.set_ylim(bottom=0)
        axis.grid(lw=0.6)
    return out["svg"]


def speeds(name, curves):
    """Speed of planted feet over time. curves: {label: (time (N,), speed (N, 2) or NaN where no foot is planted)}."""
    with _figure(name, "Speed of planted feet over time", 4.6, 2.4) as (_, axis, out):
        for label, (time, speed) in curves.items():
            colour = COLOURS[label.replace("-", "")]
            for foot, style in ((0, "-"), (1, "--")):
                side = ("right", "left")[foot]
                axis.plot(time, speed[:, foot], style, color=colour, label=f"{label}, {side} foot")
        axis.axvline(0, color=COLOURS["faint"], lw=0.8)
        axis.set_xlabel("time after the trigger (s)")
        axis.set_ylabel("m/s")
        axis.set_ylim(bottom=0)
        axis.grid(lw=0.6)
        axis.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, borderaxespad=0.2)
    return out["svg"]


def film_strip(name, rows, spacing, view=THREE_QUARTERS, cell=1.3):
    """Figs. 7, 8, 11: transitions as rows of stick figures, all on one time axis.

    rows: [(title, `Played`)]. spacing: s between figures. cell: width of a figure in the picture, m. The camera follows
    the root. Below each row lie the shares of its clips over time, in the colours of source, hops and destination.
    """
    begin = min(played.time[0] for _, played in rows)
    end = max(min(played.time[-1], played.arrival + 0.3) for _, played in rows)
    times = np.arange(np.ceil(begin / spacing), np.floor(end / spacing) + 1) * spacing
    width, high, low = cell * len(times), 2.3, -0.5
    scale = 0.42  # inch per metre in the picture
    title = "Film strips: " + ", ".join(text for text, _ in rows)
    size = (scale * width + 0.1, len(rows) * (scale * (high - low) + 0.25) + 0.1)
    with _figure(name, title, *size, nrows=len(rows), squeeze=False) as (_, axes, out):
        for axis, (text, played) in zip(axes[:, 0], rows):
            _strip_row(axis, played, times, spacing, cell, view)
            axis.set_xlim(-cell / 2, width - cell / 2)
            axis.set_ylim(low, high)
            axis.set_aspect("equal")
            axis.axis("off")
            axis.set_title(text, loc="left", fontsize=9, pad=1)
    return out["svg"]


def _strip_row(axis, played, times, spacing, cell, view):
    """One transition: figures, ground, and the shares of its clips."""
    # seen from the same side of the character in every row, whatever way the clip goes in its own frame
    heading = np.degrees(rotations.heading(played.poses[np.searchsorted(played.time, 0), 3:7]))
    project, colours = render.projector(view[0] + heading, view[1]), leg_colours(len(played.legs))
    frames = np.rint((times - played.time[0]) * played.fps).astype(int)
    shown = [(i, frame) for i, frame in enumerate(frames) if 0 <= frame < len(played.poses)]
    most = played.share.argmax(axis=1)
    for leg in range(len(played.legs)):
        here = [(i, frame) for i, frame in shown if most[frame] == leg]
        if not here:
            continue
        poses = [played.poses[frame] * _GROUNDED for _, frame in here]
        lines = render.flat_strokes(poses, project, [np.array([i * cell, 0.0]) for i, _ in here])
        colour = COLOURS[colours[leg]]
        axis.plot(*lines["shield"].T, color=COLOURS["faint"], lw=0.7)
        axis.plot(*lines["left"].T, color=colour, lw=1.4, alpha=0.55, solid_capstyle="round")
        axis.plot(*lines["trunk"].T, color=colour, lw=1.8, solid_capstyle="round")
        axis.plot(*lines["right"].T, color=colour, lw=1.6, solid_capstyle="round")
        axis.plot(*lines["sword"].T, color=COLOURS["ink"], lw=0.9)
    axis.axhline(0, color=COLOURS["grid"], lw=0.8, zorder=0)
    seconds = (played.time - times[0]) / spacing * cell
    inside = seconds <= (len(times) - 0.5) * cell
    bottom = np.full(inside.sum(), -0.34)
    for leg in range(len(played.legs)):
        top = bottom + 0.2 * played.share[inside, leg]
        axis.fill_between(seconds[inside], bottom, top, color=COLOURS[colours[leg]], lw=0)
        bottom = top
    for i, time in enumerate(times):
        axis.text(i * cell, -0.37, f"{time:.2f}", ha="center", va="top", fontsize=7, color=COLOURS["faint"])
    zero = -times[0] / spacing * cell
    axis.plot([zero, zero], [-0.36, -0.1], color=COLOURS["ink"], lw=1.2)


def leg_colours(count):
    """Colour names of a transition's `count` legs: source, (hop, (second hop,)) destination."""
    return ["source", "hop", "second"][: count - 1] + ["destination"]


_GROUNDED = np.ones(47)
_GROUNDED[:2] = 0  # the camera follows the root
