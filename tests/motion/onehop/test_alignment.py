"""The distance of two windows, in closed form, in the kernels' float64, and as float32 lower bounds."""

import enumeration
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from motion.onehop.alignment import align
from motion.onehop.clips import ClipSet
from motion.onehop.distances import BIG, Workspace, fill
from motion.onehop.features import ROWS, Layout, Windows
from motion.onehop.pricing import exact


def random_windows(seed, frames=5, points=7):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(2, frames, points, 3)), rng.uniform(0.1, 1, (frames, points))


def turned(points, yaw, x, y):
    c, s = np.cos(yaw), np.sin(yaw)
    return points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + [x, y, 0]


@given(st.integers(0, 10**6), st.sampled_from([1.0, 1e-3, 1e-6]))
def test_distance_is_that_of_explicit_alignment_to_1e_9(seed, apart):
    """For similar windows too, where a difference of sums would lose all digits."""
    (a, noise), weights = random_windows(seed)
    b = turned(a + apart * noise, 2.0, 3.0, -1.0)
    d, alignment = align(a, b, weights)
    assert d == pytest.approx(enumeration.distance(a, b, weights), rel=1e-9)
    moved = turned(b, alignment.yaw, alignment.x, alignment.y)
    assert d == pytest.approx((weights / weights.sum() * ((a - moved) ** 2).sum(-1)).sum(), rel=1e-9)


@given(st.integers(0, 10**6))
def test_no_other_alignment_is_better(seed):
    (a, b), weights = random_windows(seed)
    d, best = align(a, b, weights)
    rng = np.random.default_rng(seed)
    for step in (1e-3, 0.1, 1.0):
        yaw, x, y = np.array([best.yaw, best.x, best.y]) + step * rng.normal(size=3)
        other = (weights / weights.sum() * ((a - turned(b, yaw, x, y)) ** 2).sum(-1)).sum()
        assert other >= d


@given(st.integers(0, 10**6), st.floats(-3, 3), st.floats(-300, 300))
def test_distance_is_symmetric_invariant_and_zero_for_the_same_motion(seed, yaw, x):
    (a, b), weights = random_windows(seed)
    d = align(a, b, weights)[0]
    assert align(b, a, weights)[0] == pytest.approx(d, rel=1e-9)
    assert align(a, turned(b, yaw, x, -x), weights)[0] == pytest.approx(d, rel=1e-9)
    assert align(a, a, weights)[0] == pytest.approx(0, abs=1e-28)
    assert align(a, turned(a, yaw, x, 1.0), weights)[0] == pytest.approx(0, abs=1e-20)


def test_windows_of_other_shapes_are_refused():
    with pytest.raises(ValueError, match="shape"):
        align(np.zeros((2, 3, 3)), np.zeros((3, 3, 3)))


@pytest.fixture(scope="module")
def slabs(builtin_set):
    """(windows, clip, first, slab, bound) of strips of fast and still clips, b = 30, plain and weighted frames."""
    layout = Layout.of(builtin_set, (30,))
    rng = np.random.default_rng(0)
    out = []
    for taps in (np.full(30, 1 / 30), rng.dirichlet(np.ones(30))):
        windows = Windows(layout, 30, np.full(17, 1 / 17), taps, scale=1.5)
        for clip, first in ((builtin_set.index("run"), 0), (builtin_set.index("idle"), 100), (3, 2)):
            count = min(ROWS, int(windows.counts[clip]) - first)
            slab = np.full((count, layout.columns), BIG)
            bound = fill(windows, clip, first, count, slab, Workspace())
            out.append((windows, clip, first, slab, bound))
    return out


def test_float32_slabs_are_lower_bounds_within_their_stated_error(builtin_set, slabs):
    """L <= D <= L + 2 e for every window pair of the strips, with D by explicit alignment; e grows by their tails."""
    rng, seen = np.random.default_rng(1), 0
    for windows, clip, first, slab, bound in slabs:
        assert bound < 1e-4
        weights = windows.weights.reshape(30, 17)
        for _ in range(300):
            row, other = rng.integers(len(slab)), rng.integers(len(builtin_set))
            column = rng.integers(windows.counts[other])
            d = 1.5 * enumeration.distance(
                builtin_set.window_points(clip, first + row, 30), builtin_set.window_points(other, column, 30), weights
            )
            column += windows.layout.first[other]
            low = float(slab[row, column])
            tails = 1.5 * 2 * windows.tail[windows.layout.first[clip] + first + row] * windows.tail[column]
            assert low <= d + 1e-12
            assert d <= low + 2 * (bound + tails) + 40 * 2.0**-24 * d
            seen += low > 0
    assert seen > 1000


def test_columns_without_a_window_are_no_candidates(slabs):
    for windows, _, _, slab, _ in slabs:
        for first, last in windows.pads:
            assert (slab[:, first:last] == BIG).all()


@settings(max_examples=40)
@given(st.integers(0, 10**6), st.sampled_from([0.0, 300.0]))
def test_float64_distance_of_the_kernels_is_explicit_alignment(make_clip, seed, offset):
    """To 1e-9 relative, also 300 m from the origin and across the seam of a loop."""
    rng = np.random.default_rng(seed)
    clips = ClipSet.from_clips(
        [make_clip(rng, "a", 12, True, offset=(offset, offset)), make_clip(rng, "b", 9, offset=(-offset, 0))]
    )
    layout = Layout.of(clips, (4,))
    weights = rng.uniform(0.1, 1, (4, 17))
    weights /= weights.sum()
    means, work = np.full((2, len(layout.frames)), np.nan), np.empty(weights.size)
    for a in (0, 5, 10):
        for c in (0, 5):
            rows = layout.frame0[0] + a, layout.frame0[1] + c
            got = exact(*layout.flat, weights.reshape(-1), 17, *rows, *means, work)
            expected = enumeration.distance(clips.window_points(0, a, 4), clips.window_points(1, c, 4), weights)
            assert got == pytest.approx(expected, rel=1e-9)
    assert exact(*layout.flat, weights.reshape(-1), 17, 3, 3, *means, work) == pytest.approx(0, abs=1e-15)
