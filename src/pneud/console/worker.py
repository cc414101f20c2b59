"""The console's process: serves until the loop is gone."""

from __future__ import annotations

import os
import signal
import socket
import sys
import time

from pneud.console import protocol
from pneud.console.commands import AxisDesk
from pneud.console.facts import Run
from pneud.console.server import Server
from pneud.console.status import Watch
from pneud.log.live.notes import Teller
from pneud.log.live.ring import Ring

_STEP_S = 0.02
_WATCH_S = 0.1  # the ring keeps some seconds


def serve(
    listener: socket.socket, loop: socket.socket, words: socket.socket, run: Run, ring: Ring, parent: int
) -> None:
    """Serve until the ring is closed or the parent is gone; SIGHUP takes gains and reference of the file.

    Args:
        listener: bound and listening.
        loop: the console's end of the hand-off.
        words: the teller's end to the recorder.
        run: what runs.
        ring: where its records are.
        parent: process id of the loop.
    """
    reload = False

    def hang_up(*_: object) -> None:
        nonlocal reload
        reload = True

    def refused(error: protocol.ProtocolError) -> None:
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
