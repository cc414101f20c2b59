"""The live screen of the running daemon; keys stop, arm, disarm, clear, hold, go to and jog.

Two processes, as with the screen of the daemon itself: one draws and reads keys, the other one waits for it
and puts the terminal right, whatever becomes of the first. If the waiting one is killed, the drawing one does
so itself.
"""

from __future__ import annotations

import os
import signal
import sys
from typing import Annotated

import typer

from pneud.console.client import Client, RefusedError
from pneud.console.operator import Operator
from pneud.log.live.ring import Ring
from pneud.safety.cause import first_cause
from pneud.verbs import AxisOption, SocketOption
from pneud.view.hands import Leaving
from pneud.view.info import info_of
from pneud.view.processes import fork_screen


def top(
    read_only: Annotated[bool, typer.Option("--read-only", help="Look only: no keys but q.")] = False,
    axis: AxisOption = None,
    socket: SocketOption = None,
) -> int:
    """Show a running daemon until `q` or Ctrl-C, or until it ends.

    Returns:
        Exit status: 0, or 1 where the daemon cannot be looked at.
    """
    with Client(socket, axis) as client:
        try:
            if read_only:
                client.ask("observe")
            fields, descriptor = client.attach()
        except RefusedError as e:
            print(f"pneud: {e}", file=sys.stderr)
            return 1
        if fields["layout"] != Ring.layout():
            os.close(descriptor)
            print("pneud: the daemon runs another version of pneud; restart it", file=sys.stderr)
            return 1
        ring = Ring.attach(descriptor, fields["slots"], fields["slot_bytes"])
        operator = Operator(lambda: Client(socket, axis), client, read_only)
        screen = fork_screen(
            ring, info_of(fields, first_cause), operator, Leaving("leave"), [client.fileno()]
        )
        for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
            signal.signal(number, lambda *_: os.kill(screen.pid, signal.SIGTERM))
        signal.signal(signal.SIGTSTP, signal.SIG_IGN)
        screen.wait()
        if ring.closed:
            print("pneud: the daemon has ended", file=sys.stderr)
        return 0
