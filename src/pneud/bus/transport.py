"""unixcan: one party on a bus made of Unix sockets, for machines without SocketCAN.

Each party listens on a SOCK_SEQPACKET socket of its own in the channel's private folder. Who joins hands
every party that is there already one end of a socket pair; frames travel over these pairs as `struct
can_frame`, or as `struct canfd_frame` those of CAN FD, which whoever does not want them passes over. A pair
holds as many frames as its send buffer takes (about 10,000 with 4 MiB, 278 with the kernel's default
`net.core.wmem_max` of 208 KiB, which bounds what a user without privileges gets); what a party that does not
read loses beyond that is counted and hinders nobody.

Order: a party that only listens must see a frame before the answers to it. So arrivals are read until
nothing is left and then sorted by the kernel's stamps, and a frame goes to those who only listen before it
goes to those who answer (whom it may wake at once, on the sender's own processor). The pair is made by the
newcomer, and not by connecting, because the kernel stamps nothing for a connection that has not been
accepted yet.
"""

from __future__ import annotations

import os
import select
import socket
import struct
import threading
from contextlib import suppress
from operator import attrgetter
from pathlib import Path

from pneud.bus import wire
from pneud.rt import folders
from pneud.signals import Frame

SEND_BUFFER_BYTES = 4 * 1024 * 1024
_SO_SNDBUFFORCE = 32
_CREDENTIALS = struct.Struct("3i")
_MOST_PATH_BYTES = 107
_ANSWERS, _LISTENS = "a", "l"  # how a party behaves: the last letter of its socket's name
# a flood must not hold a caller for ever, but to stop short spoils the order: more than the buffers hold
_MOST_AT_ONCE = 65536
_STAMP = attrgetter("stamp_ns")


class UnixCanError(Exception):
    """A unixcan channel cannot be joined; the text is one line for a person."""


