"""What a bus does that goes away and comes back, and what the daemon makes of it, over real SocketCAN."""

from __future__ import annotations

import json
import re
import signal
import socket
import struct
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import groupby
from pathlib import Path

import pytest

from commands import Forked
from pneud import resources
from pneud.bus import wire
from pneud.bus.link import Link, open_link
from pneud.log.files.reader import read_log
from pneud.log.format.records import LoggedTick
from pneud.safety.faults import F
from pneud.safety.supervisor import is_engaged
from pneud.signals import Frame, State

pytestmark = pytest.mark.vm
NAME = "vcan8"
BUS_OFF, RESTARTED, CONTROLLER, PASSIVE, ACTIVE = 0x040, 0x100, 0x004, 0x30, 0x40


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True)


def make(kind: str = "vcan") -> None:
    ip("link", "add", NAME, "type", kind)
    ip("link", "set", NAME, "up")


def remove() -> None:
    ip("link", "del", NAME)


@pytest.fixture(autouse=True)
def interface() -> Iterator[None]:
    make()
    yield
    subprocess.run(["ip", "link", "del", NAME], capture_output=True, check=False)


def until(condition: Callable[[], bool], what: str, patience_s: float = 60.0) -> None:
    deadline = time.monotonic() + patience_s
    while not condition():
        assert time.monotonic() < deadline, f"in vain: {what}"
        time.sleep(0.01)


def works(link: Link) -> bool:
    return link.send(2, b"\x02") > 0 and not link.down


def test_an_interface_made_anew_is_found_by_its_name() -> None:
    with open_link(f"socketcan:{NAME}") as link:
        before = link.fileno()
        remove()
        assert link.send(1, b"") == -1
        assert link.down
        assert not link.reopen(), "there is none"
        make()
        assert link.send(1, b"") == -1, "the same name, but another interface"
        assert link.reopen()
        until(lambda: works(link), "sending works again")
        assert link.fileno() == before
        with open_link(f"socketcan:{NAME}") as other:
            other.send(3, b"\x03")
            other.send(wire.CAN_ERR_FLAG | BUS_OFF, bytes(8))
            got: list[Frame] = []
            until(lambda: (link.drain(got), len(got))[1] >= 2, "frames")
            assert [frame.can_id for frame in got] == [3, wire.CAN_ERR_FLAG | BUS_OFF]
            assert all(frame.stamp_ns > 0 for frame in got), "the kernel's stamps are still asked for"


def test_an_interface_made_anew_but_not_up_is_waited_for() -> None:
    with open_link(f"socketcan:{NAME}") as link:
        remove()
        link.send(1, b"")
        ip("link", "add", NAME, "type", "vcan")
        assert not link.reopen()
        ip("link", "set", NAME, "up")
        assert link.reopen()
        until(lambda: works(link), "sending works again")


def test_a_virtual_run_does_not_take_another_kind_of_interface_of_the_same_name() -> None:
    with open_link(f"socketcan:{NAME}", virtual=True) as link:
        remove()
        link.send(1, b"")
        made = subprocess.run(["ip", "link", "add", NAME, "type", "dummy"], check=False, capture_output=True)
        if made.returncode == 0:
            ip("link", "set", NAME, "up")
            assert not link.reopen()


def test_an_error_that_is_left_over_from_before_passes_by_itself() -> None:
    with open_link(f"socketcan:{NAME}") as link:
        for _ in range(3):
            ip("link", "set", NAME, "down")
            ip("link", "set", NAME, "up")
            outcomes = [works(link) for _ in range(3)]
            assert outcomes[1:] == [True, True], "at most one frame meets the old ENETDOWN"


