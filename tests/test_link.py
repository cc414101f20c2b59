"""The link: what the loop and the plant see of a bus, here over unixcan and over stand-ins for what fails."""

from __future__ import annotations

import errno
import select
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import can
import pytest

from pneud.bus import interfaces, wire
from pneud.bus.interfaces import Interface
from pneud.bus.link import Link, LinkError, open_link, refuse_if_driven
from pneud.bus.socketcan import SocketCanError
from pneud.signals import Frame
from unixcan_tools import short_folder


@pytest.fixture(autouse=True)
def home(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    with short_folder() as path:
        monkeypatch.setenv("RUNTIME_DIRECTORY", str(path))
        yield path


@pytest.fixture
def pair() -> Iterator[tuple[Link, Link]]:
    with open_link("unixcan:x") as one, open_link("unixcan:x") as two:
        one.drain([])
        yield one, two


def drained(member: Link) -> list[Frame]:
    frames: list[Frame] = []
    count = member.drain(frames)
    assert count == len(frames)
    return frames


class Faulty:
    """A carrier that fails as told."""

    dropped = 7

    def __init__(self) -> None:
        self.error = 0
        self.sent: list[tuple[int, bytes]] = []

    def fileno(self) -> int:
        return 0

    def drain(self, offset_ns: int, into: list[Frame], wait_ns: int = 0) -> int:
        into.append(Frame(1 - offset_ns, 2, b""))
        if self.error:
            raise OSError(self.error, "told so")
        return 1

    def send(self, can_id: int, data: bytes) -> None:
        if self.error:
            raise OSError(self.error, "told so")
        self.sent.append((can_id, data))

    def close(self) -> None:
        pass


def test_frames_cross_with_their_time_of_arrival_on_the_monotonic_clock(pair: tuple[Link, Link]) -> None:
    one, two = pair
    assert one.name == "unixcan:x"
    assert one.note == ""
    before = time.monotonic_ns()
    sent = one.send(0x181, b"\x01\x02\x03")
    after = time.monotonic_ns()
    assert before <= sent <= after
    (frame,) = drained(two)
    assert frame[1:] == (0x181, b"\x01\x02\x03")
    slack = 1_000_000  # two readings of two clocks cannot be had at once
    assert before - slack <= frame.stamp_ns <= sent + slack
    assert (one.tx, one.tx_failed, one.down, two.tx) == (1, 0, False, 0)


def test_draining_appends_and_never_waits(pair: tuple[Link, Link]) -> None:
    one, two = pair
    frames = [Frame(0, 0, b"")]
    assert two.drain(frames) == 0
    for i in range(5):
        one.send(i, b"")
    assert two.drain(frames) == 5
    assert [frame.can_id for frame in frames] == [0, 0, 1, 2, 3, 4]


def test_flag_bits_travel(pair: tuple[Link, Link]) -> None:
    one, two = pair
    ids = [wire.CAN_EFF_FLAG | 0x1ABCDEF0, wire.CAN_RTR_FLAG | 0x181, wire.CAN_ERR_FLAG | 0x40]
    for can_id in ids:
        one.send(can_id, b"")
    assert [frame.can_id for frame in drained(two)] == ids


def test_waiting_ends_with_a_frame_or_in_time(pair: tuple[Link, Link]) -> None:
    one, two = pair
    drained(two)
    start = time.monotonic_ns()
    assert not two.wait(0.0005)
    assert time.monotonic_ns() - start >= 500_000
    one.send(1, b"")
    assert two.wait(10.0)
    assert select.select([two.fileno()], [], [], 0)[0], "its descriptor fits into other sets"
    drained(two)
    assert not two.wait(0.0)


def test_python_can_is_on_the_same_bus(pair: tuple[Link, Link]) -> None:
    one, _ = pair
    with can.Bus(interface="unixcan", channel="x") as bus:
        drained(one)
        one.send(0x183, b"\xff")
        message = bus.recv(1)
        assert message is not None
        assert (message.arbitration_id, bytes(message.data)) == (0x183, b"\xff")
        bus.send(can.Message(arbitration_id=5, is_extended_id=False, data=b"\x05"))
        assert [frame[1:] for frame in drained(one)] == [(5, b"\x05")]


def test_remeasuring_returns_the_step_of_the_clock(
    monkeypatch: pytest.MonkeyPatch, pair: tuple[Link, Link]
) -> None:
    one, two = pair
    assert one.watch_clock() == 0
    real = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: real() + 3_600_000_000_000)
    assert abs(two.watch_clock() - 3_600_000_000_000) < 1_000_000_000
    one.send(1, b"")
    (frame,) = drained(two)
    assert abs(frame.stamp_ns + 3_600_000_000_000 - time.monotonic_ns()) < 60_000_000_000


@pytest.mark.parametrize("code", [errno.ENOBUFS, errno.EAGAIN])
def test_a_full_queue_drops_the_frame_and_counts_it(code: int) -> None:
    carrier = Faulty()
    member = Link("faulty", carrier)
    carrier.error = code
    assert member.send(1, b"") == -1
    assert (member.tx, member.tx_failed, member.down) == (0, 1, False)
    carrier.error = 0
    assert member.send(2, b"") > 0
    assert carrier.sent == [(2, b"")], "the dropped one is never sent again"


