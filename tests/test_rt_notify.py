"""What systemd hears, and that a deaf systemd hurts nobody."""

from __future__ import annotations

import contextlib
import os
import socket
from pathlib import Path

import pytest

from pneud.rt.notify import RESTART_US, Service, restarting, watchdog_interval_ns

STATES = ("starting", "waiting", "disarmed")
FAULTS = ("encoder_missing", "valve_missing")


def listen(address: str) -> socket.socket:
    s = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    s.bind(address)
    s.setblocking(False)
    return s


def heard(s: socket.socket) -> list[str]:
    messages = []
    while True:
        try:
            messages.append(s.recv(4096).decode())
        except BlockingIOError:
            return messages


def service(address: str, watchdog_us: int = 0) -> Service:
    environ = {"NOTIFY_SOCKET": address}
    if watchdog_us:
        environ["WATCHDOG_USEC"] = str(watchdog_us)
    return Service(1000.0, STATES, FAULTS, environ)


@pytest.mark.parametrize("abstract", [False, True])
def test_a_punctual_loop_is_ready_and_says_how_it_stands(tmp_path: Path, abstract: bool) -> None:
    name = f"@pneud-test-{os.getpid()}" if abstract else str(tmp_path / "notify")
    with listen(name.replace("@", "\0")) as s:
        it = service(name)
        it.report(0, 0, 1, 0b11)
        assert heard(s) == [], "one quarter of a second says nothing yet"
        it.report(1, 5, 1, 0b11)
        assert heard(s) == ["READY=1", "STATUS=waiting: encoder_missing, valve_missing"]
        it.report(2, 200, 1, 0b11)
        assert heard(s) == [], "nothing new; once ready, lateness is for the axis to judge"
        it.report(3, 0, 1, 0b10)
        it.report(4, 0, 2, 0)
        it.stopping()
        assert heard(s) == ["STATUS=waiting: valve_missing", "STATUS=disarmed", "STOPPING=1"]


def test_a_late_loop_is_not_ready_and_says_so(tmp_path: Path) -> None:
    name = str(tmp_path / "notify")
    with listen(name) as s:
        it = service(name, watchdog_us=2_000_000)
        ready = "READY=1\nWATCHDOG_USEC=2000000"
        late = "STATUS=starting: the loop is late; see pneud doctor"
        for skipped, expected in ((0, []), (6, [late]), (0, []), (5, [ready, "STATUS=disarmed"])):
            it.report(0, skipped, 2, 0)
            assert heard(s) == expected


def test_the_watchdog_is_fed_at_half_its_time_and_only_by_progress(tmp_path: Path) -> None:
    name = str(tmp_path / "notify")
    with listen(name) as s:
        it = service(name, watchdog_us=2_000_000)
        assert it.every == 250
        fed = []
        for n in range(1, 41):
            it.report(n * 250_000_000, 0, 2, 0)
            fed += [n for message in heard(s) if message == "WATCHDOG=1"]
        assert fed == list(range(4, 41, 4))


def test_a_short_watchdog_is_fed_often_enough(tmp_path: Path) -> None:
    with listen(str(tmp_path / "notify")):
        assert service(str(tmp_path / "notify"), watchdog_us=20_000).every == 10


def test_nothing_happens_without_a_socket() -> None:
    it = Service(1000.0, STATES, FAULTS, {"WATCHDOG_USEC": "2000000"})
    assert it.every == 0
    it.stopping()


@pytest.mark.parametrize("name", ["nobody", "x" * 300])
def test_a_missing_or_impossible_socket_is_no_error(tmp_path: Path, name: str) -> None:
    it = service(str(tmp_path / name))
    for n in range(3):
        it.report(n, 0, 2, 0)


def test_a_manager_that_does_not_read_never_blocks(tmp_path: Path) -> None:
    name = str(tmp_path / "notify")
    with listen(name):
        it = service(name)
        for n in range(20_000):  # far beyond any socket's queue; a blocking send would hang here
            it.report(n, 0, n & 1, 0)


def test_what_there_was_no_room_for_is_told_later(tmp_path: Path) -> None:
    name = str(tmp_path / "notify")
    with listen(name) as s, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as full:
        it, others = service(name, watchdog_us=2_000_000), 0
        with contextlib.suppress(BlockingIOError):
            while True:
                full.sendto(b"", name)
                others += 1
        for n in range(8):
            it.report(n * 250_000_000, 0, 2, 0)
        assert heard(s) == [""] * others
        it.report(2_000_000_000, 0, 2, 0)
        assert heard(s) == ["READY=1\nWATCHDOG_USEC=2000000", "STATUS=disarmed", "WATCHDOG=1"]


def test_the_watchdog_waits_for_this_process() -> None:
    assert watchdog_interval_ns({"WATCHDOG_USEC": "2000000"}) == 1_000_000_000
    mine = {"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": str(os.getpid())}
    assert watchdog_interval_ns(mine) == 1_000_000_000


@pytest.mark.parametrize(
    "environ",
    [
        {},
        {"WATCHDOG_USEC": "0"},
        {"WATCHDOG_USEC": "-1"},
        {"WATCHDOG_USEC": "soon"},
        {"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": "1"},
    ],
)
def test_no_watchdog_waits_for_us(environ: dict[str, str]) -> None:
    assert watchdog_interval_ns(environ) == 0


def test_a_process_that_begins_anew_is_given_time(tmp_path: Path) -> None:
    name = str(tmp_path / "notify")
    with listen(name) as s:
        restarting({"NOTIFY_SOCKET": name})
        assert heard(s) == ["STATUS=beginning anew"]
        restarting({"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "2000000"})
        assert heard(s) == [f"STATUS=beginning anew\nWATCHDOG=1\nWATCHDOG_USEC={RESTART_US}"]
    restarting({})
    restarting({"NOTIFY_SOCKET": name})
