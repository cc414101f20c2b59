"""Ticks beside sensors that run free: their grid is led to where what the sensors say comes soonest.

Where nobody sends SYNC a tick begins anywhere between two samples, and decides by one that may be as old as a
period. A sensor that samples as often as the loop ticks keeps its distance, or drifts slowly; then the ticks
can keep theirs as well, and begin just before its frames come. One that samples at another rate comes now
sooner, now later, and on the average puts off nothing.
"""

from __future__ import annotations

BEHIND = 0.1  # of a period: a set is to come so long after its tick began
SHARE = 0.02  # of what that is off, by which the grid moves in a tick
MOST = 0.002  # of a period, by which it moves at most


class Phase:
    """By how much to move the grid; no clock."""

    __slots__ = ("_behind_ns", "_most_ns", "_period_ns")

    def __init__(self, period_ns: int) -> None:
        """Nothing has come.

        Args:
            period_ns: of the ticks.
        """
        self._period_ns = period_ns
        self._behind_ns = round(BEHIND * period_ns)
        self._most_ns = max(1, round(MOST * period_ns))

    def shift_ns(self, arrived_ns: int) -> int:
        """By how much later all ticks are to begin from the next one on [ns].

        Args:
            arrived_ns: when the newest set was complete, since the tick began; negative before.
        """
        half_ns = self._period_ns // 2
        off_ns = (arrived_ns - self._behind_ns + half_ns) % self._period_ns - half_ns
        return max(-self._most_ns, min(self._most_ns, round(SHARE * off_ns)))
