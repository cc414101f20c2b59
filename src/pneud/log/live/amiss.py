"""Readings that their tick had to go without: how many were missing, late or odd, and how many lately.

A run bears them one at a time. Only their share over a window is a fault; how often they come tells before.
"""

from collections import deque
from typing import NamedTuple

from pneud.signals import ALL_SOURCES, Defect, Measurement, Source

LATELY_S = 60
NEVER_NS = 2**61  # a source's age above this means that it has never been heard

_CORRUPT, _FROZEN, _LATE = int(Defect.CORRUPT), int(Defect.FROZEN), int(Defect.LATE)
_ODD, _CONFIRMED = int(Defect.ODD), int(Defect.CONFIRMED)
_MARKED = _ODD | _CONFIRMED
_ENCODER, _PRESSURE, _VALVE = int(Source.ENCODER), int(Source.PRESSURE), int(Source.VALVE)


class Counts(NamedTuple):
    """Readings of all three sources."""

    missing: int = 0  # expected, but not there in time
    late: int = 0  # answered an earlier SYNC
    odd: int = 0  # beyond physics, and not confirmed by the next one


class Amiss:
    """Counts them, tick by tick.

    Attributes:
        all: since the start.
        corrupt: readings that were not there because frames were corrupt.
        frozen: likewise because their counter stood still.
    """

    def __init__(self, sync: bool = True) -> None:
        """None so far.

        Args:
            sync: every source owes a frame in every tick; of free-running ones nothing is ever missing.
        """
        self._sync = sync
        self._now_s = 0
        self._seconds: deque[tuple[int, Counts]] = deque(maxlen=LATELY_S)  # of those that had any
        self.all = Counts()
        self.corrupt = self.frozen = 0

    def add(self, m: Measurement) -> None:
        """Take the measurement of the next tick."""
        self._now_s = m.t_ns // 1_000_000_000
        if m.fresh == ALL_SOURCES and not (m.encoder_defects | m.pressure_defects) & _MARKED:
            return
        found = self._of(m)
        self.all = _counted(_sum(self.all, found))
        last = self._seconds.pop() if self._seconds and self._seconds[-1][0] == self._now_s else (0, Counts())
        self._seconds.append((self._now_s, _sum(last[1], found)))

    def _of(self, m: Measurement) -> Counts:
        """Those of one tick; an odd one that is confirmed takes back that it was."""
        missing = late = odd = 0
        for bit, age_ns, defects in (
            (_ENCODER, m.encoder_age_ns, m.encoder_defects),
            (_PRESSURE, m.pressure_age_ns, m.pressure_defects),
            (_VALVE, m.valve_age_ns, m.valve_defects),
        ):
            odd += (defects & _ODD != 0) - (defects & _CONFIRMED != 0)
            if not m.fresh & bit and age_ns <= NEVER_NS:
                late += defects & _LATE != 0
                self.corrupt += defects & _CORRUPT != 0
                self.frozen += defects & _FROZEN != 0
                missing += self._sync and not defects
        return Counts(missing, late, odd)

    def lately(self) -> Counts:
        """Those of the last minute."""
        total = Counts()
        for second, counts in self._seconds:
            if second > self._now_s - LATELY_S:
                total = _sum(total, counts)
        return _counted(total)


def _sum(a: Counts, b: Counts) -> Counts:
    return Counts(a.missing + b.missing, a.late + b.late, a.odd + b.odd)


def _counted(a: Counts) -> Counts:
    # one that is taken back may have been counted before this began
    return a._replace(odd=max(0, a.odd))