class Party:
    """One member of a channel, from construction to `close`.

    One thread may drain while another sends. Nothing here blocks but joining and leaving, and these only
    for as long as others join or leave.
    """

    def __init__(
        self,
        channel: str,
        *,
        answers: bool = False,
        hear_self: bool = False,
        by: wire.Carriage = wire.CARRIAGE,
        fd: int = wire.CLASSIC,
    ) -> None:
        """Join `channel`.

        Args:
            channel: a name; whoever of this user gives the same name is on the same bus.
            answers: it will send, so that those who may only listen are served before it. Who does not say so
                is found out when it first sends.
            hear_self: receive the own frames too.
            by: how frames are taken and given.
            fd: what to mark the identifiers of frames of CAN FD with; without, these are passed over.

        Raises:
            UnixCanError: a bad name, or a folder or socket that cannot be made.
        """
        self.channel = channel
        self.dropped = 0  # frames that a party which does not read has lost
        self.refused = 0  # strangers turned away
        self._peers: dict[int, socket.socket] = {}  # all connections, by descriptor
        self._doors: dict[int, socket.socket] = {}  # those who knock and have not handed over anything yet
        self._talkers: dict[int, socket.socket] = {}  # those that answer or ever sent something
        self._targets: tuple[socket.socket, ...] = ()  # listeners first
        self._deaf: socket.socket | None = None  # the end on which the own frames come back
        self._changing = threading.Lock()
        self._receive, self._send = by
        self._fd = fd
        self._counts = wire.counts()
        self._owner = os.getpid()
        self._manner = _ANSWERS if answers else _LISTENS
        self._closed = False
        if not channel or channel in (".", "..") or "/" in channel or "\0" in channel:
            raise UnixCanError(f"unixcan:{channel}: a channel is a plain name without slashes")
        try:
            home = folders.private_folder(folders.runtime_folder() / "can")
            self._folder = home / channel
            self._path = self._folder / f"{self._owner}.{os.urandom(2).hex()}{self._manner}"
        except OSError as e:
            raise UnixCanError(f"unixcan:{channel}: {e}") from None
        length = len(os.fsencode(self._path))
        if length > _MOST_PATH_BYTES:
            raise UnixCanError(
                f"unixcan:{channel}: {self._path} has {length} bytes, and a socket's path at most"
                f" {_MOST_PATH_BYTES}; choose a shorter name or a shorter XDG_RUNTIME_DIR"
            )
        self._epoll = select.epoll()
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        try:
            with folders.locked(self._folder, create=True):
                self._join()
            if hear_self:
                self._hear_self()
        except OSError as e:
            self.close()
            raise UnixCanError(f"unixcan:{channel}: {self._folder}: {e.strerror or e}") from None

    def fileno(self) -> int:
        """One descriptor that is readable whenever there is something to drain."""
        return self._epoll.fileno()

    @property
    def parties(self) -> int:
        """How many others are on the channel, as far as this one has noticed."""
        return len(self._targets) - (self._deaf is not None)

    def drain(self, offset_ns: int, into: list[Frame], wait_ns: int = 0) -> int:
        """Append everything that has arrived, in the order of its stamps; also lets others join and leave.

        Returns:
            How many frames came.
        """
        begin, orderly = len(into), True
        while True:
            try:
                found = self._receive(
                    *(self._epoll, self._talkers, offset_ns, into, _MOST_AT_ONCE),
                    *(wait_ns, self._counts, Frame, self._fd),
                )
            except OSError:  # of one of them; who it was shows when each is looked at
                for descriptor in list(self._talkers):
                    self._attend(descriptor, offset_ns, into)
                wait_ns, orderly = 0, False
                continue
            if found < 0:
                break
            wait_ns, orderly = 0, False
            self._attend(found, offset_ns, into)
        if found == wire.UNORDERED or not orderly:
            into[begin:] = sorted(into[begin:], key=_STAMP)
        return len(into) - begin

    def _attend(self, descriptor: int, offset_ns: int, into: list[Frame]) -> None:
        """Somebody knocks, speaks for the first time, or has left."""
        # in any case: the same look may have shown that somebody knocks, and it is shown but once
        self.admit()
        sock = self._peers.get(descriptor)
        if sock is None:
            return
        before = len(into)
        try:
            alive = wire.take(sock, offset_ns, into, self._counts, fd=self._fd)
        except OSError:
            alive = False
        if len(into) > before and descriptor not in self._talkers:
            self._talkers[descriptor] = sock
            self._retarget()
        if not alive:
            self._forget(descriptor)

    def send(self, can_id: int, data: bytes) -> None:
        """Hand one frame to everybody; who has no room for it loses it."""
        # who has gone is forgotten by the next drain
        lost = self._send(self._targets, can_id, data, False)
        if lost:
            self.dropped += lost

    def admit(self) -> None:
        """Let in everybody who knocks, except other users."""
        with suppress(OSError):
            while True:
                door, _ = self._listener.accept()
                if _peer_uid(door) == os.geteuid():
                    door.setblocking(False)
                    self._doors[door.fileno()] = door
                    self._epoll.register(door, select.EPOLLIN)
                else:
                    self.refused += 1
                    door.close()
        for door in list(self._doors.values()):
            self._answer(door)

    def close(self) -> None:
        """Leave; the last one out removes the channel's folder."""
        if self._closed:
            return
        self._closed = True
        with self._changing:
            self._targets = ()
            for sock in (*self._peers.values(), *self._doors.values()):
                sock.close()
            self._peers.clear()
            self._doors.clear()
        self._listener.close()
        self._epoll.close()
        if os.getpid() != self._owner:
            return  # a forked copy: the socket's file belongs to the parent
        with suppress(OSError):
            self._path.unlink()
        with suppress(OSError), folders.locked(self._folder, create=False):
            _remove_if_empty(self._folder)

    def _join(self) -> None:
        self._listener.bind(os.fspath(self._path))
        self._listener.listen(4096)
        # edge-triggered, or a process out of descriptors could never finish a drain
        self._epoll.register(self._listener, select.EPOLLIN | select.EPOLLET)
        for path in _sockets(self._folder):
            if path != self._path:
                door = _connect(path)
                if door is not None:
                    ours, theirs = _pair()
                    with suppress(OSError):  # it is leaving
                        socket.send_fds(door, (self._manner.encode(),), (theirs.fileno(),))
                    door.close()
                    theirs.close()
                    self._welcome(ours, path.name[-1])

    def _hear_self(self) -> None:
        ours, theirs = _pair()
        self._welcome(ours, _ANSWERS)
        self._welcome(theirs, _ANSWERS)
        # one end is only read and the other only written, or every frame would come twice
        self._deaf = ours
        self._retarget()

    def _answer(self, door: socket.socket) -> None:
        """Take the end of a pair that somebody at the door hands over."""
        manner, descriptors = b"", list[int]()
        try:
            manner, descriptors, _, _ = socket.recv_fds(door, 1, 1, socket.MSG_CMSG_CLOEXEC)
        except BlockingIOError:
            return  # still looking for it
        except OSError:
            pass  # gone again
        if self._doors.pop(door.fileno(), None) is not None:  # unless another thread is just doing this
            self._epoll.unregister(door)
            door.close()
        for descriptor in descriptors:
            sock = socket.socket(fileno=descriptor)
            sock.setblocking(False)
            self._welcome(sock, manner.decode("latin-1"))

    def _welcome(self, sock: socket.socket, manner: str) -> None:
        with self._changing:
            self._peers[sock.fileno()] = sock
            if manner == _ANSWERS:
                self._talkers[sock.fileno()] = sock
        self._epoll.register(sock, select.EPOLLIN)
        self._retarget()

    def _forget(self, descriptor: int) -> None:
        with self._changing:
            sock = self._peers.pop(descriptor, None)
        self._talkers.pop(descriptor, None)
        self._retarget()
        if sock is not None:
            # closing alone would leave it in the epoll set where a forked process holds a copy
            self._epoll.unregister(sock)
            sock.close()

    def _retarget(self) -> None:
        with self._changing:
            targets = [sock for sock in self._peers.values() if sock is not self._deaf]
            self._targets = tuple(sorted(targets, key=lambda sock: sock.fileno() in self._talkers))


