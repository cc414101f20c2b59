"""Where the console's socket lies: made by the daemon, found by its clients."""

import contextlib
import errno
import fcntl
import os
import socket
import stat
from pathlib import Path
from typing import NamedTuple

from pneud.console.peer import GROUP, commanding_group
from pneud.rt.folders import runtime_folder

SYSTEM_FOLDER = Path("/run/pneud")
_SUFFIX = ".sock"


class PlaceError(Exception):
    """There is no socket to be had; the text is one line for a person."""

    def __init__(self, text: str, exit_code: int = 3) -> None:
        super().__init__(text)
        self.exit_code = exit_code


class Endpoint(NamedTuple):
    """A socket that listens, and the lock that makes it this daemon's for as long as it lives."""

    listener: socket.socket
    path: Path
    lock: int


def bind(name: str, given: str | None, *, virtual: bool) -> Endpoint:
    """Make the daemon's socket; one that a dead daemon left is replaced.

    Args:
        name: of the axis.
        given: `--socket`; None asks `$PNEUD_SOCKET`, then the runtime folder.
        virtual: several runs of a virtual axis may go on at once: the later ones add their process id.

    Raises:
        PlaceError: a living daemon has it, or it cannot be made.
    """
    named = given or os.environ.get("PNEUD_SOCKET")
    try:
        path = Path(named).absolute() if named else runtime_folder() / f"{name}{_SUFFIX}"
        if path.exists() and not stat.S_ISSOCK(path.lstat().st_mode):
            raise PlaceError(f"{path}: is no socket; give --socket another name", 2)
        lock = _lock(path)
        if lock is None and virtual and not named:
            path = path.with_name(f"{name}-{os.getpid()}{_SUFFIX}")
            lock = _lock(path)
        if lock is None:
            raise PlaceError(f"{path}: another pneud serves it; stop that one, or give --socket")
    except OSError as e:
        raise PlaceError(f"no socket for the console: {e}") from None
    listener = socket.socket(socket.AF_UNIX)
    try:
        path.unlink(missing_ok=True)
        listener.bind(str(path))  # nobody can connect before listen()
        path.chmod(0o660 if _give_to_group(path) else 0o600)
        listener.listen(64)
    except OSError as e:
        listener.close()
        os.close(lock)
        raise PlaceError(_words(e, str(path))) from None
    return Endpoint(listener, path, lock)


def _lock(path: Path) -> int | None:
    """Lock a socket's name, and leave this process's number there; None where a living daemon has it."""
    flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
    descriptor = os.open(_lock_of(path), flags, 0o640)  # who finds the socket dead may ask whose it was
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, f"{_lock_of(path)}: is no file")
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        return None
    except OSError:
        os.close(descriptor)
        raise
    os.truncate(descriptor, 0)
    os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
    return descriptor


def _lock_of(path: Path) -> Path:
    return path.with_name(path.name + ".lock")


def _holder(path: Path) -> str | None:
    """The process that holds a socket's lock, "?" where it does not say; None where nobody does."""
    try:
        descriptor = os.open(_lock_of(path), os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        said = os.pread(descriptor, 16, 0).decode("ascii", "replace").strip()
        return said if said.isdecimal() else "?"
    except OSError:
        return None
    finally:
        os.close(descriptor)
    return None


def _give_to_group(path: Path) -> bool:
    group = commanding_group()
    if group is None:
        return False
    if path.stat().st_gid == group:  # the unit refuses even a chown that changes nothing
        return True
    try:
        os.chown(path, -1, group)
    except OSError:
        return False
    return True


def find(given: str | None) -> socket.socket:
    """Connect to the daemon's socket.

    Raises:
        PlaceError: there is none, there are several, or it is somebody else's.
    """
    named = given or os.environ.get("PNEUD_SOCKET")
    if named:
        return _connect(Path(named))
    living: list[tuple[Path, socket.socket]] = []
    shut: list[Path] = []
    mute: list[str] = []
    for folder in dict.fromkeys(_folders()):
        try:
            paths = sorted(p for p in folder.iterdir() if p.suffix == _SUFFIX)
        except OSError as e:
            if e.errno in (errno.EACCES, errno.EPERM):
                shut.append(folder)
            continue
        for path in paths:
            try:
                living.append((path, _connect(path)))
            except _DeadError:
                if (pid := _holder(path)) is not None:
                    mute.append(_mute(path, pid))
            except PlaceError:
                shut.append(path)
    if len(living) == 1:
        return living[0][1]
    for _, connection in living:
        connection.close()
    if living:
        names = ", ".join(str(path) for path, _ in living)
        raise PlaceError(f"several daemons run: {names}; choose one with --socket", 2)
    if mute:
        raise PlaceError("; ".join(mute))
    if shut:
        raise PlaceError(f"no daemon of yours runs (pneud --virtual starts one); {_forbidden(shut[0])}")
    raise PlaceError("no running daemon found; start one (pneud --virtual), or give its --socket")


def _mute(path: Path, pid: str) -> str:
    return (
        f"{path}: the daemon (process {pid}) runs, but nobody listens there: it is ending, or its console is"
        " gone for good, and what an operator had engaged comes to rest; restart the daemon, or end it:"
        f" kill {pid}"
    )


class _DeadError(PlaceError):
    pass


def _folders() -> list[Path]:
    folders = [SYSTEM_FOLDER]
    with contextlib.suppress(OSError):
        folders.append(runtime_folder())
    return folders


def _connect(path: Path) -> socket.socket:
    connection = socket.socket(socket.AF_UNIX)
    try:
        connection.connect(str(path))
    except OSError as e:
        connection.close()
        if e.errno in (errno.EACCES, errno.EPERM):
            raise PlaceError(_forbidden(path)) from None
        if e.errno in (errno.ECONNREFUSED, errno.ENOENT):
            pid = _holder(path)
            raise _DeadError(f"{path}: no daemon serves it" if pid is None else _mute(path, pid)) from None
        raise PlaceError(_words(e, str(path))) from None
    return connection


def _forbidden(path: Path) -> str:
    return f"{path}: permission denied; join the group: sudo usermod -aG {GROUP} USER, then log in again"


def _words(e: OSError, where: str) -> str:
    return f"{where}: {e.strerror or e}"
