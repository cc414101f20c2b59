"""The console's process: forked beside the loop, serves until the loop is gone."""

from __future__ import annotations

import os
import signal
import socket
import sys
import time
from typing import TYPE_CHECKING

from pneud import crew
from pneud.console.facts import Run
from pneud.log.live.notes import Teller
from pneud.log.live.ring import Ring

if TYPE_CHECKING:
    from pneud.console.protocol import ProtocolError

_STEP_S = 0.02
_WATCH_S = 0.1  # the ring keeps some seconds


def fork_console(
    listener: socket.socket, loop: socket.socket, words: socket.socket, run: Run, ring: Ring
) -> int:
    """Fork the console; the sockets are the child's from here on.

    It finishes by itself when the ring is closed or this process dies, however it dies.

    Args:
        listener: bound and listening.
        loop: the console's end of the hand-off.
        words: the teller's end to the recorder.
        run: what runs.
        ring: where its records are.

    Returns:
        The child's process id.

    Raises:
        OSError: no more processes.
    """
    parent = os.getpid()
    child = crew.fork(
        lambda: _serve(listener, loop, words, run, ring, parent),
        keep=(listener.fileno(), loop.fileno(), words.fileno(), ring.descriptor),
        orphaned=None,
    )
    for end in (listener, loop, words):
        end.close()
    return child


def _serve(
    listener: socket.socket, loop: socket.socket, words: socket.socket, run: Run, ring: Ring, parent: int
) -> None:
    """Serve until the ring is closed or the parent is gone; SIGHUP takes gains and reference of the file."""
    # the protocol is loaded here, beside the loop's own start; who calls meanwhile is queued
    from pneud.console import protocol  # noqa: PLC0415
    from pneud.console.commands import AxisDesk  # noqa: PLC0415
    from pneud.console.server import Server  # noqa: PLC0415
    from pneud.console.status import Watch  # noqa: PLC0415

    reload = False

    def hang_up(*_: object) -> None:
        nonlocal reload
        reload = True

    def refused(error: ProtocolError) -> None:
        print(f"pneud: {error}", file=sys.stderr, flush=True)

    signal.signal(signal.SIGHUP, hang_up)
    teller = Teller(words, "console")
    watch = Watch(ring)
    server = Server(listener, loop, AxisDesk(run, ring, watch), teller.say)
    due_s = 0.0
    while not (ring.closed or server.over) and os.getppid() == parent:
        now_s = time.monotonic()
        if now_s >= due_s:
            watch.poll()
            due_s = now_s + _WATCH_S
        if reload:
            reload = False
            server.ask(protocol.TuneReload(v=1, id=0, verb="tune_reload"), "SIGHUP", refused)
        server.step(_STEP_S)
    server.close()
