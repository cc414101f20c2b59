"""CAN frames as the kernel lays them out, and the one way of reading them from a socket.

SocketCAN and unixcan both carry `struct can_frame` in packets, or `struct canfd_frame`, and stamp each on
arrival, so they share this. `frames.c` beside this file is `receive` and `send` in C.
"""

from __future__ import annotations

import math
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
# beside an identifier on its way to a socket, or from one; the kernel has no place for them there
FD_FLAG = 1 << 32  # a frame of CAN FD
SWITCH_FLAG = 1 << 33  # which switches its bit rate

PACKET = struct.Struct("=IB3x8s")
FD_PACKET = struct.Struct("=IBB2x64s")
FD_LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)
"""Bytes that a frame of CAN FD can carry."""
CLASSIC = -1
"""In the place of what marks frames of CAN FD: they are not frames here."""
_SWITCHED, _FD = 0x01, 0x04  # flags in such a packet

# what the controller's report of an error says: bits of the identifier, and of the second byte
ERR_CONTROLLER, ERR_BUS_OFF, ERR_RESTARTED = 0x004, 0x040, 0x100
ERR_PASSIVE, ERR_NOT_PASSIVE = 0x30, 0x4C  # passive; warning or active, so passive no longer

FRAME_BITS = 47  # of a standard frame without data, interframe space included
EXTENDED_BITS = 20  # more with a 29-bit identifier
STUFFING = 1.1

# of a frame of CAN FD, by the rate that they have: from its start to BRS, which may be stuffed, then ESI and
# DLC, likewise, before the data; behind them count of stuffed bits, checksum and what is stuffed into these
# in any case; then delimiters, acknowledgement, end of frame, interframe space
FD_HEAD_BITS, FD_EXTENDED_BITS, FD_CODE_BITS, FD_TAIL_BITS = 17, 19, 5, 13
_LONG_BYTES = 16  # the checksum of more data is longer
_CHECK_BITS, _LONG_CHECK_BITS = 27, 32

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


def fd_check_bits(data_bytes: int) -> int:
    """Bits of a frame of CAN FD between its data and the delimiter of its checksum."""
    return _CHECK_BITS if data_bytes <= _LONG_BYTES else _LONG_CHECK_BITS


def wire_time_ns(data_bytes: int, bitrate_bit_s: float, can_id: int = 0, data_bit_s: float = 0.0) -> int:
    """How long a frame is on the wire: 47 bits and its data, plus 10 % stuffing; 0 at infinite bit rate.

    An identifier of 29 bits, with its flag, takes 20 bits more. A frame of CAN FD has its data and what goes
    with them at a rate of its own.

    Args:
        data_bytes: of the frame.
        bitrate_bit_s: of the bus.
        can_id: identifier.
        data_bit_s: of the data of a frame of CAN FD; 0 for a classic one.
    """
    if data_bit_s and bitrate_bit_s < math.inf:
        head = FD_HEAD_BITS + (FD_EXTENDED_BITS if can_id & CAN_EFF_FLAG else 0)
        slow = head * STUFFING + FD_TAIL_BITS
        fast = (FD_CODE_BITS + 8 * data_bytes) * STUFFING + fd_check_bits(data_bytes)
        return round((slow / bitrate_bit_s + fast / data_bit_s) * 1e9)
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
    "Callable[[select.epoll, Sources, int, list[Frame], int, int, array[int], type[Frame], int], int]"
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
    fd: int,
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
        fd: `CLASSIC`, or what to mark the identifiers of frames of CAN FD with: 0, or `FD_FLAG` and, of those
            that have it, `SWITCH_FLAG`.

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
            if sock is None or not take(sock, offset_ns, into, counts, class_, fd):
                return descriptor
            if into:
                stamp_ns = into[-1].stamp_ns
                if stamp_ns < last_ns:
                    found = UNORDERED
                last_ns = stamp_ns
    return found


class Fd(NamedTuple):
    """What is sent as frames of CAN FD, on a bus that has them."""

    ids: frozenset[int]  # identifiers, as in `struct can_frame`
    switches: bool  # their data have a bit rate of their own


class Carriage(NamedTuple):
    """How frames are taken from sockets and given to them."""

    receive: Receive
    send: Send


def send(targets: tuple[socket.socket, ...], can_id: int, data: bytes, strict: bool, /) -> int:
    """Give one frame to non-blocking sockets, now or never.

    Args:
        targets: the sockets; one that is closed counts as gone.
        can_id: identifier, with its flag bits, `FD_FLAG` and `SWITCH_FLAG` among them.
        data: at most 8 bytes; 64, of one of `FD_LENGTHS`, with `FD_FLAG`.
        strict: raise what goes wrong; else only count who had no room.

    Returns:
        How many had no room for it.

    Raises:
        OSError: where strict.
        ValueError, struct.error: no such frame.
    """
    length, lost = len(data), 0
    if can_id >= FD_FLAG:
        if length not in FD_LENGTHS or can_id >> 32 not in (FD_FLAG >> 32, (FD_FLAG | SWITCH_FLAG) >> 32):
            raise ValueError("send: no frame of CAN FD has so many bytes, or such flags")
        flags = _FD | (_SWITCHED if can_id & SWITCH_FLAG else 0)
        packet = FD_PACKET.pack(can_id & 0xFFFFFFFF, length, flags, data)
    elif length > 8:
        raise ValueError("send: more than 8 bytes")
    else:
        packet = PACKET.pack(can_id, length, data)
    for sock in targets:
        try:
            sock.send(packet, _SEND_FLAGS)
        except OSError as e:
            if strict:
                raise
            lost += isinstance(e, BlockingIOError)
    return lost


def take(
    sock: socket.socket,
    offset_ns: int,
    into: list[Frame],
    counts: array[int],
    class_: type[Frame] = Frame,
    fd: int = CLASSIC,
) -> bool:
    """Append the next frame that waits in a non-blocking socket, if there is one; `fd` as for `receive`.

    Returns:
        False where the other end has closed and everything has been read.

    Raises:
        OSError: other than that nothing waits.
    """
    packet = bytearray(FD_PACKET.size + 1)  # one more, so that a longer packet shows
    try:
        count, ancillary, _, _ = sock.recvmsg_into((packet,), _ANCILLARY)
    except (BlockingIOError, ConnectionResetError):
        return True  # a reset comes ahead of what the other end had sent before it died
    if count == 0:
        return False
    flexible = fd >= 0 and count == FD_PACKET.size
    if flexible:
        can_id, length, flags, data = FD_PACKET.unpack_from(packet)
        if fd:
            can_id |= fd | (SWITCH_FLAG if flags & _SWITCHED else 0)
    else:
        can_id, length, data = PACKET.unpack_from(packet)
    if not (flexible or count == PACKET.size) or length > len(data):
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
