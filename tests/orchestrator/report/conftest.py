"""A sweep's folder without training: two rows, two seeds, made-up curves and evaluations, a policy of random weights.
"""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from orchestrator import settings
from orchestrator.evaluation import replay
from orchestrator.plan import Run
from orchestrator.report import choice
from orchestrator.table import COLUMNS

STATES = ("idle", "run", "stab")
SEEDS = (0, 1)


def evaluation(tightenings, share):
    """An evaluation.json in which `share` of the tasks of every group but idle -> stab is reached."""
    groups = [
        {
            "source": a, "target": b, "tasks": 20, "reached": 0,
            "reached_trained": 3 if (a, b) == (0, 2) else round(20 * share), "steps": 9.5, "fell": 1, "timed_out": 0,
        }
        for a in range(3) for b in range(3)
    ]  # fmt: skip
    metrics = {column: 0.5 for column in COLUMNS} | {"MS": None, "IRFA": None, "TTAR": 0.0}
    bins = [{"low": -1.5 + i, "high": -0.5 + i, "tasks": 60, "reached": 0, "reached_trained": 50} for i in range(3)]
    moments = [
        {"source": a, "low": 0.5 * i, "high": 0.5 * i + 0.5, "tasks": 30, "reached": 0, "reached_trained": 10 * i}
        for a in range(3) for i in range(3)
    ]  # fmt: skip
    rungs = [
        {"tightenings": n, "thresholds": [0.3, 3.0, 1.0], "reached": 180 - 5 * n, "reached_by_source": [60] * 3}
        for n in range(35)
    ]
    return {
        "checkpoint": "00000040.pt", "samples": 2560, "iterations": 40, "tasks": 180, "tightenings": tightenings,
        "final_tightenings": 34, "log_sigma": -3.7, "metrics": metrics, "trained": metrics | {"TTAR": share},
        "deterministic": metrics, "trained_deterministic": metrics, "metrics_thresholds": [0.01, 0.09, 0.15],
        "trained_thresholds": [0.3, 3.0, 1.0], "states": list(STATES), "groups": groups, "by_rotation": bins,
        "by_moment": moments, "by_accuracy": rungs,
        "grid": {"moment_spacing": 0.03, "rotation_spacing": 0.03, "max_tasks": 180, "whole": 5000},
    }  # fmt: skip


def lines(seed, count=40):
    """metrics.jsonl of `count` iterations, the second one without an ended episode."""
    generator = np.random.default_rng(seed)
    for i in range(1, count + 1):
        yield json.dumps({
            "iteration": i, "samples": 64 * i, "return/mean": None if i == 2 else i / 10 + generator.normal(),
            "thresholds/tightenings": i // 15, "perf/seconds": (2 + seed) * i, "perf/samples_per_second": 32.0,
            "perf/time": 1.8e9 + i,
        }) + "\n"  # fmt: skip


@pytest.fixture(scope="session")
def make_sweep(make_config):
    """A function of (folder to make it in, ...) that gives a sweep: out, its folder, and runs."""

    def make(folder, rows=("ours", "no_sbc"), seeds=SEEDS, evaluated=True):
        out, runs = folder / "a <b> & c", []
        for row in rows:
            for seed in seeds:
                config = make_config({
                    "row": row, "seed": seed, "budget.iterations": 40, "evaluation.max_tasks": 180, "report.tasks": 2,
                    "report.strips": 1, "report.videos": 2,
                })  # fmt: skip
                run = Run(config, out / f"{row}-seed{seed}")
                run.folder.mkdir(parents=True)
                settings.save(config, run.folder / "config.yaml")
                (run.folder / "metrics.jsonl").write_text("".join(lines(seed)))
                if evaluated:
                    content = evaluation(2, 0.8 if row == "ours" else 0.6)
                    (run.folder / "evaluation.json").write_text(json.dumps(content))
                runs.append(run)
        return SimpleNamespace(out=out, runs=runs)

    return make


@pytest.fixture(scope="module")
def policy(make_policy):
    """A policy with random weights stands for every run's newest checkpoint."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(replay, "load_policy", lambda folder, config: (make_policy(seed=1), 0))
        patch.setattr(choice, "CANDIDATES", 24)
        yield


@pytest.fixture(scope="session")
def opengl():
    """Skips where MuJoCo cannot draw off screen."""
    import os
    import subprocess
    import sys

    from orchestrator.report.films import backends, environment

    code = "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 8, 8).render()"
    for backend in backends():
        command = [sys.executable, "-c", code]
        if subprocess.run(command, env=environment(backend), capture_output=True, timeout=120).returncode == 0:
            return os.environ.get("MUJOCO_GL", backend)
    pytest.skip("no OpenGL for MuJoCo (EGL or OSMesa, and PyOpenGL) on this machine")
