"""Runs that a seeded killer disturbs: which process dies, how, and when is a function of the seed."""

import contextlib
import json
import os
import signal
import sqlite3
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]

# victim -> (signal, share of the kills). Worker, learner, curriculum are Ray's actors; driver is the command itself
VICTIMS = {
    "worker": (signal.SIGKILL, 0.40),
    "worker hangs": (signal.SIGSTOP, 0.04),
    "learner": (signal.SIGKILL, 0.22),
    "curriculum": (signal.SIGKILL, 0.14),
    "driver": (signal.SIGKILL, 0.12),
    "driver, politely": (signal.SIGTERM, 0.08),
}
# metrics in MLflow that are no iteration's, or depend on the clock
NOT_OF_ITERATIONS = ("perf/", "system/", "eval", "trained")
TITLES = {"worker": "ray::RolloutWorker", "learner": "ray::Learner", "curriculum": "ray::Curriculum"}

ITERATIONS = 120
ON_THEIR_WAY = 2  # lines that may come although somebody is dead
# thresholds that are cut on the way; checkpoints seldom enough that iterations are lost and repeated
OPTIONS = [
    "scale=smoke", f"budget.iterations={ITERATIONS}", "num_workers=1", "checkpoint.every=7", "task.max_steps=8",
    "curriculum.start=[1.0,8.0,2.0]", "curriculum.achievement=0.2", "faults.hang_timeout=60",
    "tracking.register_model=false",
]  # fmt: skip


@dataclass(frozen=True)
class Kill:
    """Who dies once the line of an iteration is there, and how many seconds later."""

    iteration: int
    victim: str
    delay: float


@dataclass
class Report:
    """What a disturbed run came to.

    recovery: (victim, seconds until the third line after it) per kill that hit. missed: kills that found no such
    process. starts: of the command. wrong_lines: iterations that metrics.jsonl lacks, has twice or has other numbers
    in; wrong_steps: the same of MLflow. seconds: of the whole run. output: what the command printed.
    """

    recovery: list = field(default_factory=list)
    missed: int = 0
    starts: int = 0
    wrong_lines: int = 0
    wrong_steps: int = 0
    same_weights: bool = False
    seconds: float = 0.0
    output: str = ""

    @property
    def identical(self):
        """Whether nothing was lost, doubled or changed."""
        return self.same_weights and not self.wrong_lines and not self.wrong_steps


def plan(seed, kills):
    """`kills` many `Kill`s in the order of their iterations."""
    generator = np.random.default_rng(seed)
    shares = np.array([share for _, share in VICTIMS.values()])
    names = generator.choice(list(VICTIMS), size=kills, p=shares / shares.sum())
    iterations = np.sort(generator.integers(1, ITERATIONS - 8, size=kills))
    delays = generator.uniform(0, 0.15, size=kills)
    return [Kill(int(i), str(name), float(delay)) for i, name, delay in zip(iterations, names, delays)]


def undisturbed(folder, seed=0):
    """The run that others are compared with: one process, no fault."""
    run = _Run(folder, seed, "runtime=local")
    run.start()
    run.wait()
    return folder


def disturbed(folder, kills, reference, seed=0, patience=600):
    """Do the same run on Ray under a plan of `Kill`s, starting the same command again whenever it ended; a `Report`."""
    report, begun = Report(), time.monotonic()
    run = _Run(folder, seed, "runtime=ray")
    try:
        for kill in kills:
            run.until(kill.iteration, patience)
            time.sleep(kill.delay)
            number, _ = VICTIMS[kill.victim]
            before = run.lines()
            if not run.hit(kill.victim, number):
                report.missed += 1
                continue
            at = time.monotonic()
            run.until(min(before + ON_THEIR_WAY + 1, ITERATIONS), patience)
            report.recovery.append((kill.victim, time.monotonic() - at))
        run.until(ITERATIONS, patience)
        run.finish(patience)
    finally:
        run.end()
    report.starts, report.output = run.starts, run.output()
    report.seconds = time.monotonic() - begun
    report.wrong_lines = count_wrong(numbers(folder), numbers(reference))
    report.wrong_steps = wrong_steps(folder, numbers(reference))
    report.same_weights = weights(folder) == weights(reference)
    return report


