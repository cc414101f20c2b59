"""Who is connected to the console, what each may use up, and what is on its way to the loop."""

from __future__ import annotations

import select
import selectors
import socket
from collections.abc import Callable
from typing import NamedTuple

from pneud.console.beside import Then
from pneud.console.lease import LEASE_S
from pneud.console.line_stream import MAX_LINE
from pneud.console.orders import Orders
from pneud.console.peer import Peer
from pneud.console.protocol import Error, ProtocolError

LINES = 4  # of a client in a turn, and on their way: nobody's stop waits for more of everybody else's


class ClientBounds(NamedTuple):
    """What clients may use up."""

    clients: int = 32
    rate_hz: float = 100.0  # requests a second of one client, when it has used up the burst
    burst: float = 200.0
    jobs: int = 64  # that wait for the loop
    unsent_bytes: int = 256 * 1024
    unsent_s: float = 5.0  # after which who does not read is dropped
    silent_s: float = 1.0  # after which the loop counts as silent
    look_s: float = 0.2  # that a status waits for a file; then it has what was read before
    read_s: float = 3.0  # that a reload waits for a file
    lease_s: float = LEASE_S


BOUNDS = ClientBounds()


class Connected:
    """A client: what it has sent and is still to get, and the pace that is due to it."""

    def __init__(self, connection: socket.socket, peer: Peer, read_only: bool, now_s: float, burst: float):
        self.connection = connection
        self.peer = peer
        self.read_only = read_only
        self.received = bytearray()
        self.unsent = bytearray()
        self.tokens = burst
        self.paced_s = self.active_s = self.sent_s = now_s
        self.interest = selectors.EVENT_READ
        self.has_gone = False  # has hung up; of what it has sent before, stops are done, and nothing else
        self.ended = False  # sends what is left, then goes
        self.mistakes = 0  # not yet in the log
        self.quiet_until_s = 0.0
        self.awaits = 0  # replies that depend on a file

    @property
    def has_line(self) -> bool:
        """Whether it has sent a line that is not taken yet, or one that is too long."""
        return b"\n" in self.received or len(self.received) >= MAX_LINE

    @property
    def is_due(self) -> bool:
        """Whether it has sent something that is not taken yet, and could be."""
        return self.interest == 0 and self.tokens >= 1.0 and self.awaits < LINES

    def hung_up(self) -> bool:
        """Whether it has gone by now, whatever it has sent before."""
        look = select.poll()
        look.register(self.connection, select.POLLRDHUP)
        return bool(look.poll(0))

    def awaiting(self, then: Then) -> Then:
        """How to go on with a reply, which is awaited until then."""
        self.awaits += 1

        def go_on(read: bool) -> None:
            self.awaits -= 1
            then(read)

        return go_on

    def next_line(self) -> bytes | None:
        """The next line that is complete.

        Raises:
            ProtocolError: it is, or is going to be, too long.
        """
        end = self.received.find(b"\n", 0, MAX_LINE)
        if end < 0:
            if len(self.received) >= MAX_LINE:
                raise ProtocolError(
                    Error.TOO_LONG, f"a line has at most {MAX_LINE} bytes; the connection ends here"
                )
            return None
        found = bytes(self.received[:end])
        del self.received[: end + 1]
        return found


class Job:
    """A plan under way; its client may have gone (None) meanwhile."""

    def __init__(
        self,
        client: Connected | None,
        number: int | None,
        plan: Orders,
        label: str,
        refused: Callable[[ProtocolError], None] | None = None,
    ) -> None:
        self.client = client
        self.number = number
        self.plan = plan
        self.label = label
        self.refused = refused
        self.next = 0
        self.begun = False  # something of it may have been done
        self.ended = False  # its client has been told that it is not done
