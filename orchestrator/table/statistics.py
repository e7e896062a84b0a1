"""What a few runs per row support: interval of a mean, difference between rows, error of a rate (docs/table.md).

Plain lists of numbers in, plain numbers out; random draws come from a fixed seed, so that a table is a function of its
runs.
"""

from functools import lru_cache

import numpy as np

CONFIDENCE = 0.95
RATE = 0.05  # of false marks among the marks of a table, as expected
TAILS = (1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2
ALL_RESAMPLES = 6**6
RESAMPLES = 20_000
PERMUTATIONS = 19_999  # up to 8 runs against 8 (12,870 ways to deal them out) the test is exact
FEWEST = 4  # runs per row below which no difference can be marked: 2 of 3 against 3 have 2 in 20 by chance
SEED = 0


def interval(values):
    """[low, high]: bootstrap (percentile) interval of the mean over runs; None if they are one, or one is None."""
    if len(values) < 2 or None in values:
        return None
    means = np.asarray(values, dtype=float)[resamples(len(values))].mean(axis=1)
    return np.quantile(means, TAILS, method="inverted_cdf").tolist()


@lru_cache
def resamples(count):
    """Indices (samples, count) of samples with replacement: all of them where they are few, else drawn at random."""
    if count**count <= ALL_RESAMPLES:
        return np.stack(np.unravel_index(np.arange(count**count), (count,) * count), axis=1)
    return np.random.default_rng(SEED).integers(count, size=(RESAMPLES, count))


def p_value(one, other):
    """Chance of means that are at least as far apart if the runs' rows had been dealt out at random; two-sided.

    A permutation test of the difference of means, exact up to 8 runs each. None for fewer than two, or if one is None.
    """
    if min(len(one), len(other)) < 2 or None in [*one, *other]:
        return None
    from scipy import stats

    def difference(a, b, axis):
        return a.mean(axis=axis) - b.mean(axis=axis)

    samples = [np.asarray(values, dtype=float) for values in (one, other)]
    found = stats.permutation_test(
        samples, difference, permutation_type="independent", vectorized=True, n_resamples=PERMUTATIONS,
        rng=np.random.default_rng(SEED),
    )  # fmt: skip
    return float(found.pvalue)


def marked(p_values):
    """Which of a table's differences are marked: {key: p or None} -> {key: bool}.

    Of 36 cells without any difference, about two would have p < 0.05. So the whole table counts as one question:
    Benjamini and Hochberg's procedure keeps the expected share of false marks among the marks below `RATE`.
    """
    tested = {key: p for key, p in p_values.items() if p is not None}
    if not tested:
        return dict.fromkeys(p_values, False)
    from scipy import stats

    adjusted = dict(zip(tested, stats.false_discovery_control(list(tested.values()), method="bh"), strict=True))
    return {key: bool(adjusted.get(key, 1.0) <= RATE) for key in p_values}


def rate_interval(rate, count):
    """[low, high]: Wilson's interval of a share of `count` tasks that one run reaches, as if drawn at random."""
    from scipy import stats

    found = stats.binomtest(round(rate * count), count).proportion_ci(CONFIDENCE, method="wilson")
    return [float(found.low), float(found.high)]
