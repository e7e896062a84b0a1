"""Make a sweep's report: gather, play, draw, write. What cannot be had is left out and named in the page."""

from dataclasses import dataclass
from pathlib import Path

from learner.storage import replace_file
from motion.errors import InputError
from orchestrator.curriculum import final_tightenings, thresholds
from orchestrator.report import NAME, charts, choice, curves, data, films, heat, sticks
from orchestrator.report.export import export
from orchestrator.report.page import page

REFERENCE = "ours"  # the row whose policy is shown and compared


@dataclass(frozen=True)
class Films:
    """What the page shows of transitions. run: whose policy. limits: thresholds of d^rp, d^kp, d^q.

    strips: ((`choice.Shown`, ((title, WebP or SVG, times), ...)), ...). videos: ((`choice.Shown`, WebP, takes side by
    side, whether it is one of the worst), ...).
    """

    run: str = ""
    limits: tuple = ()
    tried: int = 0
    reached: int = 0
    strips: tuple = ()
    videos: tuple = ()


def make(out, runs, config, say):
    """See `orchestrator.report.make`."""
    out, notes = Path(out), []
    subject = reference(runs)
    shown = None
    if subject is not None and (config.report.strips or config.report.videos):
        say("playing transitions")
        shown = attempt("films", notes, lambda: Show(subject, config.report))
    with films.Drawing(shown.jobs if shown else {}) as drawing:  # while it draws, the rest is made
        if subject is not None and config.report.tasks:
            attempt("comparison with kinematic transitions", notes, lambda: compare(out, subject, config, say))
        sweep = data.read(out, runs)
        missing(sweep, notes)
        pictures = attempt("curves", notes, lambda: draw_curves(sweep)) or {}
        if shown and shown.jobs:
            say("drawing transitions")
        shown = attempt("films", notes, lambda: shown.films(*drawing.wait(), notes)) if shown else None
    path = out / NAME
    replace_file(path, page(sweep, shown or Films(), pictures, notes).encode())
    written = [path, *(out / name for name in (data.BASELINES, "baselines.md") if (out / name).exists())]
    if config.report.figures:
        written += export(config.report.figures, sweep, shown or Films(), pictures)
    return written


def attempt(what, notes, make):
    """make(), or None and a note where it fails: a part that cannot be made must not take the others with it."""
    try:
        return make()
    except Exception as error:
        lines = str(error).strip().splitlines()
        kind = "" if isinstance(error, InputError) else f"{type(error).__name__}: "
        notes.append(f"{what}: {kind}{lines[0][:300] if lines else 'no message'}")
        return None


def reference(runs):
    """The run whose policy is shown: the first evaluated one of the row ours, else of any row, else None."""
    done = [run for run in runs if (run.folder / "evaluation.json").exists()]
    return next((run for run in done if run.config.row == REFERENCE), done[0] if done else None)


def compare(out, subject, config, say):
    """Write baselines.json, unless there is one that is newer than the run's evaluation."""
    path, evaluation = out / data.BASELINES, subject.folder / "evaluation.json"
    if path.exists() and path.stat().st_mtime >= evaluation.stat().st_mtime:
        return
    from orchestrator.baselines import compare
    from orchestrator.evaluation.replay import load_policy

    say("comparing with kinematic transitions")
    policy, tightenings = load_policy(subject.folder, subject.config)
    limits = thresholds(subject.config.curriculum, subject.config.reach, tightenings)
    compare(out, subject.config, policy, limits, config.report.tasks)


def missing(sweep, notes):
    """Note what the folder does not hold."""
    for run in sweep.runs:
        if not len(run.curves["iteration"]):
            notes.append(f"{run.name}: no curve: it has no line in metrics.jsonl")
        if run.evaluation is None:
            notes.append(f"{run.name}: not evaluated: python -m orchestrator.evaluate {run.folder}")
        elif "groups" not in run.evaluation:
            notes.append(
                f"{run.name}: no heat map: its evaluation is of an older version: "
                f"python -m orchestrator.evaluate {run.folder}"
            )
    if sweep.baselines is None and any(run.evaluation for run in sweep.runs):
        notes.append(f"no comparison with kinematic transitions: python -m orchestrator.baselines {sweep.out}")


class Show:
    """The transitions of a run's newest policy that a report shows. options: `ReportConfig`."""

    def __init__(self, subject, options):
        bad = options.videos // 2
        good = options.videos - bad
        self._run = subject.name
        self._chosen = choice.choose(subject.config, subject.folder, max(options.strips, good), bad)
        self._strips = [self._rows(number, shown) for number, shown in enumerate(self._chosen.good[: options.strips])]
        self._videos = {}
        for name, group in (("video", self._chosen.good[:good]), ("worst", self._chosen.bad)):
            for number, shown in enumerate(group):
                # beside interpolation once: it shows the difference, and a second pane costs as much as a second video
                beside = name == "video" and number == 0 and shown.other is not None
                self._videos[f"{name}{number}"] = shown, [shown.other] * beside + [shown.ours]
        strips = {name: films.strip(take, at) for rows in self._strips for name, _, take, at in rows}
        self.jobs = strips | {name: films.video(takes) for name, (_, takes) in self._videos.items()}
        """{name: `render.Film`}: what is to be drawn."""

    @staticmethod
    def _rows(number, shown):
        """[(name, title, take, its frames)] of one strip."""
        rows = [("Interpolation", shown.other)] * (shown.other is not None) + [("Ours", shown.ours)]
        frames = films.frames_of_strips([take for _, take in rows])
        return [(f"strip{number}-{title.lower()}", title, take, at) for (title, take), at in zip(rows, frames)]

    def films(self, drawn, why, notes):
        """The `Films`, from what `films.Drawing.wait` gave; says in `notes` what is missing."""
        if why:
            instead = "some are missing" if drawn else "strips are stick figures, videos are left out"
            notes.append(f"films: {instead} ({why}); {films.REMEDY}")

        def row(name, title, take, at):
            picture = drawn.get(name) or sticks.strip(name, take, at)
            return f"{title}: {take.duration:.2f} s, {take.end}", picture, take.time[at]

        chosen, limits = self._chosen, self._chosen.limits
        return Films(
            self._run,
            (limits.root_position, limits.key_bodies, limits.joint_rotation),
            chosen.tried,
            chosen.reached,
            tuple((shown, tuple(row(*one) for one in rows)) for shown, rows in zip(chosen.good, self._strips)),
            tuple((shown, drawn[name], len(takes), name.startswith("worst"))
                  for name, (shown, takes) in self._videos.items() if name in drawn),
        )  # fmt: skip


def draw_curves(sweep):
    """{name: SVG}: Fig. 4 as return-AXIS and reductions-AXIS, `rotation` and `accuracy` where they are known."""
    out = {}
    config = sweep.runs[0].config
    for quantity in curves.QUANTITIES:
        for axis in curves.AXES:
            rows = [(sweep.methods[row], curves.curve(runs, axis, quantity)) for row, runs in sweep.rows.items()]
            name = f"{quantity}-{axis}"
            out[name] = charts.training(name, rows, axis, quantity, final_tightenings(config.curriculum))
    turns = [(sweep.methods[row], heat.turns(runs)) for row, runs in sweep.rows.items()]
    if any(bins for _, bins in turns):
        out["rotation"] = charts.by_rotation("rotation", turns)
    accuracies = [(sweep.methods[row], heat.accuracies(runs)) for row, runs in sweep.rows.items()]
    if any(points for _, points in accuracies):
        out["accuracy"] = charts.by_accuracy("accuracy", accuracies)
    return out
