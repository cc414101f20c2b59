"""Passwords in files."""

from __future__ import annotations

import stat
from pathlib import Path


def first_line(path: Path, error: type[Exception]) -> str:
    """The first line of a file that is its owner's alone.

    Raises:
        OSError: it cannot be read.
        Exception: `error`, where others may read it.
    """
    with path.open(encoding="utf-8") as file:
        if stat.S_IMODE(path.stat().st_mode) & (stat.S_IRWXO | stat.S_IWGRP):
            raise error(f"{path}: anybody may read the password: chmod 600 {path}")
        return file.readline().rstrip("\r\n")