@pytest.mark.parametrize("code", [errno.ENETDOWN, errno.ENODEV, errno.ENXIO])
def test_an_interface_that_goes_down_is_down_until_a_frame_leaves(code: int) -> None:
    carrier = Faulty()
    member = Link("faulty", carrier)
    carrier.error = code
    frames: list[Frame] = []
    assert member.drain(frames) == 1, "what was read before the error counts"
    assert member.down
    carrier.error = 0
    member.drain(frames)
    assert member.down
    carrier.error = errno.ENETDOWN  # the stale one after coming up again
    assert member.send(1, b"") == -1
    carrier.error = 0
    assert member.send(1, b"") > 0
    assert not member.down


def test_a_driven_bus_is_refused(pair: tuple[Link, Link]) -> None:
    one, two = pair
    two.send(0x181, bytes(8))
    refuse_if_driven(one, (0x080, 0x203), 0.02)
    two.send(0x203, bytes(8))
    with pytest.raises(LinkError, match="unixcan:x: 0x203 is on this bus already") as caught:
        refuse_if_driven(one, (0x080, 0x203), 5.0)
    assert caught.value.exit_code == 2


@pytest.mark.parametrize("channel", ["", "can0", "unixcan", "unixcan:", "socketcan:", "tcp:x"])
def test_an_unknown_form_is_a_usage_error(channel: str) -> None:
    with pytest.raises(LinkError, match="none of auto, socketcan:IF, unixcan:NAME") as caught:
        open_link(channel)
    assert caught.value.exit_code == 2


def test_a_channel_that_cannot_be_joined_is_the_machines_fault(home: Path) -> None:
    home.chmod(0o700)
    (home / "can").mkdir(mode=0o755)
    (home / "can").chmod(0o755)
    with pytest.raises(LinkError, match="chmod 700") as caught:
        open_link("unixcan:x")
    assert caught.value.exit_code == 3


@pytest.mark.parametrize(
    ("found", "virtual", "text", "exit_code"),
    [
        (None, False, "socketcan:can9: no such interface", 3),
        (Interface(False, True, ""), False, "is not a CAN interface", 3),
        (Interface(True, False, "can"), False, "is down; sudo ip link set can9 up type can bitrate", 3),
        (Interface(True, False, "vcan"), True, "is down; sudo ip link set can9 up$", 3),
        (Interface(True, True, "can"), True, "is of kind can, and a virtual run touches nothing but vcan", 2),
        (Interface(True, True, "vxcan"), True, "is of kind vxcan", 2),
        (Interface(True, True, ""), True, "is of kind unknown", 2),
        (Interface(True, True, "vcan", 16), True, "carries no CAN FD .* link set can9 mtu 72 up$", 3),
        (Interface(True, True, "can", 16), False, "carries no CAN FD .* dbitrate 4000000 fd on$", 3),
    ],
)
def test_an_unusable_interface_is_refused_with_the_cure(
    monkeypatch: pytest.MonkeyPatch, found: Interface | None, virtual: bool, text: str, exit_code: int
) -> None:
    monkeypatch.setattr(interfaces, "query", lambda name: found)
    with pytest.raises(LinkError, match=text) as caught:
        open_link("socketcan:can9", virtual=virtual, fd=wire.Fd(frozenset(), False))
    assert caught.value.exit_code == exit_code
    assert "\n" not in str(caught.value)


def test_a_kernel_without_socketcan_is_told_with_the_cure(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.EAFNOSUPPORT, "Address family not supported by protocol")

    monkeypatch.setattr(interfaces, "query", lambda name: Interface(True, True, "can"))
    monkeypatch.setattr(socket, "socket", refuse)
    with pytest.raises(
        LinkError, match="has no SocketCAN; sudo modprobe can-raw, or use --bus unixcan"
    ) as caught:
        open_link("socketcan:can0")
    assert caught.value.exit_code == 3


@pytest.mark.parametrize(
    ("found", "reason"),
    [
        (None, "there is no vcan0"),
        (Interface(True, False, "vcan"), "vcan0 is down"),
        (Interface(True, True, "can"), "vcan0 is no vcan"),
    ],
)
def test_auto_falls_back_to_a_unixcan_of_its_own_and_says_why(
    monkeypatch: pytest.MonkeyPatch, found: Interface | None, reason: str
) -> None:
    monkeypatch.setattr(interfaces, "query", lambda name: found)
    with open_link("auto", virtual=True) as one, open_link("auto") as two:
        assert one.name.startswith("unixcan:auto-")
        assert one.name != two.name
        assert one.note == f"bus {one.name} ({reason})"
        with open_link(one.name) as guest:
            guest.send(1, b"")
            assert len(drained(one)) == 1
            assert drained(two) == []


def test_auto_says_why_a_vcan_that_is_there_cannot_be_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object, **__: object) -> None:
        raise SocketCanError("vcan0: no permission; be root")

    monkeypatch.setattr(interfaces, "query", lambda name: Interface(True, True, "vcan"))
    monkeypatch.setattr("pneud.bus.link.SocketCan.__init__", refused)
    with open_link("auto", virtual=True) as one:
        assert one.note == f"bus {one.name} (no permission)"


def test_the_kernel_knows_the_loopback_interface_and_no_nonsense() -> None:
    found = interfaces.query("lo")
    assert found is not None
    assert not found.is_can
    assert interfaces.query("no-such-one") is None
    assert interfaces.query("much-too-long-for-a-name") is None


def test_nothing_is_lost_unnoticed_by_default(pair: tuple[Link, Link]) -> None:
    one, two = pair
    for i in range(200):
        one.send(i, bytes(8))
    assert [frame.can_id for frame in drained(two)] == list(range(200))
    assert (one.peers_dropped, two.rx_dropped) == (0, 0)
