"""What Ray Tune says of its trials becomes what the terminal shows and what the sweep knows."""

import io
from types import SimpleNamespace

import pytest

from orchestrator.progress import Progress, Row
from orchestrator.tuning import make_watch


@pytest.fixture
def clock():
    return SimpleNamespace(now=0.0)


@pytest.fixture
def shown(clock):
    """A sweep of two runs of 100 iterations of 10 samples on a plain terminal: its `Progress` and what that wrote."""
    stream = io.StringIO()
    rows = [Row("ours-seed0", 100, 10), Row("no_sbc-seed0", 100, 10)]
    return Progress(rows, 1, stream, interactive=False, clock=lambda: clock.now), stream


def trial(name, folder):
    return SimpleNamespace(config={"job": {"name": name, "folder": str(folder)}}, error_file=None)


def test_a_run_whose_process_died_is_said_to_wait_and_is_no_failure(shown, clock, tmp_path):
    progress, stream = shown
    watch = make_watch(object, progress, [tmp_path])
    ours = trial("ours-seed0", tmp_path)

    def report(iteration, now):
        clock.now = now
        watch.on_trial_result(0, [], ours, {"iteration": iteration})

    watch.on_trial_start(0, [], ours)
    report(1, 0.0)
    report(11, 100.0)
    watch.on_trial_recover(0, [], ours)
    died, waits = stream.getvalue().splitlines()[-2:]
    assert died.startswith("ours-seed0: its process died") and "checkpoint" in died
    assert waits.split()[:2] == ["ours-seed0", "waiting"]
    watch.on_trial_start(0, [], ours)
    report(6, 5000.0)
    report(16, 5010.0)
    # 84 iterations at one a second: neither the wait nor the iterations done again are part of its speed
    assert stream.getvalue().splitlines()[-1].endswith("84 s left")
    assert watch.failures == {}


def test_a_sweep_that_is_told_to_end_does_not_wait_for_a_run_whose_process_died(shown, tmp_path):
    progress, _ = shown
    watch = make_watch(object, progress, [tmp_path])
    watch.on_trial_start(0, [], trial("ours-seed0", tmp_path))
    watch.stop()
    with pytest.raises(KeyboardInterrupt):
        watch.on_trial_recover(0, [], trial("ours-seed0", tmp_path))


def test_a_run_that_failed_for_good_is_a_failure_with_its_reason(shown, tmp_path):
    progress, stream = shown
    watch = make_watch(object, progress, [tmp_path])
    watch.on_trial_start(0, [], trial("ours-seed0", tmp_path))
    watch.on_trial_error(0, [], trial("ours-seed0", tmp_path))
    assert watch.failures == {"ours-seed0": "its process died"}
    assert "ours-seed0: failed: its process died" in stream.getvalue()
