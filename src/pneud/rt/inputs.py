"""Files that a tool reads: files, and nothing that never ends or that waits for somebody to write."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import IO


def open_file(path: Path) -> IO[bytes]:
    """Open a file to read from.

    Raises:
        OSError: there is none, it may not be read, or it is a folder, a pipe or a device.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY)
    mode = os.fstat(descriptor).st_mode
    if stat.S_ISREG(mode):
        return os.fdopen(descriptor, "rb")
    os.close(descriptor)
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    raise OSError(errno.EINVAL, "is no file", str(path))


def read_whole(path: Path) -> bytes:
    """All that is in a file.

    Raises:
        OSError: as for `open_file`.
    """
    with open_file(path) as file:
        return file.read()
