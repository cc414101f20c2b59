"""A folder of files that are believed, and run: who may write to it may do whatever its user may.

It is reached through its descriptor alone, so that whatever becomes of its path leads nowhere else. A file
carries its digest: one that was cut short, altered or renamed is as good as none.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Self

from pure2c.folders import open_private

_DIGEST_BYTES = hashlib.sha256().digest_size
_LEFTOVER_S = 3600.0  # what somebody has been at for so long, he was killed at


class Cache:
    """The files of a folder, by their names; a context manager."""

    def __init__(self, path: Path, *, keep: int) -> None:
        """Open the folder; make it, and what leads to it, where it is missing.

        Args:
            path: of the folder.
            keep: how many files stay when one more comes.

        Raises:
            OSError: it cannot be made, or others might write to it; the text is one line for a person.
        """
        self._keep = keep
        self._folder = open_private(path)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._folder)

    def get(self, name: str) -> bytes | None:
        """What was put there; None where there is no such file, or it is not as it was put there."""
        flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        try:
            with os.fdopen(os.open(name, flags, dir_fd=self._folder), "rb") as file:
                found = os.fstat(file.fileno())
                if not stat.S_ISREG(found.st_mode) or found.st_uid != os.geteuid():
                    return None
                whole = file.read()
        except OSError:
            return None
        content, digest = whole[:-_DIGEST_BYTES], whole[-_DIGEST_BYTES:]
        return content if digest == _digest(name, content) else None

    def put(self, name: str, content: bytes) -> None:
        """Keep something: when this returns it is on the disk, and until then all of what was there before.

        Raises:
            OSError: it cannot be written.
        """
        beside, flags = _passing_name(), os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
        try:
            with os.fdopen(os.open(beside, flags, 0o600, dir_fd=self._folder), "wb") as file:
                file.write(content + _digest(name, content))
                file.flush()
                os.fsync(file.fileno())
            os.replace(beside, name, src_dir_fd=self._folder, dst_dir_fd=self._folder)
        except OSError:
            self._remove(beside)
            raise
        os.fsync(self._folder)
        self._tidy()

    @contextmanager
    def workshop(self) -> Iterator[int]:
        """The descriptor of an empty folder inside, which is gone afterwards.

        Raises:
            OSError: it cannot be made.
        """
        name = _passing_name()
        os.mkdir(name, 0o700, dir_fd=self._folder)
        try:
            inside = os.open(name, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC, dir_fd=self._folder)
            try:
                yield inside
            finally:
                os.close(inside)
        finally:
            self._remove(name)

    def _tidy(self) -> None:
        """Remove the oldest files, and what was left by somebody who was killed."""
        ages: dict[str, float] = {}
        with os.scandir(self._folder) as entries:
            for entry in entries:
                with suppress(OSError):  # another process tidies, too
                    ages[entry.name] = entry.stat(follow_symlinks=False).st_mtime
        kept = sorted((name for name in ages if not _is_passing(name)), key=ages.__getitem__)
        since = time.time() - _LEFTOVER_S
        left = [name for name, changed in ages.items() if _is_passing(name) and changed < since]
        for name in (*kept[: -self._keep], *left):
            self._remove(name)

    def _remove(self, name: str) -> None:
        try:
            os.unlink(name, dir_fd=self._folder)
        except FileNotFoundError:
            pass
        except OSError:
            shutil.rmtree(name, ignore_errors=True, dir_fd=self._folder)


def _passing_name() -> str:
    return f".{os.urandom(8).hex()}"


def _is_passing(name: str) -> bool:
    return name.startswith(".")


def _digest(name: str, content: bytes) -> bytes:
    return hashlib.sha256(name.encode() + b"\0" + content).digest()
