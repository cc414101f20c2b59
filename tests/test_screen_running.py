"""The screen of a virtual axis on a terminal: space stops it, faults stay, the terminal comes back."""

from __future__ import annotations

import os
import re
import select
import signal
import subprocess
import termios
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from commands import PNEUD, children, eventually
from running import patient_axis

pytestmark = [pytest.mark.slow, pytest.mark.realtime]
_CODES = re.compile(r"\x1b\[[0-?]*[ -/]*[@-~]|\x1b\][^\x07]*\x07")


class Terminal:
    """A command on a terminal of its own."""

    def __init__(self, *words: object, **environment: str) -> None:
        self.master, slave = os.openpty()
        self.slave = slave
        termios.tcsetwinsize(slave, (40, 120))
        self.before = termios.tcgetattr(slave)
        self.seen = ""
        self.process = subprocess.Popen(
            [*PNEUD, *map(str, words)],
            stdin=slave,
            stdout=slave,
            stderr=slave,
            env={**os.environ, "TERM": "xterm-256color", **environment},
            start_new_session=True,
        )

    def read(self, seconds: float = 0.05) -> str:
        """What has come, without what moves the cursor."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if select.select([self.master], [], [], 0.02)[0]:
                self.seen += os.read(self.master, 65536).decode(errors="replace")
        return _CODES.sub("", self.seen)

    def until(self, *texts: str, timeout: float = 20.0) -> None:
        """Wait until all of them have been shown, from now on."""
        self.seen = ""
        self.wait_for(lambda: all(text in self.read() for text in texts), timeout)

    @staticmethod
    def wait_for(holds: Callable[[], bool], timeout: float) -> None:
        eventually(holds, timeout)

    def press(self, keys: str) -> None:
        os.write(self.master, keys.encode())

    @property
    def screen(self) -> int:
        """Process id of what draws on it."""
        for pid in children(self.process.pid):
            if str(Path(f"/proc/{pid}/fd/1").readlink()) == os.ttyname(self.slave):
                return pid
        raise AssertionError("nothing draws")

    def ended(self) -> int:
        """Exit status, with all that it has written read."""
        self.wait_for(lambda: bool(self.read()) and self.process.poll() is not None, 20.0)
        self.read(0.2)
        return self.process.returncode


@contextmanager
def terminal(*words: object, **environment: str) -> Iterator[Terminal]:
    found = Terminal(*words, **environment)
    try:
        yield found
    finally:
        found.process.kill()
        found.process.wait()
        os.close(found.master)
        os.close(found.slave)


def virtual(folder: Path) -> tuple[object, ...]:
    """A virtual run that a stall of a shared machine does not end."""
    return "--virtual", "--config", patient_axis(folder), "--log", folder / "run.mcap"


def assert_as_it_was(t: Terminal) -> None:
    assert termios.tcgetattr(t.slave) == t.before
    assert t.seen.rindex("\x1b[?1049l") >= 0
    assert t.seen.rindex("\x1b[?25h") >= 0


def test_keys_of_a_virtual_run_stop_go_and_end_it(tmp_path: Path) -> None:
    with terminal(*virtual(tmp_path)) as t:
        t.until("follows the reference", "elsewhere: pneud top")
        t.press(" ")
        t.until("stop: taken", "holding")
        t.press("g300\r")
        t.until("goto: taken", "in position")
        t.press("?")
        t.until("controlled stop, whatever it does")
        t.press("x")
        t.press("q")
        assert t.ended() == 0
        assert "log " in t.read()
        assert_as_it_was(t)


def test_a_scenario_stays_on_its_fault_until_a_key(tmp_path: Path) -> None:
    words = ("--virtual", "--scenario", "pressure-missing", "--log", tmp_path / "run.mcap")
    with terminal(*words) as t:
        t.until("fault: ", "c clears")
        t.read(1.0)
        assert t.process.poll() is None
        t.press("q")
        assert t.ended() == 1
        assert_as_it_was(t)


def test_a_scenario_with_a_duration_ends_by_itself(tmp_path: Path) -> None:
    words = ("--virtual", "--scenario", "pressure-missing", "--log", tmp_path / "run.mcap", "--duration", 4)
    with terminal(*words) as t:
        assert t.ended() == 1


@pytest.mark.parametrize("how", ["Ctrl-C", "SIGTERM", "SIGKILL", "the screen is killed"])
def test_the_terminal_comes_back(how: str, tmp_path: Path) -> None:
    with terminal(*virtual(tmp_path)) as t:
        t.until("follows the reference")
        if how == "Ctrl-C":
            os.killpg(t.process.pid, signal.SIGINT)  # as the kernel does for the terminal's own group
        elif how == "the screen is killed":
            os.kill(t.screen, signal.SIGKILL)
            t.read(0.2)
            os.kill(t.process.pid, signal.SIGINT)
        else:
            t.process.send_signal(getattr(signal, how))
        t.ended()
        t.wait_for(lambda: bool(t.read()) and termios.tcgetattr(t.slave) == t.before, 5.0)
        assert_as_it_was(t)


def test_top_shows_another_daemon_and_leaves_it_running(tmp_path: Path) -> None:
    socket = tmp_path / "axis.sock"
    daemon = subprocess.Popen(
        [*PNEUD, *map(str, virtual(tmp_path)), "--headless", "--json", "--socket", str(socket)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        eventually(socket.exists)
        with terminal("top", "--socket", socket) as t:
            t.until("follows the reference")
            t.press(" ")
            t.until("stop: taken")
            os.kill(t.screen, signal.SIGKILL)
            assert t.ended() == 0
            assert_as_it_was(t)
        with terminal("top", "--read-only", "--socket", socket) as t:
            t.until("in position")
            t.press("dq")
            assert t.ended() == 0
        assert daemon.poll() is None
    finally:
        daemon.kill()
        daemon.wait()
