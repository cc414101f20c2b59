"""The console's process: serves until the loop is gone, and says again and again that it lives."""

import signal
import socket
import sys
import time
from typing import TYPE_CHECKING, NamedTuple

from pneud import crew
from pneud.console import handoff
from pneud.console.facts import RunFacts
from pneud.console.memory import Memory
from pneud.log.live.notes import Teller
from pneud.log.live.ring import Ring

if TYPE_CHECKING:
    from pneud.console.protocol import ProtocolError

_STEP_S = 0.1  # a fraction of the silence that `loop.console_watch` bears; the ring keeps some seconds
_NUMBERS = 1 << 24  # requests that one console may number before it comes to the next one's


class Seat:
    """What the console has of one axis.

    Attributes:
        words: the teller's end to the recorder.
        run: what runs.
        ring: where its records are.
        memory: what the console before has left.
        counts: what it has counted for `status`, and until where.
        teller: speaks through `words`.
    """

    def __init__(self, words: socket.socket, run: RunFacts, ring: Ring) -> None:
        self.words, self.run, self.ring = words, run, ring
        self.memory = Memory()
        self.counts = Memory()
        self.teller = Teller(words, "console")


class Post(NamedTuple):
    """What every console of a run works with, one after the other."""

    listener: socket.socket  # bound and listening
    loop: socket.socket  # the console's end of the hand-off
    name: str  # of the daemon
    seats: tuple[Seat, ...]  # one for each axis

    @property
    def descriptors(self) -> tuple[int, ...]:
        """Those that a console needs."""
        own = [end for seat in self.seats for end in (seat.words.fileno(), seat.ring.descriptor)]
        return self.listener.fileno(), self.loop.fileno(), *own

    @property
    def ring(self) -> Ring:
        """Of the first axis: all begin and end together."""
        return self.seats[0].ring

    def set_console_gone(self) -> None:
        """Say that the console does not live any longer."""
        for seat in self.seats:
            seat.ring.set_console_gone()

    def say(self, level: int, words: str) -> None:
        """Say something in the log of each axis."""
        for seat in self.seats:
            seat.teller.say(level, words)


def load() -> None:
    """Load what a console needs and the loop does not."""
    from pneud.console import commands, protocol, server, status_reply  # noqa: F401, PLC0415


def serve(post: Post, daemon: int, keeper: int, place: int) -> None:
    """Serve until the ring is closed or the loop is gone; SIGHUP takes gains and reference of the file."""
    reload = False

    def hang_up(*_: object) -> None:
        nonlocal reload
        reload = True

    signal.signal(signal.SIGHUP, hang_up)
    crew.die_with_parent(keeper)
    # the keeper has loaded them, beside the loop's own start
    from pneud.console import protocol  # noqa: PLC0415
    from pneud.console.commands import AxisDesk  # noqa: PLC0415
    from pneud.console.processes import Processes  # noqa: PLC0415
    from pneud.console.server import Server  # noqa: PLC0415
    from pneud.console.status_reply import StatusWatch  # noqa: PLC0415

    def refused(error: "ProtocolError") -> None:
        print(f"pneud: {error}", file=sys.stderr, flush=True)

    seats, ring = post.seats, post.ring
    watches = [StatusWatch(seat.ring, bool(seat.run.config.bus.sync), seat.counts) for seat in seats]
    processes = Processes(daemon, lambda: [seat.ring.status().pid for seat in seats])
    desks = [
        AxisDesk(seat.run, seat.ring, watch, seat.memory, processes if seat is seats[0] else None)
        for seat, watch in zip(seats, watches, strict=True)
    ]
    first = place * _NUMBERS
    server = Server(
        *(post.listener, post.loop, desks, post.say),
        first=first,
        name=post.name,
        place=ring.consoles_gone,
    )
    if place:
        _pass_over(post.loop)
    while not (ring.closed or server.over):
        for seat, watch in zip(seats, watches, strict=True):
            seat.ring.set_console(time.monotonic_ns())
            watch.poll()
        if reload:
            reload = False
            for desk in desks:
                server.ask(
                    protocol.TuneReload(v=1, id=0, axis=desk.name, verb="tune_reload"), "SIGHUP", refused
                )
        server.step(_STEP_S)
    server.close()


def _pass_over(loop: socket.socket) -> None:
    """Leave answers to what another console has asked."""
    try:
        while handoff.receive(loop) is not None:
            pass
    except EOFError:
        return  # the server finds it, too
