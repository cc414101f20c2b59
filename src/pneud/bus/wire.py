"""Classic CAN frames as the kernel lays them out, and the one way of reading them from a socket.

SocketCAN and unixcan both carry `struct can_frame` in packets and stamp each on arrival, so they share this.
`frames.c` beside this file is `receive` and `send` in C.
"""

from __future__ import annotations

import select
import socket
import struct
import time
from array import array
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, TypeAlias

from pneud.signals import Frame

CAN_EFF_FLAG = 0x80000000  # 29-bit identifier
CAN_RTR_FLAG = 0x40000000  # asks for a frame instead of carrying one
CAN_ERR_FLAG = 0x20000000  # the controller's report of an error
CAN_FLAGS = CAN_EFF_FLAG | CAN_RTR_FLAG | CAN_ERR_FLAG

PACKET = struct.Struct("=IB3x8s")

# what the controller's report of an error says: bits of the identifier, and of the second byte
ERR_CONTROLLER, ERR_BUS_OFF, ERR_RESTARTED = 0x004, 0x040, 0x100
ERR_PASSIVE, ERR_NOT_PASSIVE = 0x30, 0x4C  # passive; warning or active, so passive no longer

FRAME_BITS = 47  # of a standard frame without data, interframe space included
EXTENDED_BITS = 20  # more with a 29-bit identifier
STUFFING = 1.1

_SEND_FLAGS = socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL
_SO_TIMESTAMPNS = 35
_SO_RXQ_OVFL = 40
_TIMESPEC = struct.Struct("@ll")
_COUNT = struct.Struct("@I")
_ANCILLARY = socket.CMSG_SPACE(_TIMESPEC.size) + socket.CMSG_SPACE(_COUNT.size)


def stamp_arrivals(sock: socket.socket) -> None:
    """Have the kernel note when each packet arrives (CLOCK_REALTIME)."""
    sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)


def count_overflows(sock: socket.socket) -> None:
    """Have the kernel tell how many packets found the receive queue full."""
    sock.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)


def wire_time_ns(data_bytes: int, bitrate_bit_s: float, can_id: int = 0) -> int:
    """How long a frame is on the wire: 47 bits and its data, plus 10 % stuffing; 0 at infinite bit rate.

    An identifier of 29 bits, with its flag, takes 20 bits more.
    """
    bits = FRAME_BITS + 8 * data_bytes + (EXTENDED_BITS if can_id & CAN_EFF_FLAG else 0)
    return round(bits * STUFFING / bitrate_bit_s * 1e9)


def realtime_offset_ns(attempts: int = 5) -> int:
    """CLOCK_REALTIME minus CLOCK_MONOTONIC, from the tightest of several readings."""
    best, offset = 1 << 62, 0
    for _ in range(attempts):
        before = time.monotonic_ns()
        real = time.time_ns()
        after = time.monotonic_ns()
        if after - before < best:
            best, offset = after - before, real - (before + after) // 2
    return offset


SOURCE = Path(__file__).with_name("frames.c")
ORDERED, UNORDERED = -1, -2  # everything has been taken; in the order of its stamps, or perhaps not

Sources: TypeAlias = dict[int, socket.socket]
Receive: TypeAlias = (
    "Callable[[select.epoll, Sources, int, list[Frame], int, int, array[int], type[Frame]], int]"
)
"""`receive`, or its twin in C."""
Send: TypeAlias = Callable[[tuple[socket.socket, ...], int, bytes, bool], int]
"""`send`, or its twin in C."""

DROPPED, MALFORMED = 0, 1  # places in the counts


def counts() -> array[int]:
    """Two counts for `receive`: packets that found the receive queue full, packets that are no frame."""
    return array("q", (0, 0))


def receive(
    epoll: select.epoll,
    sources: Sources,
    offset_ns: int,
    into: list[Frame],
    most: int,
    wait_ns: int,
    counts: array[int],
    class_: type[Frame],
    /,
) -> int:
    """Append what waits at the sockets of an epoll set until nothing is left; one packet at a time.

    Args:
        epoll: the set, level-triggered.
        sources: the non-blocking sockets in it that frames are expected from, by descriptor.
        offset_ns: what to take from the kernel's stamps.
        into: where to.
        most: how many frames may come at the most, or a few more.
        wait_ns: how long to wait for something to happen.
        counts: as from `counts`.
        class_: of the frames.

    Returns:
        `ORDERED` or `UNORDERED`; or, before everything has been taken, a descriptor that is no source, or one
        whose other end has closed.

    Raises:
        OSError: of a source.
    """
    if wait_ns > 0:
        select.select((epoll,), (), (), wait_ns * 1e-9)
    enough, last_ns, found = len(into) + most, 0, ORDERED
    while len(into) < enough and (ready := epoll.poll(0, 16)):
        for descriptor, _ in ready:
            sock = sources.get(descriptor)
            if sock is None or not take(sock, offset_ns, into, counts, class_):
                return descriptor
            if into:
                stamp_ns = into[-1].stamp_ns
                if stamp_ns < last_ns:
                    found = UNORDERED
                last_ns = stamp_ns
    return found


class Carriage(NamedTuple):
    """How frames are taken from sockets and given to them."""

    receive: Receive
    send: Send


def send(targets: tuple[socket.socket, ...], can_id: int, data: bytes, strict: bool, /) -> int:
    """Give one frame to non-blocking sockets, now or never.

    Args:
        targets: the sockets; one that is closed counts as gone.
        can_id: identifier, with its flag bits.
        data: at most 8 bytes.
        strict: raise what goes wrong; else only count who had no room.

    Returns:
        How many had no room for it.

    Raises:
        OSError: where strict.
        ValueError, struct.error: no such frame.
    """
    if len(data) > 8:
        raise ValueError("send: more than 8 bytes")
    packet, lost = PACKET.pack(can_id, len(data), data), 0
    for sock in targets:
        try:
            sock.send(packet, _SEND_FLAGS)
        except OSError as e:
            if strict:
                raise
            lost += isinstance(e, BlockingIOError)
    return lost


def take(
    sock: socket.socket, offset_ns: int, into: list[Frame], counts: array[int], class_: type[Frame] = Frame
) -> bool:
    """Append the next frame that waits in a non-blocking socket, if there is one.

    Returns:
        False where the other end has closed and everything has been read.

    Raises:
        OSError: other than that nothing waits.
    """
    packet = bytearray(PACKET.size + 1)  # one more, so that a longer packet shows
    try:
        count, ancillary, _, _ = sock.recvmsg_into((packet,), _ANCILLARY)
    except (BlockingIOError, ConnectionResetError):
        return True  # a reset comes ahead of what the other end had sent before it died
    if count == 0:
        return False
    can_id, length, data = PACKET.unpack_from(packet)
    if count != PACKET.size or length > 8:
        counts[MALFORMED] += 1
        return True
    stamp_ns = 0
    for _, kind, value in ancillary:
        if kind == _SO_TIMESTAMPNS:
            seconds, nanoseconds = _TIMESPEC.unpack(value)
            stamp_ns = seconds * 1_000_000_000 + nanoseconds - offset_ns
        elif kind == _SO_RXQ_OVFL:
            counts[DROPPED] = _COUNT.unpack(value)[0]
    into.append(class_(stamp_ns, can_id, data[:length]))
    return True


CARRIAGE = Carriage(receive, send)
"""In Python."""
