"""The doors: modules of the standard library as an actor has them, where the shipped modules look for them.

A module of pneud that says `time.sleep` finds, for as long as a world lasts, a door in the place of `time`.
What is not behind a door is the real thing. No function of pneud is replaced but those that fork, ask the
kernel about real processes, or set this very process's scheduling (`Cast.adapters`).
"""

from __future__ import annotations

import errno
import os
import select
import selectors
import signal
import socket
import sys
import threading
import time
import traceback
import uuid
from collections.abc import Callable, Collection, Sequence
from contextlib import nullcontext
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

from pneud.prove.disk import Disk
from pneud.prove.pipes import Eventfd, Readable, Socket, pair_of
from pneud.prove.world import FOREVER_NS, Actor, World

_S = 1e9


def deadline_ns(world: World, timeout_s: float | None) -> int:
    """When a wait is over."""
    return FOREVER_NS if timeout_s is None or timeout_s < 0 else world.now_ns + round(timeout_s * _S)


class Door:
    """A module; what it lacks is the real one's."""

    real: Any

    def __init__(self, world: World) -> None:
        self.world = world

    def __getattr__(self, name: str) -> Any:
        return getattr(self.real, name)


class TimeDoor(Door):
    """`time`: a look at the clock is a step, and takes time."""

    real = time

    def __init__(self, world: World) -> None:
        super().__init__(world)

        def monotonic_ns(step: Callable[[], None] = world.step) -> int:
            step()
            return world.now_ns

        self.monotonic_ns = monotonic_ns

    def monotonic(self) -> float:
        """CLOCK_MONOTONIC [s]."""
        return self.monotonic_ns() / _S

    def time_ns(self) -> int:
        """CLOCK_REALTIME."""
        self.world.step()
        return self.world.now_ns + self.world.wall_ns

    def time(self) -> float:
        """CLOCK_REALTIME [s]."""
        return self.time_ns() / _S

    def sleep(self, seconds: float) -> None:
        """Sleep."""
        self.world.step()
        self.world.sleep_until(self.world.now_ns + round(seconds * _S))


class SignalDoor(Door):
    """`signal`: handlers and masks are those of the process that runs."""

    real = signal

    def signal(self, number: int, handler: Any) -> Any:
        """Say what a signal does."""
        handlers = self.world.me().process.handlers
        before = handlers.get(int(number), signal.SIG_DFL)
        handlers[int(number)] = handler
        return before

    def pthread_sigmask(self, how: int, mask: Collection[int]) -> None:
        """Block signals, or take what is blocked."""
        process = self.world.me().process
        numbers = frozenset(int(number) for number in mask)
        blocked = process.blocked | numbers if how == signal.SIG_BLOCK else process.blocked - numbers
        self.world.unblock(process, blocked)

    def alarm(self, seconds: int) -> None:
        """Have a signal come."""
        process, world = self.world.me().process, self.world
        world.at(world.now_ns + round(seconds * _S), lambda: world.send(process, signal.SIGALRM))

    def sigtimedwait(self, wanted: Collection[int], timeout_s: float) -> Any:
        """Wait for a signal that is blocked."""
        self.world.step()
        process, until_ns = self.world.me().process, deadline_ns(self.world, timeout_s)
        while True:
            for number in process.pending:
                if number in wanted:
                    process.pending.remove(number)
                    return SimpleNamespace(si_signo=number)
            if self.world.now_ns >= until_ns:
                return None
            self.world.wait(until_ns, process.signalled)


