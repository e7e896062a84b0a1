"""K-FAC's factors are those of the definition, its steps natural gradients; a checkpoint has all that it keeps."""

import copy
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from learner import kfac
from learner.kfac import KFAC, factors

SIGMA = 0.3


def network(sizes, seed):
    """An MLP of doubles with random weights and biases."""
    torch.manual_seed(seed)
    layers = []
    for a, b in zip(sizes, sizes[1:]):
        layers += [nn.Linear(a, b), nn.ReLU()]
    return nn.Sequential(*layers[:-1]).double()


def numbers(*shape, seed=0):
    return torch.as_tensor(np.random.default_rng(seed).normal(size=shape))


def sigmas(n, seed=None):
    """Deviations of the outputs at n inputs: all alike, or random."""
    alike = torch.full([n], SIGMA, dtype=torch.double)
    return alike if seed is None else alike * torch.as_tensor(np.random.default_rng(seed).uniform(0.3, 3.0, n))


def gradient(net, seed):
    """Random numbers as gradients of all parameters."""
    for i, parameter in enumerate(net.parameters()):
        parameter.grad = numbers(*parameter.shape, seed=seed + i)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**31), st.lists(st.integers(1, 5), min_size=2, max_size=4), st.integers(1, 6), st.integers(1, 4))
def test_the_factors_are_means_of_outer_products_over_single_inputs(seed, sizes, n, sparse):
    """Against the definition, one input and one output at a time, by automatic differentiation."""
    net, inputs, sigma = network(sizes, seed), numbers(n, sizes[0], seed=seed), sigmas(n, seed)
    share = sigma**-2 / sum(sigma**-2)
    layers = [layer for layer in net if isinstance(layer, nn.Linear)]
    wanted = [[0.0, 0.0] for _ in layers]
    some = range(0, n, sparse)
    for k, (x, deviation, weight) in enumerate(zip(inputs, sigma, share, strict=True)):
        hidden, before, after = x, [], []
        for layer in layers:
            before.append(torch.cat([hidden, torch.ones(1, dtype=hidden.dtype)]).detach())
            after.append(layer(hidden))
            hidden = torch.relu(after[-1])
        for i, s in enumerate(after):
            wanted[i][0] += torch.outer(before[i], before[i]) * weight
            for output in after[-1] if k in some else ():
                (row,) = torch.autograd.grad(output, s, retain_graph=True)
                wanted[i][1] += torch.outer(row, row) / (len(some) * deviation**2)
    with torch.no_grad():
        found = factors(layers, inputs, sigma, sparse)
    for (a, g), (wanted_a, wanted_g) in zip(found, wanted, strict=True):
        torch.testing.assert_close(a, wanted_a)
        torch.testing.assert_close(g, wanted_g)


def fisher(net, inputs, sigma):
    """The Fisher information of a network's Gaussian outputs at inputs, dense, over its parameters in their order."""
    rows = []
    for x, deviation in zip(inputs, sigma, strict=True):
        for output in net(x):
            rows.append(flat(torch.autograd.grad(output / deviation, list(net.parameters()), retain_graph=True)))
    jacobian = torch.stack(rows)
    return jacobian.T @ jacobian / len(inputs)


def flat(tensors):
    return torch.cat([tensor.detach().flatten() for tensor in tensors])


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 4), st.integers(1, 4))
def test_a_single_layers_step_is_the_natural_gradient(seed, wide, high):
    """There the Kronecker product is no approximation: F^-1 g by the dense Fisher information of all parameters."""
    net, inputs, sigma = network([wide, high], seed), numbers(40, wide, seed=seed), sigmas(40, seed)
    optimizer = KFAC(net, 0.1, 1e-12, sparse=1)
    optimizer.observe(inputs, sigma)
    gradient(net, seed)
    natural = torch.linalg.solve(fisher(net, inputs, sigma), flat(p.grad for p in net.parameters()))
    before = flat(net.parameters())
    optimizer.step()
    torch.testing.assert_close(before - flat(net.parameters()), 0.1 * natural, rtol=1e-5, atol=1e-8)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**31))
