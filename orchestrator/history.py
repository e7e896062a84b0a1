"""metrics.jsonl as the run's loop writes it: a line per iteration, each written once, whatever is repeated."""

import json
import logging

from learner.storage import replace_file
from orchestrator.lines import LineFile

CLOCK = "perf/"  # prefix of the keys that depend on the clock


class History:
    """The lines of a run so far, and the file open for appending.

    An iteration that is done again, after a crash or a lost actor, gives the same numbers: its line stays as it is and
    the new one is compared with it. `last`: the newest iteration that has a line. `seconds`: training time up to it.
    """

    def __init__(self, path, iteration):
        """Open the file at `path` for a run that continues after `iteration`; a line that a crash cut off goes."""
        self._path, self._repeated, self._warned = path, {}, False
        self.last, self.seconds = 0, 0.0
        kept = []
        for line in path.read_bytes().split(b"\n")[:-1] if path.exists() else ():
            try:
                metrics = json.loads(line)
                number = int(metrics["iteration"])
            except (ValueError, KeyError):
                break
            kept.append(line + b"\n")
            self.last, self.seconds = number, metrics.get("perf/seconds", 0.0)
            if number > iteration:
                self._repeated[number] = without_clock(metrics)
        data = b"".join(kept)
        if not path.exists() or path.stat().st_size != len(data):
            replace_file(path, data)
        self._file = LineFile(path)

    def write(self, metrics):
        """Append an iteration's line (dict), or compare it with the one that is there."""
        number = metrics["iteration"]
        if number > self.last:
            self._file.write(json.dumps(metrics) + "\n")
            self.last, self.seconds = number, metrics["perf/seconds"]
            return
        before, now = self._repeated.pop(number, None), without_clock(json.loads(json.dumps(metrics)))
        if before is not None and before != now and not self._warned:
            self._warned = True
            key = next(k for k in {**before, **now} if before.get(k) != now.get(k))
            logging.getLogger(__name__).warning(
                "%s: iteration %d gave %s=%s before and %s now; its old lines stay. Was it continued with other "
                "versions, or on another type of machine?", self._path, number, key, before.get(key), now.get(key)
            )  # fmt: skip

    def sync(self):
        """Make all lines so far survive a power cut."""
        self._file.sync()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._file.__exit__()


def without_clock(metrics):
    """The part of an iteration's metrics that is a function of the configuration."""
    return {key: value for key, value in metrics.items() if not key.startswith(CLOCK)}
