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
        sys.argv, sys.orig_argv = ["pneud", *words], [*PNEUD, *words]  # with which a daemon begins anew
        cli.main()
    except SystemExit as e:
        status = e.code or 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(status if isinstance(status, int) else 1)


class Forked:
    """A command in a fork of this process: with streams of its own, and nothing to load.

    Args:
        args: its words.
        cwd: folder in which it is given.
        out_to: a device that takes its standard output.

    Attributes:
        pid: its process id.
        returncode: its exit status, or less than 0 by a signal; None while it goes on.
    """

    def __init__(self, *args: object, cwd: Path | None = None, out_to: str = "") -> None:
        self.words = [str(arg) for arg in args]
        self.returncode: int | None = None
        self._out, self._err = tempfile.TemporaryFile(), tempfile.TemporaryFile()  # noqa: SIM115
        with Path(out_to).open("wb", 0) if out_to else nullcontext(self._out) as to:
            self.pid = os.fork()
            if not self.pid:
                become(self.words, to.fileno(), self._err.fileno(), lambda: os.chdir(cwd or "."))

    def poll(self) -> int | None:
        """Its exit status if it has ended."""
        return self._take(os.WNOHANG)

    def _take(self, how: int) -> int | None:
        if self.returncode is None:
            pid, status = os.waitpid(self.pid, how)
            if pid:
                self.returncode = os.waitstatus_to_exitcode(status)
        return self.returncode

    def send_signal(self, number: signal.Signals) -> None:
        """If it has not ended."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def communicate(self, timeout: float | None = None) -> tuple[str, str]:
        """What it has said on both streams when it has ended.

        Args:
            timeout: it is killed then, and what it has said is in the error.
        """
        if timeout is None:
            self._take(0)
        deadline = time.monotonic() + (timeout or 0.0)
        while self.poll() is None and time.monotonic() < deadline:
            time.sleep(0.01)
        if self.poll() is None:
            self.kill()
            raise AssertionError(f"{self.words} goes on: {self._said()}")
        return self._said()

    def _said(self) -> tuple[str, str]:
        texts = []
        for file in (self._out, self._err):
            file.seek(0)
            texts.append(file.read().decode())
        return texts[0], texts[1]

    def kill(self) -> None:
        """End it, whatever it does."""
        self.send_signal(signal.SIGKILL)
        self._take(0)


def pneud_forked(
    *args: object, out_to: str = "", cwd: Path | None = None, timeout: float | None = None
) -> subprocess.CompletedProcess[str]:
    """One command to its end in a fork of this process.

    Args:
        args: its words.
        out_to: a device that takes its standard output.
        cwd: folder in which it is given.
        timeout: after which it is killed, and the test has failed.
    """
    forked = Forked(*args, out_to=out_to, cwd=cwd)
    out, err = forked.communicate(timeout)
    assert forked.returncode is not None
    return subprocess.CompletedProcess(forked.words, forked.returncode, out, err)


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
