"""SocketCAN: a raw socket bound to one interface of the kernel."""

from __future__ import annotations

import errno
import os
import select
import socket
import struct

from pneud.bus import interfaces, wire
from pneud.signals import Frame

_SEND_BUFFER_BYTES = 4096  # some ten frames: a stale command is worth less than none
_RECEIVE_BUFFER_BYTES = 1024 * 1024
_SO_RCVBUFFORCE = 33
_CAN_RAW_ERR_FILTER, _CAN_RAW_FD_FRAMES = 2, 5
_FD_MTU = wire.FD_PACKET.size
_ALL_ERRORS = struct.pack("=I", 0x1FFFFFFF)
_EVERYTHING = struct.pack("=II", 0, 0)
_MOST_AT_ONCE = 4096  # a flood must not hold a caller for ever


class SocketCanError(Exception):
    """An interface cannot be opened; the text is one line for a person."""


class NotVirtualError(SocketCanError):
    """The interface may lead to real devices, and only a virtual one was asked for."""


class SocketCan:
    """A bus of the kernel."""

    def __init__(
        self,
        interface: str,
        *,
        virtual: bool = False,
        by: wire.Carriage = wire.CARRIAGE,
        fd: int = wire.CLASSIC,
    ) -> None:
        """Open `interface`.

        Args:
            interface: its name.
            virtual: refuse what might lead to real devices.
            by: how frames are taken and given.
            fd: what to mark the identifiers of frames of CAN FD with; without, there are none.

        Raises:
            NotVirtualError: not of kind vcan, though `virtual`.
            SocketCanError: no SocketCAN, no such interface, not up, no permission, no CAN FD though wanted.
        """
        self._receive, self._send = by
        self._fd = fd
        self._counts = wire.counts()
        self._name, self._virtual = interface, virtual
        self._check(interface, virtual)
        try:
            self._socket = socket.socket(
                socket.AF_CAN, socket.SOCK_RAW | socket.SOCK_NONBLOCK, socket.CAN_RAW
            )
        except OSError as e:
            raise SocketCanError(_reason(interface, e)) from None
        self._epoll = select.epoll()
        self._targets = (self._socket,)
        self._sources = {self._socket.fileno(): self._socket}
        try:
            self._configure(interface)
        except OSError as e:
            self.close()
            raise SocketCanError(_reason(interface, e)) from None

    @property
    def dropped(self) -> int:
        """Frames that found the receive queue full."""
        return self._counts[wire.DROPPED]

    def fileno(self) -> int:
        """A descriptor that is readable when there is something to drain."""
        return self._epoll.fileno()

    def drain(self, offset_ns: int, into: list[Frame], wait_ns: int = 0) -> int:
        """Append everything that has arrived, after waiting for something to happen if need be.

        Raises:
            OSError: the interface went down (ENETDOWN) or away (ENODEV).
        """
        before = len(into)
        self._receive(
            *(self._epoll, self._sources, offset_ns, into, _MOST_AT_ONCE),
            *(wait_ns, self._counts, Frame, self._fd),
        )
        return len(into) - before

    def send(self, can_id: int, data: bytes) -> None:
        """Hand one frame to the kernel.

        Raises:
            OSError: it has no room for it, or the interface is down or gone.
        """
        self._send(self._targets, can_id, data, True)

    def bind(self) -> bool:
        """Bind to whatever interface now has the name, if there is one that may be used.

        A socket whose interface is removed loses its filter with it, and would then hear error frames only.
        """
        try:
            self._check(self._name, self._virtual)
            self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, _EVERYTHING)
            self._socket.bind((self._name,))
        except (OSError, SocketCanError):
            return False
        return True

    def close(self) -> None:
        """Leave the bus."""
        self._epoll.close()
        self._socket.close()

    def _check(self, name: str, virtual: bool) -> None:
        if not hasattr(socket, "AF_CAN"):
            raise SocketCanError(_reason(name, OSError(errno.EAFNOSUPPORT, "")))
        try:
            found = interfaces.query(name)
        except OSError as e:
            raise SocketCanError(
                f"socketcan:{name}: the kernel does not tell about it: {e.strerror or e}"
            ) from None
        if found is None:
            raise SocketCanError(_reason(name, OSError(errno.ENODEV, "")))
        if not found.is_can:
            raise SocketCanError(f"socketcan:{name}: is not a CAN interface; see: ip -br link show type can")
        if virtual and found.kind != "vcan":
            kind = found.kind or "unknown"
            raise NotVirtualError(
                f"socketcan:{name}: is of kind {kind}, and a virtual run touches nothing but vcan;"
                " use --bus auto"
            )
        if not found.up:
            raise SocketCanError(_reason(name, OSError(errno.ENETDOWN, ""), found.kind))
        if self._fd >= 0 and found.mtu < _FD_MTU:
            cure = (
                "mtu 72 up" if found.kind == "vcan" else "up type can bitrate 1000000 dbitrate 4000000 fd on"
            )
            raise SocketCanError(
                f"socketcan:{name}: carries no CAN FD (bus.fd); sudo ip link set {name} down;"
                f" sudo ip link set {name} {cure}"
            )

    def _configure(self, name: str) -> None:
        sock = self._socket
        sock.setsockopt(socket.SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, _ALL_ERRORS)
        if self._fd >= 0:
            sock.setsockopt(socket.SOL_CAN_RAW, _CAN_RAW_FD_FRAMES, 1)
        wire.stamp_arrivals(sock)
        wire.count_overflows(sock)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
        try:
            sock.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _RECEIVE_BUFFER_BYTES)
        except OSError:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER_BYTES)
        sock.bind((name,))
        self._epoll.register(sock, select.EPOLLIN)


def _reason(name: str, error: OSError, kind: str = "can") -> str:
    """One line: what is wrong, and the cure."""
    code = error.errno
    if code in (errno.EAFNOSUPPORT, errno.EPROTONOSUPPORT, errno.ESOCKTNOSUPPORT):
        what = "this machine has no SocketCAN; sudo modprobe can-raw, or use --bus unixcan:NAME"
    elif code == errno.ENODEV:
        what = "no such interface; see: ip -br link show type can (and type vcan)"
    elif code == errno.ENETDOWN:
        settings = "" if kind == "vcan" else " type can bitrate 1000000 restart-ms 100"
        what = f"is down; sudo ip link set {name} up{settings}"
    elif code in (errno.EPERM, errno.EACCES):
        what = "not permitted; a service needs AF_CAN and AF_NETLINK in RestrictAddressFamilies"
    else:
        what = error.strerror or os.strerror(code or 0)
    return f"socketcan:{name}: {what}"
