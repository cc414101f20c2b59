"""Files that a tool makes: whole, or as they were before."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A name beside a file to write to; with the end of the block it takes the file's place, on the disk.

    After an exception the file is as it was. What is there and no file (a pipe, a device) is written to as it
    is. A link stays, and what it points to is replaced.

    Raises:
        OSError: nothing can be made there.
    """
    with contextlib.suppress(FileNotFoundError):
        path.stat()  # refuses what leads round in circles
    target = path.resolve() if path.is_symlink() else path
    if target.exists() and not target.is_file():
        yield path
        return
    beside = target.with_name(f".pneud-{os.getpid()}{target.suffix}")
    try:
        yield beside
        descriptor = os.open(beside, os.O_RDONLY | os.O_CLOEXEC)
        try:
            with contextlib.suppress(FileNotFoundError):
                os.fchmod(descriptor, target.stat().st_mode & 0o7777)
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
        beside.replace(target)
    except BaseException:
        with contextlib.suppress(OSError):
            beside.unlink()
        raise
    _sync_folder(target.parent)


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