class _Run:
    """The command of one run and all processes that it starts."""

    def __init__(self, folder, seed, runtime):
        self.folder, self.starts, self._process = Path(folder), 0, None
        self._sessions = set()
        self._log = Path(f"{folder}.log")
        self.folder.parent.mkdir(parents=True, exist_ok=True)
        self._command = [
            sys.executable, "-m", "orchestrator.train", *OPTIONS, runtime, f"seed={seed}", f"out={folder}",
            f"tracking.uri=sqlite:///{folder}.db",
        ]  # fmt: skip

    def start(self):
        """Start the command, which continues the run."""
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
        for name in ("RAY_ADDRESS", "RAY_JOB_ID", "MLFLOW_TRACKING_URI"):
            environment.pop(name, None)
        with open(self._log, "ab") as log:
            self._process = subprocess.Popen(
                self._command, env=environment, stdout=log, stderr=log, cwd=self.folder.parent, start_new_session=True
            )
        self._sessions.add(self._process.pid)
        self.starts += 1

    def wait(self):
        """Wait for the command to end well."""
        if self._process.wait() != 0:
            raise AssertionError(f"exit status {self._process.returncode}:\n{self.output()[-3000:]}")

    def lines(self):
        """Whole lines in metrics.jsonl."""
        try:
            return (self.folder / "metrics.jsonl").read_bytes().count(b"\n")
        except FileNotFoundError:
            return 0

    def until(self, iteration, patience):
        """Wait for the line of an iteration; start the command again if it was killed."""
        deadline = time.monotonic() + patience
        while self.lines() < iteration:
            if self._process is None or self._ended():
                self.start()
            if time.monotonic() > deadline:
                raise AssertionError(f"no line {iteration} within {patience} s:\n{self.output()[-3000:]}")
            time.sleep(0.02)

    def finish(self, patience):
        """Wait for the end; start the command again if it was killed."""
        if self._ended():
            self.start()
        try:
            self._process.wait(patience)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"does not end:\n{self.output()[-3000:]}") from None
        if self._process.returncode < 0 or self._process.returncode == 143:
            self.start()
        self.wait()

    def _ended(self):
        """Whether the command is over; an error of its own, not a kill, is the test's failure."""
        status = self._process.poll()
        if status is not None and status > 0 and status != 143:
            raise AssertionError(f"exit status {status}:\n{self.output()[-3000:]}")
        return status is not None

    def hit(self, victim, number):
        """Send a signal to the victim; whether there was one."""
        name = victim.split()[0].rstrip(",")
        if name == "driver":
            pids = [self._process.pid] if self._process.poll() is None else []
        else:
            pids = [pid for pid in self._pids() if _title(pid).startswith(TITLES[name])]
        for pid in pids[:1]:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, number)
                return True
        return False

    def _pids(self):
        """Processes of the sessions that the command was started in: it, Ray's and their actors."""
        found = []
        for path in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                if os.getsid(int(path.name)) in self._sessions:
                    found.append(int(path.name))
        return sorted(found)

    def end(self):
        """Leave no process behind."""
        for pid in self._pids():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        if self._process:
            self._process.wait()

    def output(self):
        """What the command printed so far."""
        return self._log.read_text(errors="replace") if self._log.exists() else ""


def _title(pid):
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")[0].decode(errors="replace")
    return ""


def numbers(folder):
    """metrics.jsonl as text, a line per iteration, without what depends on the clock."""
    out = []
    for line in (Path(folder) / "metrics.jsonl").read_text().splitlines():
        out.append(json.dumps({k: v for k, v in json.loads(line).items() if not k.startswith("perf/")}))
    return out


def count_wrong(got, wanted):
    """Lines that are not byte for byte those wanted, missing and surplus ones included."""
    return sum(a != b for a, b in zip(got, wanted)) + abs(len(got) - len(wanted))


def wrong_steps(folder, wanted):
    """Iterations whose values in MLflow are not exactly once what metrics.jsonl should say."""
    with contextlib.closing(sqlite3.connect(f"{folder}.db")) as database:
        rows = database.execute("select step, key, value from metrics").fetchall()
    rows = [row for row in rows if not row[1].startswith(NOT_OF_ITERATIONS)]
    logged = {}
    for step, key, value in rows:
        logged.setdefault(step, []).append((key, value))
    wrong = 0
    for line in map(json.loads, wanted):
        values = {k: float(v) for k, v in line.items() if isinstance(v, int | float)}
        got = logged.pop(line["iteration"], [])
        wrong += len(got) != len(values) or any(abs(values.get(k, np.inf) - v) > 1e-12 * abs(v) for k, v in got)
    return wrong + len(logged)


def weights(folder):
    """The newest checkpoint's content as plain lists, but for the configuration, which names the runtime."""
    from learner import checkpoint

    content, _ = checkpoint.load_newest(Path(folder) / "checkpoints")
    return _plain({key: value for key, value in content.items() if key != "config"})


def _plain(value):
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value.numpy().tobytes() if hasattr(value, "numpy") else value
