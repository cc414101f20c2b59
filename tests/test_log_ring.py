from __future__ import annotations

import gc
import mmap
import os
import signal
import tracemalloc
from typing import NamedTuple

import pytest
from hypothesis import given, settings

from log_samples import WAYS, any_record, bits, noisy, tick_at
from pneud.log.live.packing import Skimmed, unpacked
from pneud.log.live.ring import RecorderStatus, Ring
from pneud.signals import Frame, Record, Timing

NO_TIME = Timing(0, 0, 0, 0, 0, 0)


def numbered(n: int, frames: int = 0) -> Record:
    some = tuple(Frame(n + i, 0x181, bytes((i & 255,))) for i in range(frames))
    return Record(tick_at(n), NO_TIME, some, 0, (), 0.0)


@given(record=any_record())
@settings(max_examples=30, deadline=None)
def test_what_is_put_is_read_to_the_bit(record: Record) -> None:
    ring = Ring.create(slots=32)
    reader = ring.reader()
    ring.put(record)
    assert [bits(r) for r in reader.drain()] == [bits(record)]
    assert reader.dropped == 0


def test_a_record_is_delivered_once_and_only_after_it_was_complete_at_the_previous_poll() -> None:
    ring = Ring.create(slots=16)
    reader = ring.reader()
    first, second = numbered(1), numbered(2)
    ring.put(first)
    assert reader.poll() == []
    ring.put(second)
    assert reader.poll() == [first]
    assert reader.poll() == [second]
    assert reader.poll() == []


@pytest.mark.parametrize("way", WAYS)
def test_records_of_several_slots_come_back_in_order_around_the_end_of_the_ring(way: str) -> None:
    ring = Ring.create(slots=16, pack=WAYS[way])
    reader = ring.reader()
    sizes = [0, 70, 3, 26, 27, 67, 68, 5] * 5
    for n, size in enumerate(sizes, start=1):
        record = numbered(n, size)
        ring.put(record)
        assert reader.drain() == [record]
    assert (reader.delivered, reader.dropped) == (len(sizes), 0)


def test_a_reader_that_is_overrun_counts_exactly_what_it_missed_and_goes_on_in_order() -> None:
    ring = Ring.create(slots=64)
    reader = ring.reader()
    total = 0
    got: list[int] = []
    for burst in (10, 500, 3, 64, 65, 1, 200):
        for _ in range(burst):
            total += 1
            ring.put(numbered(total, 40 if total % 7 == 0 else 2))
        got += [r.tick.t_ns for r in reader.poll()]
    got += [r.tick.t_ns for r in reader.drain()]
    assert got == sorted(set(got))
    assert got[-1] == total
    assert reader.dropped > 0
    assert reader.delivered + reader.dropped == total == ring.put_count


def test_a_record_too_long_or_unfit_for_the_ring_is_counted_as_dropped_and_harms_no_other() -> None:
    ring = Ring.create(slots=16)
    reader = ring.reader()
    ring.put(numbered(1))
    ring.put(numbered(2, 1000))
    ring.put(numbered(3)._replace(before=-1))
    ring.put(numbered(4))
    assert [r.tick.t_ns for r in reader.drain()] == [1, 4]
    assert reader.dropped == 2
    ring.put(numbered(5)._replace(before=-1))
    assert reader.drain() == []
    assert reader.dropped == 3


def test_two_readers_do_not_disturb_each_other() -> None:
    ring = Ring.create(slots=16)
    one, other = ring.reader(), ring.reader()
    ring.put(numbered(1))
    assert len(one.drain()) == 1
    ring.put(numbered(2))
    assert [r.tick.t_ns for r in other.drain()] == [1, 2]


def test_latest_is_the_newest_whatever_has_been_read() -> None:
    ring = Ring.create(slots=16)
    reader = ring.reader()
    assert reader.latest() is None
    for n in range(1, 40):
        ring.put(numbered(n, 50 if n % 3 == 0 else 1))
        latest = reader.latest()
        assert latest is not None and latest.tick.t_ns == n
    assert reader.delivered == 0


def test_a_slot_that_is_being_written_is_not_delivered() -> None:
    ring = Ring.create(slots=16)
    reader = ring.reader()
    ring.put(numbered(1))
    reader.poll()
    slot = 20_480 + 1 * 1024
    ring._memory[slot : slot + 8] = (17).to_bytes(8, "little")  # the writer has come round and begun
    assert reader.poll() == []
    assert reader.latest() is None


@pytest.mark.parametrize("way", WAYS)
def test_a_put_keeps_no_memory(way: str) -> None:
    ring = Ring.create(slots=64, pack=WAYS[way])
    records = list(noisy(200))
    for record in records:
        ring.put(record)
    gc.collect()
    tracemalloc.start()
    try:
        kept = []
        for _ in range(3):  # other threads of whoever runs the tests may keep something meanwhile
            before = tracemalloc.get_traced_memory()[0]
            for _ in range(10):
                for record in records:
                    ring.put(record)
            kept.append(tracemalloc.get_traced_memory()[0] - before)
        assert min(kept) < 2000
    finally:
        tracemalloc.stop()


