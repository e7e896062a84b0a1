"""Random numbers as a pure function of (seed, environment, counter): no state to save, no order to keep.

Philox4x32-10 (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011). numpy's generators hold a state
per object, which for thousands of environments would mean a Python loop; this is the same idea as a compiled function.
"""

import math

import numpy as np
from numba import njit

# Purposes: streams that never share a number
TASK, STAY, ACTION, EVALUATION, DERIVATIVES = range(5)

_MASK = np.uint64(0xFFFFFFFF)
_M0, _M1 = np.uint64(0xD2511F53), np.uint64(0xCD9E8D57)
_W0, _W1 = np.uint64(0x9E3779B9), np.uint64(0xBB67AE85)
_SHIFT = np.uint64(32)


@njit(cache=True)
def philox(c0, c1, c2, c3, k0, k1):
    """Four 32-bit words (as uint64) of the counter (c0..c3) under the key (k0, k1), all 32-bit words as uint64."""
    for _ in range(10):
        p0, p1 = _M0 * c0, _M1 * c2
        c0, c1, c2, c3 = (p1 >> _SHIFT) ^ c1 ^ k0, p1 & _MASK, (p0 >> _SHIFT) ^ c3 ^ k1, p0 & _MASK
        k0, k1 = (k0 + _W0) & _MASK, (k1 + _W1) & _MASK
    return c0, c1, c2, c3


@njit(cache=True)
def uniforms(seed, purpose, environment, counter, block):
    """Four float64 in (0, 1). All arguments are non-negative integers; `block` numbers the calls of one counter."""
    key, count = np.uint64(seed), np.uint64(counter)
    words = philox(
        np.uint64(environment) & _MASK,
        count & _MASK,
        ((count >> _SHIFT) & np.uint64(0xFFFFFF)) | (np.uint64(purpose) << np.uint64(24)),
        np.uint64(block) & _MASK,
        key & _MASK,
        key >> _SHIFT,
    )
    unit = 1.0 / 4294967296.0
    return (words[0] + 0.5) * unit, (words[1] + 0.5) * unit, (words[2] + 0.5) * unit, (words[3] + 0.5) * unit


@njit(cache=True)
def fill_normal(seed, purpose, environments, counters, out):
    """Standard normal numbers into out (N, M), row i for (environments[i], counters[i]); Box-Muller."""
    for i in range(out.shape[0]):
        for block in range((out.shape[1] + 3) // 4):
            u = uniforms(seed, purpose, environments[i], counters[i], block)
            for pair in range(2):
                radius = math.sqrt(-2.0 * math.log(u[2 * pair]))
                angle = 2.0 * math.pi * u[2 * pair + 1]
                column = 4 * block + 2 * pair
                if column < out.shape[1]:
                    out[i, column] = radius * math.cos(angle)
                if column + 1 < out.shape[1]:
                    out[i, column + 1] = radius * math.sin(angle)
