"""Classic CAN frames as the kernel lays them out, and the one way of reading them from a socket.

SocketCAN and unixcan both carry `struct can_frame` in packets and stamp each on arrival, so they share this.
"""

from __future__ import annotations

import socket
import struct
import time

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
STUFFING = 1.1

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


def wire_time_ns(data_bytes: int, bitrate_bit_s: float) -> int:
    """How long a frame is on the wire: 47 bits and its data, plus 10 % stuffing; 0 at infinite bit rate."""
    return round((FRAME_BITS + 8 * data_bytes) * STUFFING / bitrate_bit_s * 1e9)


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


class Reader:
    """Reads packets into a buffer made once; not for several threads.

    It takes one packet at a time: to ask an epoll set for more costs a fifth of trying in vain.
    """

    def __init__(self) -> None:
        self._packet = bytearray(PACKET.size + 1)  # one more, so that a longer packet shows
        self._buffers = (memoryview(self._packet),)
        self.dropped = 0  # packets that found the receive queue full, as the kernel counts them
        self.malformed = 0  # packets that are no frame

    def read(self, sock: socket.socket, offset_ns: int, into: list[Frame]) -> bool:
        """Append the next frame that waits in a non-blocking socket, if there is one.

        Args:
            sock: where from.
            offset_ns: what to take from the kernel's stamp.
            into: where to.

        Returns:
            False where the other end has closed and everything has been read.

        Raises:
            OSError: other than that nothing waits.
        """
        try:
            count, ancillary, _, _ = sock.recvmsg_into(self._buffers, _ANCILLARY)
        except BlockingIOError:
            return True
        if count == 0:
            return False
        can_id, length, data = PACKET.unpack_from(self._packet)
        if count != PACKET.size or length > 8:
            self.malformed += 1
            return True
        stamp_ns = 0
        for _, kind, value in ancillary:
            if kind == _SO_TIMESTAMPNS:
                seconds, nanoseconds = _TIMESPEC.unpack(value)
                stamp_ns = seconds * 1_000_000_000 + nanoseconds - offset_ns
            elif kind == _SO_RXQ_OVFL:
                self.dropped = _COUNT.unpack(value)[0]
        into.append(Frame(stamp_ns, can_id, data[:length]))
        return True
