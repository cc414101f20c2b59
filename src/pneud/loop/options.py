"""How a run goes, from the configuration and the command line."""

from typing import NamedTuple


class Options(NamedTuple):
    """How a run goes."""

    rate_hz: float
    set_deadline: float  # part of the period to wait for a complete set
    spin_us: float
    auto_arm: bool  # arm once, as soon as everything allows it
    duration_s: float | None  # None runs until it is told to stop
    end_on_fault: bool
    no_realtime: bool  # real-time scheduling is required and was refused
    unproven: bool = False  # the movement test has not been passed
    follow_s: float | None = None  # ticks begin with another controller's SYNC, which is lost after so long

    def ticks(self, seconds: float, least: int = 1) -> int:
        """So much time, in ticks."""
        return max(least, round(seconds * self.rate_hz))
