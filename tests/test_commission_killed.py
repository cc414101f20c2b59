"""A client of a daemon that is killed, or ended by Ctrl-C, in the middle of a commissioning's step."""

from __future__ import annotations

import os
import signal
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

import pytest

from commands import become, eventually
from pneud.axis.state import AxisParameters
from pneud.config.proof import digest, keep, place
from pneud.console.client import Client
from pneud.loading import load
from pneud.signals import State
from pneud.study.commissioning import procedure, steps
from pneud.study.commissioning.steps import Step, dynamic, static
from running import Running, running

pytestmark = pytest.mark.slow
STEPS = {
    "movement test": State.PROBING,
    "edges": State.PROBING,
    "moves": State.MOVING,
    "sine": State.TRACKING,
    "verification": State.TRACKING,
}
INTERRUPTED = 130
AT_ONCE_S = 2.0  # a lease and a half of a probe, or a stop from the speed of these steps, on a busy machine


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    with running(tmp_path_factory.mktemp("killed"), log_name="logs") as run:
        yield run


def state(run: Running) -> State:
    return State[run.status()[0].upper()]


def rests(run: Running) -> None:
    """Have the axis disarmed."""
    if state(run) != State.DISARMED:
        with Client(run.socket) as client:
            client.ask("clear" if state(run) == State.FAULT else "disarm")
    eventually(run.ready)


def kept(file: Path) -> list[bytes]:
    return [file.read_bytes(), place(file).read_bytes()]


class Commissioning:
    """The command in a fork of this process, which has nothing to load; it plays one step."""

    def __init__(self, run: Running, name: str) -> None:
        self._run, self._state = run, STEPS[name]
        self._said = tempfile.TemporaryFile("w+")  # noqa: SIM115 - as long as the command
        self.pid = os.fork()
        if not self.pid:
            self._commission(name)
        try:
            eventually(self._under_way)
        except AssertionError:
            self.ended_by(signal.SIGKILL)
            raise AssertionError((self._run.status(), self.said())) from None

    def _commission(self, name: str) -> NoReturn:
        def one_step() -> None:
            procedure._steps = lambda p, wishes: steps_of(p, name)
            procedure._learnt_edges = lambda *_: False
            steps.first = lambda p: []

        words = ["commission", "--yes", "--json", "--socket", self._run.socket]
        become(words, self._said.fileno(), self._said.fileno(), one_step)

    def _under_way(self) -> bool:
        if state(self._run) != self._state:
            return False
        time.sleep(0.2)
        return state(self._run) == self._state

    def ended_by(self, how: signal.Signals) -> int:
        """Its exit status, or less than 0."""
        os.kill(self.pid, how)
        return os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])

    def said(self) -> str:
        """On both streams."""
        self._said.seek(0)
        return self._said.read()


def steps_of(p: AxisParameters, name: str) -> list[Step]:
    """The first of that name; of the edges, where the valve is opened."""
    if name == "edges":
        edges = static(p)[1]
        return [edges._replace(acts=tuple(act for act in edges.acts if act.lease))]
    return [step for step in static(p) + dynamic(p) if step.name == name][:1]


@pytest.mark.parametrize(
    ("how", "name"),
    [*((how, name) for how in (signal.SIGKILL, signal.SIGINT) for name in STEPS), (signal.SIGHUP, "sine")],
)
def test_whoever_commissions_is_ended_and_the_axis_rests_and_goes_again(
    daemon: Running, how: signal.Signals, name: str
) -> None:
    rests(daemon)
    file = file_of(daemon)
    loaded = load(file)
    proven = digest(loaded.config, loaded.dbc.read_bytes()) if name != "movement test" else "of another rig"
    keep(file, proven, {"passed": True})
    before = kept(file)
    run = Commissioning(daemon, name)
    assert run.ended_by(how) == (-how if how == signal.SIGKILL else INTERRUPTED), run.said()
    ended_s = time.monotonic()
    assert "Traceback" not in run.said()
    eventually(lambda: state(daemon) in (State.HOLDING, State.DISARMED))
    assert time.monotonic() - ended_s < AT_ONCE_S
    probing = STEPS[name] == State.PROBING
    assert state(daemon) == (State.DISARMED if probing else State.HOLDING)
    assert daemon.status()[1] == []
    assert kept(file) == before
    rests(daemon)
    assert Commissioning(daemon, name).ended_by(signal.SIGINT) == INTERRUPTED
    rests(daemon)
    assert kept(file) == before


def file_of(run: Running) -> Path:
    with Client(run.socket) as client:
        return Path(client.ask("status")["config"])
