"""The whole chain as its user runs it: processes, virtual bus, log, replay, and what is killed on the way."""

from __future__ import annotations

import itertools
import json
import math
import os
import secrets
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import can
import pytest

from commands import background, children, eventually, kill, object_of, pneud, pneud_here
from pneud.bus.link import open_link
from pneud.log.files.naming import open_log
from pneud.log.files.reader import read_log
from pneud.signals import Frame, State, ValveState
from running import patient_axis

pytestmark = [pytest.mark.slow, pytest.mark.realtime]
COMMAND, SYNC, ENCODER, PRESSURE, STATUS = 0x203, 0x080, 0x181, 0x182, 0x183


@pytest.fixture
def bus() -> str:
    """The name of a virtual bus that nobody else uses."""
    return f"unixcan:test-{os.getpid()}-{secrets.token_hex(3)}"


TIMEOUT_MS = 250


@pytest.fixture
def axis(tmp_path: Path) -> Path:
    """The virtual axis with time-outs that a stall of a shared machine does not reach."""
    file = patient_axis(tmp_path)
    assert file.read_text().count(f"_timeout_ms = {TIMEOUT_MS}.0") == 3
    return file


class Ran(NamedTuple):
    """A run that nothing has happened to."""

    log: Path
    summary: dict[str, Any]


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> Ran:
    folder = tmp_path_factory.mktemp("ran")
    log, axis = folder / "run.mcap", patient_axis(folder)
    done = pneud("--virtual", "--config", axis, "--duration", 5, "--headless", "--json", "--log", log)
    assert done.returncode == 0, done.stderr
    return Ran(log, object_of(done))


def test_a_virtual_run_tracks_and_replays_to_the_bit(ran: Ran) -> None:
    log, s = ran
    assert s["state"] == "tracking"
    assert s["ticks"] + s["skipped"] == 5000
    assert s["frames"]["lost"] == s["frames"]["crc"] == s["frames"]["stale"] == 0
    assert s["log_dropped"] == 0
    assert s["faults"] == []
    assert s["tracking_mm"]["against"] == "plant"
    assert s["tracking_mm"]["rms"] <= 0.5
    assert s["lateness_us"]["p50"] <= s["lateness_us"]["p99"] <= s["lateness_us"]["max"]
    assert Path(s["log"]) == log

    again = object_of(pneud_here("replay", log, "--json"))
    assert again["identical"] is True
    assert again["mismatches"] == 0
    assert again["commands"] == again["ticks"] >= s["ticks"]
    assert again["engaged_ticks"] > 0.9 * s["ticks"]


def test_one_command_a_tick_answers_this_ticks_sync(ran: Ran) -> None:
    ticks = list(read_log(ran.log))
    assert [t.state for t in ticks[:5]] == [State.STARTING] * 5
    for t in ticks:
        sync, command = t.sent
        assert (sync.can_id, command.can_id) == (SYNC, COMMAND)
        assert command.data[3] == sync.data[0]
        assert t.t_ns <= sync.stamp_ns <= command.stamp_ns
        engaged = State.TRACKING <= t.state <= State.STOPPING
        assert command.data[2] == engaged
        if not engaged:
            assert command.data[:2] == b"\0\0"
    assert [t.state for t in ticks[-10:]] == [State.DISARMED] * 10


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_stops_in_order_with_exit_0(axis: Path, tmp_path: Path, number: signal.Signals) -> None:
    log = tmp_path / "run.mcap"
    with background("--virtual", "--config", axis, "--headless", "--json", "--log", log) as daemon:
        eventually(lambda: log.exists() and log.stat().st_size > 200_000)
        daemon.send_signal(number)
        out, err = daemon.communicate(timeout=30)
        assert daemon.returncode == 0, err
        assert json.loads(out)["state"] == "tracking"
    ticks = list(read_log(log))
    states = [State(t.state) for t in ticks]
    assert State.STOPPING in states
    stopped = states.index(State.STOPPING)
    assert set(states[stopped:]) == {State.STOPPING, State.DISARMED}
    # it slows down within the bounds, and the valve is centred at the end
    assert abs(ticks[-1].measurement.position_m - ticks[stopped].measurement.position_m) < 0.1
    assert len(states) - states.index(State.DISARMED, stopped) >= 20


