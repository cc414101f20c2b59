"""The beat of the loop: absolute deadlines on a grid whose phase never moves.

A tick that comes late is run late; whole ticks that were missed are skipped and counted. At most one tick
falls into each period, so there is never a burst that catches up, and a process that was stopped wakes up to
one big skip. CLOCK_MONOTONIC stands still while the whole machine is suspended: the grid then goes on where
it was, and only a step of CLOCK_REALTIME against CLOCK_MONOTONIC tells.
"""

from __future__ import annotations

import time
from collections.abc import Callable


class Pacer:
    """Grid points every `period_ns`; the first call of `next` lays the grid.

    Args:
        period_ns: distance of grid points [ns], positive.
        spin_ns: how long before a grid point to give up sleeping and poll the clock [ns].
        clock: CLOCK_MONOTONIC [ns]; replaced in tests.
        sleep: sleeps for seconds; may return early.

    Raises:
        ValueError: the period is not positive, or spin_ns is negative or not below the period.
    """

    __slots__ = ("_clock", "_deadline_ns", "_sleep", "period_ns", "spin_ns")

    def __init__(
        self,
        period_ns: int,
        spin_ns: int = 0,
        clock: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        if period_ns <= 0:
            raise ValueError(f"period_ns = {period_ns} must be positive")
        if not 0 <= spin_ns < period_ns:
            raise ValueError(f"spin_ns = {spin_ns} must lie between 0 and the period of {period_ns} ns")
        self.period_ns = period_ns
        self.spin_ns = spin_ns
        self._clock = clock
        self._sleep = sleep
        self._deadline_ns: int | None = None

    def put_off(self, by_ns: int) -> None:
        """Move all grid points that are to come; to earlier where it is negative."""
        if self._deadline_ns is not None:
            self._deadline_ns += by_ns

    def next(self) -> tuple[int, int, int]:
        """Sleep until the next grid point.

        Returns:
            The ideal grid point [ns], how late it is now [ns], how many grid points were skipped before it.
            The wake-up itself came `lateness + skipped * period_ns` after the grid point that was waited for.
        """
        clock = self._clock
        now = clock()
        if self._deadline_ns is None:
            self._deadline_ns = now
            return now, 0, 0
        period = self.period_ns
        deadline = self._deadline_ns + period
        wake = deadline - self.spin_ns
        while now < wake:  # again when a signal handler or a coarse timer ended the sleep early
            self._sleep((wake - now) * 1e-9)
            now = clock()
        while now < deadline:
            now = clock()
        skipped = (now - deadline) // period
        deadline += skipped * period
        self._deadline_ns = deadline
        return deadline, now - deadline, skipped
