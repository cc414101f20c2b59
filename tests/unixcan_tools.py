"""What the tests of unixcan share: a private runtime folder, other processes on the channel, patience."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

PATIENCE_S = 20.0


@contextmanager
def short_folder() -> Iterator[Path]:
    """A folder whose path leaves room for a socket's name."""
    with tempfile.TemporaryDirectory(prefix="uc", dir="/tmp") as path:
        yield Path(path)


def until(condition: Callable[[], bool], what: str) -> None:
    """Wait until something holds; fail loudly if it never does."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, f"in vain: {what}"
        time.sleep(0.002)


def python(code: str, *arguments: str) -> subprocess.Popen[str]:
    """Another Python with the same environment, talking through pipes."""
    return subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )


def said(process: subprocess.Popen[str], word: str) -> None:
    """The process's next line must be `word`."""
    assert process.stdout is not None
    line = process.stdout.readline().strip()
    if line != word:
        process.kill()
        raise AssertionError(f"said {line!r} instead of {word!r}: {process.communicate()[1]}")
