"""A daemon that begins anew, and an axis that is armed though no movement test was passed."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from axis_rig import ready
from commands import eventually, pneud_here
from pneud.config.proof import digest, keep
from pneud.console.client import Client, RefusedError
from pneud.console.endpoint import PlaceError
from pneud.loading import load
from pneud.log.files.reader import read_log
from pneud.signals import Answer, RequestKind, State
from running import running

RESTART = RequestKind.RESTART


def test_an_axis_at_rest_is_over_and_takes_nothing_more() -> None:
    rig = ready()
    assert rig.tick(RESTART).answer == Answer.TAKEN
    assert rig.tick(RequestKind.ARM).answer == Answer.CLOSING
    assert {tick.state for tick in rig.ticks(20)} == {State.DISARMED}


def test_an_engaged_axis_goes_on() -> None:
    rig = ready()
    rig.tick(RequestKind.ARM)
    assert rig.tick(RESTART).answer == Answer.WRONG_STATE
    assert rig.tick().state == State.HOLDING
    rig.tick(RequestKind.DISARM)
    rig.until(State.DISARMED)
    assert rig.tick(RequestKind.ARM).state == State.HOLDING


def test_words_behind_it_are_malformed() -> None:
    assert ready().tick(RESTART, 1.0).answer == Answer.MALFORMED


@pytest.mark.slow
def test_a_daemon_begins_anew_with_what_its_file_says(tmp_path: Path) -> None:
    with running(tmp_path, log_name="logs") as run:
        file = tmp_path / "patient.toml"
        text = file.read_text()

        def told(*words: str) -> tuple[int, str]:
            done = pneud_here(*words, "--socket", run.socket)
            return done.returncode, done.stdout + done.stderr

        assert told("arm")[0] == 0
        assert told("restart") == (1, "pneud: virtual: restart: not while the axis is holding\n")
        assert told("disarm")[0] == 0
        eventually(run.ready)
        file.write_text(text.replace("moving_mass_kg = 15.0", "moving_mass_kg = -15.0"))
        status, words = told("restart")
        assert (status, words.count("\n")) == (1, 1)
        assert "moving_mass_kg" in words
        assert run.ready(), "and goes on"
        file.write_text(text.replace("moving_mass_kg = 15.0", "moving_mass_kg = 14.0"))
        with Client(run.socket) as client:
            before = client.ask("status")
        assert before["config_changed"]
        status, words = told("restart", "--json")
        assert status == 0, words
        assert run.process.poll() is None, "the same process"
        eventually(run.ready)
        with Client(run.socket) as client:
            after = client.ask("status")
        assert not after["config_changed"]
        assert after["log"] == json.loads(words)["log"] != before["log"]
        assert told("arm")[0] == 0
        assert told("disarm")[0] == 0
        eventually(run.ready)
        run.process.terminate()
        said, complaints = run.process.communicate(timeout=20)
    assert [json.loads(line)["log"] for line in said.splitlines()] == [before["log"], after["log"]]
    assert run.process.returncode == 0, complaints
    for log in (before["log"], after["log"]):
        assert pneud_here("replay", log).returncode == 0
        assert len(list(read_log(Path(log)))) > 0


@pytest.mark.slow
def test_scheduling_of_the_run_before_is_given_back(tmp_path: Path) -> None:
    with running(tmp_path, log_name="logs") as run:
        first = children(run.process.pid)
        assert pneud_here("restart", "--socket", run.socket).returncode == 0
        assert not first & children(run.process.pid)
        found = {os.sched_getscheduler(pid) for pid in children(run.process.pid)}
        assert found
        assert os.SCHED_FIFO not in found


def children(pid: int) -> set[int]:
    return {int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()}


@pytest.mark.slow
def test_a_log_that_is_named_is_not_written_again(tmp_path: Path) -> None:
    with running(tmp_path) as run, Client(run.socket) as client:
        with pytest.raises(RefusedError, match=r"run\.mcap is this run's log; give --log a folder"):
            client.ask("restart")
        assert client.ask("status")["state"] == "disarmed"


@pytest.mark.slow
def test_an_axis_that_failed_its_test_is_armed_for_this_run_by_whoever_insists(tmp_path: Path) -> None:
    with running(tmp_path, log_name="logs") as run:
        axis = load(tmp_path / "patient.toml")
        keep(axis.path, digest(axis.config, axis.dbc.read_bytes()), {"passed": False})
        with Client(run.socket) as client:
            client.ask("restart")
        eventually(lambda: "unproven" in faults(run.socket))
        eventually(lambda: faults(run.socket) == {"unproven"})
        with Client(run.socket) as operator:
            with pytest.raises(RefusedError, match="unproven: pneud commission"):
                operator.ask("arm")
            assert operator.ask("arm", unproven=True)["state"] == "holding"
            assert operator.ask("disarm")
        eventually(lambda: run.status()[0] == "disarmed")
        assert "unproven" not in faults(run.socket)
        with Client(run.socket) as other:
            assert other.ask("arm")["state"] == "holding", "for the rest of this run"
            other.ask("disarm")
            log = Path(other.ask("status")["log"])
        eventually(lambda: run.status()[0] == "disarmed")
        run.process.terminate()
        run.process.communicate(timeout=20)
    asked = [t.request for t in read_log(log) if t.request is not None and t.request.kind == RequestKind.ARM]
    assert [request.values for request in asked] == [(), (2.0,), ()]
    assert pneud_here("replay", log).returncode == 0


def faults(socket: str) -> set[str]:
    """Of the daemon; between two runs nobody answers."""
    try:
        with Client(socket) as client:
            return {fault["name"] for fault in client.ask("status")["faults"]}
    except PlaceError:
        return set()
