"""Stretches of time in which something held, found block by block; too many of them are drawn together."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_MOST = 2000


class Span(NamedTuple):
    """From the first tick of a stretch to the first one after it [s]."""

    begin_s: float
    end_s: float
    value: int


class Spans:
    """Stretches of equal, non-zero values."""

    def __init__(self) -> None:
        self._done: list[Span] = []
        self._value = 0
        self._begin_s = 0.0
        self._gap_s = 0.0

    @property
    def open(self) -> bool:
        """Whether a stretch goes on."""
        return self._value != 0

    def add(self, t_s: NDArray[np.float64], values: NDArray[np.int64]) -> None:
        """Take a block of ticks; 0 stands for nothing."""
        for index in np.flatnonzero(np.diff(values, prepend=self._value)).tolist():
            self._close(float(t_s[index]))
            self._value, self._begin_s = int(values[index]), float(t_s[index])

    def _close(self, t_s: float) -> None:
        if not self._value:
            return
        span = Span(self._begin_s, t_s, self._value)
        last = self._done[-1] if self._done else None
        if last is not None and last.value == span.value and span.begin_s - last.end_s <= self._gap_s:
            self._done[-1] = last._replace(end_s=t_s)
            return
        self._done.append(span)
        if len(self._done) > _MOST:
            self._draw_together()

    def _draw_together(self) -> None:
        """Close gaps, ever greater ones, until half of the stretches are left or they differ in value."""
        for _ in range(40):
            if len(self._done) <= _MOST // 2:
                return
            self._gap_s = max(1e-3, 2.0 * self._gap_s)
            merged = self._done[:1]
            for span in self._done[1:]:
                last = merged[-1]
                if last.value == span.value and span.begin_s - last.end_s <= self._gap_s:
                    merged[-1] = last._replace(end_s=span.end_s)
                else:
                    merged.append(span)
            self._done = merged

    def finish(self, t_s: float) -> list[Span]:
        """All stretches, the last one ended."""
        self._close(t_s)
        self._value = 0
        return self._done