class OsDoor(Door):
    """`os`: processes, descriptors, and files that lie on the disk of the world."""

    real = os

    def __init__(self, world: World, disk: Disk) -> None:
        super().__init__(world)
        self._disk = disk

    def getpid(self) -> int:
        """Of who runs."""
        return self.world.pid

    def getppid(self) -> int:
        """Of its parent."""
        self.world.step()
        return self.world.me().process.ppid

    def kill(self, pid: int, number: int) -> None:
        """Send a signal."""
        self.world.step()
        self.world.kill(pid, number)

    def waitpid(self, pid: int, options: int) -> tuple[int, int]:
        """Whether a child is gone."""
        assert options == os.WNOHANG
        self.world.step()
        child = self.world.processes.get(pid)
        if child is None or child.reaped or child.ppid != self.world.pid:
            raise ChildProcessError(errno.ECHILD, os.strerror(errno.ECHILD))
        if child.status is None:
            return 0, 0
        child.reaped = True
        return pid, child.status

    def isatty(self, _: int) -> bool:
        """Nobody types."""
        return False

    def nice(self, _: int) -> int:
        """Nothing: who goes next is the seed's."""
        return 0

    def uname(self) -> Any:
        """A machine of no name, so that a log is the same wherever it is made."""
        return SimpleNamespace(nodename="prove", sysname="Linux", release="", version="", machine="")

    def open(self, path: Any, flags: int, mode: int = 0o777) -> int:
        """Open a file."""
        self.world.step()
        if os.fspath(path) == "/dev/tty":
            raise OSError(errno.ENXIO, os.strerror(errno.ENXIO))
        return self._disk.open(os.fspath(path), flags, mode)

    def write(self, descriptor: int, data: Any) -> int:
        """Write to a file."""
        self.world.step()
        return len(data) if descriptor <= 2 else self._disk.write(descriptor, data)

    def fdatasync(self, descriptor: int) -> None:
        """Wait until the disk keeps a file."""
        self.world.step()
        self._disk.sync(descriptor)

    fsync = fdatasync

    def fstat(self, descriptor: int) -> os.stat_result:
        """Of a file."""
        return os.fstat(descriptor)

    def close(self, descriptor: int) -> None:
        """Close a descriptor of who runs."""
        self.world.step()
        thing = self.world.things.get(descriptor)
        if thing is None:
            os.close(descriptor)
            return
        thing.release(self.world.pid)
        if self.world.current is not None:
            self.world.current.process.holdings.pop(descriptor, None)

    def eventfd(self, _: int, __: int = 0) -> int:
        """A descriptor that is readable once it was written to."""
        return Eventfd(self.world).number

    def eventfd_write(self, descriptor: int, _: int) -> None:
        """Make it readable."""
        self.world.step()
        event: Eventfd = self.world.things[descriptor]
        event.count += 1
        self.world.happens(event.readable)

    def eventfd_read(self, descriptor: int) -> int:
        """Take what was written."""
        event: Eventfd = self.world.things[descriptor]
        if not event.count:
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        count, event.count = event.count, 0
        return count


class ThreadingDoor(Door):
    """`threading`: threads are actors of the process that starts them."""

    real = threading

    def __init__(self, world: World) -> None:
        super().__init__(world)

        class Thread:
            """A thread."""

            def __init__(
                self, target: Callable[..., object], args: Sequence[Any] = (), daemon: bool = False
            ) -> None:
                self._run = lambda: target(*args)
                self._actor: Actor | None = None
                self.daemon = daemon

            def start(self) -> None:
                world.step()
                self._actor = world.thread(self._run)

            def is_alive(self) -> bool:
                return self._actor is not None and not self._actor.done

            def join(self, timeout: float | None = None) -> None:
                until_ns = deadline_ns(world, timeout)
                while self._actor is not None and not self._actor.done and world.now_ns < until_ns:
                    world.wait(until_ns, self._actor.ended)

        self.Thread = Thread


class SocketDoor(Door):
    """`socket`: pairs between processes, and a way to the manager of services; there is no network."""

    real = socket
    manager: Callable[[bytes], None]

    def socketpair(self, family: int = socket.AF_UNIX, kind: int = socket.SOCK_STREAM) -> Any:
        """Two ends."""
        assert family == socket.AF_UNIX
        return pair_of(self.world, messages=kind & 0xFF == socket.SOCK_SEQPACKET)

    def send_fds(self, *_: Any) -> int:
        """No descriptor crosses: those who look at the ring here need none."""
        raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))

    def socket(self, family: int, kind: int) -> Any:
        """One that what is said through comes to the manager."""
        assert family == socket.AF_UNIX and kind & 0xF == socket.SOCK_DGRAM

        def sendto(message: bytes, _: str) -> None:
            self.world.step()
            self.manager(message)

        word = SimpleNamespace(sendto=sendto, setblocking=lambda _: None)
        return nullcontext(word) if kind == socket.SOCK_DGRAM else word


class SelectDoor(Door):
    """`select`: waits for what is in the world."""

    real = select

    def select(
        self, read: Sequence[Any], write: Sequence[Any], _: Sequence[Any], timeout_s: float | None = None
    ) -> tuple[list[Any], list[Any], list[Any]]:
        """Wait until one can be read from."""
        assert not write
        world = self.world
        world.step()
        things: list[Readable] = [world.things[one if isinstance(one, int) else one.fileno()] for one in read]
        until_ns = deadline_ns(world, timeout_s)
        while True:
            found = [one for one, thing in zip(read, things, strict=True) if thing.can_read()]
            if found or world.now_ns >= until_ns:
                return found, [], []
            due_ns = min((thing.due_ns() for thing in things), default=FOREVER_NS)
            world.wait(min(until_ns, due_ns), *(thing.readable for thing in things))

    def epoll(self) -> Any:
        """A set of such."""
        return Epoll(self.world)

    def poll(self) -> Any:
        """A look at whether the other ends are there."""
        return Poll(self.world)


