"""unixcan: a bus of Unix sockets that python-can's own tools use as they are."""

from __future__ import annotations

import asyncio
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import can
import pytest

from pneud.bus import transport, wire
from pneud.bus.transport import Party, UnixCanError, channels
from pneud.bus.unixcan import UnixCanBus
from pneud.rt import folders
from pneud.signals import Frame
from unixcan_tools import python, said, short_folder, until

pytestmark = pytest.mark.realtime

FRAME = (0x123, b"\x01\x02")
PACKET = wire.PACKET.pack(0x123, 2, b"\x01\x02")


@pytest.fixture(autouse=True)
def home(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    with short_folder() as path:
        monkeypatch.setenv("RUNTIME_DIRECTORY", str(path))
        yield path / "can"


def drained(member: Party) -> list[Frame]:
    frames: list[Frame] = []
    member.drain(0, frames)
    return frames


def bus(channel: str = "x", **options: object) -> can.BusABC:
    return can.Bus(interface="unixcan", channel=channel, **options)  # type: ignore[arg-type]


# --- parties ---


def test_everybody_but_the_sender_gets_a_frame() -> None:
    one, two, three = Party("x"), Party("x"), Party("x")
    other = Party("y")
    for member in (one, two, three):
        drained(member)
    assert (one.parties, two.parties, three.parties, other.parties) == (2, 2, 2, 0)
    before = time.time_ns()
    two.send(*FRAME)
    after = time.time_ns()
    for member in (one, three):
        (frame,) = drained(member)
        assert frame[1:] == (0x123, b"\x01\x02")
        assert before <= frame.stamp_ns <= after
    assert drained(two) == drained(other) == []
    for member in (one, two, three, other):
        member.close()


def test_frames_of_several_senders_come_in_the_order_in_which_they_were_sent() -> None:
    listener = Party("x")
    senders = [Party("x") for _ in range(4)]
    for member in (listener, *senders):
        drained(member)
    for i in range(400):
        senders[i * 7 % 4].send(i, b"")
    assert [frame.can_id for frame in drained(listener)] == list(range(400))
    for member in (listener, *senders):
        member.close()


def test_what_was_sent_before_the_newcomer_was_noticed_is_in_order() -> None:
    listener, other = Party("x"), Party("x")
    drained(listener)
    newcomer = Party("x")
    drained(other)
    for i in range(10):
        (newcomer, other)[i % 2].send(i, b"")
    before = time.time_ns()
    time.sleep(0.001)
    frames = drained(listener)
    assert [frame.can_id for frame in frames] == list(range(10))
    assert frames[-1].stamp_ns <= before
    for member in (listener, other, newcomer):
        member.close()


def test_who_knocks_and_hands_over_nothing_holds_up_nobody(home: Path) -> None:
    member = Party("x")
    (path,) = (entry for entry in (home / "x").iterdir() if entry.name != "lock")
    idler = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    idler.connect(str(path))
    newcomer = Party("x")
    newcomer.send(*FRAME)
    assert [frame.can_id for frame in drained(member)] == [0x123]
    idler.send(b"no descriptor")
    drained(member)
    assert idler.recv(1) == b""
    assert member.parties == 1
    idler.close()
    newcomer.close()
    member.close()


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 0, 2), (2, 1, 0), (1, 2, 0)])
def test_who_only_listens_is_served_before_who_answers(order: tuple[int, ...]) -> None:
    members: dict[int, Party] = {}
    for i in order:
        members[i] = Party("x", answers=i == 1)
    speaker, answerer, listener = members[0], members[1], members[2]
    drained(speaker)
    speaker.send(*FRAME)
    (early,), (late,) = drained(listener), drained(answerer)
    assert early.stamp_ns < late.stamp_ns
    for member in members.values():
        member.close()


def test_who_was_taken_for_a_listener_is_found_out_when_it_sends() -> None:
    answerer, listener, speaker = Party("x"), Party("x"), Party("x")
    for member in (speaker, answerer, listener):
        drained(member)
    answerer.send(*FRAME)
    drained(speaker)
    drained(listener)
    speaker.send(*FRAME)
    (early,), (late,) = drained(listener), drained(answerer)
    assert early.stamp_ns < late.stamp_ns
    for member in (speaker, answerer, listener):
        member.close()


