"""`benchmarks.gradients` tells signal from noise."""

import numpy as np
import pytest

from benchmarks.gradients import cut, measure, signal
from orchestrator import saved
from orchestrator.run import train


def test_signal_is_the_share_of_the_common_part():
    generator = np.random.default_rng(0)
    noise = generator.standard_normal((400, 1000))
    assert signal(list(noise)) == pytest.approx(0, abs=0.005)
    common = generator.standard_normal(1000)
    assert signal(list(noise + common)) == pytest.approx(common @ common / (common @ common + 1000), abs=0.02)
    assert signal([common] * 5) == pytest.approx(1)


def test_gradients_are_cut_one_by_one():
    assert cut([np.array([3.0, 4.0]), np.array([0.0, 0.5])], 1.0) == pytest.approx([0.3, 0.65])


def test_a_runs_checkpoint_is_measured_and_not_changed(make_config, tmp_path):
    config = make_config({"budget.iterations": 2, "checkpoint.every": 1})
    train(config, tmp_path)
    before = [path.read_bytes() for path in sorted((tmp_path / "checkpoints").iterdir())]
    figures = measure(config, saved.load_latest(tmp_path)[0], 4, [0.95, 0.5])
    assert all(np.isfinite(list(figures.values())))
    assert 0 < figures["sbc/floor"] and figures["sbc/norm"] > 0 < figures["ppo/norm"]
    assert [path.read_bytes() for path in sorted((tmp_path / "checkpoints").iterdir())] == before
