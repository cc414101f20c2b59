"""Requests on their way from the console to the loop, and answers on their way back.

Fixed-size messages over a SEQPACKET pair. The loop's end never waits; a request that has lain there for too
long is turned away, so that what was asked of a stalled loop does not happen later. So is one whose console
has died meanwhile: whoever asked is no longer heard, and could not stop what begins.
"""

import select
import socket
import struct
import time
from collections.abc import Callable, Mapping
from typing import NamedTuple

from pneud.signals import REQUEST_VALUES, Request, RequestKind, Tick

LATE = 255  # in place of an `Answer`: the axis has not seen the request
LATE_NS = 200_000_000
MOST_AXES = 32

# number, kind, values, axis, consoles that had died before its own (the last byte), sent at, values
_REQUEST = struct.Struct(f"<IBBBBq{REQUEST_VALUES}d")
_ANSWER = struct.Struct("<IBBBx16s16s")  # number, answer, state, axis, present, latched
_NEVER_LATE = (RequestKind.STOP, RequestKind.DISARM)
_PADDING = (0.0,) * REQUEST_VALUES


class RequestOutcome(NamedTuple):
    """What became of a request, and how the axis stands after it."""

    number: int
    answer: int  # an `Answer`, or LATE
    state: int
    present: int
    latched: int


class LoopEnd:
    """The loop's end: a look costs a quarter of a microsecond where nothing has come."""

    def __init__(
        self, end: socket.socket, late_ns: int = LATE_NS, consoles_gone: Callable[[], int] = lambda: 0
    ) -> None:
        """Look at one end of a `crew.pair`.

        Args:
            end: the loop's.
            late_ns: how long a request may have been on its way.
            consoles_gone: how many consoles have died so far.
        """
        self._end = end
        self._epoll = select.epoll()
        self._epoll.register(end, select.EPOLLIN)
        self._look = self._epoll.poll
        self._late_ns = late_ns
        self._consoles_gone = consoles_gone
        self._number = 0

    def take(self) -> Request | None:
        """The next request, if there is one; never waits."""
        if not self._look(0):
            return None
        try:
            data = self._end.recv(_REQUEST.size)
        except OSError:
            data = b""
        if len(data) != _REQUEST.size:
            if not data:  # the console is gone
                self._epoll.unregister(self._end)
            return None
        self._number, _, request, late = _unpacked(data, self._late_ns, self._consoles_gone())
        if late:
            self._send(LATE, 0, 0, 0)
            return None
        return request

    def answer(self, tick: Tick) -> None:
        """Tell what became of the request taken last; never waits."""
        self._send(tick.answer, tick.state, tick.present, tick.latched)

    def _send(self, answer: int, state: int, present: int, latched: int, axis: int = 0) -> None:
        try:
            bits = present.to_bytes(16, "little"), latched.to_bytes(16, "little")
            self._end.send(_ANSWER.pack(self._number, answer, state, axis, *bits))
        except OSError:
            return  # a console that does not read, or is gone, learns nothing

    def close(self) -> None:
        """Close both descriptors."""
        self._epoll.close()
        self._end.close()


class SharedEnd(LoopEnd):
    """The loop's end where there are several axes, of which a message may ask one or more."""

    def take_all(self) -> dict[int, Request]:
        """The next requests, by the places of the axes, none where there are none; never waits."""
        if not self._look(0):
            return {}
        try:
            data = self._end.recv(_REQUEST.size * MOST_AXES)
        except OSError:
            data = b""
        if not data or len(data) % _REQUEST.size:
            if not data:  # the console is gone
                self._epoll.unregister(self._end)
            return {}
        parts = [data[i : i + _REQUEST.size] for i in range(0, len(data), _REQUEST.size)]
        found = [_unpacked(part, self._late_ns, self._consoles_gone()) for part in parts]
        self._number = found[0][0]
        if any(late for *_, late in found):
            self._send(LATE, 0, 0, 0)
            return {}
        return {axis: request for _, axis, request, _ in found}

    def answer_of(self, axis: int, tick: Tick) -> None:
        """Tell what became of the requests taken last, as one axis says; never waits."""
        self._send(tick.answer, tick.state, tick.present, tick.latched, axis)


def _unpacked(data: bytes, late_ns: int, consoles_gone: int) -> tuple[int, int, Request, bool]:
    """Number, axis, request, and whether it comes too late: after too long, or after its console's death."""
    number, kind, count, axis, console, sent_ns, *values = _REQUEST.unpack(data)
    late = time.monotonic_ns() - sent_ns > late_ns or console != consoles_gone & 0xFF
    return number, axis, Request(kind, tuple(values[:count])), late and kind not in _NEVER_LATE


def send(end: socket.socket, number: int, request: Request, console: int = 0) -> bool:
    """As `send_all`, to the only axis."""
    return send_all(end, number, {0: request}, console)


def send_all(end: socket.socket, number: int, asked: Mapping[int, Request], console: int = 0) -> bool:
    """Hand requests over from the console's end, to all axes at once.

    Args:
        end: the console's.
        number: of the message.
        asked: by the places of the axes, from 0.
        console: how many consoles had died when this one began.

    Returns:
        Whether there was room for it.
    """
    now_ns = time.monotonic_ns()
    packed = [
        _REQUEST.pack(
            number, kind, len(values), axis, console & 0xFF, now_ns, *values, *_PADDING[len(values) :]
        )
        for axis, (kind, values) in asked.items()
    ]
    try:
        end.send(b"".join(packed))
    except OSError:
        return False
    return True


def receive(end: socket.socket) -> RequestOutcome | None:
    """The next answer at the console's end; None if there is none.

    Raises:
        EOFError: the loop is gone.
    """
    found = receive_from(end)
    return found[1] if found is not None else None


def receive_from(end: socket.socket) -> tuple[int, RequestOutcome] | None:
    """As `receive`, with the place of the axis that says so."""
    try:
        data = end.recv(_ANSWER.size)
    except BlockingIOError:
        return None
    except OSError:
        raise EOFError from None
    if len(data) != _ANSWER.size:
        raise EOFError
    number, answer, state, axis, *words = _ANSWER.unpack(data)
    present, latched = (int.from_bytes(word, "little") for word in words)
    return axis, RequestOutcome(number, answer, state, present, latched)