def test_parties_come_and_go_while_others_talk() -> None:
    with_us = Party("x")
    for i in range(20):
        guest = Party("x")
        guest.send(i, b"")
        guest.close()
        assert [frame.can_id for frame in drained(with_us)] == [i], "what it said before it left is heard"
    with_us.send(*FRAME)
    drained(with_us)
    assert with_us.parties == 0
    with_us.close()


def test_the_last_one_out_leaves_nothing_behind(home: Path) -> None:
    one, two = Party("x"), Party("x")
    assert len(list((home / "x").iterdir())) == 3
    one.close()
    assert channels() == ["x"]
    two.close()
    two.close()
    assert list(home.iterdir()) == []


def test_a_packet_that_is_no_frame_is_left_out() -> None:
    one, two = Party("x"), Party("x")
    drained(one)
    for packet in (b"?", PACKET + b"?", wire.PACKET.pack(1, 9, bytes(8))):
        for sock in one._peers.values():
            sock.send(packet)
    one.send(*FRAME)
    assert [frame.can_id for frame in drained(two)] == [0x123]
    one.close()
    two.close()


def test_a_descriptor_tells_that_there_is_something() -> None:
    one, two = Party("x"), Party("x")
    drained(one)
    drained(two)
    assert not select_readable(two.fileno(), 0.0)
    one.send(*FRAME)
    assert select_readable(two.fileno(), 1.0)
    drained(two)
    assert not select_readable(two.fileno(), 0.0)
    one.close()
    assert select_readable(two.fileno(), 1.0), "leaving wakes, too"
    drained(two)
    assert not select_readable(two.fileno(), 0.0)
    two.close()


def select_readable(descriptor: int, timeout: float) -> bool:
    import select  # noqa: PLC0415

    return bool(select.select([descriptor], [], [], timeout)[0])


@pytest.mark.parametrize("name", ["", ".", "..", "a/b", "a\0b"])
def test_a_bad_name_is_refused(name: str) -> None:
    with pytest.raises(UnixCanError, match="a channel is a plain name"):
        Party(name)


def test_a_path_too_long_for_a_socket_is_refused_with_the_cure(home: Path) -> None:
    with pytest.raises(UnixCanError, match="at most 107; choose a shorter name") as caught:
        Party("n" * 100)
    assert "\n" not in str(caught.value)
    assert not (home / ("n" * 100)).exists()


# --- where the sockets lie, and who may come in ---


def test_the_runtime_folder_follows_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("RUNTIME_DIRECTORY", f"{tmp_path}/a:{tmp_path}/b")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert folders.runtime_folder() == tmp_path / "a"
    monkeypatch.delenv("RUNTIME_DIRECTORY")
    assert folders.runtime_folder() == tmp_path / "pneud"
    assert (tmp_path / "pneud").stat().st_mode & 0o777 == 0o700
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "missing"))
    assert folders.runtime_folder() == tmp_path / f"pneud-{os.geteuid()}"


def test_a_folder_that_others_may_enter_is_refused(home: Path) -> None:
    home.mkdir()
    home.chmod(0o755)
    with pytest.raises(UnixCanError, match="others may enter it; chmod 700"):
        Party("x")
    home.chmod(0o700)
    (home / "x").symlink_to("/tmp")
    with pytest.raises(UnixCanError, match="is no folder; remove it"):
        Party("x")


