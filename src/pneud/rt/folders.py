"""The private folders of a user: for the sockets of a running pneud, and for what outlives it."""

from __future__ import annotations

import errno
import fcntl
import os
import stat
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pure2c.folders import check_private

LOCK = "lock"
LOCK_TIMEOUT_S = 2.0


def runtime_folder() -> Path:
    """Where this user's sockets go.

    `$RUNTIME_DIRECTORY`, else `$XDG_RUNTIME_DIR/pneud`, else a private `pneud-UID` in the temporary
    directory. An XDG_RUNTIME_DIR that belongs to someone else (left over from `su`) is not used.

    Raises:
        OSError: the folder cannot be made, or someone else might look into it; the text is one line for a
        person.
    """
    given = os.environ.get("RUNTIME_DIRECTORY", "").split(":")[0]
    if given:
        return Path(given)
    session = os.environ.get("XDG_RUNTIME_DIR", "")
    if session and Path(session).is_dir() and Path(session).stat().st_uid == os.geteuid():
        return private_folder(Path(session) / "pneud")
    return private_folder(Path(tempfile.gettempdir()) / f"pneud-{os.geteuid()}")


def cache_folder(name: str) -> Path:
    """Where something is kept: in `$CACHE_DIRECTORY`, else `$XDG_CACHE_HOME/pneud`, else `~/.cache/pneud`.

    What lies there is believed and run: it is for `pure2c`, which checks who has a hand in it.

    Raises:
        OSError: there is no home.
    """
    given = os.environ.get("CACHE_DIRECTORY", "").split(":")[0]
    home = os.environ.get("XDG_CACHE_HOME", "")
    try:
        base = Path(given) if given else Path(home or "~/.cache").expanduser() / "pneud"
    except RuntimeError as e:
        raise FileNotFoundError(f"no place for a cache: {e}") from None
    return base / name


def private_folder(path: Path) -> Path:
    """Make a folder that only this user can enter, or check that an existing one is such.

    Raises:
        OSError: it cannot be made, or someone else might look into it; the text is one line for a person.
    """
    try:
        path.mkdir(mode=0o700)
    except FileExistsError:
        pass
    except OSError as e:
        raise OSError(f"{path}: cannot be made: {e.strerror}") from None
    found = path.lstat()
    if not stat.S_ISDIR(found.st_mode):
        raise NotADirectoryError(f"{path}: is no folder; remove it")
    check_private(path, found)
    return path


@contextmanager
def locked(path: Path, *, create: bool) -> Iterator[None]:
    """Hold a folder's lock, whose holder may remove the folder; make it where it is missing and wanted.

    Raises:
        OSError: no such folder, or somebody holds the lock for too long.
    """
    deadline = time.monotonic() + LOCK_TIMEOUT_S
    while True:
        try:
            if create:
                private_folder(path)
            lock = os.open(path / LOCK, os.O_RDWR | os.O_CLOEXEC | (os.O_CREAT if create else 0), 0o600)
        except FileNotFoundError:
            if create and time.monotonic() < deadline:
                continue
            raise
        try:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                same = (path / LOCK).stat().st_ino == os.fstat(lock).st_ino
            except (BlockingIOError, FileNotFoundError):
                same = False
            if same:  # the folder may have been removed while waiting for its lock
                yield
                return
        finally:
            os.close(lock)
        if time.monotonic() > deadline:
            raise TimeoutError(errno.ETIMEDOUT, "somebody holds its lock; is a process stopped?")
        time.sleep(0.002)
