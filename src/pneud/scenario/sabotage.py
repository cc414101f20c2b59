"""What a scenario does to the machine: a process beside the loop stops, kills and starves the others.

The plant's process tells it which fault begins. Whatever it does it undoes, at the end of the fault or of the
run.
"""

from __future__ import annotations

import os
import resource
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from pneud import crew
from pneud.console.client import Client, RefusedError
from pneud.console.endpoint import PlaceError
from pneud.rt import setup
from pneud.scenario.format import (
    ClockStep,
    Descriptors,
    Hog,
    InterfaceFault,
    Kill,
    LogFull,
    Operator,
    Overload,
    Scenario,
    StopProcess,
)

_NO_DELAY_S = 60.0


class Victims(NamedTuple):
    """Who there is to suffer."""

    daemon: int  # process ids
    recorder: int
    plant: int
    keeper: int  # of the console
    socket: str  # of the console
    interface: str  # "" without one

    def pid(self, who: str) -> int:
        """The process id of a victim by its name in a scenario."""
        if who != "console":
            return int(getattr(self, who))
        found = Path(f"/proc/{self.keeper}/task/{self.keeper}/children").read_text().split()
        if not found:  # the next one has not been started yet
            raise ProcessLookupError
        return int(found[0])


Undo = Callable[[], None]


def fork_saboteur(scenario: Scenario, orders: int, victims: Victims) -> int:
    """Start the process; it leaves when it is told to, or its parent dies.

    Numbers of faults come through `orders`, one byte each.

    Returns:
        Its process id.
    """

    def main() -> None:
        stopped = crew.asked_to_leave(signal.SIGTERM)
        undone: list[tuple[float, Undo]] = []
        try:
            while not stopped():
                now = time.monotonic()
                for due in [item for item in undone if item[0] <= now]:
                    undone.remove(due)
                    _attempt(due[1])
                if not select.select([orders], (), (), 0.01)[0]:
                    continue
                numbers = os.read(orders, 64)
                if not numbers:
                    break
                for number in numbers:
                    fault = scenario.fault[number]
                    undo = _attempt(lambda fault=fault: act(fault, victims))  # type: ignore[misc]
                    if undo is not None:
                        undone.append((time.monotonic() + (fault.for_s or _NO_DELAY_S), undo))
        finally:
            for _, undo in undone:
                _attempt(undo)

    return crew.fork(main, keep=(orders,), orphaned=signal.SIGTERM, name="saboteur")


def act(fault: Any, victims: Victims) -> Undo | None:
    """Do what a fault says.

    Returns:
        What undoes it, if anything can.

    Raises:
        OSError: the machine does not let us.
        PlaceError: there is no console to ask.
        RefusedError: the axis says no.
    """
    if isinstance(fault, StopProcess):
        pid = victims.pid(fault.who)
        os.kill(pid, signal.SIGSTOP)
        return lambda: os.kill(pid, signal.SIGCONT)
    if isinstance(fault, Overload):
        return _overload(victims.daemon, fault.stand_s, fault.run_s)
    if isinstance(fault, Kill):
        os.kill(victims.pid(fault.who), signal.SIGKILL)
    elif isinstance(fault, Operator):
        with Client(victims.socket) as client:
            client.ask(fault.verb, **_fields_of(fault))
    elif isinstance(fault, Hog):
        return _hog(fault.processes)
    elif isinstance(fault, ClockStep):
        _step_clock(fault.step_s)
        return lambda: _step_clock(-fault.step_s)
    elif isinstance(fault, LogFull):
        return _limit(victims.recorder, resource.RLIMIT_FSIZE)
    elif isinstance(fault, Descriptors):
        return _limit(victims.pid(fault.who), resource.RLIMIT_NOFILE)
    elif isinstance(fault, InterfaceFault):
        return _interface(fault.kind, victims.interface)
    return None


def _fields_of(fault: Operator) -> dict[str, Any]:
    if fault.verb == "track":
        return {"what": "reference"}
    return {} if fault.force_n is None else {"force_n": fault.force_n}


def _attempt(action: Callable[[], Undo | None]) -> Undo | None:
    try:
        return action()
    except ProcessLookupError:
        return None
    except OSError as e:
        print(f"pneud: scenario: {e.strerror or e}", file=sys.stderr, flush=True)
    except (PlaceError, RefusedError) as e:
        print(f"pneud: scenario: {e}", file=sys.stderr, flush=True)
    except subprocess.CalledProcessError as e:
        print(f"pneud: scenario: {' '.join(e.cmd)}: {e.stderr.strip()}", file=sys.stderr, flush=True)
    return None


def _overload(pid: int, stand_s: float, run_s: float) -> Undo:
    def main() -> None:
        setup.apply(98, None, False)  # to be on time
        while True:
            os.kill(pid, signal.SIGSTOP)
            time.sleep(stand_s)
            os.kill(pid, signal.SIGCONT)
            time.sleep(run_s)

    tormentor = crew.fork(main)

    def undo() -> None:
        crew.kill(tormentor)
        os.kill(pid, signal.SIGCONT)

    return undo


def _hog(processes: int) -> Undo:
    def main() -> None:
        while True:
            pass

    hogs = [crew.fork(main) for _ in range(processes)]

    def undo() -> None:
        for pid in hogs:
            crew.kill(pid)

    return undo


def _step_clock(step_s: float) -> None:
    time.clock_settime(time.CLOCK_REALTIME, time.clock_gettime(time.CLOCK_REALTIME) + step_s)


def _limit(pid: int, which: int) -> Undo:
    soft, hard = resource.prlimit(pid, which)
    resource.prlimit(pid, which, (0, hard))

    def undo() -> None:
        resource.prlimit(pid, which, (soft, hard))

    return undo


def _interface(kind: str, name: str) -> Undo:
    link = ("ip", "link")
    if kind == "link_down":
        _run(*link, "set", name, "down")
        return lambda: _run(*link, "set", name, "up")
    if kind == "link_deleted":
        _run(*link, "delete", name)

        def make() -> None:
            _run(*link, "add", name, "type", "vcan")
            _run(*link, "set", name, "up")

        return make
    # what may leave in an hour fits into no frame
    _run("tc", "qdisc", "add", "dev", name, "root", "tbf", "rate", "8bit", "burst", "8", "limit", "8")
    return lambda: _run("tc", "qdisc", "delete", "dev", name, "root")


def _run(*command: str) -> None:
    subprocess.run(command, check=True, capture_output=True, text=True)