def test_a_folder_of_someone_else_is_refused(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    home.mkdir(mode=0o700)
    owner = os.geteuid()
    monkeypatch.setattr(os, "geteuid", lambda: owner + 1)
    with pytest.raises(UnixCanError, match=f"belongs to user {owner}, not to {owner + 1}"):
        Party("x")


def test_a_stranger_who_reaches_the_socket_is_turned_away(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    member = Party("x")
    monkeypatch.setattr(transport, "_peer_uid", lambda sock: os.geteuid() + 1)
    stranger = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    (path,) = (entry for entry in (home / "x").iterdir() if entry.name != "lock")
    stranger.connect(str(path))
    assert drained(member) == []
    assert (member.parties, member.refused) == (0, 1)
    assert stranger.recv(16) == b""
    stranger.close()
    member.close()


STRANGER = """
import os, socket, sys
os.setgroups([]); os.setgid(65534); os.setuid(65534)
sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
try:
    sock.connect(sys.argv[1])
except PermissionError:
    print("locked out")
else:
    print("connected")
    try:
        print("heard" if sock.recv(16) else "thrown out")
    except ConnectionResetError:
        print("thrown out")
"""


def test_another_user_neither_reaches_the_socket_nor_gets_past_it(home: Path) -> None:
    if os.geteuid() != 0:
        return  # nobody can become somebody else; the test before this one covers the refusal itself
    member = Party("x")
    (path,) = (entry for entry in (home / "x").iterdir() if entry.name != "lock")
    home.parent.chmod(0o755)
    process = python(STRANGER, str(path))
    said(process, "locked out")
    process.communicate()
    for entry in (home, home / "x", path):
        entry.chmod(0o777)
    process = python(STRANGER, str(path))
    said(process, "connected")
    until(lambda: (drained(member), member.refused)[1] == 1, "the stranger is refused")
    member.send(*FRAME)
    said(process, "thrown out")
    process.communicate()
    member.close()


# --- processes that stall or die ---

MEMBER = """
import sys, time
from pneud.bus.transport import Party
party = Party("x")
print("here")
while True:
    party.drain(0, [])
    time.sleep(0.001)
"""


def test_a_killed_party_is_forgotten_and_its_socket_removed(home: Path) -> None:
    member = Party("x")
    process = python(MEMBER)
    said(process, "here")
    drained(member)
    assert member.parties == 1
    process.kill()
    process.communicate()
    member.send(*FRAME)
    until(lambda: (drained(member), member.parties)[1] == 0, "the dead party is forgotten")
    assert len(list((home / "x").iterdir())) == 3, "a dead process cannot clean up"
    newcomer = Party("x")
    assert len(list((home / "x").iterdir())) == 3, "lock, member, newcomer"
    member.close()
    newcomer.close()
    assert list(home.iterdir()) == []


def test_a_channel_of_dead_processes_is_swept(home: Path) -> None:
    process = python(MEMBER)
    said(process, "here")
    assert channels() == ["x"]
    process.kill()
    process.communicate()
    assert channels() == []
    assert list(home.iterdir()) == []


def test_a_stopped_party_loses_its_own_frames_and_hinders_nobody() -> None:
    process = python(MEMBER)
    said(process, "here")
    sender, other = Party("x"), Party("x")
    drained(sender)
    assert sender.parties == 2
    process.send_signal(signal.SIGSTOP)
    got = 0
    for _ in range(30_000):
        sender.send(*FRAME)
        got += other.drain(0, [])
        if sender.dropped >= 100:
            break
    assert sender.dropped >= 100, "the send buffer is bounded"
    got += other.drain(0, [])
    before = sender.dropped
    for _ in range(1000):
        sender.send(*FRAME)
        got_now = other.drain(0, [])
        assert got_now == 1
    assert sender.dropped == before + 1000
    process.send_signal(signal.SIGCONT)
    lost = -1

    def loses_nothing_more() -> bool:
        nonlocal lost
        before, lost = lost, sender.dropped
        sender.send(*FRAME)
        return before == sender.dropped

    until(loses_nothing_more, "it reads again")
    process.kill()
    process.communicate()
    sender.close()
    other.close()


def test_closing_a_forked_copy_leaves_the_original_alone(home: Path) -> None:
    one, two = Party("x"), Party("x")
    drained(one)
    child = os.fork()
    if child == 0:
        one.close()
        os._exit(0)
    os.waitpid(child, 0)
    assert channels() == ["x"]
    two.send(*FRAME)
    assert [frame.can_id for frame in drained(one)] == [0x123]
    one.close()
    two.close()


# --- as an interface of python-can ---


def test_python_can_finds_it_and_messages_survive_the_trip() -> None:
    messages = [
        can.Message(arbitration_id=0x7FF, is_extended_id=False, data=range(8)),
        can.Message(arbitration_id=0x1ABCDEF0, is_extended_id=True, data=b"\x01"),
        can.Message(arbitration_id=0x10, is_extended_id=False, is_remote_frame=True, dlc=5),
        can.Message(arbitration_id=0x40, is_extended_id=False, is_error_frame=True, data=bytes(8)),
        can.Message(arbitration_id=0x0, is_extended_id=False, data=b""),
    ]
    with bus() as one, bus() as two:
        assert isinstance(one, UnixCanBus)
        assert one.recv(0) is None
        for message in messages:
            one.send(message)
        for message in messages:
            got = two.recv(1)
            assert got is not None
            assert got.equals(message, timestamp_delta=None, check_channel=False, check_direction=False)
            assert abs(got.timestamp - time.time()) < 60
        assert two.recv(0) is None
        assert one.recv(0.01) is None


def test_filters_numbers_as_names_and_own_messages() -> None:
    with (
        bus("7", can_filters=[{"can_id": 0x10, "can_mask": 0x7F0}]) as one,
        UnixCanBus(7, receive_own_messages=True) as two,
    ):
        for can_id in (0x20, 0x15, 0x30):
            two.send(can.Message(arbitration_id=can_id, is_extended_id=False))
        one_got, two_got = one.recv(1), [two.recv(1) for _ in range(3)]
        assert one_got is not None and one_got.arbitration_id == 0x15
        assert one.recv(0) is None
        assert [m and m.arbitration_id for m in two_got] == [0x20, 0x15, 0x30]
        assert two.recv(0) is None


def test_frames_of_can_fd_pass_as_they_are() -> None:
    sent = [
        can.Message(arbitration_id=n, is_fd=True, bitrate_switch=n % 2 == 1, data=bytes(range(n)))
        for n in (0, 5, 8, 12, 64)
    ]
    with bus() as one, bus() as two, closing(Party("x")) as classic:
        for message in sent:
            one.send(message)
        got = [two.recv(1) for _ in sent]
        assert all(
            m is not None and a.equals(m, timestamp_delta=None, check_channel=False, check_direction=False)
            for a, m in zip(sent, got, strict=True)
        )
        frames: list[Frame] = []
        classic.drain(0, frames)
        assert not frames
        with pytest.raises(can.CanOperationError, match="no frame of CAN FD has so many bytes"):
            one.send(can.Message(is_fd=True, data=bytes(11), check=False, dlc=11))


def test_a_bad_channel_is_an_initialization_error() -> None:
    with pytest.raises(can.CanInitializationError, match="plain name"):
        bus("..")


def test_living_channels_are_detected() -> None:
    with bus("a"), bus("b"):
        found = can.detect_available_configs(interfaces=["unixcan"])
        assert [config["channel"] for config in found] == ["a", "b"]


def test_who_only_sends_still_lets_others_join() -> None:
    with bus() as sender, bus() as listener:
        sender.send(can.Message(arbitration_id=1, is_extended_id=False))
        assert listener.recv(1) is not None


def test_an_event_loop_gets_every_message_of_a_burst() -> None:
    async def burst() -> list[int]:
        with bus() as sender, bus() as receiver:
            reader = can.AsyncBufferedReader()
            notifier = can.Notifier(receiver, [reader], loop=asyncio.get_running_loop())
            for i in range(50):
                sender.send(can.Message(arbitration_id=i, is_extended_id=False))
            got = [(await asyncio.wait_for(reader.get_message(), 10)).arbitration_id for _ in range(50)]
            notifier.stop()
            return got

    assert asyncio.run(burst()) == list(range(50))


def test_one_thread_may_send_while_another_receives() -> None:
    with bus() as one, bus() as two:
        got: list[int] = []

        def receive() -> None:
            while len(got) < 500:
                message = one.recv(10)
                assert message is not None
                got.append(message.arbitration_id)

        thread = threading.Thread(target=receive)
        thread.start()
        for i in range(500):
            two.send(can.Message(arbitration_id=i, is_extended_id=False))
            one.send(can.Message(arbitration_id=i, is_extended_id=False))
            if i % 50 == 0:
                bus().shutdown()
        thread.join(20)
        assert got == list(range(500))


# --- python-can's own tools, in their own processes ---

NODE = """
import sys
from pneud.bus.transport import Party
from pneud.bus import wire
import select
party = Party("x", answers=True)
print("here")
left = int(sys.argv[1])
while left:
    select.select([party], [], [], 10)
    frames = []
    party.drain(0, frames)
    for frame in frames:
        if frame.can_id == 0x80:
            for can_id in (0x181, 0x182, 0x183):
                party.send(can_id, frame.data)
            left -= 1
print("done")
sys.stdin.readline()
party.close()
"""


LINE = re.compile(r"Timestamp: +([0-9.]+) +ID: +([0-9a-f]+) .*DL: +8 +([0-9a-f ]{23})")


def exchange(ticks: int) -> list[tuple[float, int, int]]:
    """Let a controller (here), a node and an unmodified can.logger meet; what the logger prints."""
    logger = subprocess.Popen(
        [sys.executable, "-m", "can.logger", "-i", "unixcan", "-c", "x"],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )
    lines: list[str] = []
    output = logger.stdout
    assert output is not None
    reader = threading.Thread(target=lambda: lines.extend(output))
    reader.start()
    until(lambda: any("Logger" in line for line in lines), "the logger is on the bus")
    controller = Party("x", answers=True)
    node = python(NODE, str(ticks))
    said(node, "here")
    until(lambda: (drained(controller), controller.parties)[1] == 2, "logger and node are there")
    for tick in range(ticks):
        controller.send(0x80, tick.to_bytes(8, "big"))
        answers: list[Frame] = []
        while len(answers) < 3:
            assert select_readable(controller.fileno(), 10.0), f"no answer to tick {tick}"
            controller.drain(0, answers)
        controller.send(0x203, tick.to_bytes(8, "big"))
    said(node, "done")
    until(lambda: sum("Timestamp" in line for line in lines) >= 5 * ticks, "the logger prints every frame")
    logger.send_signal(signal.SIGINT)
    assert logger.wait(20) == 0, "".join(lines[-5:])
    reader.join(20)
    node.communicate("\n")
    assert controller.dropped == 0
    controller.close()
    found = [match for line in lines if (match := LINE.match(line))]
    return [(float(m[1]), int(m[2], 16), int(m[3].replace(" ", ""), 16)) for m in found]


def check_causal_order(lines: list[tuple[float, int, int]], ticks: int) -> None:
    order = (0x080, 0x181, 0x182, 0x183, 0x203)
    assert [line[1:] for line in lines] == [(can_id, tick) for tick in range(ticks) for can_id in order]
    stamps = [line[0] for line in lines]
    assert stamps == sorted(stamps)


def test_can_logger_sees_every_frame_in_causal_order() -> None:
    check_causal_order(exchange(500), 500)


@pytest.mark.slow
def test_can_logger_sees_twenty_thousand_frames_in_causal_order() -> None:
    check_causal_order(exchange(4_400), 4_400)


def test_can_player_plays_to_whoever_listens(tmp_path: Path) -> None:
    log = tmp_path / "trace.log"
    log.write_text("(1.0) vcan0 123#0102\n(1.001) vcan0 7FF#\n(1.002) vcan0 1ABCDEF0#FF\n", encoding="utf-8")
    with bus() as listener:
        done = subprocess.run(
            [sys.executable, "-m", "can.player", "-i", "unixcan", "-c", "x", str(log)],
            capture_output=True,
            text=True,
            timeout=30,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        got = [listener.recv(1) for _ in range(3)]
    assert [(m.arbitration_id, bytes(m.data)) for m in got if m] == [
        (0x123, b"\x01\x02"),
        (0x7FF, b""),
        (0x1ABCDEF0, b"\xff"),
    ]


def test_who_joins_while_another_speaks_for_the_first_time_is_let_in() -> None:
    one, two = Party("x", answers=True), Party("x", answers=True)
    drained(one)
    two.send(*FRAME)
    three = Party("x", answers=True)
    assert [frame.can_id for frame in drained(one)] == [FRAME[0]]
    drained(one)
    assert one.parties == 2
    one.send(*FRAME)
    assert [frame.can_id for frame in drained(three)] == [FRAME[0]]
    for member in (one, two, three):
        member.close()


def test_who_joins_while_another_leaves_is_let_in() -> None:
    one, two = Party("x", answers=True), Party("x", answers=True)
    drained(one)
    two.send(*FRAME)
    drained(one)
    two.close()
    three = Party("x", answers=True)
    drained(one)
    assert one.parties == 1
    for member in (one, three):
        member.close()


def test_a_peer_whose_socket_fails_is_forgotten_and_nobody_waits_for_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    one, two = Party("x", answers=True), Party("x", answers=True)
    drained(one)
    two.send(*FRAME)
    drained(one)
    two.send(*FRAME)

    def broken(*_: object, **__: object) -> bool:
        raise OSError(12, "no memory")

    monkeypatch.setattr(wire, "take", broken)
    assert drained(one) == []
    assert one.parties == 0
    for member in (one, two):
        member.close()