def channels() -> list[str]:
    """The channels of this user on which somebody lives; what dead processes left behind is removed."""
    try:
        home = folders.private_folder(folders.runtime_folder() / "can")
        found = sorted(path for path in home.iterdir() if path.is_dir())
    except OSError:
        return []
    alive = []
    for path in found:
        with suppress(OSError), folders.locked(path, create=False):
            connections = [_connect(candidate) for candidate in _sockets(path)]
            if any(sock is not None for sock in connections):
                alive.append(path.name)
            else:
                _remove_if_empty(path)
            for sock in connections:
                if sock is not None:
                    sock.close()
    return alive


def _pair() -> tuple[socket.socket, socket.socket]:
    """Two ends of a connection on which the kernel stamps every packet from the first one on."""
    ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
    for sock in ends:
        wire.stamp_arrivals(sock)
        try:
            sock.setsockopt(socket.SOL_SOCKET, _SO_SNDBUFFORCE, SEND_BUFFER_BYTES)
        except OSError:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
    return ends


def _connect(path: Path) -> socket.socket | None:
    """A connection to a living party of this user; removes the file of a dead one."""
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
    try:
        sock.connect(os.fspath(path))
        if _peer_uid(sock) == os.geteuid():
            return sock
    except ConnectionRefusedError:
        with suppress(OSError):
            path.unlink()
    except OSError:
        pass  # it leaves just now, or it is stuck with thousands waiting to join
    sock.close()
    return None


def _peer_uid(sock: socket.socket) -> int:
    """Who is at the other end, says the kernel."""
    raw = sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    return int(_CREDENTIALS.unpack(raw)[1])


def _sockets(path: Path) -> list[Path]:
    return sorted(entry for entry in path.iterdir() if entry.name != folders.LOCK)


def _remove_if_empty(path: Path) -> None:
    if all(entry.name == folders.LOCK for entry in path.iterdir()):
        (path / folders.LOCK).unlink()
        path.rmdir()
