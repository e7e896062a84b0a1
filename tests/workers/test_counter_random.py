"""The counter-based random numbers: Random123's known answers, distributions, streams."""

import itertools

import numpy as np
import pytest
from scipy import stats

from workers.counter_random import ACTION, EVALUATION, STAY, TASK, fill_normal, philox, uniforms

ONES = 0xFFFFFFFF


@pytest.mark.parametrize(
    "counter, key, wanted",
    [
        ((0, 0, 0, 0), (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
        ((ONES,) * 4, (ONES,) * 2, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
        (
            (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
            (0xA4093822, 0x299F31D0),
            (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
        ),
    ],
)
def test_philox_gives_random123s_known_answers(counter, key, wanted):
    assert tuple(int(word) for word in philox(*(np.uint64(word) for word in (*counter, *key)))) == wanted


def draws(count=20_000, seed=1, purpose=TASK):
    return np.array([uniforms(seed, purpose, i % 100, i // 100, 0) for i in range(count)])


def test_uniforms_are_uniform_and_uncorrelated():
    u = draws()
    assert 0 < u.min() and u.max() < 1
    for column in u.T:
        assert stats.kstest(column, "uniform").pvalue > 1e-4
    off_diagonal = np.corrcoef(u.T)[np.triu_indices(4, 1)]
    assert np.abs(off_diagonal).max() < 5 / np.sqrt(len(u))
    # along one environment's counter, too
    one = u[:, 0].reshape(200, 100)
    assert abs(np.corrcoef(one[:-1].ravel(), one[1:].ravel())[0, 1]) < 5 / np.sqrt(one.size)


def test_no_two_streams_share_a_number():
    """Seed, purpose, environment, counter and block each make another stream, beyond 32 bits too."""
    large = [0, 1, 2**32 - 1, 2**32, 2**40]
    seen = [
        uniforms(seed, purpose, environment, counter, block)
        for seed, purpose, environment, counter, block in itertools.product(
            large, (TASK, STAY, ACTION, EVALUATION), [0, 1, 4095], large, [0, 7]
        )
    ]
    assert len({number for four in seen for number in four}) == 4 * len(seen)


def test_normals_have_the_normals_distribution():
    out = np.empty((2000, 31))
    fill_normal(4, ACTION, np.arange(2000), np.full(2000, 9), out)
    flat = out.ravel()
    assert abs(flat.mean()) < 5 / np.sqrt(flat.size)
    assert abs(flat.std() - 1) < 5 / np.sqrt(2 * flat.size)
    assert abs(stats.skew(flat)) < 0.05 and abs(stats.kurtosis(flat)) < 0.1
    assert stats.kstest(flat, "norm").pvalue > 1e-4
    assert np.abs(np.corrcoef(out.T) - np.eye(31)).max() < 6 / np.sqrt(len(out))


def test_a_rows_normals_depend_on_its_own_counters_only():
    environments, counters = np.array([5, 3, 900]), np.array([7, 7, 2**33])
    together = np.empty((3, 31))
    fill_normal(4, ACTION, environments, counters, together)
    for i in (2, 0, 1):
        alone = np.empty((1, 31))
        fill_normal(4, ACTION, environments[i : i + 1], counters[i : i + 1], alone)
        np.testing.assert_array_equal(alone[0], together[i])
    assert len(np.unique(together)) == together.size
