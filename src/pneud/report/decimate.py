"""Hours of samples in a few thousand points that keep every peak, in one pass and bounded memory.

Samples are taken together in buckets, whose length doubles each time there are too many of them. Of each
bucket the least and the greatest value stay, in the order in which they came.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class Points(NamedTuple):
    """What is left of some columns."""

    t_s: Floats  # (n,), rising
    values: Floats  # (n, columns); NaN where a bucket has no finite value


class Envelope:
    """Least and greatest value of each bucket, column by column."""

    def __init__(self, columns: int, buckets: int) -> None:
        """Nothing so far; `buckets` are the most, and with more samples than that at least half as many."""
        self._limit = buckets
        self._level = 0  # a bucket holds 2**level samples
        self._t: list[Floats] = []
        self._low: list[Floats] = []
        self._high: list[Floats] = []
        self._rising: list[NDArray[np.bool_]] = []  # the least came first
        self._count = 0
        self._rest_t = np.empty(0)
        self._rest = np.empty((0, columns))

    def add(self, t_s: Floats, values: Floats) -> None:
        """Take samples: (n,) times, (n, columns) values."""
        t = np.concatenate((self._rest_t, t_s))
        v = np.concatenate((self._rest, np.where(np.isfinite(values), values, np.nan)))
        size = 1 << self._level
        whole = len(t) // size * size
        self._rest_t, self._rest = t[whole:], v[whole:]
        if whole:
            self._append(t[:whole:size], v[:whole].reshape(-1, size, v.shape[1]))
        while self._count > self._limit:
            self._halve()

    def _append(self, t: Floats, v: Floats) -> None:
        self._t.append(t)
        self._low.append(np.fmin.reduce(v, axis=1))
        self._high.append(np.fmax.reduce(v, axis=1))
        first_low = np.argmin(np.where(np.isnan(v), np.inf, v), axis=1)
        first_high = np.argmax(np.where(np.isnan(v), -np.inf, v), axis=1)
        self._rising.append(first_low <= first_high)
        self._count += len(t)

    def _halve(self) -> None:
        t, low, high, rising = self._joined()
        even = len(t) // 2 * 2
        low_a, low_b = low[:even:2], low[1:even:2]
        high_a, high_b = high[:even:2], high[1:even:2]
        low_first = ~(low_b < low_a) & ~np.isnan(low_a)  # the least of both stands in the first
        high_first = ~(high_b > high_a) & ~np.isnan(high_a)
        same = np.where(low_first, rising[:even:2], rising[1:even:2])
        # an odd one is left over and stays as it is
        self._rising = [np.where(low_first == high_first, same, low_first), rising[even:]]
        self._t = [t[:even:2], t[even:]]
        self._low = [np.fmin(low_a, low_b), low[even:]]
        self._high = [np.fmax(high_a, high_b), high[even:]]
        self._count = sum(map(len, self._t))
        self._level += 1

    def _joined(self) -> tuple[Floats, Floats, Floats, NDArray[np.bool_]]:
        return (
            np.concatenate(self._t),
            np.concatenate(self._low),
            np.concatenate(self._high),
            np.concatenate(self._rising),
        )

    def points(self) -> Points:
        """One point for each sample while they are few, else two for each bucket."""
        if len(self._rest_t):
            self._append(self._rest_t[:1], self._rest[None])
            self._rest_t, self._rest = self._rest_t[:0], self._rest[:0]
        if not self._t:
            return Points(np.empty(0), self._rest)
        t, low, high, rising = self._joined()
        if self._level == 0:
            return Points(t, low)
        middle = t + 0.5 * np.append(np.diff(t), 0.0)
        times = np.stack((t, middle), axis=1).ravel()
        values = np.empty((2 * len(t), low.shape[1]))
        values[0::2] = np.where(rising, low, high)
        values[1::2] = np.where(rising, high, low)
        return Points(times, values)


class Path:
    """A curve in the plane: of each bucket the samples at which a coordinate is least or greatest."""

    KEPT = 4  # of a bucket

    def __init__(self, buckets: int) -> None:
        """Nothing so far; `buckets` are the most, of four samples each."""
        self._limit = buckets
        self._level = 0
        self._rest = np.empty((0, 3))
        self._kept = np.empty((0, self.KEPT, 3))

    def add(self, t_s: Floats, x: Floats, y: Floats) -> None:
        """Take samples; those that are not finite are left out."""
        rows = np.stack((t_s, x, y), axis=1)
        rows = np.concatenate((self._rest, rows[np.isfinite(rows).all(axis=1)]))
        size = self.KEPT << self._level
        whole = len(rows) // size * size
        self._rest = rows[whole:]
        self._kept = np.concatenate((self._kept, _extremes(rows[:whole].reshape(-1, size, 3))))
        while len(self._kept) > self._limit:
            even = len(self._kept) // 2 * 2
            last = self._kept[even:]
            halved = _extremes(self._kept[:even].reshape(-1, 2 * self.KEPT, 3))
            self._level += 1
            self._kept = np.concatenate((halved, last))

    def points(self) -> Points:
        """The samples that were kept, in their order."""
        rows = np.concatenate((self._kept.reshape(-1, 3), self._rest))
        if len(self._rest) > self.KEPT:
            rows = np.concatenate((self._kept.reshape(-1, 3), _extremes(self._rest[None]).reshape(-1, 3)))
        return Points(rows[:, 0], rows[:, 1:])


def _extremes(buckets: Floats) -> Floats:
    """Of each bucket (n, m, 3) the four rows with the least and greatest x and y, in their order."""
    if not len(buckets):
        return np.empty((0, Path.KEPT, 3))
    x, y = buckets[:, :, 1], buckets[:, :, 2]
    places = np.stack((x.argmin(1), x.argmax(1), y.argmin(1), y.argmax(1)), axis=1)
    places.sort(axis=1)
    return np.take_along_axis(buckets, places[:, :, None], axis=1)
