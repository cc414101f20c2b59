"""Those who look on, in processes of their own: the screen on this terminal, and the server for viewers.

What they draw and serve with is loaded there, beside the loop's own start.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import termios
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from pneud import crew
from pneud.log.format.header import LogHeader
from pneud.log.live.ring import Ring
from pneud.view.info import ScreenInfo

if TYPE_CHECKING:
    from pneud.view.admission import Admission
    from pneud.view.hands import Leaving, Operator

LEAVE_SCREEN = "\x1b[?2004l\x1b[?1004l\x1b[?2048l\x1b[<u\x1b[?7h\x1b[?1049l\x1b[?25h\x1b[0m"
"""What a parent writes to the terminal when the screen's process did not end by itself."""

SCREEN_PATIENCE_S = 3.0
_LOOK_S = 0.005


class Screen:
    """A screen in a process of its own, and the terminal that it is on.

    Attributes:
        pid: its process id.
    """

    def __init__(self, main: Callable[[], None], keep: Iterable[int] = ()) -> None:
        """Begin.

        Args:
            main: its whole life.
            keep: descriptors that it needs.
        """
        self._keyboard = termios.tcgetattr(0) if sys.stdin is not None and sys.stdin.isatty() else None
        self.pid = crew.fork(main, keep=keep, terminal=True, orphaned=signal.SIGTERM, name="screen")

    def wait(self) -> None:
        """Wait until it has ended, and leave the terminal as it was whatever has become of it."""
        self._tidy(os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1]) == 0)

    def end(self) -> None:
        """Tell it to leave, and leave the terminal as it was whatever it does."""
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGTERM)
        give_up_s = time.monotonic() + SCREEN_PATIENCE_S
        while time.monotonic() < give_up_s:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self._tidy(os.waitstatus_to_exitcode(status) == 0)
                return
            time.sleep(_LOOK_S)
        crew.kill(self.pid)
        self._tidy(False)

    def _tidy(self, in_order: bool) -> None:
        if self._keyboard is not None:
            # a process in the background would be stopped for touching its terminal
            before = signal.signal(signal.SIGTTOU, signal.SIG_IGN)
            with contextlib.suppress(termios.error):
                termios.tcsetattr(0, termios.TCSANOW, self._keyboard)
            signal.signal(signal.SIGTTOU, before)
        if not in_order and sys.stdout.isatty():
            sys.stdout.write(LEAVE_SCREEN)
            sys.stdout.flush()


class Seen(NamedTuple):
    """An axis that is looked at."""

    ring: Ring  # of its records
    info: ScreenInfo  # what they belong to
    operator: Operator | None  # whom keys ask


def fork_screen(axes: Sequence[Seen], leaving: Leaving, keep: Iterable[int] = (), chosen: int = 0) -> Screen:
    """The live screen on this terminal, until the rings are closed or it is left.

    Args:
        axes: what is shown.
        leaving: what `q` does.
        keep: descriptors that the operators need.
        chosen: the place of the axis that is drawn large at first.
    """

    def main() -> None:
        from pneud.view.several import Several  # noqa: PLC0415
        from pneud.view.show import Show  # noqa: PLC0415
        from pneud.view.terminal import run_child  # noqa: PLC0415

        def show(axis: Seen, told: Callable[[bool], bool]) -> Show:
            ring = axis.ring

            def log_counts() -> tuple[int, int, int]:
                status = ring.status()
                return status.written, status.lost, status.file_bytes

            return Show(
                ring.reader().poll,
                axis.info,
                lambda: told(ring.closed),
                log_counts=log_counts,
                operator=axis.operator,
                leaving=leaving,
            )

        def shows(told: Callable[[bool], bool]) -> Show | Several:
            all_ = [show(axis, told) for axis in axes]
            return all_[0] if len(all_) == 1 else Several(all_, chosen)

        run_child(shows)

    return Screen(main, keep)


class Looked(NamedTuple):
    """An axis that viewers look at."""

    ring: Ring
    header: LogHeader
    parameters: Mapping[str, Any]  # its configuration, by dotted keys
    name: str = ""  # where there are several


def fork_viewers(axes: Sequence[Looked], name: str, listener: socket.socket, admission: Admission) -> int:
    """The server for viewers, until the rings are closed.

    Args:
        axes: what is served.
        name: of the daemon.
        listener: where viewers come to.
        admission: who is let in.

    Returns:
        Its process id.
    """

    def main() -> None:
        from pneud.view import viewers  # noqa: PLC0415

        sources = [viewers.Source(a.ring.reader().poll, a.header, a.parameters, a.name) for a in axes]
        viewers.serve(sources, name, listener, admission, lambda: axes[0].ring.closed)

    with listener:
        return crew.fork(main, keep=[listener.fileno()], orphaned=signal.SIGTERM, name="viewers")
