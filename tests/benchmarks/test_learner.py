"""`benchmarks.learner` times both methods on every device that it is given."""

from benchmarks.learner import measure


def test_both_methods_are_timed_on_each_device(make_config):
    figures = measure(make_config(), ["cpu"], rounds=1)
    assert list(figures) == ["adam cpu", "kfac cpu"]
    assert all(duration > 0 for duration in figures.values())