def test_status_and_notes_pass_between_processes() -> None:
    ring = Ring.create(slots=16)
    assert ring.status() == RecorderStatus(0, 0, 0, 0, 0, 0, 0, 0)
    assert ring.notes() is None
    child = os.fork()
    if child == 0:
        ring.set_notes({"fifo": "refused: RLIMIT_RTPRIO is 0"})
        ring.set_status(RecorderStatus(3, 100, 2, 1, 28, 1, 1, 4096))
        ring.set_closed()
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
    assert ring.notes() == {"fifo": "refused: RLIMIT_RTPRIO is 0"}
    assert ring.closed
    assert ring.status().lost == 3
    assert ring.status().error_text == os.strerror(28)


def test_notes_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="do not fit"):
        Ring.create(slots=16).set_notes({"x": "y" * 20_000})


@pytest.mark.parametrize("way", WAYS)
def test_a_writer_killed_at_any_moment_leaves_only_whole_records(way: str) -> None:
    """A child puts as fast as it can and is killed; what is there afterwards is consistent."""
    for _ in range(3):
        ring = Ring.create(slots=256, pack=WAYS[way])
        reader = ring.reader()
        child = os.fork()
        if child == 0:
            n = 0
            while True:
                n += 1
                ring.put(numbered(n, n % 60))
        while ring.put_count < 2000:
            pass
        seen = reader.poll()
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        seen += reader.drain()
        assert seen
        for record in seen:
            n = record.tick.t_ns
            assert record == numbered(n, n % 60)
        numbers = [r.tick.t_ns for r in seen]
        assert numbers == sorted(set(numbers))
        assert numbers[-1] >= ring.put_count


def simple(n: int) -> Record:
    return Record(tick_at(n * 1_000_000), Timing(0, 0, 0, 0, 0, 0), (), 0, (), 0.0)


class Leaf(NamedTuple):
    number: int
    value: float
    more: tuple[float, ...]


def test_a_state_comes_with_its_record_and_before_the_next_one() -> None:
    ring = Ring.create(slots=64)
    reader = ring.reader()
    ring.put(simple(1))
    ring.put_state(1_000_000, Leaf(3, 0.1, (1.0, float("inf"))))
    ring.put(simple(2))
    assert (reader.poll(), reader.states()) == ([], {})
    assert [r.tick.t_ns for r in reader.poll()] == [1_000_000, 2_000_000]
    assert reader.states() == {1_000_000: Leaf(3, 0.1, (1.0, float("inf")))}
    assert (reader.poll(), reader.states()) == ([], {})
    assert reader.dropped == 0


def test_a_state_may_come_one_poll_after_its_record_and_never_before() -> None:
    ring = Ring.create(slots=64)
    reader = ring.reader()
    ring.put(simple(1))
    reader.poll()
    ring.put_state(1_000_000, Leaf(3, 0.1, ()))
    assert [r.tick.t_ns for r in reader.poll()] == [1_000_000]
    assert reader.states() == {}
    latest = reader.latest()
    assert latest is not None and latest.tick.t_ns == 1_000_000
    assert (reader.poll(), reader.states()) == ([], {1_000_000: Leaf(3, 0.1, ())})


def test_a_state_too_long_or_that_cannot_be_handed_over_arrives_as_none() -> None:
    for state in (tuple(float(i) for i in range(50_000)), lambda: None):
        ring = Ring.create(slots=64)
        reader = ring.reader()
        ring.put(simple(1))
        ring.put_state(1_000_000, state)
        reader.poll()
        reader.poll()
        assert reader.states() == {1_000_000: None}


def test_of_several_states_all_are_seen() -> None:
    ring = Ring.create(slots=64)
    reader = ring.reader()
    for n in range(1, 6):
        ring.put(simple(n))
        ring.put_state(n * 1_000_000, Leaf(n, 0.0, ()))
    assert [r.tick.t_ns for r in reader.drain()] == [n * 1_000_000 for n in range(1, 6)]
    assert reader.states() == {n * 1_000_000: Leaf(n, 0.0, ()) for n in range(1, 6)}


def test_who_skims_sees_the_same_records() -> None:
    ring = Ring.create(slots=64)
    skimmer, reader, other = ring.reader(), ring.reader(), ring.reader()
    for record in noisy(40):
        ring.put(record)
    skimmer.skim()
    reader.poll()
    assert other.raw() == []
    seen, read = skimmer.skim(), reader.poll()
    assert len(read) == 40
    assert list(map(unpacked, other.raw())) == read
    assert seen == [
        Skimmed(r.tick.measurement, r.timing.lateness_ns, r.timing.latency_ns, r.tick.command.saturated)
        for r in read
    ]
    for record in noisy(200):
        ring.put(record)
    skimmer.skim()
    skimmer.skim()
    assert skimmer.delivered + skimmer.dropped == 240
    assert skimmer.dropped > 0


def test_memory_given_for_reading_cannot_be_written() -> None:
    ring = Ring.create(slots=64)
    other = Ring.attach(ring.open_for_reading(), ring.slots, ring.slot_bytes)
    reader = other.reader()
    records = list(noisy(5))
    for record in records:
        ring.put(record)
    reader.poll()
    assert [bits(r) for r in reader.poll()] == [bits(r) for r in records]
    with pytest.raises(TypeError):
        other.put(records[0])
    with pytest.raises(OSError, match=r"not permitted|denied"):
        mmap.mmap(ring.descriptor, mmap.PAGESIZE)
