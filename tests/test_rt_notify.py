"""What systemd hears, and that a deaf systemd hurts nobody."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest

from pneud.rt.notify import Notifier, watchdog_interval_ns


def listen(address: str) -> socket.socket:
    s = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    s.bind(address)
    s.settimeout(5)
    return s


def say_everything(notifier: Notifier) -> None:
    notifier.ready()
    notifier.status("tracking\nat 1 kHz — µ")
    notifier.watchdog()
    notifier.stopping()


@pytest.mark.parametrize("abstract", [False, True])
def test_every_message_arrives_as_one_datagram(tmp_path: Path, abstract: bool) -> None:
    name = f"@pneud-test-{os.getpid()}" if abstract else str(tmp_path / "notify")
    with listen(name.replace("@", "\0")) as s:
        say_everything(Notifier({"NOTIFY_SOCKET": name}))
        heard = [s.recv(4096).decode() for _ in range(4)]
    assert heard == ["READY=1", "STATUS=tracking at 1 kHz — µ", "WATCHDOG=1", "STOPPING=1"]


def test_nothing_happens_without_a_socket() -> None:
    say_everything(Notifier({}))


def test_a_missing_or_impossible_socket_is_no_error(tmp_path: Path) -> None:
    say_everything(Notifier({"NOTIFY_SOCKET": str(tmp_path / "nobody")}))
    say_everything(Notifier({"NOTIFY_SOCKET": "/" + "x" * 300}))


def test_a_manager_that_does_not_read_never_blocks(tmp_path: Path) -> None:
    name = str(tmp_path / "notify")
    with listen(name):
        notifier = Notifier({"NOTIFY_SOCKET": name})
        for _ in range(20_000):  # far beyond any socket's queue; a blocking send would hang here
            notifier.watchdog()


def test_the_watchdog_is_fed_at_half_its_time() -> None:
    assert watchdog_interval_ns({"WATCHDOG_USEC": "2000000"}) == 1_000_000_000
    assert (
        watchdog_interval_ns({"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": str(os.getpid())}) == 1_000_000_000
    )


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
