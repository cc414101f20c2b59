"""What may take long, such as reading a file of a disk that stalls: done beside the console's turns."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

Then = Callable[[bool], None]
"""How to go on; told whether the work was done in time."""


class _Waiting(NamedTuple):
    until_s: float
    then: Then


def _in_a_thread(run: Callable[[], None]) -> None:
    threading.Thread(target=run, daemon=True).start()


class Beside:
    """One piece of work, done whenever somebody wants it done, and never twice at the same time.

    Attributes:
        descriptor: can be read from when `go_on` has something to do, but for who has waited for too long.
    """

    def __init__(
        self,
        work: Callable[[], None],
        clock: Callable[[], float] = time.monotonic,
        start: Callable[[Callable[[], None]], None] = _in_a_thread,
    ) -> None:
        self.descriptor = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._work = work
        self._clock = clock
        self._start = start
        self._under_way = False
        self._served: list[_Waiting] = []  # by the work under way
        self._next: list[_Waiting] = []  # by the next one: that under way began before they asked

    def do(self, patience_s: float, then: Then) -> None:
        """Do it, and go on with `then` in a later call of `go_on`."""
        self._next.append(_Waiting(self._clock() + patience_s, then))
        self._begin()

    def _begin(self) -> None:
        if self._next and not self._under_way:
            self._under_way, self._served, self._next = True, self._next, []
            self._start(self._run)

    def _run(self) -> None:
        try:
            self._work()
        finally:
            os.eventfd_write(self.descriptor, 1)

    def go_on(self) -> None:
        """Let those go on for whom it is done, or who have waited for too long."""
        over: list[tuple[Then, bool]] = []
        with suppress(BlockingIOError):
            os.eventfd_read(self.descriptor)
            over = [(waiting.then, True) for waiting in self._served]
            self._under_way, self._served = False, []
        self._begin()
        now_s = self._clock()
        for those in (self._served, self._next):
            over += [(waiting.then, False) for waiting in those if waiting.until_s < now_s]
            those[:] = (waiting for waiting in those if waiting.until_s >= now_s)
        for then, done in over:
            then(done)

    def close(self) -> None:
        """Go on with nothing; work that is still under way ends with the process."""
        if not self._under_way:
            os.close(self.descriptor)
