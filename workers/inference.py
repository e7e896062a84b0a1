"""The policy network's forward pass for rollouts, the same bits for a row whatever else is in the batch.

A BLAS product picks its kernel by the size of the batch, so that a row's last bits depend on how many environments a
worker has. Here every row sums its products in one fixed order, in blocks of rows of one size.
"""

import numpy as np
from numba import njit

_ROWS = 8  # rows that share one pass over the weights
_COLUMNS = 16  # outputs are padded to this, so that no column takes another code path than its neighbours


def pad_columns(matrix):
    """A float32 array with its last axis padded by zeros to a multiple of 16, contiguous."""
    matrix = np.asarray(matrix, dtype=np.float32)
    extra = -matrix.shape[-1] % _COLUMNS
    return np.ascontiguousarray(np.pad(matrix, [(0, 0)] * (matrix.ndim - 1) + [(0, extra)]))


@njit(cache=True, fastmath={"contract"})
def _layer(x, weight, bias, relu, y):
    """y (N, out) = x (N, in) @ weight (in, out) + bias, ReLU if asked. N is a multiple of _ROWS."""
    for block in range(0, x.shape[0], _ROWS):
        rows = y[block : block + _ROWS]
        for r in range(_ROWS):
            rows[r, :] = bias
        for j in range(weight.shape[0]):
            w = weight[j]
            for r in range(_ROWS):
                value = x[block + r, j]
                row = rows[r]
                for o in range(w.shape[0]):
                    row[o] += value * w[o]
        if relu:
            for r in range(_ROWS):
                row = rows[r]
                for o in range(row.shape[0]):
                    row[o] = max(row[o], np.float32(0.0))


class PolicyNetwork:
    """A `workers.types.Policy` made ready for `num_rows` observations at a time."""

    def __init__(self, policy, num_rows):
        rows = num_rows + (-num_rows % _ROWS)
        self._mean, self._scale = policy.observation_mean, policy.observation_scale
        self._weights = []
        inputs = policy.weights[0].shape[0]
        for weight, bias in zip(policy.weights, policy.biases):
            # zero rows for the padded outputs of the layer before
            self._weights.append((pad_columns(np.pad(weight, [(0, inputs - weight.shape[0]), (0, 0)])), pad_columns(bias)))
            inputs = self._weights[-1][0].shape[1]
        self._input = np.zeros((rows, policy.weights[0].shape[0]), dtype=np.float32)
        self._layers = [np.zeros((rows, bias.shape[0]), dtype=np.float32) for _, bias in self._weights]
        self._outputs = policy.biases[-1].shape[0]

    def mean(self, observation):
        """Mean actions (n, 31) float32 of observations (n, 282), n at most `num_rows`."""
        n = len(observation)
        used = n + (-n % _ROWS)
        np.subtract(observation, self._mean, out=self._input[:n])
        self._input[:n] *= self._scale
        np.clip(self._input[:n], -10.0, 10.0, out=self._input[:n])
        x = self._input[:used]
        for i, (weight, bias) in enumerate(self._weights):
            y = self._layers[i][:used]
            _layer(x, weight, bias, i + 1 < len(self._weights), y)
            x = y
        return x[:n, : self._outputs]
