"""One run from start to end, with the parts that train and evaluate replaced."""

import json

import pytest

from orchestrator import folder, trial
from orchestrator.progress import EVALUATING
from orchestrator.settings import build, command_line
from orchestrator.tracking import Tracking
from orchestrator.trial import Throttle, execute, reason

NOWHERE = Tracking(None, "none")


@pytest.fixture
def parts(monkeypatch):
    """`train` reports three iterations, `evaluate_run` writes a file; what they were called with."""
    calls = []

    def train(config, where, report, stop, notice):
        calls.append("train")
        for iteration in (1, 2, 3):
            report({"iteration": iteration})
        return {}

    def evaluate_run(where, config):
        calls.append("evaluate")
        content = {"metrics": {"FRPD": 1.0}, "trained": {"FRPD": 2.0}}
        folder.evaluation_path(where).write_text(json.dumps(content))
        return content

    monkeypatch.setattr(trial, "train", train)
    monkeypatch.setattr(trial, "evaluate_run", evaluate_run)
    return calls


def test_trains_then_evaluates(parts, tmp_path):
    (tmp_path / "error.txt").write_text("of an earlier attempt")
    seen = []
    execute(build([command_line(["scale=smoke"])]), tmp_path, NOWHERE, seen.append)
    assert parts == ["train", "evaluate"]
    assert seen == [{"iteration": 1}, {"iteration": 2}, {"iteration": 3}, {"phase": EVALUATING}]
    assert not (tmp_path / "error.txt").exists()


def test_an_error_leaves_its_traceback(parts, tmp_path, monkeypatch):
    def broken(*_):
        raise ValueError("no good\nreally")

    monkeypatch.setattr(trial, "train", broken)
    with pytest.raises(ValueError, match="no good") as caught:
        execute(build([command_line(["scale=smoke"])]), tmp_path, NOWHERE, print)
    text = (tmp_path / "error.txt").read_text()
    assert "Traceback" in text and "no good" in text
    assert reason(caught.value) == "ValueError: no good"


def test_reports_are_rare_but_the_first_and_last_are_not_lost(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(trial.time, "monotonic", lambda: now[0])
    seen = []
    report = Throttle(seen.append, 1.0)
    for step in range(30):
        now[0] = step / 10
        report({"iteration": step})
    report({"phase": EVALUATING})
    assert seen == [{"iteration": 0}, {"iteration": 10}, {"iteration": 20}, {"iteration": 29}, {"phase": EVALUATING}]


def test_final_metrics_have_stable_names():
    content = {"metrics": {"FRPD": 1.0, "MS": None}, "trained": {"FRPD": 2.0}}
    old = {"eval/FRPD": 1.0, "eval/MS": None, "trained/FRPD": 2.0}
    assert trial.evaluation_metrics(content) == old
    quiet = {"deterministic": {"TTAR": 0.5}, "trained_deterministic": {"TTAR": 0.75}, "by_moment": []}
    new = {"eval_deterministic/TTAR": 0.5, "trained_deterministic/TTAR": 0.75}
    assert trial.evaluation_metrics({**content, **quiet}) == {**old, **new}


def test_the_reason_is_the_cause_and_not_rays_wrapping():
    class ActorDiedError(Exception):
        __module__ = "ray.exceptions"

    wrapped = ActorDiedError("The actor died, \x1b[36mray::X()\x1b[39m (pid=1)\n  File ...\nImportError: no module x\n")
    assert reason(wrapped) == "ImportError: no module x"
