"""The last seconds as curves: of every 20 ms the two extremes, in the order in which they came. Pure."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Sequence

from pneud.log.live.packing import Drawn

BUCKET_NS = 20_000_000
SPAN_S = 12.0  # a little more than a page shows
# as the fields of `Drawn`
SIGNALS = ("error_mm", "position_mm", "reference_mm", "p1_bar", "p2_bar", "supply_bar", "command_v")
_SCALES = (1e3, 1e3, 1e3, 1e-5, 1e-5, 1e-5, 1.0)
_DIGITS = (4, 3, 3, 4, 4, 4, 4)

Extremes = tuple[float | None, float | None]


class Strip:
    """What pages draw."""

    def __init__(self) -> None:
        self._buckets: deque[tuple[int, list[Extremes]]] = deque(maxlen=round(SPAN_S * 1e9 / BUCKET_NS))
        self._open: list[Drawn] = []  # of the bucket that grows

    @property
    def newest(self) -> int:
        """Number of the newest bucket that is complete; −1 where there is none."""
        return self._buckets[-1][0] if self._buckets else -1

    def add(self, records: Iterable[Drawn]) -> None:
        """Take records in their order."""
        for record in records:
            if self._open and record.t_ns // BUCKET_NS != self._open[0].t_ns // BUCKET_NS:
                self._close()
            self._open.append(record)

    def _close(self) -> None:
        (first_ns, *_), columns = self._open[0], list(zip(*self._open, strict=True))[1:]
        found = [
            _extremes(column, scale, digits)
            for column, scale, digits in zip(columns, _SCALES, _DIGITS, strict=True)
        ]
        self._buckets.append((first_ns // BUCKET_NS, found))
        self._open = []

    def since(self, number: int) -> dict[str, list[float | None] | list[float]]:
        """What is behind a bucket: times [s], two a bucket, and the values of each signal."""
        new = []
        for at, values in reversed(self._buckets):
            if at <= number:
                break
            new.append((at, values))
        new.reverse()
        second = BUCKET_NS * 1e-9
        found: dict[str, list[float | None] | list[float]] = {
            "t": [round(second * t, 3) for at, _ in new for t in (at, at + 0.5)]
        }
        for k, name in enumerate(SIGNALS):
            found[name] = [value for _, values in new for value in values[k]]
        return found


def _extremes(values: Sequence[float], scale: float, digits: int) -> Extremes:
    known = [value for value in values if math.isfinite(value)]
    if not known:
        return None, None
    low, high = min(known), max(known)
    first, then = (low, high) if known.index(low) <= known.index(high) else (high, low)
    return round(first * scale, digits), round(then * scale, digits)
