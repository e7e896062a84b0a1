"""Progress of several runs on the terminal: a block updated in place, or plain lines where there is no terminal."""

import shutil
import sys
import threading
import time
from dataclasses import dataclass, field

from motion.state_machine import build_state_machine

WAITING, RUNNING, EVALUATING, DONE, FAILED = "waiting", "training", "evaluating", "done", "failed"
THRESHOLDS = ("root_position", "key_bodies", "joint_rotation")
REDRAW = 0.5  # seconds between updates of the block
LINE_EVERY = 10.0  # seconds between plain lines of a run
MEASURED_ITERATIONS, MEASURED_SECONDS = 5, 5.0  # of training before the time left is believed


@dataclass
class Row:
    """What is known of one run. total: iterations in all. before: iterations done when this command started."""

    name: str
    total: int
    samples_per_iteration: int
    before: int = 0
    state: str = WAITING
    metrics: dict = field(default_factory=dict)
    first: tuple = None  # (iteration, time) of the first report
    latest: tuple = None
    shown_at: float = 0.0

    @property
    def iteration(self):
        return self.metrics.get("iteration", self.before)

    def rate(self):
        """Iterations per second since the first report, None before it can be believed."""
        if self.first is None:
            return None
        iterations, seconds = (b - a for a, b in zip(self.first, self.latest, strict=True))
        return iterations / seconds if iterations >= MEASURED_ITERATIONS and seconds >= MEASURED_SECONDS else None


class Progress:
    """Shows rows as `update`, `state` and `say` come in. Use as a context manager; safe to call from several threads.

    rows: `Row` of every run. concurrent: how many run at a time, for the estimate of the whole.
    """

    def __init__(self, rows, concurrent=1, stream=None, interactive=None, clock=time.monotonic):
        self._rows = {row.name: row for row in rows}
        self._concurrent, self._clock = concurrent, clock
        self._stream = stream or sys.stdout
        self._interactive = self._stream.isatty() if interactive is None else interactive
        self._lock, self._closed = threading.RLock(), threading.Event()
        self._drawn = 0  # lines of the block on the screen
        self._estimated = False

    def __enter__(self):
        if self._interactive:
            threading.Thread(target=self._redraw, name="progress", daemon=True).start()
        return self

    def __exit__(self, *_):
        self._closed.set()
        with self._lock:
            if self._interactive:
                self._draw()
                self._drawn = 0

    def say(self, line):
        """A line that stays."""
        with self._lock:
            self._clear()
            self._write(line + "\n")
            self._draw()

    def update(self, name, metrics):
        """One iteration's metrics of a run."""
        with self._lock:
            row, now = self._rows[name], self._clock()
            started = row.state == WAITING
            # an iteration in which no episode ended says nothing of returns: the last known value stays
            row.metrics = {**row.metrics, **{key: value for key, value in metrics.items() if value is not None}}
            row.state, row.latest = RUNNING, (metrics["iteration"], now)
            row.first = row.first or row.latest
            self._estimate(row)
            if not self._interactive and (started or now - row.shown_at >= LINE_EVERY):
                row.shown_at = now
                self._write(self.line(row) + "\n")

    def state(self, name, state, note=""):
        """A run has changed its state; `note` says why."""
        with self._lock:
            row = self._rows[name]
            row.state = state
            if state == WAITING:
                row.first = None  # the time until it starts again is not the run's
            if state == FAILED:
                self.say(f"{name}: failed: {note}")
            elif not self._interactive:
                self._write(self.line(row) + "\n")

    def line(self, row):
        """One run as a line of text."""
        width = max(map(len, self._rows))
        parts = [f"{row.name:<{width}}", f"{row.state:<10}", f"{row.iteration:>{len(str(row.total))}}/{row.total}"]
        m = row.metrics
        if m:
            parts.append(f"{samples(m.get('perf/samples_per_second'))}/s")
            parts.append(f"return {number(m.get('return/mean'), '6.2f')}")
            parts.append(f"reached {number(m.get('achievement'), '4.0%')}")
            limits = "/".join(number(m.get(f"thresholds/{name}"), ".3g") for name in THRESHOLDS)
            least, most = m.get("thresholds/tightenings", 0), m.get("thresholds/most_tightenings")
            parts.append(f"thresholds {limits} ({least}{'' if most is None else f' to {most}'} cuts)")
        if row.state == RUNNING and (rate := row.rate()):
            parts.append(f"{duration((row.total - row.iteration) / rate)} left")
        return "  ".join(parts)

    def _estimate(self, row):
        """Say once about how long everything takes, as soon as a run's speed is known."""
        rate = row.rate()
        if self._estimated or rate is None:
            return
        self._estimated = True
        speed = rate * row.samples_per_iteration
        left = sum((r.total - r.iteration) * r.samples_per_iteration for r in self._rows.values() if r.state != DONE)
        runs = sum(r.state in (WAITING, RUNNING) for r in self._rows.values())
        together = min(self._concurrent, runs)
        self.say(
            f"measured: {samples(speed)} samples/s per run, {together} at a time; all training takes about "
            f"{duration(left / speed / together)}, evaluation comes on top"
        )

    def _redraw(self):
        while not self._closed.wait(REDRAW):
            with self._lock:
                if not self._closed.is_set():
                    self._draw()

    def _draw(self):
        if not self._interactive:
            return
        self._clear()
        width = shutil.get_terminal_size().columns
        lines = [self.line(row)[: width - 1] for row in self._rows.values()]
        self._write("".join(line + "\n" for line in lines))
        self._drawn = len(lines)

    def _clear(self):
        if self._drawn:
            self._write(f"\x1b[{self._drawn}F\x1b[J")
            self._drawn = 0

    def _write(self, text):
        try:
            self._stream.write(text)
            self._stream.flush()
        except (BrokenPipeError, ValueError):
            pass  # nobody reads any more; the run goes on


def number(value, form):
    """A number in a format, a dash if there is none."""
    return "-" if value is None else format(value, form)


def parts(config):
    """The actors of a run in a few words."""

    def count(n, noun):
        return f"{n} {noun}{'s' * (n != 1)}"

    spare = f" (and {config.spare_threads} spare)" if config.spare_threads and config.runtime == "ray" else ""
    return (
        f"{count(config.num_workers, 'worker')} x {count(config.worker_threads, 'thread')}{spare} and one learner on "
        f"{config.device}; runtime {config.runtime}"
    )


def clips(config):
    """Lines about the clips of a run: how many, and which of them are a target that no figure can stand at."""
    from workers.footing import floating_targets  # compiled code, which only who begins a run waits for

    lines = [f"{len(config.motions.clips)} clips ({config.motions.name})"]
    for name, height in floating_targets(build_state_machine(config.motions)):
        lines.append(
            f"  clip {name} floats: its lowest point is {height:.2f} m above the floor at its start point, where no "
            "figure can stand; lower the clip, give it another start, or leave it out"
        )
    return lines


def samples(value):
    """A rate or count in three digits: 950, 3.1k, 2.0M."""
    if value is None:
        return "-"
    for limit, unit in ((1e6, "M"), (1e3, "k")):
        if value >= limit:
            return f"{value / limit:.1f}{unit}"
    return f"{value:.0f}"


def duration(seconds):
    """A time in words: 40 s, 7 min, 3 h 20 min, 2 d 4 h."""
    seconds = int(seconds)
    if seconds < 90:
        return f"{seconds} s"
    minutes = round(seconds / 60)
    if minutes < 90:
        return f"{minutes} min"
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02} min" if hours < 48 else f"{hours // 24} d {hours % 24} h"
