"""What tests of whole runs share: a run's numbers, and its end at a given iteration."""

import json

from orchestrator.folder import metrics_path
from orchestrator.history import without_clock


class Killed(Exception):
    """Stands for a crash of the run."""


def killed_after(iteration):
    """A `report` for `orchestrator.run.train` that ends the run after so many iterations."""

    def report(metrics):
        if metrics["iteration"] == iteration:
            raise Killed

    return report


def lines(folder):
    """A run's metrics, an iteration each, without what depends on the clock."""
    return [without_clock(json.loads(line)) for line in metrics_path(folder).read_text().splitlines()]