@pytest.fixture
def gentle(tmp_path: Path) -> Path:
    """The rig's configuration at a rate and with gains that a virtual machine with one slow CPU can carry."""
    text = (resources.configs() / "virtual.toml").read_text()
    for key, value in {
        "rate_hz": 50.0,
        "k1": 180.0,
        "k2": 156.0,
        "k3": 30.0,
        "alpha": 0.835,
        "frequency_hz": 0.1,
        "tracking_error_m": 0.1,
        "sensor_timeout_ms": 200.0,
        "valve_timeout_ms": 200.0,
        "deadline_timeout_ms": 200.0,
    }.items():
        text, count = re.subn(rf"^{key} = \S+", f"{key} = {value}", text, flags=re.MULTILINE)
        assert count == 1, key
    section = r"(\[control\.motion\]\n)(?:[^\[\n].*\n|\n)*"
    text, count = re.subn(section, r"\1bandwidth_rad_s = 40.0\n\n", text)
    assert count == 1
    file = tmp_path / "gentle.toml"
    file.write_text(text)
    return file


@contextmanager
def plant(config: Path) -> Iterator[None]:
    process = Forked("plant", "--config", config, "--bus", f"socketcan:{NAME}")
    try:
        yield
    finally:
        process.send_signal(signal.SIGTERM)
        process.communicate(30)


class Daemon:
    """The daemon, and what is on the bus beside it."""

    def __init__(self, config: Path, log: Path, *options: str) -> None:
        self.log = log
        words = ("--config", config, "--bus", f"socketcan:{NAME}", "--headless", "--json", "--log", log)
        self.process = Forked(*words, *options)

    def ticks(self) -> list[LoggedTick]:
        """What the log holds so far."""
        if not self.log.exists() or self.log.stat().st_size < 1000:
            return []
        try:
            return list(read_log(self.log))
        except Exception:
            return []

    def waits_for(self, state: State, after: int = 0) -> int:
        """The number of a tick in that state, later than `after`."""
        found = 0

        def there() -> bool:
            nonlocal found
            assert self.process.poll() is None, self.process.communicate()
            time.sleep(0.5)
            found = next((t.number for t in self.ticks() if t.number > after and t.state == state), 0)
            return found > 0

        until(there, state.label)
        return found

    def waits(self, seconds: float) -> int:
        time.sleep(seconds)
        ticks = self.ticks()
        return ticks[-1].number if ticks else 0

    def ends(self) -> dict[str, object]:
        self.process.send_signal(signal.SIGINT)
        out, err = self.process.communicate(timeout=60)
        print(err)
        summary: dict[str, object] = json.loads(out)
        return summary


def states(ticks: list[LoggedTick]) -> list[State]:
    return [State(state) for state, _ in groupby(tick.state for tick in ticks)]


def check_that_nothing_moved(ticks: list[LoggedTick]) -> None:
    for tick in ticks:
        if not is_engaged(tick.state):
            assert (tick.command.voltage_v, tick.command.enable) == (0.0, 0)


def test_the_daemon_comes_back_to_disarmed_from_an_interface_that_was_down(
    tmp_path: Path, gentle: Path
) -> None:
    with plant(gentle):
        daemon = Daemon(gentle, tmp_path / "run.mcap")
        seen = daemon.waits_for(State.DISARMED)
        ip("link", "set", NAME, "down")
        seen = daemon.waits_for(State.WAITING, seen)
        ip("link", "set", NAME, "up")
        daemon.waits_for(State.DISARMED, seen)
        summary = daemon.ends()
    assert daemon.process.returncode == 0
    assert (summary["state"], summary["faults"]) == ("disarmed", [])
    ticks = daemon.ticks()
    assert states(ticks) == [
        State.STARTING, State.WAITING, State.DISARMED, State.WAITING, State.DISARMED,
    ]  # fmt: skip
    assert any(tick.present >> F.LINK_DOWN & 1 for tick in ticks)
    assert not ticks[-1].present >> F.LINK_DOWN & 1
    check_that_nothing_moved(ticks)


def test_the_daemon_comes_back_to_disarmed_from_an_interface_that_was_made_anew(
    tmp_path: Path, gentle: Path
) -> None:
    with plant(gentle):
        daemon = Daemon(gentle, tmp_path / "run.mcap")
        seen = daemon.waits_for(State.DISARMED)
        remove()
        seen = daemon.waits_for(State.WAITING, seen)
    make()
    with plant(gentle):
        daemon.waits_for(State.DISARMED, seen)
        daemon.ends()
    assert daemon.process.returncode == 0
    ticks = daemon.ticks()
    assert states(ticks)[-2:] == [State.WAITING, State.DISARMED]
    assert not ticks[-1].present >> F.LINK_DOWN & 1
    check_that_nothing_moved(ticks)


