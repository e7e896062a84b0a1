"""A sweep's report: one HTML page that stands alone (docs/report.md).

`make` is what a sweep calls. Everything below it is loaded then: training needs none of it.
"""

NAME = "report.html"


def make(out, runs, config, say=lambda line: None):
    """Write a sweep's report.html; returns the paths of what is to be kept with the sweep.

    out: the sweep's folder. runs: its `plan.Run`s. config: a `Config` whose `report.*` counts. say: called with a line
    of text for each part that takes a while.
    """
    from orchestrator.report import assembly

    return assembly.make(out, runs, config, say)
