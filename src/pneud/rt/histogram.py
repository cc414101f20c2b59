"""Durations counted in log-linear buckets: any percentile of any number of values in constant memory.

Each octave is cut into 64 equal buckets (after Tene's HdrHistogram), so that the middle of a bucket is within
1/128 of every value in it. Values below 128 ns are kept exactly.
"""

from __future__ import annotations

import math
from array import array
from bisect import bisect_left
from collections.abc import Sequence
from itertools import accumulate
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_BITS = 6  # 2**6 buckets an octave
_LARGEST = 2**63 - 1
RESOLUTION = 2.0 ** -(_BITS + 1)  # largest relative error of a percentile


def _index(ns: int) -> int:
    shift = ns.bit_length() - _BITS - 1
    return (shift << _BITS) + (ns >> shift) if shift > 0 else ns


def _bounds(index: int) -> tuple[int, int]:
    """Smallest and largest value [ns] that falls into a bucket."""
    shift = max((index >> _BITS) - 1, 0)
    low = (index - (shift << _BITS)) << shift
    return low, low + (1 << shift) - 1


_BUCKETS = _index(_LARGEST) + 1


class Histogram:
    """Counts of nanoseconds; `add` touches preallocated memory only."""

    __slots__ = ("_counts", "_largest", "_smallest", "_sum", "count")

    count: int
    """How many values were added."""

    def __init__(self) -> None:
        self._counts = array("Q", bytes(8 * _BUCKETS))
        self._smallest = _LARGEST
        self._largest = -1
        self._sum = 0
        self.count = 0

    def add(self, ns: int) -> None:
        """Count one duration [ns]; a negative one counts as 0, one beyond 2**63 − 1 as that."""
        # comparisons rather than min() and max(), whose calls would double the cost; likewise _index()
        if ns < 0:  # noqa: PLR1730
            ns = 0
        if ns > self._largest:
            ns = min(ns, _LARGEST)
            self._largest = ns
        if ns < self._smallest:  # noqa: PLR1730
            self._smallest = ns
        self._sum += ns
        self.count += 1
        shift = ns.bit_length() - _BITS - 1
        self._counts[(shift << _BITS) + (ns >> shift) if shift > 0 else ns] += 1

    def add_many(self, ns: NDArray[np.int64]) -> None:
        """As `add` of each."""
        import numpy as np  # noqa: PLC0415 - the loop does without

        if not len(ns):
            return
        ns = np.maximum(ns, 0)
        self._largest = max(self._largest, int(ns.max()))
        self._smallest = min(self._smallest, int(ns.min()))
        self._sum += (int((ns >> 32).sum()) << 32) + int((ns & 0xFFFF_FFFF).sum())  # a sum of all may not fit
        self.count += len(ns)
        bits = np.frexp(ns.astype(np.float64))[1].astype(np.int64)
        bits -= (ns > 0) & (ns >> np.maximum(bits - 1, 0) == 0)  # rounded up
        shift = np.maximum(bits - _BITS - 1, 0)
        for index, count in zip(
            *np.unique((shift << _BITS) + (ns >> shift), return_counts=True), strict=True
        ):
            self._counts[int(index)] += int(count)

    @property
    def max(self) -> float:
        """The largest value [ns], exact; NaN when there is none."""
        return float(self._largest) if self.count else math.nan

    @property
    def mean(self) -> float:
        """The mean [ns], exact; NaN when there is none."""
        return self._sum / self.count if self.count else math.nan

    def percentile(self, q: float) -> float:
        """The value [ns] that `q` percent of all values do not exceed (nearest rank), within `RESOLUTION`.

        Args:
            q: 0 … 100; 0 gives the smallest value and 100 the largest, both exact.

        Returns:
            NaN when there is no value.

        Raises:
            ValueError: q lies outside 0 … 100.
        """
        return self.percentiles((q,))[0]

    def percentiles(self, qs: Sequence[float]) -> list[float]:
        """Several percentiles in one pass, as `percentile`."""
        for q in qs:
            if not 0.0 <= q <= 100.0:
                raise ValueError(f"percentile {q:g} lies outside 0 … 100")
        if not self.count:
            return [math.nan] * len(qs)
        cumulative = list(accumulate(self._counts[: _index(self._largest) + 1]))
        return [self._at_rank(math.ceil(q / 100.0 * self.count), cumulative) for q in qs]

    def _at_rank(self, rank: int, cumulative: list[int]) -> float:
        if rank <= 1:
            return float(self._smallest)
        if rank >= self.count:
            return float(self._largest)
        low, high = _bounds(bisect_left(cumulative, rank))
        return float(min(max((low + high) // 2, self._smallest), self._largest))

    def merge(self, other: Histogram) -> None:
        """Add all values of another histogram."""
        for index, count in enumerate(other._counts):
            if count:
                self._counts[index] += count
        self._smallest = min(self._smallest, other._smallest)
        self._largest = max(self._largest, other._largest)
        self._sum += other._sum
        self.count += other.count

    def counts(self) -> list[tuple[int, int, int]]:
        """The buckets that hold values: (smallest, largest value of the bucket [ns], count), in order."""
        return [(*_bounds(i), n) for i, n in enumerate(self._counts) if n]
