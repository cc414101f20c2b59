"""The live screen of the running daemon; keys stop, arm, disarm, clear, hold, go to and jog.

Two processes, as with the screen of the daemon itself: one draws and reads keys, the other one waits for it
and puts the terminal right, whatever becomes of the first. If the waiting one is killed, the drawing one does
so itself.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from collections.abc import Callable
from functools import partial
from typing import Annotated

import typer

from pneud.console.attached import attached
from pneud.console.client import Client, RefusedError
from pneud.console.operator import Operator
from pneud.safety.cause import first_cause
from pneud.verbs import AxisOption, SocketOption
from pneud.view.hands import Leaving
from pneud.view.info import info_of
from pneud.view.processes import Seen, fork_screen


def top(
    read_only: Annotated[bool, typer.Option("--read-only", help="Look only: no keys but q.")] = False,
    axis: AxisOption = None,
    socket: SocketOption = None,
) -> int:
    """Show a running daemon until `q` or Ctrl-C, or until it ends.

    Returns:
        Exit status: 0, or 1 where the daemon cannot be looked at.
    """
    with contextlib.ExitStack() as clients:
        seen: list[Seen] = []
        kept: list[int] = []
        try:
            names = _axes(socket, axis)
            for name in names:
                client = clients.enter_context(Client(socket, name))
                kept.append(client.fileno())
                seen.append(_seen(client, partial(Client, socket, name), read_only))
        except RefusedError as e:
            print(f"pneud: {e}", file=sys.stderr)
            return 1
        ring = seen[0].ring
        screen = fork_screen(
            seen,
            Leaving("leave"),
            kept,
            names.index(axis) if axis in names else 0,
        )
        for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
            signal.signal(number, lambda *_: os.kill(screen.pid, signal.SIGTERM))
        signal.signal(signal.SIGTSTP, signal.SIG_IGN)
        screen.wait()
        if ring.closed:
            print("pneud: the daemon has ended", file=sys.stderr)
        return 0


def _axes(socket: str | None, axis: str | None) -> list[str | None]:
    """The axes of the daemon, where there are several; one that is not there is left to the daemon to say.

    Raises:
        RefusedError: the daemon does not say.
    """
    with Client(socket) as client:
        names = list(client.ask("status").get("axes") or ())
    return names if names and (axis is None or axis in names) else [axis]


def _seen(client: Client, connect: Callable[[], Client], read_only: bool) -> Seen:
    """An axis of the daemon.

    Raises:
        RefusedError: it cannot be looked at.
        PlaceError: it is of another version.
    """
    if read_only:
        client.ask("observe")
    fields, ring = attached(client)
    return Seen(ring, info_of(fields, first_cause), Operator(connect, client, read_only))
