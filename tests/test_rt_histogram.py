"""The histogram against numpy on the same values."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pneud.rt.histogram import RESOLUTION, Histogram

DURATIONS = st.one_of(
    st.integers(0, 300),
    st.integers(0, 10_000_000),
    st.integers(0, 2**63 - 1),
    st.integers(0, 63).map(lambda n: 2**n - 1),
    st.integers(0, 62).map(lambda n: 2**n),
)


def filled(values: list[int]) -> Histogram:
    h = Histogram()
    for value in values:
        h.add(value)
    return h


@given(st.lists(DURATIONS, min_size=1, max_size=200), st.floats(0, 100))
def test_percentiles_agree_with_numpy_within_the_resolution(values: list[int], q: float) -> None:
    h = filled(values)
    exact = sorted(values)[max(math.ceil(q / 100.0 * len(values)) - 1, 0)]
    assert abs(h.percentile(q) - exact) <= exact * RESOLUTION * (1 + 1e-12)


@given(st.lists(st.integers(0, 10_000_000), min_size=1, max_size=200))
def test_common_percentiles_agree_with_numpy(values: list[int]) -> None:
    h = filled(values)
    for q in (0, 25, 50, 75, 100):
        exact = float(np.percentile(values, q, method="inverted_cdf"))
        assert abs(h.percentile(q) - exact) <= exact * RESOLUTION


def test_resolution_is_within_three_percent() -> None:
    assert RESOLUTION <= 0.03


@given(st.lists(DURATIONS, min_size=1, max_size=100))
def test_count_mean_and_extremes_are_exact(values: list[int]) -> None:
    h = filled(values)
    assert h.count == len(values)
    assert h.mean == sum(values) / len(values)
    assert h.max == h.percentile(100) == float(max(values))
    assert h.percentile(0) == float(min(values))


@given(st.lists(DURATIONS, max_size=60), st.lists(DURATIONS, max_size=60))
def test_merging_equals_adding_everything_to_one(a: list[int], b: list[int]) -> None:
    merged = filled(a)
    merged.merge(filled(b))
    both = filled(a + b)
    assert merged.counts() == both.counts()
    assert merged.count == both.count
    if a or b:
        assert merged.mean == both.mean
        assert merged.percentiles((0, 50, 99, 100)) == both.percentiles((0, 50, 99, 100))


@given(st.lists(DURATIONS, max_size=60))
def test_counts_cover_every_value_once_in_disjoint_ordered_buckets(values: list[int]) -> None:
    buckets = filled(values).counts()
    for low, high, n in buckets:
        assert n == sum(low <= v <= high for v in values) > 0
    assert sum(n for _, _, n in buckets) == len(values)
    assert all(a[1] < b[0] for a, b in itertools.pairwise(buckets))


def test_neighbouring_buckets_leave_no_gap() -> None:
    lows_and_highs = [(low, high) for low, high, _ in filled(list(range(5000))).counts()]
    assert lows_and_highs[0][0] == 0
    assert all(b[0] == a[1] + 1 for a, b in itertools.pairwise(lows_and_highs))


def test_nothing_added_gives_nan() -> None:
    h = Histogram()
    assert h.count == 0
    assert h.counts() == []
    assert all(math.isnan(v) for v in (h.max, h.mean, h.percentile(50)))


def test_values_out_of_range_are_clamped() -> None:
    h = filled([-5, 2**70])
    assert h.percentile(0) == 0.0
    assert h.max == float(2**63 - 1)


@pytest.mark.parametrize("q", [-0.1, 100.1, math.nan])
def test_a_percentile_outside_its_range_is_refused(q: float) -> None:
    with pytest.raises(ValueError, match="outside 0 … 100"):
        filled([1]).percentile(q)
