"""Who is at the other end of a Unix socket, as the kernel says."""

import array
import contextlib
import grp
import os
import socket
import struct
from typing import NamedTuple

GROUP = "pneud"
"""Members may command, beside root and the daemon's own user."""

_SO_PEERGROUPS = 59
_CREDENTIALS = struct.Struct("3i")
_GROUPS_BYTES = 1024  # the most that getsockopt takes: 256 groups


class Peer(NamedTuple):
    """Another process, at the time at which it connected."""

    pid: int
    uid: int
    groups: frozenset[int]

    @property
    def label(self) -> str:
        """The peer as logs have it."""
        return f"uid {self.uid} pid {self.pid}"


def peer_of(connection: socket.socket) -> Peer:
    """Who connected.

    Raises:
        OSError: the kernel does not say.
    """
    data = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    pid, uid, gid = _CREDENTIALS.unpack(data)
    more = array.array("I")
    with contextlib.suppress(OSError):  # in more groups than that: only the first one counts
        more.frombytes(connection.getsockopt(socket.SOL_SOCKET, _SO_PEERGROUPS, _GROUPS_BYTES))
    return Peer(pid, uid, frozenset((gid, *more)))


def commanding_group() -> int | None:
    """The number of the group `pneud`; None where there is no such group."""
    try:
        return grp.getgrnam(GROUP).gr_gid
    except KeyError:
        return None


def may_command(peer: Peer, group: int | None) -> bool:
    """Whether a peer may do more than look."""
    return peer.uid in (0, os.geteuid()) or group in peer.groups


def why_read_only(peer: Peer) -> str:
    """What to tell somebody who may not command, or has said that he will not."""
    return f"may only look: uid {peer.uid} is not in the group {GROUP}, or has asked for no more"
