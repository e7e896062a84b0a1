"""K-FAC: the natural gradient of the policy, its Fisher information approximated layer by layer as a Kronecker product.

The trust region limits how far the policy's means move, F = E[J' J / sigma^2] with J the Jacobian of the 31 means by
the weights. For a Gaussian policy of given sigma this is its Fisher information, and F^-1 g is the direction that gains
most for a given KL divergence (Kakade, "A natural policy gradient", 2001). Of a layer that computes s = W x, F is
nearly A (x) G with A = E[x x'] and G = E[J_s' J_s] / sigma^2, so that F^-1 g = G^-1 g A^-1 (Martens and Grosse,
"Optimizing neural networks with Kronecker-factored approximate curvature", 2015). Where sigma differs between samples,
both means have the weights 1 / sigma^2.
"""

import torch
from torch import nn

MEMORY = 0.95  # decay per update of the running averages of A and G
SPARSE = 8  # G is of every eighth input: a Jacobian of 31 rows costs as much as 31 gradients
_LEAST = 1e-20  # mean eigenvalue: a layer that the outputs do not depend on (yet) has G = 0 and a gradient of zero


class KFAC:
    """Steps down the natural gradient of an MLP (`nn.Sequential` of `nn.Linear` and `nn.ReLU`) whose outputs are the
    means of Gaussians; used as a `torch.optim.Optimizer` is. `observe` first, and again as the network changes.

    damping: added to each factor's diagonal, in units of the mean of its eigenvalues. sparse: see `factors`.
    """

    def __init__(self, network, lr, damping, sparse=SPARSE):
        self.param_groups = [{"lr": lr}]
        self._layers = [layer for layer in network if isinstance(layer, nn.Linear)]
        self._damping, self._sparse, self._seen = damping, sparse, 0
        self._factors = [  # (A, G) of each layer
            (layer.weight.new_zeros([layer.in_features + 1] * 2), layer.weight.new_zeros([layer.out_features] * 2))
            for layer in self._layers
        ]
        self._inverses = None

    def state_dict(self):
        """The running averages."""
        return {"seen": self._seen, "factors": self._factors}

    def load_state_dict(self, state):
        """Go on from them."""
        self._seen = state["seen"]
        for mine, saved in zip(self._factors, state["factors"], strict=True):
            for factor, value in zip(mine, saved, strict=True):
                factor.copy_(value)

    @torch.no_grad()
    def observe(self, inputs, sigma):
        """Let the factors take in the network as it is, at inputs (n, 282) at which actions have the deviation sigma
        (n,): plain means at first, then running ones."""
        decay = min(MEMORY, self._seen / (self._seen + 1))
        self._seen += 1
        self._inverses = []
        for kept, new in zip(self._factors, factors(self._layers, inputs, sigma, self._sparse), strict=True):
            for factor, value in zip(kept, new, strict=True):
                factor.lerp_(value, 1 - decay)
            self._inverses.append([_inverse(factor, self._damping) for factor in kept])

    def zero_grad(self, set_to_none=True):
        """Forget the gradients of the last step."""
        for layer in self._layers:
            layer.zero_grad(set_to_none)

    @torch.no_grad()
    def step(self):
        """Every parameter less lr times its part of the natural gradient."""
        parameters = [parameter for layer in self._layers for parameter in (layer.weight, layer.bias)]
        for parameter, natural in zip(parameters, self.natural([p.grad for p in parameters]), strict=True):
            parameter -= self.param_groups[0]["lr"] * natural

    def natural(self, gradients):
        """G^-1 dW A^-1 of gradients in the order of the network's parameters, a bias being the weight of a one."""
        found = []
        for weight, bias, (a, g) in zip(gradients[::2], gradients[1::2], self._inverses, strict=True):
            both = g @ torch.cat([weight, bias[:, None]], dim=1) @ a
            found += [both[:, :-1], both[:, -1]]
        return found


def factors(layers, inputs, sigma, sparse=1):
    """[(A, G)] of the linear layers of an MLP: means over inputs (n, 282) of x x' with x (n, in + 1), a one appended,
    weighted by 1 / sigma^2, sigma (n,), and of J_s' J_s / sigma^2, J_s (n, 31, out) the Jacobian of the network's
    outputs by the layer's; this one over the inputs 0, sparse, 2 sparse, ... only."""
    precision = 1 / sigma.double() ** 2
    weight = (precision / precision.mean()).to(inputs.dtype)
    seen, hidden = [], inputs
    for layer in layers:
        seen.append(torch.cat([hidden, hidden.new_ones(len(hidden), 1)], dim=1))
        hidden = torch.relu(layer(hidden))  # that of the last layer is not used
    some, outputs = weight[::sparse], layers[-1].out_features
    jacobian = torch.eye(outputs, dtype=inputs.dtype, device=inputs.device) * some.sqrt()[:, None, None]
    found = []
    for i in reversed(range(len(layers))):
        rows = jacobian.reshape(len(some) * outputs, -1)
        found.append(
            (
                (seen[i] * weight[:, None]).T @ seen[i] / len(inputs),
                rows.T @ rows / (len(some) / precision.mean().item()),
            )
        )
        if i:
            jacobian = (jacobian @ layers[i].weight) * (seen[i][::sparse, None, :-1] > 0)
    return found[::-1]


def _inverse(factor, damping):
    """(factor + damping * mean eigenvalue * identity)^-1, in double precision on the way; not finite if it is not."""
    wide = factor.double()
    added = damping * wide.diagonal().mean().clamp(min=_LEAST)
    wide = wide + added * torch.eye(len(wide), dtype=wide.dtype, device=wide.device)
    return torch.cholesky_inverse(torch.linalg.cholesky_ex(wide).L).to(factor.dtype)