def party() -> socket.socket:
    """Another one on the bus."""
    found = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    found.bind((NAME,))
    return found


def report(can_id: int, second: int = 0) -> None:
    """Another party of the bus tells what a CAN controller would."""
    with party() as other:
        other.send(struct.pack("=IB3x8B", wire.CAN_ERR_FLAG | can_id, 8, 0, second, *bytes(6)))


def test_bus_off_while_tracking_centres_and_stays_so_after_the_restart(tmp_path: Path, gentle: Path) -> None:
    with plant(gentle):
        daemon = Daemon(gentle, tmp_path / "run.mcap", "--arm")
        seen = daemon.waits_for(State.TRACKING)
        report(BUS_OFF)
        seen = daemon.waits_for(State.FAULT, seen)
        report(RESTARTED)
        daemon.waits(3.0)
        summary = daemon.ends()
    assert daemon.process.returncode == 1
    assert (summary["state"], summary["faults"]) == ("fault", ["bus_off"])
    ticks = daemon.ticks()
    assert states(ticks)[-2:] == [State.TRACKING, State.FAULT]
    assert any(tick.present >> F.BUS_OFF & 1 for tick in ticks)
    assert not ticks[-1].present >> F.BUS_OFF & 1, "the controller is back, the fault stays latched"
    assert ticks[-1].latched == 1 << F.BUS_OFF
    check_that_nothing_moved(ticks)


def test_bus_off_without_a_restart_ends_with_the_interface_taken_down_and_up(
    tmp_path: Path, gentle: Path
) -> None:
    with plant(gentle):
        daemon = Daemon(gentle, tmp_path / "run.mcap")
        seen = daemon.waits_for(State.DISARMED)
        report(BUS_OFF)
        daemon.waits(2.0)
        seen = daemon.ticks()[-1].number
        assert daemon.ticks()[-1].present >> F.BUS_OFF & 1
        ip("link", "set", NAME, "down")
        seen = daemon.waits_for(State.WAITING, seen)
        ip("link", "set", NAME, "up")
        daemon.waits_for(State.DISARMED, seen)
        daemon.ends()
    assert not daemon.ticks()[-1].present >> F.BUS_OFF & 1


def test_an_error_passive_controller_stops_the_load_under_control(tmp_path: Path, gentle: Path) -> None:
    with plant(gentle):
        daemon = Daemon(gentle, tmp_path / "run.mcap", "--arm")
        seen = daemon.waits_for(State.TRACKING)
        report(CONTROLLER, PASSIVE)
        daemon.waits_for(State.FAULT, seen)
        report(CONTROLLER, ACTIVE)
        daemon.waits(2.0)
        summary = daemon.ends()
    assert summary["faults"] == ["bus_passive"]
    ticks = daemon.ticks()
    assert states(ticks)[-3:] == [State.TRACKING, State.STOPPING, State.FAULT]
    assert not ticks[-1].present >> F.BUS_PASSIVE & 1


def test_frames_that_the_kernel_drops_are_counted_and_shown(tmp_path: Path, gentle: Path) -> None:
    with plant(gentle):
        daemon = Daemon(gentle, tmp_path / "run.mcap")
        daemon.waits_for(State.DISARMED)
        daemon.process.send_signal(signal.SIGSTOP)
        with party() as other:
            for n in range(20_000):
                other.send(struct.pack("=IB3x8s", 0x7FF, 4, n.to_bytes(4, "big")))
        daemon.process.send_signal(signal.SIGCONT)
        daemon.waits(3.0)
        summary = daemon.ends()
    frames = summary["frames"]
    assert isinstance(frames, dict)
    assert frames["lost"] > 0
    assert any(tick.present >> F.RECEIVE_OVERFLOW & 1 for tick in daemon.ticks())
