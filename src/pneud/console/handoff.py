"""Requests on their way from the console to the loop, and answers on their way back.

Fixed-size messages over a SEQPACKET pair. The loop's end never waits; a request that has lain there for too
long is turned away, so that what was asked of a stalled loop does not happen later.
"""

from __future__ import annotations

import select
import socket
import struct
import time
from typing import NamedTuple

from pneud.signals import REQUEST_VALUES, Request, RequestKind, Tick

LATE = 255  # in place of an `Answer`: the axis has not seen the request
LATE_NS = 200_000_000

_REQUEST = struct.Struct(f"<IBB2xq{REQUEST_VALUES}d")  # number, kind, values, sent at, values
_ANSWER = struct.Struct("<IBB2xQQ")  # number, answer, state, present, latched
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

    def __init__(self, end: socket.socket, late_ns: int = LATE_NS) -> None:
        """Look at one end of a `crew.pair`.

        Args:
            end: the loop's.
            late_ns: how long a request may have been on its way.
        """
        self._end = end
        self._epoll = select.epoll()
        self._epoll.register(end, select.EPOLLIN)
        self._look = self._epoll.poll
        self._late_ns = late_ns
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
        number, kind, count, sent_ns, *values = _REQUEST.unpack(data)
        if kind not in _NEVER_LATE and time.monotonic_ns() - sent_ns > self._late_ns:
            self._send(number, LATE, 0, 0, 0)
            return None
        self._number = number
        return Request(kind, tuple(values[:count]))

    def answer(self, tick: Tick) -> None:
        """Tell what became of the request taken last; never waits."""
        self._send(self._number, tick.answer, tick.state, tick.present, tick.latched)

    def _send(self, number: int, answer: int, state: int, present: int, latched: int) -> None:
        try:
            self._end.send(_ANSWER.pack(number, answer, state, present, latched))
        except OSError:
            return  # a console that does not read, or is gone, learns nothing

    def close(self) -> None:
        """Close both descriptors."""
        self._epoll.close()
        self._end.close()


def send(end: socket.socket, number: int, request: Request) -> bool:
    """Hand a request over from the console's end.

    Returns:
        Whether there was room for it.
    """
    kind, values = request
    packed = _REQUEST.pack(number, kind, len(values), time.monotonic_ns(), *values, *_PADDING[len(values) :])
    try:
        end.send(packed)
    except OSError:
        return False
    return True


def receive(end: socket.socket) -> RequestOutcome | None:
    """The next answer at the console's end; None if there is none.

    Raises:
        EOFError: the loop is gone.
    """
    try:
        data = end.recv(_ANSWER.size)
    except BlockingIOError:
        return None
    except OSError:
        raise EOFError from None
    if len(data) != _ANSWER.size:
        raise EOFError
    return RequestOutcome._make(_ANSWER.unpack(data))
