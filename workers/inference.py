"""The policy network's forward pass for rollouts, the same bits for a row whatever else is in the batch.

A BLAS product picks its kernel by the size of the batch, so that a row's last bits depend on how many environments a
worker has. Here every row sums its products in one fixed order, in blocks of rows of one size.
"""

import numpy as np
from numba import njit

_ROWS = 4  # rows, and inputs, that share one pass over the weights
_COLUMNS = 16  # inputs and outputs are padded to this, so that no column takes another code path than its neighbours


def _pad(array, axis):
    """A float32 array with one axis padded by zeros to a multiple of 16, contiguous."""
    array = np.asarray(array, dtype=np.float32)
    width = [(0, 0)] * array.ndim
    width[axis] = (0, -array.shape[axis] % _COLUMNS)
    return np.ascontiguousarray(np.pad(array, width))


@njit(cache=True, fastmath={"contract"})
def _layer(x, weight, bias, relu, y):
    """y (N, out) = x (N, in) @ weight (in, out) + bias, ReLU if asked. N and in are multiples of _ROWS.

    Four rows and four inputs at a time: twice as fast as one by one, as sums stay longer in registers.
    """
    for i in range(0, x.shape[0], _ROWS):
        y0, y1, y2, y3 = y[i], y[i + 1], y[i + 2], y[i + 3]
        x0, x1, x2, x3 = x[i], x[i + 1], x[i + 2], x[i + 3]
        y0[:], y1[:], y2[:], y3[:] = bias, bias, bias, bias
        for j in range(0, weight.shape[0], _ROWS):
            w0, w1, w2, w3 = weight[j], weight[j + 1], weight[j + 2], weight[j + 3]
            a0, a1, a2, a3 = x0[j], x0[j + 1], x0[j + 2], x0[j + 3]
            b0, b1, b2, b3 = x1[j], x1[j + 1], x1[j + 2], x1[j + 3]
            c0, c1, c2, c3 = x2[j], x2[j + 1], x2[j + 2], x2[j + 3]
            d0, d1, d2, d3 = x3[j], x3[j + 1], x3[j + 2], x3[j + 3]
            for o in range(weight.shape[1]):
                p, q, r, s = w0[o], w1[o], w2[o], w3[o]
                y0[o] += a0 * p + a1 * q + a2 * r + a3 * s
                y1[o] += b0 * p + b1 * q + b2 * r + b3 * s
                y2[o] += c0 * p + c1 * q + c2 * r + c3 * s
                y3[o] += d0 * p + d1 * q + d2 * r + d3 * s
        if relu:
            for k in range(i, i + _ROWS):
                row = y[k]
                for o in range(row.shape[0]):
                    row[o] = max(row[o], np.float32(0.0))


class PolicyNetwork:
    """A `workers.types.Policy` made ready for `num_rows` observations at a time."""

    def __init__(self, policy, num_rows):
        rows = num_rows + (-num_rows % _ROWS)
        self._mean, self._scale = policy.observation_mean, policy.observation_scale
        # padded inputs and outputs are zero: they add nothing
        self._weights = [(_pad(_pad(w, 0), 1), _pad(b, 0)) for w, b in zip(policy.weights, policy.biases)]
        self._input = np.zeros((rows, self._weights[0][0].shape[0]), dtype=np.float32)
        self._layers = [np.zeros((rows, bias.shape[0]), dtype=np.float32) for _, bias in self._weights]
        self._outputs = policy.biases[-1].shape[0]

    def mean(self, observation):
        """Mean actions (n, 31) float32 of observations (n, 282), n at most `num_rows`."""
        n = len(observation)
        used = n + (-n % _ROWS)
        inputs = self._input[:n, : observation.shape[1]]
        np.subtract(observation, self._mean, out=inputs)
        inputs *= self._scale
        np.clip(inputs, -10.0, 10.0, out=inputs)
        x = self._input[:used]
        for i, (weight, bias) in enumerate(self._weights):
            y = self._layers[i][:used]
            _layer(x, weight, bias, i + 1 < len(self._weights), y)
            x = y
        return x[:n, : self._outputs]
