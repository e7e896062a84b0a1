"""`benchmarks.steps` measures distances as policies differ, and gains as slopes per distance."""

import math

import numpy as np
import pytest
import torch
from torch import nn

from benchmarks import steps
from orchestrator import saved
from orchestrator.run import train


def test_the_distance_is_how_far_the_means_move_for_a_small_step():
    torch.manual_seed(0)
    policy = nn.Sequential(nn.Linear(3, 5), nn.ReLU(), nn.Linear(5, 2)).double()
    inputs, sigma = torch.randn(50, 3, dtype=torch.double), torch.linspace(0.1, 0.3, 50)
    v = np.random.default_rng(0).normal(size=sum(p.numel() for p in policy.parameters()))
    before, small = policy(inputs), 1e-7
    with torch.no_grad():
        for parameter, part in zip(policy.parameters(), steps.parts(policy, v)):
            parameter += small * part
    moved = ((policy(inputs) - before) / small / sigma[:, None]).pow(2).sum(dim=-1).mean().sqrt().item()
    assert steps.distance(policy, inputs, sigma, v) == pytest.approx(moved, rel=1e-4)


def test_the_gain_is_the_slope_along_the_others_and_has_no_scale():
    """Of steps that are noise around one direction: its length in units of the distance, whatever the steps' length."""
    generator = np.random.default_rng(0)
    true = np.array([2.0, 0, 0]) + 0.01 * generator.normal(size=(200, 3))
    for scale in (1.0, 50.0):
        mean, error = steps.gain(true, scale * true, np.linalg.norm)
        assert mean == pytest.approx(2.0, abs=0.01) and error < 0.01
    mean, error = steps.gain(true, generator.normal(size=(200, 3)), np.linalg.norm)
    assert abs(mean) < 4 * error and error == pytest.approx(2.0 / math.sqrt(3 * 200), rel=0.3)
    # a chunk's own gradient does not count for its step: pure noise gains nothing
    noise = generator.normal(size=(400, 30))
    mean, error = steps.gain(noise, noise, np.linalg.norm)
    assert abs(mean) < 0.02


@pytest.mark.parametrize("optimizer", ["adam", "kfac"])
def test_a_runs_checkpoint_is_measured_and_not_changed(optimizer, make_config, tmp_path):
    config = make_config({"budget.iterations": 2, "checkpoint.every": 1, "ppo.optimizer": optimizer})
    train(config, tmp_path)
    before = [path.read_bytes() for path in sorted((tmp_path / "checkpoints").iterdir())]
    figures = steps.measure(config, saved.load_latest(tmp_path)[0], 3, [1.0, 0.5])
    assert all(np.isfinite(list(figures.values())).ravel())
    assert ("sbc, adam" in figures) == (optimizer == "adam") and "ppo, lambda 0.5, kfac" in figures
    assert [path.read_bytes() for path in sorted((tmp_path / "checkpoints").iterdir())] == before
