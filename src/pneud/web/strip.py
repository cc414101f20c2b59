"""The last seconds as curves: of every 20 ms the two extremes, in the order in which they came. Pure."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Sequence

from pneud.signals import Record

BUCKET_NS = 20_000_000
SPAN_S = 12.0  # a little more than a page shows
SIGNALS = ("error_mm", "position_mm", "reference_mm", "p1_bar", "p2_bar", "supply_bar", "command_v")
_DIGITS = (4, 3, 3, 4, 4, 4, 4)

Extremes = tuple[float | None, float | None]


class Strip:
    """What pages draw."""

    def __init__(self) -> None:
        self._buckets: deque[tuple[int, list[Extremes]]] = deque(maxlen=round(SPAN_S * 1e9 / BUCKET_NS))
        self._open: list[Record] = []  # of the bucket that grows

    @property
    def newest(self) -> int:
        """Number of the newest bucket that is complete; −1 where there is none."""
        return self._buckets[-1][0] if self._buckets else -1

    def add(self, records: Iterable[Record]) -> None:
        """Take records in their order."""
        for record in records:
            if self._open and _bucket_of(record) != _bucket_of(self._open[0]):
                self._close()
            self._open.append(record)

    def _close(self) -> None:
        columns = zip(*map(_values, self._open), strict=True)
        found = [_extremes(column, digits) for column, digits in zip(columns, _DIGITS, strict=True)]
        self._buckets.append((_bucket_of(self._open[0]), found))
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


def _bucket_of(record: Record) -> int:
    return record.tick.t_ns // BUCKET_NS


def _values(record: Record) -> tuple[float, ...]:
    tick = record.tick
    m = tick.measurement
    return (
        tick.error_m * 1e3,
        tick.estimate.position_m * 1e3,
        tick.reference.position_m * 1e3,
        m.p1_pa * 1e-5,
        m.p2_pa * 1e-5,
        m.supply_pa * 1e-5,
        tick.command.voltage_v,
    )


def _extremes(values: Sequence[float], digits: int) -> Extremes:
    known = [value for value in values if math.isfinite(value)]
    if not known:
        return None, None
    low, high = min(known), max(known)
    first, then = (low, high) if known.index(low) <= known.index(high) else (high, low)
    return round(first, digits), round(then, digits)
