"""Who trained how much when: a line per step or iteration, written by whichever process runs the environments."""

import time
from dataclasses import dataclass

import numpy as np

# time.monotonic() at the end, samples, episodes of freshly drawn tasks that ended, those of them that were reached,
# and whether a new iteration begins with these samples
FIELDS = np.dtype([("time", "f8"), ("samples", "f8"), ("ended", "f8"), ("reached", "f8"), ("begins", "f8")])


class Writer:
    """Appends records to a file that others may read meanwhile."""

    def __init__(self, path):
        self._file = open(path, "ab", buffering=0)

    def write(self, samples, ended, reached, begins, at=None):
        """One record; `at`: time.monotonic() of it, default now."""
        at = time.monotonic() if at is None else at
        self._file.write(np.array([(at, samples, ended, reached, begins)], FIELDS).tobytes())


@dataclass(frozen=True)
class Record:
    """A run's records in the order of time. begins: (I,) times at which iterations began, also the last's end.

    time, samples, ended, reached: (R,), the last three summed up from the start of the run.
    """

    begins: np.ndarray
    time: np.ndarray
    samples: np.ndarray
    ended: np.ndarray
    reached: np.ndarray

    def at(self, moment):
        """(samples, ended, reached) up to a time."""
        i = np.searchsorted(self.time, moment, side="right") - 1
        return tuple(float(sums[i]) if i >= 0 else 0.0 for sums in (self.samples, self.ended, self.reached))

    def when(self, samples):
        """The end of the iteration that learned from sample number `samples`; None if there is none."""
        return next((moment for moment in self.begins if self.at(moment)[0] >= samples), None)

    def achievement(self, moment, window):
        """Achievement rate of the freshly drawn tasks that ended in the last `window` samples before a time."""
        samples, ended, reached = self.at(moment)
        i = np.searchsorted(self.samples, samples - window, side="right") - 1
        before = (self.ended[i], self.reached[i]) if i >= 0 else (0.0, 0.0)
        return float((reached - before[1]) / (ended - before[0])) if ended > before[0] else None


def read(paths):
    """The `Record` of files that the processes of one run write; iterations begin where the first process says."""
    # a record may be half written
    parts = []
    for path in sorted(paths):
        data = path.read_bytes()
        parts.append(np.frombuffer(data[: len(data) // FIELDS.itemsize * FIELDS.itemsize], FIELDS))
    if not parts:
        parts = [np.zeros(0, FIELDS)]
    begins = parts[0]["time"][parts[0]["begins"] == 1]
    merged = np.concatenate(parts)
    merged = merged[np.argsort(merged["time"], kind="stable")]
    sums = {name: np.cumsum(merged[name]) for name in ("samples", "ended", "reached")}
    return Record(begins=begins, time=merged["time"], **sums)
