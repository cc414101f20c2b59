"""Signals that end a run in good order."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Callable


def stop_on_signals(stop: Callable[[], None], console_pid: int = 0) -> None:
    """Let Ctrl-C, a closed terminal and a kill stop the run in good order.

    Args:
        stop: asks for the end; called in the handler.
        console_pid: process that a SIGHUP is handed on to, unless it says that the terminal has gone.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGQUIT):
        signal.signal(number, lambda *_: stop())
    had_terminal = _has_terminal()

    def hang_up(*_: object) -> None:
        if not console_pid or (had_terminal and not _has_terminal()):
            stop()
        else:
            with contextlib.suppress(ProcessLookupError):
                os.kill(console_pid, signal.SIGHUP)

    signal.signal(signal.SIGHUP, hang_up)
    # stopped from the keyboard, the axis would be gone but not centred, and the screen in the way
    signal.signal(signal.SIGTSTP, signal.SIG_IGN)


def _has_terminal() -> bool:
    try:
        os.close(os.open("/dev/tty", os.O_RDONLY | os.O_NOCTTY))
    except OSError:
        return False
    return True