def test_the_step_does_not_depend_on_how_inputs_are_scaled_and_mixed(seed):
    """Networks that are the same function, of x and of M x + c, are the same after a step on the same loss."""
    sizes, n = [4, 5, 3], 60
    one, x = network(sizes, seed), numbers(n, 4, seed=seed)
    mix = numbers(4, 4, seed=seed + 1) + 3 * torch.eye(4)
    shift = numbers(4, seed=seed + 2)
    other, y = copy.deepcopy(one), x @ mix.T + shift
    with torch.no_grad():
        other[0].weight.copy_(one[0].weight @ torch.linalg.inv(mix))
        other[0].bias.copy_(one[0].bias - other[0].weight @ shift)
    target, after = numbers(n, 3, seed=seed + 3), []
    for net, inputs in ((one, x), (other, y)):
        optimizer = KFAC(net, 0.05, 1e-11, sparse=1)
        optimizer.observe(inputs, sigmas(len(inputs)))
        ((net(inputs) - target) ** 2).mean().backward()
        # the hidden layer's factors may be singular (units that are never on): those of the first decide here
        optimizer._inverses[0][1] = torch.eye(5, dtype=torch.double)
        optimizer._inverses[1] = [torch.eye(6, dtype=torch.double), torch.eye(3, dtype=torch.double)]
        optimizer.step()
        after.append(net(inputs))
    torch.testing.assert_close(*after, rtol=1e-4, atol=1e-6)


def test_damping_is_in_units_of_the_mean_eigenvalue():
    factor = torch.diag(torch.tensor([1.0, 3.0]))
    torch.testing.assert_close(kfac._inverse(factor, 0.5), torch.diag(torch.tensor([1 / 2.0, 1 / 4.0])))


def test_factors_are_a_plain_mean_at_first_and_a_running_one_in_the_long_run():
    net = network([1, 1], 0)
    optimizer = KFAC(net, 1.0, 0.1)
    for x in (1.0, 2.0, 3.0):
        optimizer.observe(torch.full((1, 1), x, dtype=torch.double), sigmas(1))
    ((a, g),) = optimizer.state_dict()["factors"]
    torch.testing.assert_close(a, torch.tensor([[14 / 3, 2], [2, 1]], dtype=torch.double))
    torch.testing.assert_close(g, torch.full((1, 1), 1 / SIGMA**2, dtype=torch.double))
    for _ in range(200):
        optimizer.observe(torch.zeros(1, 1, dtype=torch.double), sigmas(1))
    expected = 14 / 3 * math.prod(min(kfac.MEMORY, k / (k + 1)) for k in range(3, 203))
    assert float(optimizer.state_dict()["factors"][0][0][0, 0]) == pytest.approx(expected)


def test_a_loaded_one_goes_on_as_the_one_that_was_saved():
    nets, after = [network([3, 4, 2], 0) for _ in range(2)], []
    first = KFAC(nets[0], 0.1, 0.01)
    first.observe(numbers(9, 3), sigmas(9))
    second = KFAC(nets[1], 0.1, 0.01)
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    for net, optimizer in zip(nets, (first, second)):
        optimizer.observe(numbers(9, 3, seed=1), sigmas(9))
        gradient(net, 5)
        optimizer.step()
        after.append(flat(net.parameters()))
    assert torch.equal(*after)


def test_a_copy_has_its_own_factors_and_network():
    net = network([3, 4, 2], 0)
    optimizer = KFAC(net, 0.1, 0.01)
    optimizer.observe(numbers(9, 3), sigmas(9))
    before, weights = copy.deepcopy(optimizer.state_dict()), flat(net.parameters())
    other, other_net = copy.deepcopy((optimizer, net))
    other.observe(numbers(9, 3, seed=1), sigmas(9))
    gradient(other_net, 5)
    other.step()
    assert torch.equal(flat(net.parameters()), weights) and not torch.equal(flat(other_net.parameters()), weights)
    for mine, kept in zip(optimizer.state_dict()["factors"], before["factors"], strict=True):
        assert all(map(torch.equal, mine, kept))


def test_layers_that_nothing_depends_on_stay_and_the_others_learn():
    """The last layer's weights are zero at first with network.output_scale=0: G of those before it is zero."""
    net = network([3, 4, 2], 0)
    with torch.no_grad():
        net[2].weight.zero_()
    optimizer, before = KFAC(net, 0.1, 0.01), copy.deepcopy(net)
    optimizer.observe(numbers(9, 3), sigmas(9))
    (net(numbers(9, 3)) ** 2 - net(numbers(9, 3))).mean().backward()
    optimizer.step()
    assert torch.equal(net[0].weight, before[0].weight) and not torch.equal(net[2].weight, before[2].weight)
    assert torch.isfinite(flat(net.parameters())).all()
