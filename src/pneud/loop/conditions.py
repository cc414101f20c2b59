"""What the host has to say in a tick, in a running loop and in simulated time.

What does not depend on the answers is found before they come, when there is time for it.
"""

from __future__ import annotations

from typing import Protocol

from pneud.bus.inbox import Inbox
from pneud.signals import Host

FOREIGN_S = 1.0  # how long another controller counts as present after its last frame
FOREIGN_NS = round(FOREIGN_S * 1e9)
# plain numbers: an operation on a flag of the enum module costs ten times as much
LINK_DOWN, SEND_FAILED = int(Host.LINK_DOWN), int(Host.SEND_FAILED)
RECEIVE_OVERFLOW, OTHER_CONTROLLER = int(Host.RECEIVE_OVERFLOW), int(Host.OTHER_CONTROLLER)


class BusWay(Protocol):
    """The controller's way to the bus."""

    @property
    def down(self) -> bool:
        """The interface was down or gone when last used."""

    @property
    def tx_failed(self) -> int:
        """Frames that could not be sent, so far."""

    @property
    def rx_dropped(self) -> int:
        """Frames that were lost on their way in, so far."""


class Conditions:
    """The host of one axis; in every tick `early` once SYNC has left, `host` when the answers have come."""

    __slots__ = ("_foreign", "_foreign_until_ns", "_inbox", "_rx_dropped", "_t_ns", "_tx_failed", "_way")

    def __init__(self, inbox: Inbox, way: BusWay) -> None:
        self._inbox = inbox
        self._way = way
        self._tx_failed = way.tx_failed
        self._rx_dropped = way.rx_dropped
        self._foreign = inbox.foreign
        self._foreign_until_ns = 0
        self._t_ns = 0

    def early(self, t_ns: int, others: int) -> int:
        """Bits of `signals.Host` that do not depend on the answers.

        Args:
            t_ns: this tick's SYNC.
            others: bits from elsewhere: what machine, clock and recorder lack.
        """
        way, host = self._way, others
        self._t_ns = t_ns
        if way.tx_failed != self._tx_failed:
            self._tx_failed = way.tx_failed
            host |= SEND_FAILED
        if way.rx_dropped != self._rx_dropped:
            self._rx_dropped = way.rx_dropped
            host |= RECEIVE_OVERFLOW
        return host

    def host(self, early: int) -> int:
        """All bits of `signals.Host`, with those from `early`."""
        inbox = self._inbox
        host = early | inbox.conditions
        if inbox.foreign != self._foreign:
            self._foreign = inbox.foreign
            self._foreign_until_ns = self._t_ns + FOREIGN_NS
        if self._t_ns < self._foreign_until_ns:
            host |= OTHER_CONTROLLER
        if self._way.down:
            host |= LINK_DOWN
            inbox.bus_restarted()
        return host
