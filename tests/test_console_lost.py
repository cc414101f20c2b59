"""A running daemon whose console dies or stands still while an operator has engaged the axis."""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

import pytest

from commands import children, eventually, object_of, pneud, pneud_here
from pneud.console.client import Client
from pneud.log.files.reader import read_log
from pneud.safety.faults import F
from pneud.safety.supervisor import is_engaged
from pneud.signals import Answer, RequestKind, State
from running import Running, patient_axis, running

REST_S = 1.0
ACTIVITIES = ("tracking", "jogging", "moving", "homing")
QUICK = {("tracking", signal.SIGSTOP)}


def begin(client: Client, activity: str) -> None:
    """Arm, and let the axis do something."""
    if activity == "homing":
        client.ask("home")
        return
    client.ask("arm")
    if activity == "tracking":
        client.ask("track", what="reference")
    elif activity == "jogging":
        client.ask("jog", velocity_mm_s=40.0, lease_s=1.0)
    elif activity == "moving":
        client.ask("goto", x_mm=client.ask("status")["position_mm"] + 200.0, speed_mm_s=50.0)


def lost(run: Running, number: int) -> float:
    """Take the console away; when that was [s]."""
    (console,) = children(children(run.process.pid)[1])
    os.kill(console, number)
    return time.monotonic()


def end(run: Running) -> None:
    """Stop it in order; what it has heard on its busy bus is another test's subject."""
    run.process.send_signal(signal.SIGTERM)
    _, err = run.process.communicate(timeout=60)
    assert run.process.returncode in (0, 1), err
    assert "Traceback" not in err, err


@pytest.mark.parametrize(
    ("activity", "number"),
    [
        pytest.param(a, n, marks=[] if (a, n) in QUICK else [pytest.mark.slow])
        for a in ACTIVITIES
        for n in (signal.SIGKILL, signal.SIGSTOP)
    ],
)
def test_it_comes_to_rest_and_is_operated_again(tmp_path: Path, activity: str, number: int) -> None:
    with running(tmp_path, incremental=activity == "homing") as run:
        with Client(run.socket) as client:
            begin(client, activity)
            time.sleep(0.4)
            assert client.ask("status")["state"] == ("moving" if activity == "jogging" else activity)
            at_s = lost(run, number)
        if number == signal.SIGKILL:  # whoever calls now is served by the next console
            done = pneud_here("stop", "--socket", run.socket)
            assert done.returncode == 0 or "not while the axis is in fault" in done.stderr, done.stderr
        eventually(lambda: run.status() == ("fault", ["console_lost"]))
        shown = pneud_here("status", "--socket", run.socket)
        assert "fault console_lost (latched; controlled stop): none but to clear and arm" in shown.stdout
        with Client(run.socket) as client:
            assert client.ask("clear")["state"] == "disarmed"
            eventually(run.ready)
            if activity == "homing":
                assert client.ask("home")["state"] == "homing"
            else:
                assert client.ask("arm")["state"] == "holding"
        end(run)
    ticks = list(read_log(run.log))
    first = next(t for t in ticks if t.latched)
    rest = next(t for t in ticks if t.state == State.FAULT)
    assert first.latched == rest.latched == 1 << F.CONSOLE_LOST
    assert rest.t_ns * 1e-9 - at_s < REST_S
    told = [event.message for event in read_log(run.log).events() if event.name == "console"]
    assert any("what an operator had engaged comes to rest" in words for words in told)
    assert "the console was started again" in told
    again = object_of(pneud("replay", run.log, "--json"))
    assert again["identical"] is True, again


SLOW_FILES = """
import time
from pneud.console.tuning import Tuning
Tuning.read = lambda _: time.sleep(60.0)
from pneud.cli import main
main()
"""


@pytest.mark.slow
def test_a_console_whose_disk_stalls_lives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What an operator has engaged goes on while a file does not come, and can be stopped."""
    monkeypatch.setattr("running.PNEUD", [sys.executable, "-c", SLOW_FILES])
    with running(tmp_path) as run:
        with Client(run.socket) as client:
            begin(client, "tracking")
            run.process.send_signal(signal.SIGHUP)
            reload = pneud_here("tune", "reload", "--socket", run.socket)
            assert "cannot be read within 3 s" in reload.stderr
            for _ in range(5):
                status = client.ask("status")
                assert (status["state"], status["faults"]) == ("tracking", [])
            client.ask("disarm")
        eventually(lambda: run.status() == ("disarmed", []))
        end(run)
    assert not any(tick.present & 1 << F.CONSOLE_LOST for tick in read_log(run.log))


@pytest.mark.slow
def test_a_disarmed_axis_stays_as_it_is(tmp_path: Path) -> None:
    with running(tmp_path) as run:
        lost(run, signal.SIGKILL)
        assert run.status() == ("disarmed", []), "answered by the next one"
        end(run)
    assert not any(tick.present & 1 << F.CONSOLE_LOST for tick in read_log(run.log))


@pytest.mark.slow
def test_an_axis_that_armed_itself_goes_on_until_an_operator_steers_it(tmp_path: Path) -> None:
    from commands import background  # noqa: PLC0415
    from running import patient_axis, serves  # noqa: PLC0415

    log, socket = tmp_path / "run.mcap", f"/tmp/pneud-lost-{os.getpid()}.sock"
    arguments = ("--virtual", "--config", patient_axis(tmp_path), "--headless", "--json")
    with background(*arguments, "--socket", socket, "--log", log) as daemon:
        eventually(lambda: serves(socket))

        def state() -> str:
            with Client(socket) as client:
                return str(client.ask("status")["state"])

        eventually(lambda: state() == "tracking")
        for expected in ("tracking", "fault"):
            if expected == "fault":
                with Client(socket) as client:
                    client.ask("hold")
            (console,) = children(children(daemon.pid)[1])
            os.kill(console, signal.SIGKILL)
            assert state() == expected
        daemon.send_signal(signal.SIGTERM)
        assert "Traceback" not in daemon.communicate(timeout=60)[1]
    asked = [t for t in read_log(log) if t.request is not None and t.answer == Answer.TAKEN]
    kinds = [t.request.kind for t in asked if t.request is not None]
    assert kinds == [RequestKind.ARM, RequestKind.HOLD, RequestKind.SHUTDOWN]
    assert not any(is_engaged(t.state) for t in asked[2:])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["console-killed", "console-stands"])
def test_a_scenario_takes_the_console_away(name: str, tmp_path: Path) -> None:
    words = ("--virtual", "--scenario", name, "--headless", "--json", "--duration", 5, "--log", tmp_path)
    done = pneud(*words, "--config", patient_axis(tmp_path))
    assert object_of(done)["scenario"]["met"], done.stderr
    assert done.returncode == 1, "a fault is latched"
