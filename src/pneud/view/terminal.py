"""The live screen on a terminal, in a process of its own: with textual, else a page drawn by rich, or lines.

A slow or stalled terminal is nobody else's matter, and an end of the process leaves the terminal as it was.
"""

from __future__ import annotations

import contextlib
import os
import re
import select
import signal
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterator
from typing import Any

from rich.console import Console
from rich.control import Control

from pneud.view.screen import Drawn, status_line
from pneud.view.several import Several
from pneud.view.show import Show, is_ascii

FRAME_S = 0.1
PLAIN_LINE_S = 2.0
_LEAVE_S = 2  # that a terminal may take to be left
_KEY = re.compile(rb"\x1b\[[0-?]*[ -/]*[@-~]|\x1bO.|[^\x1b]|\x1b", re.DOTALL)
_NAMED = {
    b"\x1b[D": "left",
    b"\x1bOD": "left",
    b"\x1b[C": "right",
    b"\x1bOC": "right",
    b"\r": "enter",
    b"\n": "enter",
    b"\x1b": "escape",
    b"\x7f": "backspace",
    b"\x08": "backspace",
    b"\x04": "ctrl+d",
    b"\t": "tab",
}


def keys_in(data: bytes) -> list[str]:
    """The names of keys in what a terminal has sent; those of no meaning here are left out."""
    names = []
    for found in _KEY.findall(data):
        if found in _NAMED:
            names.append(_NAMED[found])
        elif len(found) == 1 and 0x20 <= found[0] < 0x7F:
            names.append(found.decode())
    return names


def has_keyboard() -> bool:
    """Whether standard input is a terminal whose keys come to this program."""
    if sys.stdin is None or not sys.stdin.isatty():
        return False
    try:
        return os.tcgetpgrp(0) == os.getpgrp()
    except OSError:  # a terminal that nobody's jobs are controlled from
        return True


def run(show: Show | Several, console: Console | None = None) -> None:
    """Show an axis until it is over; the terminal is as before afterwards.

    On a terminal that cannot move its cursor (TERM=dumb), or no terminal at all, a line every two seconds
    stands in for the screen. Where textual is not installed, or no keyboard there, rich draws the page.

    Args:
        show: what to show.
        console: where to draw with rich; standard output if not given.

    Raises:
        OSError: the terminal is gone.
    """
    given, console = console, console or Console(highlight=False)
    plain = not console.is_terminal or console.is_dumb_terminal
    keyboard = given is None and has_keyboard()
    if keyboard and not plain:
        with contextlib.suppress(ImportError):
            from pneud.view.app import run_app  # noqa: PLC0415 - takes longer to load than all the rest

            run_app(show)
            return
    with _keyboard(keyboard) as pressed:
        if plain:
            _lines(show, console, pressed)
        else:
            with console.screen():
                _pages(show, console, pressed)


def _lines(show: Show | Several, console: Console, pressed: Callable[[], list[str] | None]) -> None:
    due_s = 0.0
    while _attend(show, pressed):
        if time.monotonic() >= due_s:
            due_s = time.monotonic() + PLAIN_LINE_S
            line = status_line(show.snapshot, show.history)
            console.print(line, soft_wrap=True, markup=False, highlight=False)
        time.sleep(FRAME_S)


def _pages(show: Show | Several, console: Console, pressed: Callable[[], list[str] | None]) -> None:
    ascii_only = is_ascii(console.encoding)
    while _attend(show, pressed):
        begun_s = time.monotonic()
        # half the work of rich's Live, which lays a picture out twice; a page has its exact shape
        page = Drawn(show.picture((console.width, console.height), ascii_only))
        console.print(Control.home(), page, end="", crop=False)
        time.sleep(max(0.0, begun_s + FRAME_S - time.monotonic()))


def _attend(show: Show | Several, pressed: Callable[[], list[str] | None]) -> bool:
    keys = pressed()
    for key in keys or ():
        show.hands.press(key)
    return show.attend() and keys is not None


@contextlib.contextmanager
def _keyboard(there: bool) -> Iterator[Callable[[], list[str] | None]]:
    """Keys as they are pressed, while Ctrl-C stays a signal; None once the terminal is gone."""
    if not there:
        yield list
        return
    before = termios.tcgetattr(0)

    def pressed() -> list[str] | None:
        data = b""
        while select.select([0], [], [], 0.0)[0]:
            more = os.read(0, 1024)
            if not more:
                return None
            data += more
        return keys_in(data)

    tty.setcbreak(0)
    try:
        yield pressed
    finally:
        restore(before)


def restore(attributes: list[Any] | None) -> None:
    """Give the terminal's keyboard back its habits."""
    if attributes is not None:
        # a process in the background would be stopped for touching its terminal
        signal.signal(signal.SIGTTOU, signal.SIG_IGN)
        with contextlib.suppress(termios.error):
            termios.tcsetattr(0, termios.TCSANOW, attributes)


def run_child(make: Callable[[Callable[[bool], bool]], Show | Several]) -> None:
    """`run` as the whole life of a forked process: leaves in order on SIGTERM and SIGHUP.

    Where the terminal takes no more output, SIGALRM ends the process two seconds after it was told to leave;
    the parent then puts the terminal right.

    Args:
        make: the show, of what is told whether all is over, and tells whether it is time to leave.
    """
    leaving = False

    def leave(*_: object) -> None:
        nonlocal leaving
        if not leaving:
            leaving = True
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            signal.alarm(_LEAVE_S)

    def told(over: bool) -> bool:
        if over:
            leave()
        return leaving

    for signum in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(signum, leave)
    os.nice(5)  # the picture may be late, the plant and the recorder beside it may not
    with contextlib.suppress(OSError, SystemExit):  # the terminal is gone; rich exits on a broken pipe
        run(make(told))
