"""Frames taken from sockets and given to them: Python's way and the one in C do the same."""

from __future__ import annotations

import select
import shutil
import socket
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pneud.bus import wire
from pneud.rt.folders import cache_folder
from pneud.signals import Frame
from pure2c import load_source

CARRIAGES = {"python": wire.CARRIAGE}
if shutil.which("cc") is not None:  # the loop goes without, too
    MODULE = load_source(wire.SOURCE, cache=cache_folder("compiled"))
    CARRIAGES["c"] = wire.Carriage(MODULE.receive, MODULE.send)
WAYS = {name: carriage.receive for name, carriage in CARRIAGES.items()}

MOST = 1000


@pytest.fixture(params=WAYS)
def receive(request: pytest.FixtureRequest) -> wire.Receive:
    return WAYS[request.param]


class Ends:
    """Some pairs of sockets in one epoll set."""

    def __init__(self, count: int) -> None:
        self.pairs = [socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET) for _ in range(count)]
        self.epoll = select.epoll()
        for ours, _ in self.pairs:
            ours.setblocking(False)
            wire.stamp_arrivals(ours)
            self.epoll.register(ours, select.EPOLLIN)
        self.sources = {ours.fileno(): ours for ours, _ in self.pairs}
        self.counts = wire.counts()
        self.frames: list[Frame] = []

    def take(
        self,
        receive: wire.Receive,
        *,
        wait_ns: int = 0,
        most: int = MOST,
        offset_ns: int = 0,
        fd: int = wire.CLASSIC,
    ) -> int:
        known = self.epoll, self.sources, offset_ns, self.frames, most, wait_ns, self.counts, Frame
        return receive(*known, fd)


@contextmanager
def ends(count: int = 1) -> Iterator[Ends]:
    made = Ends(count)
    try:
        yield made
    finally:
        made.epoll.close()
        for pair in made.pairs:
            for end in pair:
                end.close()


def packet(can_id: int, data: bytes) -> bytes:
    return wire.PACKET.pack(can_id, len(data), data)


def fd_packet(can_id: int, flags: int, data: bytes) -> bytes:
    return wire.FD_PACKET.pack(can_id, len(data), flags, data)


identifiers = st.integers(0, 2**32 - 1)
packets = st.one_of(
    st.builds(packet, identifiers, st.binary(max_size=8)),
    st.builds(fd_packet, identifiers, st.integers(0, 255), st.binary(max_size=64)),
    st.binary(min_size=1, max_size=90),
    st.binary(min_size=16, max_size=16),
    st.binary(min_size=72, max_size=72),
)
kinds = st.sampled_from((wire.CLASSIC, 0, wire.FD_FLAG))


@given(st.lists(st.tuples(st.integers(0, 2), packets), max_size=20), kinds)
def test_both_ways_take_the_same(sent: list[tuple[int, bytes]], fd: int) -> None:
    taken = []
    for receive in WAYS.values():
        with ends(3) as some:
            for source, data in sent:
                some.pairs[source][1].send(data)
            found = some.take(receive, fd=fd)
            stamps = [frame.stamp_ns for frame in some.frames]
            assert all(a <= b for a, b in pairwise(stamps)) or found == wire.UNORDERED
            assert all(type(frame) is Frame for frame in some.frames)
            by_stamp = sorted(some.frames)
            taken.append(([frame[1:] for frame in by_stamp], list(some.counts)))
            assert some.take(receive, fd=fd) == wire.ORDERED
            assert len(some.frames) + some.counts[wire.MALFORMED] == len(sent)
    assert all(one == taken[0] for one in taken)


def test_stamps_are_of_arrival_less_the_offset(receive: wire.Receive) -> None:
    with ends() as some:
        before = time.time_ns()
        some.pairs[0][1].send(packet(0x181, b"12345678"))
        after = time.time_ns()
        assert some.take(receive, offset_ns=1_000_000) == wire.ORDERED
        (frame,) = some.frames
        assert before - 1_000_000 <= frame.stamp_ns <= after - 1_000_000
        assert frame[1:] == (0x181, b"12345678")


def test_it_waits_for_the_first_and_not_for_nothing(receive: wire.Receive) -> None:
    with ends() as some:
        begin = time.monotonic_ns()
        assert some.take(receive, wait_ns=20_000_000) == wire.ORDERED
        assert time.monotonic_ns() - begin >= 20_000_000
        some.pairs[0][1].send(packet(1, b""))
        some.take(receive, wait_ns=10**12)
        assert some.frames[-1].can_id == 1


def test_a_stranger_and_whoever_has_left_are_named(receive: wire.Receive) -> None:
    with ends(2) as some:
        (ours, theirs), (stranger, knocking) = some.pairs
        theirs.send(packet(1, b"last"))
        theirs.close()
        assert some.take(receive) == ours.fileno()
        assert [frame.data for frame in some.frames] == [b"last"]
        some.epoll.unregister(ours)
        del some.sources[stranger.fileno()]
        knocking.send(b"x")
        assert some.take(receive) == stranger.fileno()
        assert stranger.recv(10) == b"x"  # nothing of it has been taken


