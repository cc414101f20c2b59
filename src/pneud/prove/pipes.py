"""Sockets between the processes of a world: pairs of messages or of bytes, and a place to call at."""

from __future__ import annotations

import errno
import os
import socket
import struct
from collections import deque
from typing import Any

from pneud.prove.world import FOREVER_NS, Happening, World

FIRST_NUMBER = 1 << 20  # of descriptors; real ones are smaller
MOST_MESSAGES = 256  # that wait in a pair
MOST_BYTES = 100_000
BACKLOG = 64
_CREDENTIALS = struct.Struct("3i")


class Readable:
    """What one may wait for to be readable; open in some processes."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.readable, self.writable = Happening(), Happening()
        self.number = FIRST_NUMBER + next(world.numbers)
        self.holders: set[int] = set()
        world.things[self.number] = self
        self.share(world.pid)

    def fileno(self) -> int:
        """Its number."""
        return self.number

    def can_read(self) -> bool:
        """Whether a read would not wait."""
        return False

    def can_write(self) -> bool:
        """Whether a write would not wait."""
        return True

    def due_ns(self) -> int:
        """When it will be readable by itself."""
        return FOREVER_NS

    def share(self, pid: int) -> None:
        """Another process has it, too."""
        self.holders.add(pid)
        process = self.world.processes.get(pid)
        if process is not None:
            process.holdings[self.number] = self

    def release(self, pid: int) -> None:
        """A process has closed it, or is gone."""
        if pid in self.holders:
            self.holders.discard(pid)
            if not self.holders:
                self.gone()

    def gone(self) -> None:
        """Nobody has it."""

    def check(self) -> None:
        """Make sure that who runs has it.

        Raises:
            OSError: it does not.
        """
        if self.world.pid not in self.holders:
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))

    def close(self) -> None:
        """Close it for who runs."""
        self.world.step()
        self.release(self.world.pid)
        if self.world.current is not None:
            self.world.current.process.holdings.pop(self.number, None)


class Eventfd(Readable):
    """A counter that is readable once it was written to."""

    def __init__(self, world: World) -> None:
        super().__init__(world)
        self.count = 0

    def can_read(self) -> bool:
        """Whether it was written to."""
        return self.count > 0


class Socket(Readable):
    """One end of a pair; it waits only where it was given a time to wait for."""

    def __init__(self, world: World, *, messages: bool) -> None:
        super().__init__(world)
        self.peer: Socket | None = None
        self.caller = world.pid  # who has made it
        self._messages = messages
        self._waiting: deque[bytes] = deque()
        self._bytes = 0
        self._since: deque[tuple[int, int]] = deque()  # when each message came, and from which process
        self.age_ns = 0  # of the message that was taken last
        self.sender = 0  # of it
        self._timeout_s: float | None = None  # for ever

    @property
    def hung_up(self) -> bool:
        """The other end is gone."""
        return self.peer is None or not self.peer.holders

    @property
    def waiting(self) -> int:
        """Bytes that are to be read, or messages."""
        return len(self._waiting) if self._messages else self._bytes

    def can_read(self) -> bool:
        """Whether something waits, or the end is there."""
        return bool(self._waiting) or self.hung_up

    def can_write(self) -> bool:
        """Whether there is room at the other end, or none any more."""
        return self.hung_up or self._room() > 0

    def _room(self) -> int:
        peer = self.peer
        assert peer is not None
        return MOST_MESSAGES - len(peer._waiting) if self._messages else MOST_BYTES - peer._bytes

    def gone(self) -> None:
        """Tell the other end."""
        if self.peer is not None:
            self.world.happens(self.peer.readable)
            self.world.happens(self.peer.writable)

    def setblocking(self, blocking: bool) -> None:
        """Wait for ever, or not at all."""
        self._timeout_s = None if blocking else 0.0

    def settimeout(self, timeout_s: float | None) -> None:
        """How long to wait."""
        self._timeout_s = timeout_s

    def getsockopt(self, _: int, option: int, __: int) -> bytes:
        """Who is at the other end; only the number is told, and root it is."""
        if option != socket.SO_PEERCRED or self.peer is None:
            raise OSError(errno.ENOPROTOOPT, os.strerror(errno.ENOPROTOOPT))
        return _CREDENTIALS.pack(self.peer.caller, 0, 0)

    def recv(self, most: int) -> bytes:
        """Take what waits.

        Raises:
            BlockingIOError: nothing does.
            TimeoutError: nothing has come.
        """
        world = self.world
        world.step()
        self.check()
        if self._timeout_s != 0.0:
            until_ns = FOREVER_NS if self._timeout_s is None else world.now_ns + round(1e9 * self._timeout_s)
            while not self.can_read():
                if world.now_ns >= until_ns:
                    raise TimeoutError("timed out")
                world.wait(until_ns, self.readable)
        if not self._waiting:
            if self.hung_up:
                return b""
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        data = self._waiting.popleft()
        if self._messages:
            since_ns, self.sender = self._since.popleft()
            self.age_ns = world.now_ns - since_ns
        else:
            self._bytes -= min(len(data), most)
            if len(data) > most:
                self._waiting.appendleft(data[most:])
        if self.peer is not None:
            world.happens(self.peer.writable)
        return data[:most]

    def recvmsg(self, most: int, _: int = 0) -> tuple[bytes, list[Any], int, None]:
        """As `recv`; no descriptor comes along."""
        return self.recv(most), [], 0, None

    def send(self, data: Any) -> int:
        """Hand over as much as there is room for.

        Raises:
            BlockingIOError: there is none.
            BrokenPipeError: nobody is there.
        """
        self.world.step()
        self.check()
        if self.hung_up:
            raise BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))
        room = self._room()
        if room <= 0:
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        some = bytes(data) if self._messages else bytes(data[:room])
        assert self.peer is not None
        self.peer._waiting.append(some)
        self.peer._bytes += len(some)
        if self._messages:
            self.peer._since.append((self.world.now_ns, self.world.pid))
        self.world.happens(self.peer.readable)
        return len(some)

    def sendall(self, data: bytes) -> None:
        """Hand over all of it, or as much as there is room for in the time to wait."""
        while data:
            try:
                data = data[self.send(data) :]
            except BlockingIOError:
                if self._timeout_s == 0.0:
                    raise
                self.world.wait(self.world.now_ns + round(1e9 * (self._timeout_s or 1e9)), self.writable)


class Listener(Readable):
    """A place to call at."""

    def __init__(self, world: World) -> None:
        super().__init__(world)
        self._calling: deque[Socket] = deque()

    def can_read(self) -> bool:
        """Whether somebody calls."""
        return bool(self._calling)

    def setblocking(self, _: bool) -> None:
        """It never waits."""

    def accept(self) -> tuple[Socket, str]:
        """Take the next call.

        Raises:
            BlockingIOError: nobody calls.
        """
        self.world.step()
        self.check()
        while self._calling:
            end = self._calling.popleft()
            end.holders.clear()
            end.share(self.world.pid)
            end.setblocking(True)
            return end, ""
        raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))

    def call(self) -> Socket:
        """Call, as who runs.

        Raises:
            ConnectionRefusedError: nobody listens.
        """
        self.world.step()
        if not self.holders or len(self._calling) >= BACKLOG:
            raise ConnectionRefusedError(errno.ECONNREFUSED, os.strerror(errno.ECONNREFUSED))
        mine, other = pair_of(self.world, messages=False)
        me = self.world.current
        if me is not None:
            me.process.holdings.pop(other.number, None)
        other.holders = {0}  # nobody's, as long as it is not taken
        self._calling.append(other)
        self.world.happens(self.readable)
        return mine

    def gone(self) -> None:
        """Nobody will take those that call."""
        for end in self._calling:
            end.release(0)


def pair_of(world: World, *, messages: bool) -> tuple[Socket, Socket]:
    """Two ends, of who runs."""
    one, other = Socket(world, messages=messages), Socket(world, messages=messages)
    one.peer, other.peer = other, one
    return one, other
