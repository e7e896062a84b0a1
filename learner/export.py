"""The policy as a `torch.nn.Module`, for use outside this project: 282 numbers in, 31 out, nothing of Segue inside."""

import hashlib

import numpy as np
import torch
from torch import nn

LIMIT = 10.0  # the network sees observations clipped to this many deviations, as `workers.inference` does


class ExportedPolicy(nn.Module):
    """Mean actions (n, 31) float32 of observations (n, 282) float32, as `workers.inference.PolicyNetwork.mean`.

    Observations are those of `workers.observation`, as they are: normalising them is part of the module. An action is
    in units of `action.scale` radians (`workers.action`).
    """

    def __init__(self, policy):
        """policy: `workers.types.Policy`; its arrays are copied."""
        super().__init__()
        self.register_buffer("observation_mean", _tensor(policy.observation_mean))
        self.register_buffer("observation_scale", _tensor(policy.observation_scale))
        layers = []
        for weight, bias in zip(policy.weights, policy.biases, strict=True):
            layer = nn.Linear(*weight.shape)
            layer.weight.data, layer.bias.data = _tensor(weight.T), _tensor(bias)
            layers += [layer, nn.ReLU()]
        self.layers = nn.Sequential(*layers[:-1])

    def forward(self, observation):
        return self.layers(((observation - self.observation_mean) * self.observation_scale).clamp(-LIMIT, LIMIT))


def export(policy):
    """The `ExportedPolicy` of a `workers.types.Policy`, ready for use: in evaluation mode, without gradients."""
    return ExportedPolicy(policy).eval().requires_grad_(False)


def digest(policy):
    """SHA-256 (hex) of all that decides which action a policy takes in mean: two that are equal act alike."""
    content = hashlib.sha256()
    for array in (*policy.weights, *policy.biases, policy.observation_mean, policy.observation_scale):
        array = np.ascontiguousarray(array, dtype=np.float32)
        content.update(repr(array.shape).encode() + array.tobytes())
    return content.hexdigest()


def _tensor(array):
    return torch.from_numpy(np.array(array, dtype=np.float32, order="C"))  # a copy of its own, in rows
