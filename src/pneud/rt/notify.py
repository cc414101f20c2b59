"""Word to systemd (sd_notify): never blocks, never fails, does nothing where nobody listens."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Mapping


class Notifier:
    """Sends to the socket named by NOTIFY_SOCKET; without it every call does nothing."""

    def __init__(self, environ: Mapping[str, str] = os.environ) -> None:
        address = environ.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._socket: socket.socket | None = None
        if address:
            with contextlib.suppress(OSError):
                self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)

    def _send(self, message: bytes) -> None:
        if self._socket is not None:
            with contextlib.suppress(OSError):  # a manager that does not read must not stop the loop
                self._socket.sendto(message, self._address)

    def ready(self) -> None:
        """The service has started."""
        self._send(b"READY=1")

    def status(self, text: str) -> None:
        """One line for `systemctl status`."""
        self._send(b"STATUS=" + text.replace("\n", " ").encode(errors="replace"))

    def watchdog(self) -> None:
        """The loop makes progress."""
        self._send(b"WATCHDOG=1")

    def stopping(self) -> None:
        """The service is on its way out."""
        self._send(b"STOPPING=1")


def watchdog_interval_ns(environ: Mapping[str, str] = os.environ) -> int:
    """How often to call `Notifier.watchdog` [ns]: half of WATCHDOG_USEC; 0 where no watchdog waits for us."""
    try:
        usec = int(environ.get("WATCHDOG_USEC", "0"))
        pid = int(environ.get("WATCHDOG_PID", os.getpid()))
    except ValueError:
        return 0
    return usec * 500 if usec > 0 and pid == os.getpid() else 0
