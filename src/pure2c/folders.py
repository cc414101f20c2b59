"""Opening a folder whose content nobody else can have a hand in."""

from __future__ import annotations

import os
import stat
from contextlib import ExitStack, suppress
from pathlib import Path

_MOST_LINKS = 40  # as the kernel has it
_ROOT = 0


def open_private(path: Path) -> int:
    """The descriptor of a folder that only this user may enter; made, with what leads to it, where missing.

    The path is walked from the root, each part opened in the one before it. Each has to belong to root or to
    this user, and nobody else may write to it: he could put something in the place of the next. In a sticky
    folder, such as /tmp, he could not. A symbolic link that root or this user made is followed: systemd's
    `DynamicUser=` has one.

    Raises:
        OSError: it cannot be made or opened, or is not safe; the text is one line for a person.
    """
    ahead, here, links = list(reversed(path.absolute().parts)), Path("/"), 0
    with ExitStack() as opened:
        folder = os.open(here, os.O_PATH | os.O_CLOEXEC)
        opened.callback(os.close, folder)
        while ahead:
            name = ahead.pop()
            place = here / name
            try:
                inside = _entered(folder, name)
            except OSError as e:
                raise OSError(f"{place}: {e.strerror}") from None
            opened.callback(os.close, inside)
            found = os.fstat(inside)
            if stat.S_ISLNK(found.st_mode):
                _check_owner(place, found)
                links += 1
                if links > _MOST_LINKS:
                    raise OSError(f"{place}: too many symbolic links")
                ahead += reversed(Path(os.readlink("", dir_fd=inside)).parts)
                continue
            if not stat.S_ISDIR(found.st_mode):
                raise NotADirectoryError(f"{place}: is no folder; remove it")
            if ahead:
                _check_owner(place, found)
                if found.st_mode & 0o022 and not found.st_mode & stat.S_ISVTX:
                    raise PermissionError(f"{place}: others may write to it; chmod go-w {place}")
            else:
                check_private(place, found)
            folder, here = inside, place
        return os.open(".", os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC, dir_fd=folder)


def _entered(folder: int, name: str) -> int:
    flags = os.O_PATH | os.O_NOFOLLOW | os.O_CLOEXEC
    with suppress(FileNotFoundError):
        return os.open(name, flags, dir_fd=folder)
    with suppress(FileExistsError):  # somebody else starts at the same time
        os.mkdir(name, 0o700, dir_fd=folder)
    return os.open(name, flags, dir_fd=folder)


def _check_owner(place: Path, found: os.stat_result) -> None:
    if found.st_uid not in (_ROOT, os.geteuid()):
        raise PermissionError(f"{place}: belongs to user {found.st_uid}, not to {os.geteuid()} or root")


def check_private(place: Path, found: os.stat_result) -> None:
    """Raise PermissionError, one line for a person, unless this user alone may enter a folder."""
    if found.st_uid != os.geteuid():
        raise PermissionError(f"{place}: belongs to user {found.st_uid}, not to {os.geteuid()}; remove it")
    if found.st_mode & 0o077:
        raise PermissionError(f"{place}: others may enter it; chmod 700 {place}")
