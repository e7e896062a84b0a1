"""Film strips and videos: rendered by a process of `orchestrator.report.render`, else as stick figures."""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from orchestrator.report import render
from orchestrator.report.takes import FPS

MOST = 14  # figures of a strip
LEAD, STAY = 0.3, 0.3  # s of the source clip and of the target clip that strips show
WATCH = 0.5  # s of the target clip that videos show
PROCESSES = 2
TIMEOUT = 600.0  # s for all drawing
REMEDY = "for rendered ones: apt-get install libegl1 libgl1-mesa-dri; pip install PyOpenGL; see docs/report.md"


def frames_of_strips(takes):
    """Rows of each take's poses that strips of them show below each other: every k-th, at the same times in all.

    They begin LEAD s before the transitions and end STAY s after the longest. At most MOST figures; the first of a
    transition is among them.
    """
    end = max(take.duration for take in takes) + STAY
    shown = [(take.time > -LEAD - 1e-9) & (take.time < end + 1e-9) for take in takes]
    step = -(-max(map(np.count_nonzero, shown)) // MOST)
    return [np.flatnonzero((np.rint(take.time * FPS) % step == 0) & here) for take, here in zip(takes, shown)]


def strip(take, chosen):
    """The `render.Film` of a strip of one take."""
    return render.Film(render.STRIP, [take.qpos], [take.phase], [take.target], chosen)


def video(takes):
    """The `render.Film` of a video of takes side by side, which begin their transitions together."""
    begin = max(int(np.argmax(take.time >= 0)) for take in takes)
    qpos, phase = [], []
    for take in takes:
        wait = begin - int(np.argmax(take.time >= 0))
        shown = np.concatenate([np.zeros(wait, int), np.flatnonzero(take.time <= take.duration + WATCH)])
        qpos.append(take.qpos[shown])
        phase.append(take.phase[shown])
    return render.Film(render.VIDEO, qpos, phase, [take.target for take in takes])


class Drawing:
    """Films being drawn by processes of their own: whatever happens to them, the caller goes on.

    films: {name: `render.Film`}. Use as a context manager; leaving it ends what still draws.
    """

    def __init__(self, films):
        self._films, self._processes, self._backends = films, [], backends()
        self._deadline = time.monotonic() + TIMEOUT
        self._folder = tempfile.TemporaryDirectory(prefix="segue-films-")

    def __enter__(self):
        self._start()
        return self

    def __exit__(self, *_):
        for process, _ in self._processes:
            if process.poll() is None:
                process.kill()
            process.wait()
        self._folder.cleanup()

    def wait(self):
        """({name: WebP (bytes)}, why some are missing or None), at the latest TIMEOUT seconds after the beginning."""
        while True:
            why = self._ended()
            done = {path.stem: path.read_bytes() for path in Path(self._folder.name).rglob("*.webp")}
            self._backends = self._backends[1:]
            if why is None or done or not self._backends or time.monotonic() >= self._deadline:
                return done, why
            self._start()

    def _ended(self):
        """Why not all processes have drawn all of their films; None if they have."""
        why = None
        for process, log in self._processes:
            try:
                status = process.wait(max(0.1, self._deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
                why = f"not all were drawn within {TIMEOUT:g} s"
                continue
            if status:
                lines = log.read_text(errors="replace").strip().splitlines() or [f"status {status}"]
                why = f"MUJOCO_GL={self._backends[0] or 'default'}: {lines[-1][:200]}"
        return why

    def _start(self):
        shares = [[] for _ in range(min(PROCESSES, os.cpu_count() or 1, len(self._films)))]
        for name in sorted(self._films, key=lambda name: -work(self._films[name])):  # to whoever has the least to do
            min(shares, key=lambda names: sum(work(self._films[other]) for other in names)).append(name)
        self._processes = []
        for i, names in enumerate(shares):
            own = Path(self._folder.name) / str(i)
            own.mkdir(exist_ok=True)
            for name in names:
                render.save(self._films[name], own / f"{name}.npz")
            with open(own / "log", "wb") as log:
                process = subprocess.Popen(
                    [sys.executable, "-m", "orchestrator.report.render", str(own)], env=environment(self._backends[0]),
                    cwd=own, stdin=subprocess.DEVNULL, stdout=log, stderr=log,
                )  # fmt: skip
            self._processes.append((process, own / "log"))


def environment(backend):
    """Environment variables of a drawing process."""
    project = str(Path(__file__).resolve().parents[2])
    path = os.pathsep.join(filter(None, [project, os.environ.get("PYTHONPATH")]))
    # one thread each for Mesa's drawing without a GPU: there is a process per core
    own = {"PYTHONPATH": path, "LP_NUM_THREADS": "1", "PYTHONWARNINGS": "ignore"}
    return {**os.environ, **own, **({"MUJOCO_GL": backend} if backend else {})}


def backends():
    """Values of MUJOCO_GL to try: the user's, else those that need no screen."""
    if os.environ.get("MUJOCO_GL"):
        return [os.environ["MUJOCO_GL"]]
    return ["egl", "osmesa"] if sys.platform.startswith("linux") else [""]


def work(film):
    """How many pictures of one figure a film is worth."""
    return sum(map(len, film.qpos)) if film.kind == render.VIDEO else len(film.chosen) / 4
