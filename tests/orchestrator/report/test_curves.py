"""Curves over seeds: against slow code, and on what is known."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from orchestrator.report import charts, curves
from orchestrator.report.data import CURVES, read_curves


class Seed:
    """A run with the given curves."""

    def __init__(self, iterations, seconds, values, cuts=None):
        count = len(iterations)
        self.curves = {
            "iteration": np.asarray(iterations, float), "samples": 10.0 * np.asarray(iterations),
            "return/mean": np.asarray(values, float), "perf/seconds": np.asarray(seconds, float),
            "thresholds/tightenings": np.zeros(count) if cuts is None else np.asarray(cuts, float),
        }  # fmt: skip


@given(st.lists(st.one_of(st.just(np.nan), st.floats(-5, 5)), min_size=1, max_size=40), st.integers(1, 12))
def test_running_mean_is_the_mean_of_the_last_known_values(values, window):
    out = curves.running_mean(np.array(values), window)
    for i in range(len(values)):
        known = [v for v in values[max(0, i - window + 1) : i + 1] if not np.isnan(v)]
        expected = sum(known) / len(known) if known else np.nan
        np.testing.assert_allclose(out[i], expected, atol=1e-12)


@given(st.lists(st.integers(0, 5), min_size=1, max_size=20), st.floats(0, 30))
def test_what_changes_in_steps_holds_its_last_value(steps, at):
    x, y = np.arange(len(steps), dtype=float), np.cumsum(steps)
    expected = [value for moment, value in zip(x, y) if moment <= at][-1]
    assert curves.held(np.array([at]), x, y)[0] == expected


def test_a_rows_curve_is_the_mean_and_range_of_its_seeds_and_ends_with_the_shortest():
    first = Seed([1, 2, 3, 4], [1, 2, 3, 4], [1.0] * 4)
    second = Seed([1, 2, 3], [2, 4, 6], [3.0] * 3)
    found = curves.curve([first, second, Seed([], [], [])], "iterations", "return")
    assert found.seeds == 2 and found.x[-1] == 3
    np.testing.assert_allclose([found.mean, found.low, found.high], np.array([[2.0], [1.0], [3.0]]) * np.ones(300))
    assert curves.curve([first, second], "minutes", "return").x[-1] == 4 / 60  # where the faster one ends
    assert curves.curve([Seed([], [], [])], "iterations", "return") is None


def test_cuts_are_not_smoothed():
    cuts = [0] * 10 + [1] * 10
    found = curves.curve([Seed(range(20), range(20), np.zeros(20), cuts)], "samples", "reductions")
    np.testing.assert_array_equal(found.mean, cuts)


def test_long_runs_are_drawn_with_few_points_and_keep_their_ends():
    found = curves.curve([Seed(range(5000), range(5000), np.arange(5000))], "iterations", "return")
    assert len(found.x) == curves.POINTS and found.x[0] == 0 and found.x[-1] == 4999


def test_a_line_that_a_crash_cut_off_is_left_out(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"iteration": 1, "samples": 8, "return/mean": null}\n{"iteration": 2, "samp\n{"iteration": 3')
    found = read_curves(path)
    assert set(found) == set(CURVES) and found["iteration"].tolist() == [1]
    assert np.isnan(found["return/mean"][0])
    assert len(read_curves(tmp_path / "nowhere")["iteration"]) == 0


def test_every_row_of_a_sweep_looks_different():
    styles = [charts.line_style(number) for number in range(4 * charts.ROWS)]
    assert len({(style["color"], str(style["ls"])) for style in styles}) == len(styles)


def test_a_chart_is_the_same_every_time():
    row = [("a", curves.curve([Seed([1, 2], [1, 2], [0.0, 1.0])], "samples", "return"))]
    assert charts.training("x", row, "samples", "return") == charts.training("x", row, "samples", "return")
