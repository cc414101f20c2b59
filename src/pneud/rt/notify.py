"""Word to systemd (sd_notify): never blocks, never fails, does nothing where nobody listens."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Mapping, Sequence

RESTART_US = 90_000_000  # without a sign of life, as at a start
REPORT_S = 0.25  # the shortest time between two reports
PUNCTUAL = 0.02  # of the ticks may be skipped by a loop that counts as being on time
SETTLED = 2  # reports on end without more, and the service is ready


class Service:
    """What a loop that systemd runs tells it: ready, alive, how it stands; from the progress of its ticks.

    It is ready once its ticks have been on time for a while; what it controls may be waiting for its nodes
    meanwhile. A loop that hangs tells nothing, and the watchdog ends it.
    """

    def __init__(
        self,
        rate_hz: float,
        states: Sequence[str],
        faults: Sequence[str],
        environ: Mapping[str, str] = os.environ,
    ) -> None:
        address = self._address = address_of(environ)
        self._socket: socket.socket | None = None
        if address:
            with contextlib.suppress(OSError):
                self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        self._interval_ns = watchdog_interval_ns(environ)
        period_s = min(REPORT_S, self._interval_ns * 1e-9) if self._interval_ns else REPORT_S
        # ticks from one call of `report` to the next; 0 where nobody listens
        self.every = max(1, int(period_s * rate_hz)) if self._socket is not None else 0
        self._states = [f"STATUS={name}".encode() for name in states]
        self._faults = [name.encode() for name in faults]
        self._told: tuple[int, int] | None = None
        self._alive_ns = 0
        self._punctual = 0

    def report(self, t_ns: int, skipped: int, state: int, faults: int) -> None:
        """Tell what is new; to be called every `every` ticks."""
        if self._punctual < SETTLED:
            if skipped > PUNCTUAL * self.every:
                self._punctual = 0
                self._send(b"STATUS=starting: the loop is late; see pneud doctor")
                return
            self._punctual += 1
            if self._punctual < SETTLED:
                return
            # a start in the same process has had more time than the watchdog usually gives
            usual = b"\nWATCHDOG_USEC=%d" % (self._interval_ns // 500) if self._interval_ns else b""
            if not self._send(b"READY=1" + usual):
                self._punctual -= 1
                return
        if self._told != (state, faults):
            named = b", ".join([name for bit, name in enumerate(self._faults) if faults >> bit & 1])
            if self._send(self._states[state] + (b": " + named if named else b"")):
                self._told = state, faults
        if self._interval_ns and t_ns - self._alive_ns >= self._interval_ns and self._send(b"WATCHDOG=1"):
            self._alive_ns = t_ns

    def stopping(self) -> None:
        """Tell that the service is on its way out."""
        self._send(b"STOPPING=1")

    def _send(self, message: bytes) -> bool:
        """Whether there was room for it: a manager that does not read for a while is told later."""
        if self._socket is not None:
            with contextlib.suppress(OSError):  # one that does not read at all must not stop the loop
                self._socket.sendto(message, self._address)
                return True
        return False


def restarting(environ: Mapping[str, str] = os.environ) -> None:
    """Tell that this process begins anew, and how long it may be silent."""
    address = address_of(environ)
    if not address:
        return
    words = b"STATUS=beginning anew"
    if watchdog_interval_ns(environ):
        words += b"\nWATCHDOG=1\nWATCHDOG_USEC=%d" % RESTART_US
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as word:
        word.setblocking(False)
        word.sendto(words, address)


def address_of(environ: Mapping[str, str]) -> str:
    """Of the manager's socket; empty where nobody listens."""
    address = environ.get("NOTIFY_SOCKET", "")
    return "\0" + address[1:] if address.startswith("@") else address


def watchdog_interval_ns(environ: Mapping[str, str]) -> int:
    """How often to tell of life [ns]: half of WATCHDOG_USEC; 0 where no watchdog waits for this process."""
    try:
        usec = int(environ.get("WATCHDOG_USEC", "0"))
        pid = int(environ.get("WATCHDOG_PID", os.getpid()))
    except ValueError:
        return 0
    return usec * 500 if usec > 0 and pid == os.getpid() else 0
