"""Runs the pneud command as its users do."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any, NoReturn

Figures = Callable[[str], None]  # takes a line that is printed when all tests are over
PNEUD = [sys.executable, "-m", "pneud.cli"]


def pneud(*args: object, timeout: float = 120.0, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """One command to its end."""
    return subprocess.run(
        [*PNEUD, *map(str, args)], capture_output=True, text=True, timeout=timeout, cwd=cwd, check=False
    )


def pneud_here(*args: object) -> subprocess.CompletedProcess[str]:
    """One command to its end in this process, which saves a start; for verbs that start no processes."""
    from typer.testing import CliRunner  # noqa: PLC0415

    from pneud.cli import app  # noqa: PLC0415

    words = [str(arg) for arg in args]
    result = CliRunner().invoke(app, words)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return subprocess.CompletedProcess(words, result.exit_code, result.stdout, result.stderr)


def become(words: list[str], out: int, err: int, before: Callable[[], None] = lambda: None) -> NoReturn:
    """Go on as the command, in a fork of a test's process.

    Args:
        words: of the command.
        out: descriptor of its standard output.
        err: descriptor of its standard error.
        before: what to change first.
    """
    status: object = 70
    try:
        from pneud import cli  # noqa: PLC0415

        os.dup2(out, 1)
        os.dup2(err, 2)
        sys.stdout, sys.stderr = (
            open(number, "w", buffering, encoding="utf-8", closefd=False)  # noqa: SIM115
            for number, buffering in ((1, -1), (2, 1))  # by blocks and by lines, as ever
        )
        before()
        sys.argv = ["pneud", *words]
        cli.main()
    except SystemExit as e:
        status = e.code or 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(status if isinstance(status, int) else 1)


def pneud_forked(*args: object, out_to: str = "") -> subprocess.CompletedProcess[str]:
    """One command to its end in a fork of this process: with streams of its own, and nothing to load.

    Args:
        args: its words.
        out_to: a device that takes its standard output.
    """
    words = [str(arg) for arg in args]
    with (
        tempfile.TemporaryFile() as out,
        tempfile.TemporaryFile() as err,
        Path(out_to).open("wb", 0) if out_to else nullcontext(out) as to,
    ):
        child = os.fork()
        if not child:
            become(words, to.fileno(), err.fileno())
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        texts = []
        for file in (out, err):
            file.seek(0)
            texts.append(file.read().decode())
    return subprocess.CompletedProcess(words, status, *texts)


def object_of(done: subprocess.CompletedProcess[str]) -> dict[str, Any]:
    """The one JSON object on standard output."""
    lines = done.stdout.splitlines()
    assert len(lines) == 1, (done.stdout, done.stderr)
    found: dict[str, Any] = json.loads(lines[0], parse_constant=no_json)
    return found


def no_json(constant: str) -> None:
    """Called for NaN and infinity, which are no JSON."""
    raise AssertionError(f"{constant} in the output")


@contextmanager
def background(*args: object) -> Iterator[subprocess.Popen[str]]:
    """A command that runs beside the test and is killed with it."""
    process = subprocess.Popen(
        [*PNEUD, *map(str, args)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def eventually(holds: Callable[[], bool], timeout: float = 30.0) -> None:
    """Wait until something holds; fail if it never does."""
    deadline = time.monotonic() + timeout
    while not holds():
        assert time.monotonic() < deadline, "never came true"
        time.sleep(0.02)


def children(pid: int) -> list[int]:
    """Process ids of a process's children, the oldest first."""
    text = Path(f"/proc/{pid}/task/{pid}/children").read_text()
    return [int(word) for word in text.split()]


def kill(pid: int, number: signal.Signals = signal.SIGKILL) -> None:
    """Send a signal."""
    os.kill(pid, number)
