"""The link over real SocketCAN; needs vcan0 and vcan1 and fails, never skips, where there are none."""

from __future__ import annotations

import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import pytest

from pneud.bus import interfaces, wire
from pneud.bus.link import Link, LinkError, open_link, refuse_if_driven
from pneud.signals import Frame

pytestmark = pytest.mark.vm


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True)


def until(condition: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < deadline, f"in vain: {what}"
        time.sleep(0.002)


@pytest.fixture(autouse=True)
def home(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    ip("link", "set", "vcan0", "up")
    with tempfile.TemporaryDirectory(prefix="uc", dir="/tmp") as path:
        monkeypatch.setenv("RUNTIME_DIRECTORY", path)
        yield Path(path)


@pytest.fixture
def pair() -> Iterator[tuple[Link, Link]]:
    with open_link("socketcan:vcan0", virtual=True) as one, open_link("socketcan:vcan0") as two:
        yield one, two


def drained(member: Link) -> list[Frame]:
    frames: list[Frame] = []
    count = member.drain(frames)
    assert count == len(frames)
    return frames


def arrived(member: Link, count: int) -> list[Frame]:
    """The next frames; a vcan delivers a moment after send()."""
    frames: list[Frame] = []
    until(lambda: (member.drain(frames), len(frames))[1] >= count, f"{count} frames")
    return frames


def test_frames_cross_with_kernel_stamps_on_the_monotonic_clock(pair: tuple[Link, Link]) -> None:
    one, two = pair
    before = time.monotonic_ns()
    sent = one.send(0x181, b"\x01\x02\x03")
    assert sent >= before
    assert two.wait(5.0)
    (frame,) = drained(two)
    assert frame[1:] == (0x181, b"\x01\x02\x03")
    assert before - 5_000_000 <= frame.stamp_ns <= time.monotonic_ns()
    assert drained(one) == [], "nobody hears itself"
    assert not two.wait(0.0)


def test_order_lengths_and_flags_are_kept(pair: tuple[Link, Link]) -> None:
    one, two = pair
    frames = [(i, bytes(range(i))) for i in range(9)] + [(wire.CAN_EFF_FLAG | 0x1ABCDEF0, b"\xff")]
    for can_id, data in frames:
        assert one.send(can_id, data) > 0
    assert [frame[1:] for frame in arrived(two, 10)] == frames
    assert one.tx == 10


def test_python_can_is_on_the_same_bus(pair: tuple[Link, Link]) -> None:
    one, _ = pair
    with can.Bus(interface="socketcan", channel="vcan0") as bus:
        one.send(0x183, b"\xff")
        message = bus.recv(5)
        assert message is not None
        assert (message.arbitration_id, bytes(message.data)) == (0x183, b"\xff")
        bus.send(can.Message(arbitration_id=5, is_extended_id=False, data=b"\x05"))
        assert one.wait(5.0)
        assert [frame[1:] for frame in drained(one)] == [(5, b"\x05")]


def test_error_frames_are_delivered_as_such(pair: tuple[Link, Link]) -> None:
    one, two = pair
    one.send(wire.CAN_ERR_FLAG | 0x40, bytes(8))  # a vcan passes on what a controller would report
    (frame,) = arrived(two, 1)
    assert frame.can_id == wire.CAN_ERR_FLAG | 0x40


def test_an_interface_going_down_and_up_is_survived_by_the_same_link(pair: tuple[Link, Link]) -> None:
    one, two = pair
    ip("link", "set", "vcan0", "down")
    assert one.send(1, b"") == -1
    assert (one.down, one.tx_failed) == (True, 1)
    assert drained(two) == []
    assert two.down
    assert not two.wait(0.0), "a dead interface must not keep a loop busy"
    ip("link", "set", "vcan0", "up")
    until(lambda: one.send(2, b"") > 0, "sending works again")
    until(lambda: two.send(3, b"") > 0, "sending works again")
    assert (one.down, two.down) == (False, False)
    assert [frame.can_id for frame in arrived(two, 1)] == [2]


def test_an_interface_taken_away_is_down_and_raises_nothing() -> None:
    ip("link", "add", "vcan7", "type", "vcan")
    ip("link", "set", "vcan7", "up")
    with open_link("socketcan:vcan7") as member:
        ip("link", "del", "vcan7")
        for _ in range(3):
            assert member.send(1, b"") == -1
            member.drain([])
        assert member.down
        assert member.tx_failed == 3
        assert not member.wait(0.0)


def test_frames_that_found_the_queue_full_are_counted(pair: tuple[Link, Link]) -> None:
    one, two = pair
    for _ in range(20_000):
        one.send(0x10, bytes(8))
    got = 0
    while two.wait(0.2):
        got += two.drain([])
    one.send(0x11, b"")  # the kernel tells with the next frame
    got += len(arrived(two, 1))
    assert two.rx_dropped > 0
    assert got + two.rx_dropped == one.tx


def test_kinds_are_told_apart() -> None:
    assert interfaces.query("vcan0") == interfaces.Interface(is_can=True, up=True, kind="vcan", mtu=72)
    ip("link", "set", "vcan1", "down")
    assert interfaces.query("vcan1") == interfaces.Interface(is_can=True, up=False, kind="vcan", mtu=72)
    ip("link", "set", "vcan1", "up")


@pytest.mark.parametrize(
    ("channel", "text"),
    [
        ("socketcan:can9", "no such interface"),
        ("socketcan:lo", "is not a CAN interface"),
        ("socketcan:vcan1", "socketcan:vcan1: is down; sudo ip link set vcan1 up$"),
    ],
)
def test_unusable_interfaces_are_refused_with_the_cure(channel: str, text: str) -> None:
    ip("link", "set", "vcan1", "down")
    with pytest.raises(LinkError, match=text) as caught:
        open_link(channel)
    assert caught.value.exit_code == 3
    ip("link", "set", "vcan1", "up")


def test_auto_takes_an_idle_vcan0_and_leaves_a_busy_one_alone() -> None:
    with open_link("auto", virtual=True) as member:
        assert member.name == "socketcan:vcan0"
        assert member.note == "bus socketcan:vcan0 (it is there and idle)"
    with can.Bus(interface="socketcan", channel="vcan0") as other:
        traffic = other.send_periodic(can.Message(arbitration_id=1, is_extended_id=False), 0.005)
        with open_link("auto", virtual=True) as member:
            assert member.name.startswith("unixcan:auto-")
            assert member.note.endswith("(vcan0 carries traffic)")
        traffic.stop()
    ip("link", "set", "vcan0", "down")
    with open_link("auto", virtual=True) as member:
        assert member.note.endswith("(vcan0 is down)")


def test_a_driven_bus_is_refused(pair: tuple[Link, Link]) -> None:
    one, two = pair
    two.send(0x181, bytes(8))
    refuse_if_driven(one, (0x080, 0x203), 0.05)
    two.send(0x080, b"\x01")
    with pytest.raises(LinkError, match="0x080 is on this bus already") as caught:
        refuse_if_driven(one, (0x080, 0x203), 5.0)
    assert caught.value.exit_code == 2


def test_the_send_queue_is_short() -> None:
    with (
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as usual,
        open_link("socketcan:vcan0") as member,
    ):
        mine = member._carrier._socket  # type: ignore[attr-defined]
        size = mine.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF)
        assert size <= 16384 < usual.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF)
