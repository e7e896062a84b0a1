"""The learner on a GPU: the same update as on the CPU, the same bits each time, checkpoints that need no GPU."""

import copy

import numpy as np
import pytest
import torch

from learner import checkpoint
from learner.learner import Learner
from learner.state import LearnerState
from learner.update import update

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")

METHODS = [{}, {"ppo.optimizer": "kfac"}, {"ppo.optimizer": "kfac", "ppo.kfac_after": 2, "policy.average": 0.9}]


def learner(config, device):
    return LearnerState(config, seed=1, device=device)


def weights(state):
    return torch.cat([p.detach().cpu().flatten() for net in (state.policy, state.value) for p in net.parameters()])


@pytest.mark.parametrize("overrides", METHODS)
def test_an_update_is_the_one_of_the_cpu(overrides, lessons, make_config):
    config = make_config({"ppo.target_kl": 0.05, **overrides})
    first = learner(config, "cpu")
    ours, theirs = first, learner(config, "cuda")
    for chunk in lessons[:3]:
        ours, expected = update(ours, [chunk])
        theirs, found = update(theirs, [chunk])
        assert found.keys() == expected.keys()
        assert found == pytest.approx(expected, rel=2e-2, abs=2e-3)
    # measured by how far training went: rounding, not another direction
    start, here, there = weights(first), weights(ours), weights(theirs)
    assert (here - start).norm() > 0
    assert (here - there).norm() < 0.03 * (here - start).norm()


@pytest.mark.parametrize("overrides", METHODS)
def test_the_same_chunks_give_the_same_bits(overrides, lessons, make_config, assert_same_bits):
    results = []
    for _ in range(2):
        state, metrics = learner(make_config(overrides), "cuda"), []
        for chunk in lessons[:3]:
            state, numbers = update(state, [chunk])
            metrics.append(numbers)
        results.append([weights(state), metrics, state.snapshot()])
    assert_same_bits(*results)


@pytest.mark.parametrize("overrides", METHODS)
def test_an_update_leaves_its_state_as_it_was(overrides, lessons, make_config, assert_same_bits):
    state, _ = update(learner(make_config(overrides), "cuda"), lessons[:1])
    before = copy.deepcopy(state.state_dict())
    update(state, lessons[1:2])
    assert_same_bits(_numbers(before), _numbers(state.state_dict()))


def _numbers(value):
    """Nested containers with arrays instead of CUDA tensors."""
    if isinstance(value, torch.Tensor):
        return value.detach().cpu().numpy()
    if isinstance(value, dict):
        return {key: _numbers(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_numbers(item) for item in value]
    return value


@pytest.mark.parametrize("overrides", METHODS)
@pytest.mark.parametrize("devices", [("cuda", "cuda"), ("cuda", "cpu"), ("cpu", "cuda")])
def test_a_run_goes_on_on_either_device_from_a_checkpoint_without_one(
    devices, overrides, lessons, make_config, tmp_path
):
    """What is saved holds no CUDA tensor, and goes through a file as any other."""
    config = make_config(overrides)
    config.device = devices[0]
    one = Learner(config)
    for chunk in lessons[:3]:
        one.update(chunk)
    saved = one.saved()
    assert not any(isinstance(leaf, torch.Tensor) and leaf.is_cuda for leaf in _leaves(saved))
    path = checkpoint.save(tmp_path, 3, {"learner": saved}, keep=1)
    config.device = devices[1]
    other = Learner(config, checkpoint.load(path)["learner"])
    (ours, expected), (theirs, found) = one.update(lessons[3]), other.update(lessons[3])
    exact = devices[0] == devices[1]
    for a, b in zip(ours.weights, theirs.weights):
        assert np.array_equal(a, b) if exact else np.allclose(a, b, atol=2e-3)
    assert found == (expected if exact else pytest.approx(expected, rel=2e-2, abs=2e-3))


def _leaves(value):
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, (list, tuple)):
        for item in value:
            yield from _leaves(item)
    else:
        yield value
