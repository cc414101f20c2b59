"""The disk of a world: a real folder, whose writes may fail or fall short, and what was not synced be lost.

A file has its bytes in the page cache at once, and on the disk after a sync that was not lost. A power cut
leaves it what the disk has, and of the rest a beginning of any length.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pneud.prove.world import FOREVER_NS, World

SYNC_NS = 4_000_000  # that a sync takes


class File:
    """A file that is open for writing."""

    def __init__(self, world: World, path: Path, descriptor: int) -> None:
        self.path, self.descriptor = path, descriptor
        self.size = self.durable = 0
        self._world = world
        self.holders: set[int] = set()
        self.share(world.pid)

    def share(self, pid: int) -> None:
        """Another process has it, too."""
        self.holders.add(pid)
        process = self._world.processes.get(pid)
        if process is not None:
            process.holdings[self.descriptor] = self

    def release(self, pid: int) -> None:
        """A process has closed it, or is gone."""
        if pid in self.holders:
            self.holders.discard(pid)
            if not self.holders:
                self._world.things.pop(self.descriptor, None)
                os.close(self.descriptor)


class Disk:
    """Files below a folder.

    Attributes:
        room: bytes that may still be written; then there is none.
        failing: whether every write fails.
        short: whether writes take but a part.
        forgets: whether a sync says that it is done, and is not.
        sync_ns: how long a sync takes.
        on_synced: told of a file that the disk has, and of how many bytes; `on_sync` of its beginning.
    """

    def __init__(self, world: World, root: Path) -> None:
        self.root = root
        self.files: dict[Path, File] = {}
        self.heal()
        self.on_sync: Callable[[File], Callable[[], None]] = lambda _: lambda: None
        self._world = world

    def heal(self) -> None:
        """Nothing is wrong with it."""
        self.room = FOREVER_NS
        self.failing = self.short = self.forgets = False
        self.sync_ns = SYNC_NS

    def open(self, path: str, flags: int, mode: int) -> int:
        """Open a file.

        Raises:
            OSError: it cannot be.
        """
        inside = Path(path).is_relative_to(self.root)
        if inside and flags & os.O_CREAT and self.room <= 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        descriptor = os.open(path, flags, mode)
        if inside and flags & (os.O_WRONLY | os.O_RDWR):
            file = File(self._world, Path(path), descriptor)
            self._world.things[descriptor] = self.files[file.path] = file
        return descriptor

    def write(self, descriptor: int, data: Any) -> int:
        """Write as much as the disk takes.

        Raises:
            OSError: it takes nothing.
        """
        file = self._world.things.get(descriptor)
        if not isinstance(file, File):
            return os.write(descriptor, data)
        if self._world.pid not in file.holders:
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))
        if self.failing:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        most = len(data)
        if self.short and most > 1:
            most = self._world.rng.randrange(1, most)
        most = min(most, self.room)
        if most <= 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        written = os.write(descriptor, memoryview(data)[:most])
        self.room -= written if self.room < FOREVER_NS else 0
        file.size += written
        return written

    def sync(self, descriptor: int) -> None:
        """Wait until the disk keeps a file.

        Raises:
            OSError: it does not.
        """
        world, file = self._world, self._world.things.get(descriptor)
        if not isinstance(file, File):
            return
        size, forgets, done = file.size, self.forgets, self.on_sync(file)
        world.sleep_until(world.now_ns + self.sync_ns)
        if self.failing:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        if not forgets:
            file.durable = max(file.durable, size)
            done()

    def close(self) -> None:
        """Close what dead processes have left open."""
        for thing in list(self._world.things.values()):
            if isinstance(thing, File):
                for pid in sorted(thing.holders):
                    thing.release(pid)

    def cut(self) -> None:
        """Power is gone: what the disk has not, may be lost from any byte on."""
        for file in self.files.values():
            if file.path.exists():
                size = file.path.stat().st_size
                os.truncate(file.path, self._world.rng.randint(min(file.durable, size), size))
