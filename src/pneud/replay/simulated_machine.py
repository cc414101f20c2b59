"""What a scenario does to the machine, as far as a simulation has one: interface, processes that stop."""

from __future__ import annotations

from typing import Any

from pneud.scenario.format import InterfaceFault, Overload, StopProcess

HEALTHY, FULL, DOWN = 0, 1, 2  # the controller's way to the bus


class SimulatedMachine:
    """Asked in every tick of a simulation.

    Attributes:
        down: the interface is down in this tick.
        tx_failed: ticks in which nothing could be sent, so far.
        rx_dropped: frames that were lost on their way in; there are none.
    """

    rx_dropped = 0

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._t_ns = 0
        self._link, self._link_until_ns = HEALTHY, 0
        self._plant_until_ns = 0
        self._stall_ticks = 0
        self._overload_ticks, self._overload_until_ns = 0, 0
        self.down = False
        self.tx_failed = 0

    def begin(self, fault: Any) -> None:
        """A fault of the machine begins in this tick."""
        until_ns = self._t_ns + round(fault.for_s * 1e9) if fault.for_s is not None else 1 << 62
        if isinstance(fault, InterfaceFault):
            self._link = FULL if fault.kind == "queue_full" else DOWN
            self._link_until_ns = until_ns
        elif isinstance(fault, StopProcess) and fault.who == "daemon":
            self._stall_ticks = round(fault.for_s * 1e9 / self._period_ns)
        elif isinstance(fault, Overload):
            self._overload_ticks = round(fault.stand_s * 1e9 / self._period_ns)
            self._overload_until_ns = until_ns
        elif isinstance(fault, StopProcess) and fault.who == "plant":
            self._plant_until_ns = until_ns

    def skip(self, t_ns: int) -> int:
        """Ticks that the controller misses before the one that would be at `t_ns`."""
        skipped, self._stall_ticks = self._stall_ticks, 0
        if t_ns < self._overload_until_ns:
            skipped = max(skipped, self._overload_ticks)
        self._t_ns = t_ns + skipped * self._period_ns
        return skipped

    def link(self, t_ns: int) -> int:
        """The controller's way to the bus; to be asked once a tick."""
        link = self._link if t_ns < self._link_until_ns else HEALTHY
        self.down = link == DOWN
        self.tx_failed += link != HEALTHY
        return link

    def plant_stands(self, t_ns: int) -> bool:
        """Whether the plant's process stands still."""
        return t_ns < self._plant_until_ns