def test_what_another_had_sent_before_it_died_is_taken(receive: wire.Receive) -> None:
    with ends() as some:
        ours, theirs = some.pairs[0]
        ours.send(b"never read")  # which makes closing a reset
        theirs.send(packet(1, b"last"))
        theirs.close()
        assert some.take(receive) == ours.fileno()
        assert [frame.data for frame in some.frames] == [b"last"]


def test_a_flood_ends_at_the_bound(receive: wire.Receive) -> None:
    with ends() as some:
        for n in range(20):
            some.pairs[0][1].send(packet(n, b""))
        some.take(receive, most=5)
        assert [frame.can_id for frame in some.frames] == list(range(5))
        some.take(receive)
        assert [frame.can_id for frame in some.frames] == list(range(20))


def test_an_error_of_a_source_is_passed_on(receive: wire.Receive) -> None:
    with ends() as some:
        some.sources[some.epoll.fileno()] = some.pairs[0][0]
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with listener, socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as caller:
            listener.bind(f"\0pneud-test-{time.monotonic_ns()}")
            listener.listen()
            listener.setblocking(False)
            caller.connect(listener.getsockname())
            some.epoll.register(listener, select.EPOLLIN)
            some.sources[listener.fileno()] = listener
            with pytest.raises(OSError):
                some.take(receive)


@pytest.fixture(params=CARRIAGES)
def send(request: pytest.FixtureRequest) -> wire.Send:
    return CARRIAGES[request.param].send


@pytest.mark.parametrize("data", [b"", b"\x01\x02\x03", b"12345678"])
@pytest.mark.parametrize("can_id", [0, 0x203, 2**32 - 1])
def test_a_frame_reaches_everybody(send: wire.Send, can_id: int, data: bytes) -> None:
    with ends(2) as some:
        targets = tuple(theirs for _, theirs in some.pairs)
        assert send(targets, can_id, data, True) == 0
        assert [ours.recv(40) for ours, _ in some.pairs] == [packet(can_id, data)] * 2


def test_who_has_no_room_is_counted_and_who_has_gone_is_not(send: wire.Send) -> None:
    with ends(3) as some:
        (gone, _), (full, filling), (good, _) = some.pairs
        filling.setblocking(False)
        for _, theirs in some.pairs:
            theirs.setblocking(False)
        gone.close()
        while True:
            try:
                filling.send(b"x")
            except BlockingIOError:
                break
        targets = tuple(theirs for _, theirs in some.pairs)
        assert send(targets, 1, b"now", False) == 1
        assert good.recv(40) == packet(1, b"now")
        for target, error in zip(targets, (BrokenPipeError, BlockingIOError), strict=False):
            with pytest.raises(error):
                send((target,), 1, b"now", True)
        assert full.recv(40) == b"x"


def test_a_target_that_another_thread_has_closed_counts_as_gone(send: wire.Send) -> None:
    with ends(2) as some:
        (_, closed), (ours, theirs) = some.pairs
        closed.close()
        assert send((closed, theirs), 1, b"", False) == 0
        assert ours.recv(40) == packet(1, b"")
        with pytest.raises((OSError, ValueError)):
            send((closed,), 1, b"", True)


@pytest.mark.parametrize("length", wire.FD_LENGTHS)
def test_a_frame_of_can_fd_is_one_of_the_kernels(send: wire.Send, length: int) -> None:
    marks = {wire.FD_FLAG: 4, wire.FD_FLAG | wire.SWITCH_FLAG: 5}
    with ends() as some:
        ((ours, theirs),) = some.pairs
        for mark, flags in marks.items():
            assert send((theirs,), 0x98765432 | mark, bytes(range(length)), True) == 0
            assert ours.recv(90) == fd_packet(0x98765432, flags, bytes(range(length)))


def test_what_is_no_frame_is_not_sent(send: wire.Send) -> None:
    fd = [(wire.FD_FLAG, bytes(n)) for n in range(65) if n not in wire.FD_LENGTHS]
    fd += [(wire.SWITCH_FLAG, b""), (wire.FD_FLAG | 1 << 34, b""), (wire.FD_FLAG, bytes(65))]
    for can_id, data in ((1, bytes(9)), (-1, b""), (2**64, b""), ("1", b""), (1, "x"), *fd):
        with pytest.raises((ValueError, TypeError, OverflowError, struct.error)):
            send((), can_id, data, True)  # type: ignore[arg-type]


@pytest.mark.skipif("c" not in WAYS, reason="there is no C compiler")
def test_wrong_arguments_raise_and_do_not_crash() -> None:
    receive = WAYS["c"]
    with ends() as some:
        good = (some.epoll, some.sources, 0, some.frames, 1, 0, some.counts, Frame, wire.CLASSIC)
        for place, wrong in enumerate((object(), [], "0", (), None, 1.5, b"", int, "x")):
            arguments = list(good)
            arguments[place] = wrong
            with pytest.raises((TypeError, ValueError, BufferError)):
                receive(*arguments)  # type: ignore[arg-type]
        with pytest.raises(TypeError):
            receive()  # type: ignore[call-arg]


def test_packets_have_the_kernels_layout() -> None:
    assert struct.calcsize(wire.PACKET.format) == wire.PACKET.size == 16
    assert struct.calcsize(wire.FD_PACKET.format) == wire.FD_PACKET.size == 72