def test_daemon_and_plant_in_two_terminals_with_an_unmodified_logger(
    axis: Path, tmp_path: Path, bus: str
) -> None:
    candump, log = tmp_path / "can.log", tmp_path / "run.mcap"
    with background("plant", "--config", axis, "--bus", bus) as plant:
        channel = bus.partition(":")[2]
        logger = subprocess.Popen(
            [sys.executable, "-u", "-m", "can.logger", "-i", "unixcan", "-c", channel, "-f", str(candump)],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        try:
            assert logger.stdout is not None
            assert b"Connected" in logger.stdout.readline()
            with background("--config", axis, "--bus", bus, "--arm", "--headless", "--json",
                            "--duration", 5, "--log", log) as daemon:  # fmt: skip
                eventually(lambda: candump.exists() and candump.stat().st_size > 100_000)
                logger.send_signal(signal.SIGSTOP)
                time.sleep(1.0)
                logger.send_signal(signal.SIGCONT)
                out, err = daemon.communicate(timeout=60)
                assert daemon.returncode == 0, err
                s = json.loads(out)
                assert s["state"] == "tracking"
                assert s["frames"]["lost"] == 0
            time.sleep(0.5)
            logger.send_signal(signal.SIGINT)
            logger.wait(10)
        finally:
            logger.kill()
        plant.send_signal(signal.SIGTERM)
        _, said = plant.communicate(timeout=10)
        assert plant.returncode == 0
        assert "valve node: timed_out" in said  # the daemon has gone, so its commands have expired
    seen = [
        (int(w[2][:3], 16), bytes.fromhex(w[2][4:])) for w in map(str.split, candump.read_text().splitlines())
    ]
    assert {i for i, _ in seen} == {SYNC, ENCODER, PRESSURE, STATUS, COMMAND}
    # causal: a command follows the SYNC that it answers and that tick's sensor frames
    last_sync, out_of_order, commands = 0, 0, 0
    fresh: set[int] = set()
    for i, data in seen:
        if i == SYNC:
            last_sync, fresh = data[0], set()
        elif i == COMMAND:
            commands += 1
            out_of_order += data[3] != last_sync
        else:
            fresh.add(i)
    assert commands > 3000
    assert out_of_order == 0


def test_the_plant_killed_means_centre_and_a_named_fault(axis: Path, tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    with background("--virtual", "--config", axis, "--headless", "--json", "--log", log) as daemon:
        eventually(lambda: log.exists() and log.stat().st_size > 200_000)
        kill(children(daemon.pid)[2])
        out, _ = daemon.communicate(timeout=30)
        assert daemon.returncode == 1
        s = json.loads(out)
    assert s["state"] == "fault"
    # those whose frames of the last tick it still sent are missed a tick later
    assert s["faults"]
    assert set(s["faults"]) <= {"encoder_missing", "pressure_missing", "valve_missing"}
    ticks = list(read_log(log))
    last_heard = max(i for i, t in enumerate(ticks) if t.measurement.fresh)
    faulted = next(i for i, t in enumerate(ticks) if t.state == State.FAULT)
    waited_ns = ticks[faulted].t_ns - ticks[last_heard].t_ns
    assert waited_ns <= TIMEOUT_MS * 1e6 + (1 + ticks[faulted].skipped) * 1e6 + 1e6
    assert all(t.sent[1].data[:3] == b"\0\0\0" for t in ticks[faulted:])
    assert object_of(pneud_here("replay", log, "--json"))["identical"] is True


def test_the_daemon_killed_means_that_the_valve_node_centres_and_the_log_is_finished(
    axis: Path, tmp_path: Path, bus: str
) -> None:
    log = tmp_path / "run.mcap"
    with background("plant", "--config", axis, "--bus", bus) as plant, open_link(bus) as ear:
        with background("--config", axis, "--bus", bus, "--arm", "--headless", "--log", log) as daemon:
            eventually(lambda: log.exists() and log.stat().st_size > 200_000)
            ear.drain([])
            daemon.kill()
            daemon.communicate()
        assert plant.stderr is not None
        lines = iter(plant.stderr.readline, "")
        assert any("timed_out" in line for line in lines)
        heard: list[Frame] = []
        ear.drain(heard)
        last = [f for f in heard if f.can_id == COMMAND][-1]
        eventually(lambda: read_log(log).truncated is False and sum(1 for _ in read_log(log)) > 0)
        reader = read_log(log)
        ticks = list(reader)
        assert not reader.truncated, reader.damage
        # the last command on the bus is the last or last but one in the log
        commands = [t.sent[1].data for t in ticks[-3:]]
        assert last.data in commands
    assert object_of(pneud_here("replay", log, "--json"))["identical"] is True


def test_the_recorder_killed_means_that_control_goes_on_and_says_so(axis: Path, tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    with background(
        "--virtual", "--config", axis, "--headless", "--json", "--duration", 3, "--log", log
    ) as daemon:
        eventually(lambda: log.exists() and log.stat().st_size > 100_000)
        kill(children(daemon.pid)[0])
        out, err = daemon.communicate(timeout=60)
        assert daemon.returncode == 1, "the run went well, but its log is lost"
    s = json.loads(out)
    assert s["state"] == "tracking"
    assert s["ticks"] + s["skipped"] == 3000
    assert s["log_dropped"] > 0
    assert f"the log lacks {s['log_dropped']} records: the recorder was lost" in err
    again = object_of(pneud_here("replay", log, "--json"))
    assert again["truncated"] is True
    assert again["identical"] is True
    # ticks, of which up to 0.2 s may be lost, and those after the kill are
    assert again["ticks"] + s["log_dropped"] >= s["ticks"]


def test_a_recorder_that_dies_at_once_is_no_success(axis: Path, tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    with background(
        "--virtual", "--config", axis, "--headless", "--json", "--duration", 2, "--log", log
    ) as daemon:
        eventually(lambda: log.exists() and bool(children(daemon.pid)))
        kill(children(daemon.pid)[0])
        out, err = daemon.communicate(timeout=60)
    s = json.loads(out)
    assert (daemon.returncode, s["state"]) == (1, "tracking"), err
    assert f"the log lacks {s['log_dropped']} records: the recorder" in err
    # nothing, or what little there was before
    assert s["log_dropped"] > 1500


def test_a_bus_that_is_driven_already_is_refused(axis: Path, bus: str) -> None:
    channel = bus.partition(":")[2]
    with can.Bus(interface="unixcan", channel=channel) as other:
        message = can.Message(arbitration_id=SYNC, data=[1], is_extended_id=False)
        other.send_periodic(message, 0.01)
        done = pneud("--virtual", "--config", axis, "--bus", bus, "--duration", 1, "--headless", "--json")
        assert done.returncode == 2
        assert done.stdout == ""
        assert "another controller drives it" in done.stderr


def test_a_second_controller_centres_the_axis(axis: Path, tmp_path: Path, bus: str) -> None:
    log = tmp_path / "run.mcap"
    with background(
        "--virtual", "--config", axis, "--bus", bus, "--headless", "--json", "--log", log
    ) as daemon:
        eventually(lambda: log.exists() and log.stat().st_size > 100_000)
        with open_link(bus) as other:
            other.send(COMMAND, bytes(8))
            out, _ = daemon.communicate(timeout=30)
    assert daemon.returncode == 1
    assert json.loads(out)["faults"] == ["other_controller"]
    ticks = list(read_log(log))
    heard = next(i for i, t in enumerate(ticks) if any(f.can_id == COMMAND for f in t.frames))
    assert ticks[heard].state == State.FAULT
    assert ticks[heard].sent[1].data[:3] == b"\0\0\0"
    assert object_of(pneud_here("replay", log, "--json"))["identical"] is True


def test_ctrl_z_stops_nothing(axis: Path, tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    with background(
        "--virtual", "--config", axis, "--headless", "--json", "--duration", 2, "--log", log
    ) as daemon:
        eventually(lambda: log.exists() and log.stat().st_size > 50_000)
        for pid in (daemon.pid, *children(daemon.pid)):
            kill(pid, signal.SIGTSTP)
        out, err = daemon.communicate(timeout=60)
    assert daemon.returncode == 0, err
    assert json.loads(out)["log_dropped"] == 0


def test_two_runs_at_once_get_two_logs(tmp_path: Path) -> None:
    names = {open_log(str(tmp_path), "virtual", 0.0)[0] for _ in range(5)}
    assert len(names) == 5


def test_the_log_holds_what_the_valve_did(ran: Ran) -> None:
    tracking = [t for t in read_log(ran.log) if t.state == State.TRACKING]
    assert tracking[-1].measurement.valve_state == ValveState.ENABLED
    # what was applied is what was commanded one tick before, to the resolution of the DAC
    pairs = [
        (a.command.voltage_v, b.measurement.applied_v)
        for a, b in itertools.pairwise(tracking)
        if b.measurement.fresh == 7 and b.skipped == 0
    ]
    close = sum(math.isclose(sent, applied, abs_tol=0.0025) for sent, applied in pairs)
    assert close > 0.95 * len(pairs)


def test_flipping_one_bit_of_one_encoder_frame_is_found(ran: Ran, tmp_path: Path) -> None:
    from test_replay import rewritten  # noqa: PLC0415

    flipped = rewritten(ran.log, tmp_path / "flipped.mcap", tick=800)
    done = pneud_here("replay", flipped)
    assert done.returncode == 1
    assert "first at tick 800:" in done.stdout