class Poll:
    """`select.poll`, for a look without a wait at who has hung up."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._sockets: list[Socket] = []

    def register(self, one: Socket, events: int) -> None:
        """Look at this, too."""
        assert events == select.POLLRDHUP
        self._sockets.append(one)

    def poll(self, timeout_ms: int) -> list[tuple[int, int]]:
        """Those that have."""
        assert timeout_ms == 0
        self._world.step()
        return [(one.fileno(), select.POLLRDHUP) for one in self._sockets if one.hung_up]


class Epoll:
    """`select.epoll`, for a look without a wait."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._things: list[Readable] = []

    def register(self, thing: Any, _: int) -> None:
        """Look at this, too."""
        self._things.append(thing)

    def unregister(self, thing: Any) -> None:
        """And no longer."""
        self._things.remove(thing)

    def poll(self, timeout_s: float) -> list[tuple[int, int]]:
        """Those that can be read from."""
        assert timeout_s == 0
        return [(thing.fileno(), select.EPOLLIN) for thing in self._things if thing.can_read()]

    def close(self) -> None:
        """Nothing: it has no descriptor."""


class Key(NamedTuple):
    """As of `selectors`."""

    fileobj: Any
    fd: int
    events: int
    data: Any


class SelectorsDoor(Door):
    """`selectors`: what is ready at once comes in an order of the seed's."""

    real = selectors

    def DefaultSelector(self) -> Any:
        """A selector."""
        return Selector(self.world)


class Selector:
    """A `selectors.DefaultSelector`."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._keys: dict[Any, Key] = {}

    def register(self, fileobj: Any, events: int, data: Any = None) -> None:
        """Wait for this, too."""
        number = fileobj if isinstance(fileobj, int) else fileobj.fileno()
        self._keys[fileobj] = Key(fileobj, number, events, data)

    def unregister(self, fileobj: Any) -> None:
        """And no longer."""
        del self._keys[fileobj]

    def modify(self, fileobj: Any, events: int, data: Any = None) -> None:
        """For something else."""
        del self._keys[fileobj]
        self.register(fileobj, events, data)

    def select(self, timeout_s: float | None = None) -> list[tuple[Key, int]]:
        """Wait."""
        world = self._world
        world.step()
        until_ns = deadline_ns(world, timeout_s)
        while True:
            found, waits = [], []
            for key in self._keys.values():
                thing = world.things.get(key.fd)
                if thing is None:
                    continue
                events = selectors.EVENT_READ if key.events & selectors.EVENT_READ and thing.can_read() else 0
                if key.events & selectors.EVENT_WRITE and thing.can_write():
                    events |= selectors.EVENT_WRITE
                if events:
                    found.append((key, events))
                waits += [thing.readable] if key.events & selectors.EVENT_READ else []
                waits += [thing.writable] if key.events & selectors.EVENT_WRITE else []
            if found or world.now_ns >= until_ns:
                if len(found) > 1:
                    world.rng.shuffle(found)
                return found
            world.wait(until_ns, *waits)

    def close(self) -> None:
        """Nothing."""
        self._keys.clear()


class SysDoor(Door):
    """`sys`: what processes say goes nowhere."""

    real = sys

    def __init__(self, world: World) -> None:
        super().__init__(world)
        self.stdout = self.stderr = self.stdin = Said()


class Said(StringIO):
    """Takes all that is printed, and keeps none."""

    def write(self, text: str) -> int:
        """Take it."""
        return len(text)

    def isatty(self) -> bool:
        """Nobody looks."""
        return False


class Terminal(Said):
    """A terminal, which may take nothing for a while.

    Attributes:
        stands_until_ns: for so long.
    """

    def __init__(self, world: World) -> None:
        super().__init__()
        self.stands_until_ns = 0
        self._world = world

    def write(self, text: str) -> int:
        """Wait until it goes on."""
        self._world.step()
        self._world.sleep_until(self.stands_until_ns)
        return len(text)


class TracebackDoor(Door):
    """`traceback`: a process that prints one has died of an exception, and that is a finding."""

    real = traceback

    def print_exc(self, *_: Any, **__: Any) -> None:
        """Note it."""
        me, error = self.world.current, sys.exception()
        who = me.process.name if me is not None else "?"
        frame = traceback.extract_tb(error.__traceback__)[-1] if error is not None else None
        where = f"{Path(frame.filename).name}:{frame.name}" if frame is not None else ""
        self.world.crashes.append(f"{who}: {type(error).__name__}: {error} in {where}")


class UuidDoor(Door):
    """`uuid`: numbers of the seed's."""

    real = uuid

    def uuid4(self) -> uuid.UUID:
        """The next one."""
        return uuid.UUID(int=self.world.rng.getrandbits(128), version=4)


def doors(world: World, disk: Disk) -> dict[str, Any]:
    """All of them, by the names of what they stand for."""
    return {
        "time": TimeDoor(world),
        "signal": SignalDoor(world),
        "os": OsDoor(world, disk),
        "threading": ThreadingDoor(world),
        "socket": SocketDoor(world),
        "select": SelectDoor(world),
        "selectors": SelectorsDoor(world),
        "sys": SysDoor(world),
        "traceback": TracebackDoor(world),
        "uuid": UuidDoor(world),
    }
