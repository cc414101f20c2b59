"""A client of a daemon that is killed, or ended by Ctrl-C, in the middle of a commissioning's step."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from commands import eventually
from pneud.config.proof import digest, keep, place
from pneud.console.client import Client
from pneud.loading import load
from pneud.signals import State
from running import Running, running

pytestmark = [pytest.mark.slow, pytest.mark.realtime]
STEP = """
import sys
from pneud.cli import main
from pneud.study.commissioning import procedure, steps
procedure._steps = lambda p, wishes: [s for s in steps.static(p) + steps.dynamic(p) if s.name == {name!r}][:1]
main()
"""
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


def kept(file: Path) -> list[bytes]:
    return [file.read_bytes(), place(file).read_bytes()]


def commissioning(run: Running, name: str) -> subprocess.Popen[str]:
    """The command, when it is in a step."""
    words = ["commission", "--yes", "--json", "--socket", run.socket]
    process = subprocess.Popen(
        [sys.executable, "-c", STEP.format(name=name), *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )

    def under_way() -> bool:
        assert process.poll() is None, process.communicate()
        if state(run) != STEPS[name]:
            return False
        time.sleep(0.2)
        return state(run) == STEPS[name]

    eventually(under_way)
    return process


@pytest.mark.parametrize("name", STEPS)
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT], ids=lambda how: how.name)
def test_whoever_commissions_is_ended_and_the_axis_rests_and_goes_again(
    daemon: Running, name: str, how: signal.Signals
) -> None:
    file = file_of(daemon)
    loaded = load(file)
    proven = digest(loaded.config, loaded.dbc.read_bytes()) if name != "movement test" else "of another rig"
    keep(file, proven, {"passed": True})
    before = kept(file)
    process = commissioning(daemon, name)
    process.send_signal(how)
    _, err = process.communicate(timeout=20)
    ended_s = time.monotonic()
    assert process.returncode == (INTERRUPTED if how == signal.SIGINT else -how), err
    assert "Traceback" not in err
    eventually(lambda: state(daemon) in (State.HOLDING, State.DISARMED))
    assert time.monotonic() - ended_s < AT_ONCE_S
    probing = STEPS[name] == State.PROBING
    assert state(daemon) == (State.DISARMED if probing else State.HOLDING)
    assert daemon.status()[1] == []
    assert kept(file) == before
    with Client(daemon.socket) as client:
        client.ask("disarm")
    eventually(daemon.ready)
    again = commissioning(daemon, name)
    again.send_signal(signal.SIGINT)
    again.communicate(timeout=20)
    with Client(daemon.socket) as client:
        client.ask("disarm")
    eventually(daemon.ready)
    assert kept(file) == before


def file_of(run: Running) -> Path:
    with Client(run.socket) as client:
        return Path(client.ask("status")["config"])
