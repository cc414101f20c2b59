"""What the kernel says of a network interface: whether it is CAN, up, and of which kind."""

import errno
import os
import socket
import struct
import sys
from collections.abc import Iterator
from typing import NamedTuple

_RTM_NEWLINK, _RTM_GETLINK, _NLM_F_REQUEST, _NLMSG_ERROR = 16, 18, 1, 2
_IFLA_IFNAME, _IFLA_MTU, _IFLA_LINKINFO, _IFLA_INFO_KIND = 3, 4, 18, 1
_ARPHRD_CAN, _IFF_UP = 280, 1
_HEADER = struct.Struct("=IHHII")  # nlmsghdr
_LINK = struct.Struct("=BxHiII")  # ifinfomsg
_ATTRIBUTE = struct.Struct("=HH")  # nlattr


class Interface(NamedTuple):
    """One interface; `kind` is "can" for hardware, "vcan" for a virtual one, "" where none is told."""

    is_can: bool
    up: bool
    kind: str
    mtu: int = 16  # bytes of the longest frame as the kernel lays it out: 72 with CAN FD


def query(name: str) -> Interface | None:
    """Ask the kernel (rtnetlink) about the interface `name`; None where there is none.

    Raises:
        OSError: the kernel does not answer.
    """
    encoded = os.fsencode(name) + b"\0"
    if len(encoded) > 16:
        return None
    attribute = _ATTRIBUTE.pack(_ATTRIBUTE.size + len(encoded), _IFLA_IFNAME) + encoded
    body = _LINK.pack(socket.AF_UNSPEC, 0, 0, 0, 0) + attribute + bytes(-len(attribute) % 4)
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as netlink:
        netlink.settimeout(1.0)
        netlink.send(_HEADER.pack(_HEADER.size + len(body), _RTM_GETLINK, _NLM_F_REQUEST, 1, 0) + body)
        answer = netlink.recv(65536)
    _, kind, _, _, _ = _HEADER.unpack_from(answer)
    if kind == _NLMSG_ERROR:
        code = -struct.unpack_from("=i", answer, _HEADER.size)[0]
        if code == errno.ENODEV:
            return None
        raise OSError(code, os.strerror(code))
    if kind != _RTM_NEWLINK:
        raise OSError(errno.EPROTO, "an unexpected answer from rtnetlink")
    _, hardware, _, flags, _ = _LINK.unpack_from(answer, _HEADER.size)
    told = dict(_attributes(answer[_HEADER.size + _LINK.size :]))
    info = told.get(_IFLA_LINKINFO, b"")
    mtu = int.from_bytes(told.get(_IFLA_MTU, b""), sys.byteorder)
    name_of_kind = dict(_attributes(info)).get(_IFLA_INFO_KIND, b"")
    is_can, kind_of = hardware == _ARPHRD_CAN, name_of_kind.rstrip(b"\0").decode()
    return Interface(is_can, bool(flags & _IFF_UP), kind_of, mtu)


def _attributes(data: bytes) -> Iterator[tuple[int, bytes]]:
    at = 0
    while at + _ATTRIBUTE.size <= len(data):
        length, kind = _ATTRIBUTE.unpack_from(data, at)
        if length < _ATTRIBUTE.size:
            return
        yield kind & 0x3FFF, data[at + _ATTRIBUTE.size : at + length]
        at += (length + 3) & ~3
