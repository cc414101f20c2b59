"""The processes around the loop: the software plant and the screen, forked; and how they end."""

from __future__ import annotations

import json
import mmap
import os
import signal
import socket
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, NoReturn

from pneud.bus.codec import Codecs
from pneud.bus.link import Link, LinkError, open_link
from pneud.bus.wire import Carriage
from pneud.config.models import Config
from pneud.console.facts import Run
from pneud.log.format.header import LogHeader
from pneud.log.live.recorder import leave_the_parents_files
from pneud.log.live.ring import Ring
from pneud.physics.plant import PlantParameters
from pneud.rig.answering import serve
from pneud.rig.node import Advance, PlantNode
from pneud.rig.truth import TruthWriter
from pneud.rt import setup
from pneud.safety.faults import FAULT_CURES, FAULT_NAMES

if TYPE_CHECKING:
    from pneud.scenario.engine import Engine
    from pneud.scenario.format import Scenario


def fork(main: Callable[[], None]) -> int:
    """Run `main` in a child process that ends with it.

    Returns:
        The child's process id.
    """
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:  # as it is where the descriptor is closed
            stream.flush()
    child = os.fork()
    if not child:
        _in_child(main)
    return child


def _in_child(main: Callable[[], None]) -> NoReturn:
    status = 1
    try:
        main()
        status = 0
    except LinkError as e:
        print(f"pneud: {e}", file=sys.stderr)
    except Exception:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(status)


class Stage(NamedTuple):
    """A scenario, and the pipes between its process and the others."""

    scenario: Scenario
    rate_hz: float  # of the controller
    report: int  # to write what plant and bus have shown
    orders: int  # to write numbers of faults of the machine

    def engine(self, p: PlantParameters, codecs: Codecs, seed: int, advance: Advance) -> Engine:
        """Plays the scenario on a plant."""
        from pneud.scenario.engine import Engine  # noqa: PLC0415

        def order(number: int) -> None:
            os.write(self.orders, bytes((number,)))

        return Engine(self.scenario, p, codecs, seed, self.rate_hz, order, advance)


def fork_plant(
    channel: str,
    inherited: Link,
    p: PlantParameters,
    codecs: Codecs,
    seed: int,
    truth: mmap.mmap,
    priority: int,
    advance: Advance,
    by: Carriage,
    stage: Stage | None = None,
) -> int:
    """The software plant on the same bus.

    Args:
        channel: the bus, not "auto".
        inherited: the parent's link, closed in the child.
        p: the plant.
        codecs: of the frames.
        seed: of the sensors' noise.
        truth: shared memory for the true positions.
        priority: real-time priority to try for, since frames that come late are not what a real bus does.
        advance: what integrates the plant.
        by: how frames are taken from the bus and given to it.
        stage: a scenario to play.
    """
    parent = os.getpid()

    def main() -> None:
        stopped = False

        def stop(*_: object) -> None:
            nonlocal stopped
            stopped = True

        setup.ignore_terminal_signals()
        signal.signal(signal.SIGTERM, stop)
        setup.die_with_parent(parent)
        inherited.close()
        with open_link(channel, virtual=True, by=by) as link:
            engine = stage.engine(p, codecs, seed, advance) if stage is not None else None
            node = engine.node if engine is not None else PlantNode(p, codecs, seed, advance=advance)
            setup.apply(priority, None, False)
            serve(link, node, stop=lambda: stopped, truth=TruthWriter(truth))
        if stage is not None and engine is not None:
            engine.settle()
            os.write(stage.report, json.dumps(engine.effects.as_dict()).encode())

    return fork(main)


def fork_console(
    listener: socket.socket, loop: socket.socket, words: socket.socket, run: Run, ring: Ring
) -> int:
    """The operator's console; the sockets are the child's from here on."""
    parent = os.getpid()

    def main() -> None:
        # a Ctrl-C reaches the whole group; the console leaves with the loop
        setup.ignore_terminal_signals()
        # the protocol is loaded here, beside the loop's own start; who calls meanwhile is queued
        from pneud.console.worker import serve as serve_console  # noqa: PLC0415

        leave_the_parents_files(*(listener.fileno(), loop.fileno(), words.fileno()), ring.descriptor)
        serve_console(listener, loop, words, run, ring, parent)

    child = fork(main)
    for end in (listener, loop, words):
        end.close()
    return child


def fork_screen(ring: Ring, inherited: Link, config: Config, log_file: Path) -> int:
    """The live screen on this terminal."""
    parent = os.getpid()
    bus, note = inherited.name, inherited.note

    def main() -> None:
        inherited.close()
        # rich is loaded here, beside the loop's own start
        from pneud.view import ScreenInfo, run_child  # noqa: PLC0415

        info = ScreenInfo(
            name=config.name,
            bus=bus,
            rate_hz=config.loop.rate_hz,
            travel_min_m=config.limits.travel_min_m,
            travel_max_m=config.limits.travel_max_m,
            u_max_v=config.valve.u_max_v,
            note=note,
            fault_names=FAULT_NAMES,
            cures=FAULT_CURES,
            log_path=str(log_file),
            sync=config.bus.sync,
        )
        reader = ring.reader()

        def log_counts() -> tuple[int, int]:
            status = ring.status()
            return status.written, status.lost

        run_child(reader.poll, info, lambda: ring.closed, parent, log_counts=log_counts)

    return fork(main)


def fork_live(ring: Ring, inherited: Link, header: LogHeader, config: Config, host: str, port: int) -> int:
    """The server for viewers."""
    parent = os.getpid()

    def main() -> None:
        inherited.close()
        from pneud.view import viewers  # noqa: PLC0415

        parameters = config.model_dump(mode="json", by_alias=True)
        viewers.serve(ring.reader().poll, header, parameters, host, port, lambda: ring.closed, parent)

    return fork(main)


def end_screen(pid: int) -> None:
    """Tell the screen to leave, and leave the terminal clean whatever it does."""
    if not end(pid, 3.0):
        from pneud.view import LEAVE_SCREEN  # noqa: PLC0415

        sys.stdout.write(LEAVE_SCREEN)
        sys.stdout.flush()


def end(pid: int, patience_s: float) -> bool:
    """Ask a child to leave; kill it when it does not.

    Returns:
        Whether it left by itself.
    """
    try:
        os.kill(pid, signal.SIGTERM)
    except ProcessLookupError:
        return True
    if wait(pid, patience_s):
        return True
    os.kill(pid, signal.SIGKILL)
    wait(pid, patience_s)
    return False


def wait(pid: int, patience_s: float) -> bool:
    """Wait for a child to end.

    Returns:
        Whether it has.
    """
    deadline = time.monotonic() + patience_s
    while True:
        try:
            if os.waitpid(pid, os.WNOHANG)[0]:
                return True
        except ChildProcessError:
            return True
        if time.monotonic() > deadline:
            return False
        time.sleep(0.005)
