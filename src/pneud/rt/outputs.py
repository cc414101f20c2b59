"""Files that a tool makes: whole, or as they were before."""

from __future__ import annotations

import contextlib
import errno
import itertools
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def require_folder(output: Path) -> None:
    """Find out before the work, not after it, that there is no place for what comes of it.

    Raises:
        OSError: so it is.
    """
    if not output.parent.is_dir():
        why = f"there is no folder {output.parent}; create it or name another file"
        raise OSError(errno.ENOENT, why, str(output))


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A name beside a file to write to; with the end of the block it takes the file's place, on the disk.

    After an exception the file is as it was. What is there and no file (a pipe, a device) is written to as it
    is. A link stays, and what it points to is replaced.

    Raises:
        OSError: it cannot be written.
    """
    with replacing_all(path) as (beside,):
        yield beside


@contextmanager
def replacing_all(*paths: Path) -> Iterator[tuple[Path, ...]]:
    """As `replacing`, of files that belong together: none is replaced unless all can be.

    Should the system die between one and the next, the first are the new ones and the rest the old.

    Raises:
        OSError: one of them cannot be written; it is named, and not what is written beside it.
    """
    places: list[_Place] = []
    try:
        places += map(_Place, paths)
        yield tuple(place.beside for place in places)
        for place in places:
            place.settle()
        for place in places:
            place.take(alone=len(places) == 1)
    except BaseException as e:
        for place in places:
            with contextlib.suppress(OSError):
                place.undo()
        if isinstance(e, OSError):
            names = {str(place.beside): path for place, path in zip(places, paths, strict=False)}
            name = names.get(str(e.filename), e.filename or paths[0])
            raise OSError(e.errno, f"cannot be written: {e.strerror or e}", str(name)) from None
        raise
    for place in places:
        place.finish()


_NUMBERS = itertools.count()  # of the files that are written beside others; several may be at once


class _Place:
    """A file that is to be replaced, and the one that is written beside it."""

    def __init__(self, path: Path) -> None:
        with contextlib.suppress(FileNotFoundError):
            path.stat()  # refuses what leads round in circles
        self._target = path.resolve() if path.is_symlink() else path
        self._there = self._target.exists()
        self._as_it_is = self._there and not self._target.is_file()
        name = f".pneud-{os.getpid()}-{next(_NUMBERS)}"
        self.beside = path if self._as_it_is else self._target.with_name(f"{name}{path.suffix}")
        self._before = self._target.with_name(f"{name}.before")
        self._taken = False

    def settle(self) -> None:
        """Have the disk keep what was written."""
        if self._as_it_is:
            return
        descriptor = os.open(self.beside, os.O_RDONLY | os.O_CLOEXEC)
        try:
            with contextlib.suppress(FileNotFoundError):
                os.fchmod(descriptor, self._target.stat().st_mode & 0o7777)
            os.fsync(descriptor)
        finally:
            os.close(descriptor)

    def take(self, *, alone: bool) -> None:
        """Put it into its place; what was there has another name until all are, if the disk knows such."""
        if self._as_it_is:
            return
        if self._there and not alone:
            with contextlib.suppress(OSError):
                os.link(self._target, self._before)
        self.beside.replace(self._target)
        self._taken = True

    def undo(self) -> None:
        """Have it as it was."""
        if self._as_it_is:
            return
        if not self._taken:
            self.beside.unlink(missing_ok=True)
            self._before.unlink(missing_ok=True)
        elif not self._there:
            self._target.unlink()
        elif self._before.exists():
            self._before.replace(self._target)

    def finish(self) -> None:
        """Have the new name survive a power cut."""
        if not self._as_it_is:
            self._before.unlink(missing_ok=True)
            _sync_folder(self._target.parent)


def write_whole(path: Path, data: str | bytes) -> None:
    """Write a file, text in UTF-8, so that it is there whole or as it was before.

    Raises:
        OSError: it cannot be written.
    """
    with replacing(path) as beside:
        beside.write_bytes(data.encode() if isinstance(data, str) else data)


def _sync_folder(folder: Path) -> None:
    """Have the new name survive a power cut, where the file system can."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
