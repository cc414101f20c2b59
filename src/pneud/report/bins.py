"""Averages over places: of one quantity, sorted by another, in one pass and bounded memory."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

FEWEST = 10  # values in a bin that counts
DRAWN = 400  # frequencies, at most


class Bins:
    """Mean, deviation and extremes of y by x."""

    def __init__(self, edges: Floats) -> None:
        self.edges = edges
        n = len(edges) - 1
        self.count, self._sum, self._square = (np.zeros(n) for _ in range(3))
        self.low, self.high = np.full(n, math.inf), np.full(n, -math.inf)

    def add(self, x: Floats, y: Floats) -> None:
        """Take values; those outside of the edges, or not finite, are left out."""
        place = np.searchsorted(self.edges, x, side="right") - 1
        kept = (place >= 0) & (place < len(self.count)) & np.isfinite(y)
        place, y = place[kept], y[kept]
        n = len(self.count)
        self.count += np.bincount(place, minlength=n)
        self._sum += np.bincount(place, y, n)
        self._square += np.bincount(place, y * y, n)
        np.minimum.at(self.low, place, y)
        np.maximum.at(self.high, place, y)

    def merged(self, most: int) -> Bins:
        """Neighbours taken together, so that few more than `most` bins have anything in them."""
        used = np.flatnonzero(self.count)
        each = max(1, -(-(int(used[-1] - used[0]) + 1) // most)) if len(used) else 1
        starts = np.arange(0, len(self.count), each)
        found = Bins(np.append(self.edges[starts], self.edges[-1]))
        found.count, found._sum, found._square = (
            np.add.reduceat(values, starts) for values in (self.count, self._sum, self._square)
        )
        found.low, found.high = np.minimum.reduceat(self.low, starts), np.maximum.reduceat(self.high, starts)
        return found

    @property
    def kept(self) -> NDArray[np.intp]:
        """The bins with enough in them."""
        return np.flatnonzero(self.count >= FEWEST)

    @property
    def x(self) -> Floats:
        """The middle of each bin that is kept."""
        middle: Floats = 0.5 * (self.edges[1:] + self.edges[:-1])
        return middle[self.kept]

    @property
    def mean(self) -> Floats:
        """Of each bin that is kept."""
        found: Floats = self._sum[self.kept] / self.count[self.kept]
        return found

    @property
    def deviation(self) -> Floats:
        """Standard deviation in each bin that is kept."""
        found: Floats = np.sqrt(
            np.maximum(self._square[self.kept] / self.count[self.kept] - self.mean**2, 0.0)
        )
        return found


def fine_about_zero(most: float, count: int) -> Floats:
    """Edges of bins from −most to most, 74 times as fine at 0 as at the ends."""
    steps = np.linspace(-5.0, 5.0, count + 1)
    return most * np.sinh(steps) / math.sinh(5.0)


class Spectrum:
    """Amplitude density of what is sampled evenly, by Welch's method: stretches that overlap by half."""

    def __init__(self, rate_hz: float, length: int) -> None:
        """Nothing so far; stretches are of so many samples, a power of two."""
        self._rate_hz, self._length = rate_hz, length
        self._rest = np.empty(0)
        self._next = -1
        self._sum: dict[int, Floats] = {}
        self._count: dict[int, int] = {}

    def add(self, number: NDArray[np.int64], values: Floats, wanted: NDArray[np.bool_]) -> None:
        """Take samples by their number; a stretch ends where one is not wanted, missing, or not finite."""
        good = wanted & np.isfinite(values)
        breaks = np.flatnonzero((np.diff(number) != 1) | (good[1:] != good[:-1])) + 1
        for part in np.split(np.arange(len(values)), breaks):
            if not len(part) or not good[part[0]]:
                self._end()
                continue
            if int(number[part[0]]) != self._next:
                self._end()
            self._next = int(number[part[-1]]) + 1
            self._rest = np.concatenate((self._rest, values[part]))
            while len(self._rest) >= self._length:
                self._take(self._rest[: self._length])
                self._rest = self._rest[self._length // 2 :]

    def _end(self) -> None:
        """What is left over counts where nothing longer has come."""
        left = 1 << (len(self._rest).bit_length() - 1) if len(self._rest) else 0
        if left >= 128 and left >= max(self._count, default=0):
            self._take(self._rest[:left])
        self._rest, self._next = np.empty(0), -1

    def _take(self, values: Floats) -> None:
        n = len(values)
        window = np.hanning(n)
        power = np.abs(np.fft.rfft((values - values.mean()) * window)) ** 2
        density = 2.0 * power / (self._rate_hz * float(window @ window))
        self._sum[n] = self._sum.get(n, np.zeros(len(density))) + density
        self._count[n] = self._count.get(n, 0) + 1

    def density(self) -> tuple[Floats, Floats]:
        """Frequencies [Hz] and the values' unit/√Hz, from the longest stretches that there were.

        Where they lie close together on a logarithmic axis, they are taken together.
        """
        self._end()
        if not self._count:
            return np.empty(0), np.empty(0)
        n = max(self._count)
        power = self._sum[n][1:] / self._count[n]
        place = np.arange(1, len(power) + 1)
        starts = np.unique(np.searchsorted(place, np.geomspace(1.0, len(power), DRAWN)))
        counts = np.diff(np.append(starts, len(power)))
        middle = np.add.reduceat(place, starts) / counts
        return middle * self._rate_hz / n, np.sqrt(np.add.reduceat(power, starts) / counts)
