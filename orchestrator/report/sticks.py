"""Film strips as stick figures, for machines without OpenGL."""

import numpy as np

from motion.onehop.render import flat_strokes, projector
from motion.picture import drawing, palette
from orchestrator.report.phases import SOURCE, TRANSITION
from orchestrator.report.render import AZIMUTH, ELEVATION, SPACING

COLOURS = palette("source", "transition")
VIEW = projector(AZIMUTH + 180, -ELEVATION)  # the same side as in the rendered strips


def strip(name, take, chosen):
    """SVG text of the figures `chosen` (rows of a `Take`'s poses), the camera going with each."""
    width, low, high, scale = SPACING * len(chosen), -0.15, 2.15, 0.62
    title = "Film strip of a transition, stick figures"
    with drawing(COLOURS, name, title, scale * width, scale * (high - low)) as (figure, axis, out):
        figure.set_layout_engine("none")
        axis.set_position([0, 0, 1, 1])
        for phase in np.unique(take.phase[chosen]):
            here = np.flatnonzero(take.phase[chosen] == phase)
            poses = take.qpos[chosen[here]].copy()
            poses[:, :2] = 0
            lines = flat_strokes(poses, VIEW, [np.array([i * SPACING, 0.0]) for i in here])
            colour = COLOURS["transition" if phase == TRANSITION else "source"]
            axis.plot(*lines["shield"].T, color=COLOURS["faint"], lw=0.8)
            axis.plot(*lines["left"].T, color=colour, lw=1.6, alpha=0.55, solid_capstyle="round")
            axis.plot(*lines["trunk"].T, color=colour, lw=2.2, solid_capstyle="round")
            axis.plot(*lines["right"].T, color=colour, lw=1.9, solid_capstyle="round")
            axis.plot(*lines["sword"].T, color=COLOURS["ink"], lw=1.0)
        axis.axhline(0, color=COLOURS["grid"], lw=0.8, zorder=SOURCE)
        axis.set_xlim(-SPACING / 2, width - SPACING / 2)
        axis.set_ylim(low, high)
        axis.set_aspect("equal")
        axis.axis("off")
    return out["svg"]
