"""The times of a recording as those of a log, in which no clock is ever set."""

from __future__ import annotations

from pneud.replay.remarks import Remarks

_OUT_OF_ORDER_NS = 1_000_000_000  # frames that came in turn may be stamped so much out of turn
_LONGEST_TICKS = 1 << 31  # a pause that is longer, no log can tell of
_SET = "the clock was set; what follows goes on from there"


class Times:
    """Takes the times of one frame after another."""

    def __init__(self, start_ns: int, offset_ns: int, period_ns: float, remarks: Remarks) -> None:
        """Nothing seen yet; `offset_ns` is what to take from the stamps."""
        self._begun_ns = self._newest_ns = start_ns - offset_ns
        self._shift_ns = offset_ns
        self._period_ns = round(period_ns)
        self._longest_ns = round(period_ns * _LONGEST_TICKS)
        self._sync_ns = -self._period_ns
        self._remarks = remarks

    @property
    def place(self) -> str:
        """How far the recording has come, in words."""
        return f"after {(self._newest_ns - self._begun_ns) * 1e-9:.3f} s"

    def at(self, stamp_ns: int, *, is_sync: bool) -> int:
        """The log's time of a frame."""
        time_ns = stamp_ns - self._shift_ns
        newest_ns = self._newest_ns
        backwards = time_ns < newest_ns - _OUT_OF_ORDER_NS or (is_sync and time_ns < self._sync_ns)
        if backwards or time_ns > newest_ns + self._longest_ns:
            goes_on_ns = max(newest_ns, self._sync_ns + self._period_ns) if is_sync else newest_ns
            by_ns = time_ns - goes_on_ns
            self._remarks.add(_SET, self.place, f" (by {by_ns * 1e-9:+.3f} s)")
            self._shift_ns += by_ns
            time_ns = goes_on_ns
        self._newest_ns = max(newest_ns, time_ns)
        if is_sync:
            self._sync_ns = time_ns
        return time_ns
