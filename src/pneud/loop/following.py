"""The beat of a loop that follows the SYNC of another controller, in the place of the pacer.

A tick begins with the newest SYNC that has come. Those that it comes too late for are skipped and counted.
Where none comes, ticks go on by the clock, so that the valve is told of it, and `lost` says so.
"""

import time
from collections.abc import Callable
from typing import NamedTuple, Protocol

from pneud.bus.codec import Codec
from pneud.signals import Frame

_LATEST = 1.5  # periods after a SYNC, until when the next one is waited for


class Way(Protocol):
    """What is needed of the link to the bus."""

    @property
    def down(self) -> bool:
        """The interface was down or gone when last used."""

    def drain(self, into: list[Frame], wait_ns: int = 0) -> int:
        """Append what has arrived, after waiting for it if need be."""


class Beat(NamedTuple):
    """How a tick begins."""

    t_ns: int  # stamp of its SYNC, or now without one
    late_ns: int  # how late it is
    skipped: int  # ticks skipped just before
    sequence: int  # SYNC's counter, 0 where it has none or there is none
    lost: bool  # no SYNC has come for too long


class Following:
    """Waits for SYNC; `next` in every tick.

    Attributes:
        rest: what has come behind the SYNC of this tick.
    """

    def __init__(
        self,
        way: Way,
        sync: Codec,
        period_ns: int,
        patience_ns: int,
        clock: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Nothing has been waited for yet.

        Args:
            way: to the bus.
            sync: codec of SYNC.
            period_ns: from SYNC to SYNC.
            patience_ns: how long none may come.
            clock: CLOCK_MONOTONIC [ns]; replaced in tests.
            sleep: sleeps for seconds; may return early.
        """
        self.rest: list[Frame] = []
        self._way = way
        self._sync = sync
        self._counts = sync.counter_values > 1
        self._period_ns = period_ns
        self._patience_ns = patience_ns
        self._clock = clock
        self._sleep = sleep
        self._tick_ns = 0  # when the last tick began; 0 before the first
        self._synced_ns = 0  # when the last SYNC came, or waiting began
        self._alone = True  # the last tick had none

    def next(self, came: list[Frame]) -> Beat:
        """Wait for SYNC, or until it is time to go on without.

        Args:
            came: gets what has come up to SYNC, with it; all that has come without one.
        """
        clock, rest = self._clock, self.rest
        before_ns = self._tick_ns or clock()
        self._synced_ns = self._synced_ns or before_ns
        until_ns = before_ns + round((1.0 if self._alone else _LATEST) * self._period_ns)
        self._way.drain(rest)
        places = self._places(0, rest)
        while not places and (left_ns := until_ns - clock()) > 0:
            known = len(rest)
            if not self._way.drain(rest, left_ns) and self._way.down:
                # a dead interface is always readable: sleep, or this would spin at high priority
                self._sleep(max(0.0, (until_ns - clock()) * 1e-9))
            places = self._places(known, rest)
        now_ns, sequence = clock(), 0
        if places:
            sync = rest[places[-1]]
            came += rest[: places[-1] + 1]
            del rest[: places[-1] + 1]
            t_ns = self._synced_ns = sync.stamp_ns
            sequence = self._sync.counter(sync.data) if self._counts else 0
        else:
            came += rest
            rest.clear()
            t_ns = now_ns
        passed = round((t_ns - self._tick_ns) / self._period_ns) if self._tick_ns else 1
        self._tick_ns, self._alone = t_ns, not places
        lost = t_ns - self._synced_ns > self._patience_ns
        return Beat(t_ns, max(0, now_ns - t_ns), max(0, passed - 1), sequence, lost)

    def keep(self, came: list[Frame]) -> bool:
        """Keep for the next tick what has come from its SYNC on; whether anything has."""
        places = self._places(0, came)
        if places:
            self.rest += came[places[0] :]
            del came[places[0] :]
        return bool(places)

    def _places(self, begin: int, came: list[Frame]) -> list[int]:
        """Where SYNCs are among what has come, from a place on."""
        sync = self._sync
        return [
            n for n in range(begin, len(came)) if came[n].can_id == sync.can_id and sync.valid(came[n].data)
        ]
