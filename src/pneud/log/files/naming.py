"""Where logs lie, what they are called, and the one error that is for people."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pneud.rt.outputs import replacing

_NEW, _MODE = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644


class LogError(Exception):
    """A log cannot be written or read; the text is one line for a person."""

    exit_code = 2


def log_path(option: str | None, name: str, now: float | None = None) -> Path:
    """The file a new log goes to; its folder exists afterwards, the file does not.

    Args:
        option: a `.mcap` file, which must not exist, or a folder; None or empty for the default folder,
            `$STATE_DIRECTORY`, else `~/.local/state/pneud`.
        name: what the file's name begins with.
        now: Unix time [s] in the file's name; the present if None.

    Raises:
        LogError: the file exists, or its folder cannot be made.
    """
    if option and option.endswith(".mcap"):
        path = _at_home(option)
        if path.exists():
            raise LogError(f"{path}: exists already; a log is never overwritten, name another file")
        if not path.parent.is_dir():
            raise LogError(f"{path}: there is no folder {path.parent}; create it or name another file")
        return path
    folder = log_folder(option)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise LogError(f"{folder}: is a file, but neither a folder nor a name ending in .mcap") from None
    except OSError as e:
        raise LogError(f"{folder}: cannot be made: {e.strerror}; choose a folder with --log") from None
    stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(now))
    stem = f"{_stem(name)}-{stamp}"
    path = folder / f"{stem}.mcap"
    count = 1
    while path.exists():
        count += 1
        path = folder / f"{stem}-{count}.mcap"
    return path


def mileage_file(option: str | None, name: str, airless: bool) -> Path | None:
    """Where it is kept what an axis has done: in the default folder of logs, wherever those are.

    Args:
        option: where the log goes, as for `log_path`.
        name: of the axis.
        airless: nothing wears: it counts apart from an axis of that name that has air, and not at all where
            its log is sent elsewhere.

    Returns:
        The path; None where there is none.
    """
    if airless and option:
        return None
    try:
        return log_folder(None) / f"{_stem(name)}{'.airless' if airless else ''}.mileage.json"
    except LogError:
        return None


def _stem(name: str) -> str:
    """An axis's name as names of files have it."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", name).strip("-.") or "log"


def open_log(option: str | None, name: str, now: float | None = None) -> tuple[Path, int]:
    """As `log_path`, with the file made, so that two runs in the same second get two names.

    Returns:
        The path, and a descriptor open for writing, the caller's to close.

    Raises:
        LogError: the file exists, or cannot be made.
    """
    while True:
        path = log_path(option, name, now)
        try:
            return path, create_log(path)
        except LogError:
            if (option or "").endswith(".mcap") or not path.exists():
                raise


def log_folder(option: str | None) -> Path:
    """The folder that logs go to, which need not exist; the default where none is asked for.

    Raises:
        LogError: there is no default.
    """
    if option:
        return _at_home(option)
    # systemd gives several folders with colons between them where a unit names several.
    state = os.environ.get("STATE_DIRECTORY", "").split(":")[0]
    if state:
        return Path(state)
    try:
        return Path.home() / ".local" / "state" / "pneud"
    except RuntimeError:
        raise LogError("no home folder for the log; set STATE_DIRECTORY or choose with --log") from None


def _at_home(option: str) -> Path:
    try:
        return Path(option).expanduser()
    except RuntimeError:
        raise LogError(f"{option}: no such user, or one without a home") from None


def create_log(path: Path) -> int:
    """Create a log's file and open it for writing; the descriptor is the caller's to close.

    Raises:
        LogError: the file exists or cannot be created.
    """
    try:
        return os.open(path, _NEW, _MODE)
    except FileExistsError:
        raise LogError(f"{path}: exists already; a log is never overwritten, name another file") from None
    except OSError as e:
        raise LogError(f"{path}: cannot be created: {e.strerror}; choose another place with --log") from None


@contextmanager
def new_log(path: Path) -> Iterator[int]:
    """As `create_log`, for a log that a tool makes: it has its name when the block is over, and not before.

    Raises:
        LogError: the file exists.
        OSError: it cannot be written.
    """
    if path.exists():
        raise LogError(f"{path}: exists already; a log is never overwritten, name another file")
    with replacing(path) as beside:
        yield os.open(beside, _NEW, _MODE)


def next_part(path: Path, number: int) -> Path:
    """The file that a log goes on in: x.mcap, x.part00002.mcap, …; names that sort in this order.

    Args:
        path: of any earlier part.
        number: of the part, from 2.

    Returns:
        A path that is free; where the name is taken, the next one that is.
    """
    stem = re.sub(r"\.part\d+$", "", path.stem)
    while (found := path.with_name(f"{stem}.part{number:05}.mcap")).exists():
        number += 1
    return found
