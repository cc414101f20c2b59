"""Durations counted in buckets of a 64th of an octave, arrays at a time."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

_PER_OCTAVE = 64
_OCTAVES = 64


class Spread:
    """Counts of nanoseconds; any percentile within one part in 128, the extremes exact."""

    def __init__(self) -> None:
        self.count = 0
        self.max_ns = -1
        self.min_ns = -1
        self._counts = np.zeros(_OCTAVES * _PER_OCTAVE, dtype=np.int64)

    def add(self, ns: NDArray[np.int64]) -> None:
        """Count durations [ns]; a negative one means that there was none."""
        ns = ns[ns >= 0]
        if not len(ns):
            return
        self.count += len(ns)
        self.max_ns = max(self.max_ns, int(ns.max()))
        least = int(ns.min())
        self.min_ns = least if self.min_ns < 0 else min(self.min_ns, least)
        mantissa, exponent = np.frexp(ns.astype(np.float64))
        place = np.floor((mantissa - 0.5) * 2 * _PER_OCTAVE).astype(np.int64)
        index = np.where(ns > 0, exponent * _PER_OCTAVE + place, 0)
        self._counts += np.bincount(index, minlength=len(self._counts))

    def percentile_ns(self, q: float) -> float:
        """The duration [ns] that `q` percent do not exceed (nearest rank); NaN if there is none."""
        if not self.count:
            return math.nan
        rank = max(1, math.ceil(q / 100.0 * self.count))
        if rank == self.count:
            return float(self.max_ns)
        index = int(np.searchsorted(np.cumsum(self._counts), rank))
        low, high = _bounds_ns(index)
        return min(max(0.5 * (low + high), float(self.min_ns)), float(self.max_ns))

    def in_words(self, between: str) -> str:
        """Median, 99 % and greatest [µs]."""
        return (
            between.join(f"{self.percentile_ns(q) / 1e3:.0f}" for q in (50, 99, 100)) if self.count else "–"
        )

    def buckets(self) -> list[tuple[int, int, int]]:
        """Those that hold something: least, greatest duration [ns] and count, in order."""
        found = []
        for index in np.flatnonzero(self._counts).tolist():
            low, high = _bounds_ns(index)
            found.append((math.floor(low), math.ceil(high), int(self._counts[index])))
        return found


def _bounds_ns(index: int) -> tuple[float, float]:
    exponent, place = divmod(index, _PER_OCTAVE)
    if index == 0:
        return 0.0, 0.0
    low = math.ldexp(0.5 + 0.5 * place / _PER_OCTAVE, exponent)
    return low, low + math.ldexp(0.5 / _PER_OCTAVE, exponent)
