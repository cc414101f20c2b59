"""The live screen on a terminal, twenty pictures a second, in a process of its own.

A slow or stalled terminal is nobody else's matter, and an end of the process leaves the terminal as it was.
"""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Callable

from rich.console import Console
from rich.control import Control

from pneud.signals import Record
from pneud.view.history import History
from pneud.view.info import ScreenInfo
from pneud.view.screen import Page, ScreenState, status_line

FRAME_S = 0.05
PLAIN_LINE_S = 2.0


def run(
    poll: Callable[[], list[Record]],
    info: ScreenInfo,
    stop: Callable[[], bool],
    *,
    log_counts: Callable[[], tuple[int, int]] | None = None,
    console: Console | None = None,
    attend: Callable[[ScreenInfo], ScreenInfo] | None = None,
) -> None:
    """Show an axis until told to stop; the terminal is as before afterwards.

    On a terminal that cannot move its cursor (TERM=dumb), or no terminal at all, a line every two seconds
    stands in for the screen.

    Args:
        poll: all records since the last call.
        info: what they belong to.
        stop: looked at before every picture.
        log_counts: records written to the log and dropped.
        console: where to draw; standard output if not given.
        attend: called before every picture; may change what does not come from the records.

    Raises:
        OSError: the terminal is gone.
    """
    console = console or Console(highlight=False)
    history = History(info.sync)
    # the font of the Linux console has neither the eighth blocks nor combining characters
    ascii_only = True if os.environ.get("TERM") == "linux" else None
    plain = not console.is_terminal or console.is_dumb_terminal
    frame_s = PLAIN_LINE_S if plain else FRAME_S
    with contextlib.nullcontext() if plain else console.screen():
        heard_s = due_s = time.monotonic()
        while not stop():
            records = poll()
            now_s = time.monotonic()
            if records:
                history.add(records)
                heard_s = now_s
            history.silent_s = now_s - heard_s
            if attend is not None:
                info = attend(info)
            if log_counts is not None:
                history.log_written, history.log_dropped = log_counts()
            if now_s >= due_s - 0.5 * FRAME_S:
                snapshot = ScreenState(history.last, info)
                if plain:
                    console.print(
                        status_line(snapshot, history), soft_wrap=True, markup=False, highlight=False
                    )
                else:
                    # half the work of rich's Live, which lays a picture out twice; a page has its exact shape
                    page = Page(snapshot, history, console.size, ascii_only)
                    console.print(Control.home(), page, end="", crop=False)
                due_s = now_s + frame_s
            time.sleep(max(0.0, now_s + FRAME_S - time.monotonic()))


def run_child(
    poll: Callable[[], list[Record]],
    info: ScreenInfo,
    stop: Callable[[], bool],
    *,
    log_counts: Callable[[], tuple[int, int]] | None = None,
    attend: Callable[[ScreenInfo], ScreenInfo] | None = None,
) -> None:
    """`run` as the whole life of a forked process: leaves in order on SIGTERM and SIGHUP.

    Where the terminal takes no more output, SIGALRM ends the process two seconds after it was told to leave;
    the parent then writes `LEAVE_SCREEN`.
    """
    leaving = False

    def leave(*_: object) -> None:
        nonlocal leaving
        if not leaving:
            leaving = True
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            signal.alarm(2)

    def told_to_stop() -> bool:
        if stop():
            leave()
        return leaving

    for signum in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(signum, leave)
    os.nice(5)  # the picture may be late, the plant and the recorder beside it may not
    with contextlib.suppress(OSError, SystemExit):  # the terminal is gone; rich exits on a broken pipe
        run(poll, info, told_to_stop, log_counts=log_counts, attend=attend)
