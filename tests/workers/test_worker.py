"""A worker's threads change no number; with spare ones it steps back for everything else on its machine."""

import pytest

from orchestrator.curriculum import thresholds
from workers import worker


@pytest.fixture
def stepped_back(monkeypatch):
    """The niceness that a worker has asked for, in the order of its requests."""
    asked = []
    monkeypatch.setattr(worker.os, "nice", asked.append)
    return asked


def test_spare_threads_step_back_and_change_no_number(stepped_back, make_config, make_policy, assert_same_bits):
    config = make_config({"num_envs": 6, "horizon": 3})
    limits = thresholds(config.curriculum, config.reach, 0)
    alone, helped = worker.RolloutWorker(config, 6), worker.RolloutWorker(config, 6, spare_threads=2)
    states = [one.initial_state(0) for one in (alone, helped)]
    assert_same_bits(*(one.collect(state, make_policy(), limits) for one, state in zip((alone, helped), states)))
    assert stepped_back == [worker.NICENESS]
