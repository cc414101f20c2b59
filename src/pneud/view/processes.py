"""Those who look on, in processes of their own: the screen on this terminal, and the server for viewers.

What they draw and serve with is loaded there, beside the loop's own start.
"""

from __future__ import annotations

import signal
import socket
import sys
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, TypeAlias

from pneud import crew
from pneud.log.format.header import LogHeader
from pneud.log.live.ring import Ring
from pneud.view.info import ScreenInfo

if TYPE_CHECKING:
    from pneud.view.admission import Admission

LEAVE_SCREEN = "\x1b[?1049l\x1b[?25h\x1b[0m"
"""What a parent writes to the terminal when the screen's process did not end by itself."""

SCREEN_PATIENCE_S = 3.0

Learnt: TypeAlias = Callable[[Any], Mapping[str, Mapping[str, Any]]]


def fork_screen(ring: Ring, info: ScreenInfo, learnt: Learnt) -> int:
    """The live screen on this terminal, until the ring is closed.

    Returns:
        Its process id.
    """

    def main() -> None:
        from pneud.view.terminal import run_child  # noqa: PLC0415

        def log_counts() -> tuple[int, int]:
            status = ring.status()
            return status.written, status.lost

        def attend(info: ScreenInfo) -> ScreenInfo:
            for state in filter(None, reader.states().values()):
                info = info._replace(learnt=learnt(state))
            return info

        reader = ring.reader()
        run_child(reader.poll, info, lambda: ring.closed, log_counts=log_counts, attend=attend)

    return crew.fork(main, terminal=True, orphaned=signal.SIGTERM)


def end_screen(pid: int) -> None:
    """Tell the screen to leave, and leave the terminal clean whatever it does."""
    if not crew.end(pid, SCREEN_PATIENCE_S):
        leave_screen()


def leave_screen() -> None:
    """Put the terminal right for a screen that could not."""
    sys.stdout.write(LEAVE_SCREEN)
    sys.stdout.flush()


def fork_viewers(
    ring: Ring,
    header: LogHeader,
    parameters: Mapping[str, Any],
    listener: socket.socket,
    admission: Admission,
) -> int:
    """The server for viewers, until the ring is closed.

    Returns:
        Its process id.
    """

    def main() -> None:
        from pneud.view import viewers  # noqa: PLC0415

        viewers.serve(ring.reader().poll, header, parameters, listener, admission, lambda: ring.closed)

    with listener:
        return crew.fork(main, keep=[listener.fileno()], orphaned=signal.SIGTERM)
