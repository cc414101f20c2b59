from __future__ import annotations

import errno
import os
import resource
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from log_samples import FAULTS, bits, header, noisy, tick_at, write_log
from pneud.bus import wire
from pneud.log.files.naming import LogError, create_log
from pneud.log.files.reader import read_log
from pneud.log.files.writer import FLUSH_NS, LogWriter
from pneud.log.format.schema import Level
from pneud.log.live.notes import Note
from pneud.log.live.recorder import start_recorder
from pneud.log.live.ring import _HEAD_BYTES, _NOTES_BYTE, RecorderStatus, Ring
from pneud.loop.recorder_watch import RecorderWatch
from pneud.signals import Frame, Host, Record, Request, RequestKind, State, Tick, Timing

NO_TIME = Timing(0, 0, 0, 0, 0, 0)
PATIENCE_S = 30.0  # only ever spent where a test fails


def record(n: int) -> Record:
    return Record(tick_at(n * 1_000_000), NO_TIME, (), 0, (), 0.0)


def until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.005)


def ended(pid: int) -> int:
    """Wait for a child; its exit status, or minus the signal that ended it."""
    status = 0

    def gone() -> bool:
        nonlocal status
        done, status = os.waitpid(pid, os.WNOHANG)
        return done == pid

    until(gone)
    return os.waitstatus_to_exitcode(status)


def test_notes_fill_the_head_of_the_ring_and_no_more() -> None:
    ring, room = Ring.create(slots=16), _HEAD_BYTES - _NOTES_BYTE - len('{"n": ""}')
    with pytest.raises(ValueError, match=r"do not fit into the ring"):
        ring.set_notes({"n": "x" * (room + 1)})
    ring.set_notes({"n": "x" * room})
    assert ring.notes() == {"n": "x" * room}


def test_what_is_said_is_an_event_of_who_has_said_it(tmp_path: Path) -> None:
    writer = LogWriter(create_log(tmp_path / "x.mcap"), header())
    writer.say(Note(1_000_000_000, int(Level.WARNING), "console", "something"))
    assert writer.close()
    found = [(e.level, e.name, e.message) for e in read_log(tmp_path / "x.mcap").events()]
    assert found == [(Level.WARNING, "console", "something")]


def test_a_file_is_left_alone_until_a_chunk_is_due(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    writer = LogWriter(create_log(path), header())
    begun = path.stat().st_size
    for record in noisy(3):
        writer.write(record)
        writer.attend()
    assert path.stat().st_size == begun
    time.sleep(1e-9 * FLUSH_NS)
    writer.attend()
    assert path.stat().st_size > begun
    assert writer.close()


def test_everything_put_is_in_the_file_when_the_ring_was_closed(tmp_path: Path) -> None:
    ring = Ring.create()
    path = tmp_path / "x.mcap"
    child = start_recorder(ring, create_log(path), header())
    ring.set_notes({"fifo": "granted", "mlockall": "refused: RLIMIT_MEMLOCK"})
    records = list(noisy(300))
    for r in records:
        ring.put(r)
    ring.set_closed()
    assert ended(child) == 0
    reader = read_log(path)
    assert [bits(t.record) for t in reader] == [bits(r) for r in records]
    assert (reader.truncated, reader.missing) == (False, 0)
    assert reader.setup == {"fifo": "granted", "mlockall": "refused: RLIMIT_MEMLOCK"}
    status = ring.status()
    assert (status.written, status.lost, status.error, status.finished) == (300, 0, 0, 1)
    assert status.file_bytes == path.stat().st_size


def test_the_recorder_outlives_ctrl_c_and_says_that_it_lives(tmp_path: Path) -> None:
    ring = Ring.create(slots=64)
    child = start_recorder(ring, create_log(tmp_path / "x.mcap"), header())
    until(lambda: ring.status().heartbeat > 2)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        os.kill(child, number)
    ring.put(record(1))
    until(lambda: ring.status().written == 1)
    before = ring.status().heartbeat
    until(lambda: ring.status().heartbeat > before)
    ring.set_closed()
    assert ended(child) == 0


def test_all_records_of_a_killed_loop_are_written_and_the_file_is_finished(tmp_path: Path) -> None:
    ring = Ring.create()
    path = tmp_path / "x.mcap"
    read_end, write_end = os.pipe()
    loop = os.fork()
    if loop == 0:
        recorder = start_recorder(ring, create_log(path), header())
        os.write(write_end, b"%d" % recorder)
        n = 0
        while True:
            n += 1
            ring.put(record(n))
            time.sleep(0.0002)
    until(lambda: ring.put_count > 500 and ring.status().heartbeat > 0)
    os.kill(loop, signal.SIGKILL)
    assert ended(loop) == -signal.SIGKILL
    put = ring.put_count
    until(lambda: ring.status().finished == 1)
    reader = read_log(path)
    numbers = [t.t_ns // 1_000_000 for t in reader]
    assert numbers == list(range(1, len(numbers) + 1))
    assert len(numbers) >= put
    assert not reader.truncated
    os.close(read_end)
    os.close(write_end)


def test_a_killed_recorder_loses_little_and_the_rest_reads(tmp_path: Path) -> None:
    """At most what lies between two flushes and two polls is lost, counted in the recorder's own rounds.

    A round lasts 40 ms or more, a chunk stays open for three of them, and a record waits for two to be taken.
    """
    ring = Ring.create()
    path = tmp_path / "x.mcap"
    child = start_recorder(ring, create_log(path), header())
    n = 0
    put_by: dict[int, int] = {}
    while ring.status().written < 600:
        n += 1
        ring.put(record(n))
        put_by.setdefault(ring.status().heartbeat, n)
        time.sleep(0.0005)
    reported = ring.status().written
    os.kill(child, signal.SIGKILL)
    assert ended(child) == -signal.SIGKILL
    rounds = ring.status().heartbeat
    reader = read_log(path)
    numbers = [t.t_ns // 1_000_000 for t in reader]
    assert numbers == list(range(1, len(numbers) + 1))
    assert len(numbers) >= reported  # said before the kill, hence in the file after it
    assert len(numbers) >= max((n for beat, n in put_by.items() if beat <= rounds - 10), default=0)
    assert reader.truncated


def test_a_file_is_never_more_than_a_flush_behind(tmp_path: Path) -> None:
    """Reads the growing file beside its writer: each flush leaves whole ticks behind, without a gap."""
    path = tmp_path / "x.mcap"
    writer = LogWriter(create_log(path), header())
    seen = 0
    for n in range(1, 501):
        writer.write(record(n))
        writer.attend()
        time.sleep(0.0005)
        if n % 50 == 0:
            read = sum(1 for _ in read_log(path))
            assert read == writer.written >= seen
            seen = read
    assert seen > 0
    assert writer.close()


def test_records_overwritten_before_they_were_read_are_counted_and_told(tmp_path: Path) -> None:
    ring = Ring.create(slots=64)
    path = tmp_path / "x.mcap"
    for n in range(1, 501):
        ring.put(record(n))
    child = start_recorder(ring, create_log(path), header())
    until(lambda: ring.status().dropped > 0)
    ring.put(record(501))
    ring.set_closed()
    assert ended(child) == 1
    status = ring.status()
    reader = read_log(path)
    got = len(list(reader))
    assert status.dropped + got == 501
    assert reader.missing == status.dropped
    assert status.finished == 1
    dropped = [e for e in reader.events() if "dropped" in e.message]
    assert [e.level for e in dropped] == [Level.ERROR]


def limit_files(size: int) -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))


def test_a_full_disk_stops_neither_the_recorder_nor_the_loop_and_is_reported(tmp_path: Path) -> None:
    ring = Ring.create()
    path = tmp_path / "x.mcap"
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    limit_files(20_000)
    try:
        child = start_recorder(ring, create_log(path), header())
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    records = list(noisy(2000))
    for r in records:
        ring.put(r)
        if ring.status().error:
            break
        time.sleep(0.0005)
    assert ring.status().error == errno.EFBIG
    for r in records[:300]:
        ring.put(r)
    until(lambda: ring.status().unwritten >= 300)
    ring.set_closed()
    assert ended(child) == 1
    status = ring.status()
    assert (status.finished, status.dropped) == (0, 0)
    assert status.error_text == os.strerror(errno.EFBIG)
    reader = read_log(path)
    read = len(list(reader))
    assert status.written <= read < ring.put_count  # a reader finds some of a block that was cut, too
    assert status.written + status.unwritten == ring.put_count
    assert reader.truncated
    assert path.stat().st_size <= 20_000


@pytest.mark.slow
def test_a_disk_that_takes_data_again_is_no_fault_any_longer(tmp_path: Path) -> None:
    ring = Ring.create()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    limit_files(20_000)
    try:
        child = start_recorder(ring, create_log(tmp_path / "x.mcap"), header())
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    watch, records = RecorderWatch(ring, child), iter(list(noisy(4000)))

    def shows(bits: int) -> bool:
        ring.put(next(records))
        watch.look()
        return watch.host == bits

    until(lambda: shows(int(Host.RECORDER_LOST)))
    resource.prlimit(child, resource.RLIMIT_FSIZE, limits)
    until(lambda: shows(0))
    ring.set_closed()
    assert ended(child) == 1, "some are missing"
    status = ring.status()
    assert (status.finished, status.written + status.unwritten) == (1, ring.put_count)


@pytest.mark.parametrize("full", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_is_a_fault_for_as_long_as_it_is_full(full: int) -> None:
    ring = Ring.create(slots=64)
    child = os.fork()
    if not child:
        signal.pause()
        os._exit(0)
    try:
        watch = RecorderWatch(ring, child)
        for failing, error, host, lost in (
            (0, 0, 0, False),
            (1, full, int(Host.DISK_FULL), False),
            (0, full, 0, False),  # the last failure is still told
            (1, errno.EIO, int(Host.RECORDER_LOST), True),
            (0, errno.EIO, 0, False),
        ):
            ring.set_status(RecorderStatus(1, 0, 0, 0, error, failing, 0, 0))
            watch.look()
            assert (watch.host, watch.lost) == (host, lost)
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


def test_a_disk_with_room_again_goes_on_where_it_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 10**12
    monkeypatch.setattr(time, "monotonic_ns", lambda: now)
    path = tmp_path / "x.mcap"
    writer = LogWriter(create_log(path), header())
    real_write = os.write
    room = [700]

    def write(descriptor: int, data: bytes) -> int:
        if room[0] == 0:
            raise OSError(errno.ENOSPC, "full")
        some = data[: room[0]]
        room[0] -= len(some)
        return real_write(descriptor, some)

    for n in range(1, 101):
        writer.write(record(n))
    monkeypatch.setattr(os, "write", write)
    writer.flush()
    assert (writer.error, writer.written) == (errno.ENOSPC, 0)
    assert writer.blocked
    for n in range(101, 151):
        writer.write(record(n))
        writer.attend()
    assert writer.unwritten == 50
    room[0] = 10**9
    now += 2_000_000_000
    writer.attend()
    for n in range(151, 201):
        writer.write(record(n))
    assert writer.close()
    assert (writer.blocked, writer.error) == (False, errno.ENOSPC)  # it was, and is no longer
    assert (writer.written, writer.unwritten) == (150, 50)
    reader = read_log(path)
    assert [t.number for t in reader] == [*range(1, 101), *range(151, 201)]
    assert (reader.truncated, reader.missing) == (False, 50)
    told = [e for e in reader.events() if "gave up" in e.message]
    assert [e.message for e in told] == [f"gave up 50 records: {os.strerror(errno.ENOSPC)}"]


def test_dev_full_from_the_first_byte_is_survived() -> None:
    writer = LogWriter(os.open("/dev/full", os.O_WRONLY), header())
    for n in range(1, 200):
        writer.write(record(n))
        writer.flush()
    assert not writer.close()
    assert (writer.written, writer.unwritten, writer.error) == (0, 199, errno.ENOSPC)


@pytest.mark.parametrize("frame", [Frame(5, 1 << 32, b""), Frame(5, 1, bytes(65)), Frame(1 << 70, 1, b"")])
def test_an_unfit_record_is_told_and_harms_no_other(tmp_path: Path, frame: Frame) -> None:
    ring = Ring.create(slots=64)
    child = start_recorder(ring, create_log(tmp_path / "x.mcap"), header())
    good = [record(n)._replace(frames=(Frame(n, 0x181, b"x"),)) for n in (1, 2, 4, 5)]
    unfit = record(3)._replace(frames=(Frame(3, 0x181, b"x"), frame))
    for r in (*good[:2], unfit, *good[2:]):
        ring.put(r)
    ring.set_closed()
    assert ended(child) == 1
    assert (ring.status().written, ring.status().unwritten) == (4, 1)
    log = read_log(tmp_path / "x.mcap")
    assert [t.record for t in log] == good
    assert (log.missing, log.truncated) == (1, False)
    assert [e.message for e in log.events() if e.message.startswith("unfit record")]


def test_an_existing_file_is_refused_before_the_fork(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(LogError, match="never overwritten"):
        start_recorder(Ring.create(slots=16), create_log(path), header())
    assert path.read_bytes() == b"precious"


def test_the_recorder_holds_none_of_its_parents_files(tmp_path: Path) -> None:
    read_end, write_end = os.pipe()
    ring = Ring.create(slots=16)
    child = start_recorder(ring, create_log(tmp_path / "x.mcap"), header())
    os.close(write_end)
    until(lambda: ring.status().heartbeat > 0)
    assert os.read(read_end, 1) == b""  # would wait for ever if the recorder still held the other end
    os.close(read_end)
    ring.set_closed()
    assert ended(child) == 0


def told(path: Path, ticks: list[Tick]) -> list[tuple[Level, str, str]]:
    write_log(path, [Record(t, NO_TIME, (), 0, (), 0.0) for t in ticks])
    return [(e.level, e.name, e.message) for e in read_log(path).events()]


def test_events_tell_states_requests_and_faults(tmp_path: Path) -> None:
    t = [tick_at(n * 1_000_000, State.DISARMED) for n in range(1, 8)]
    t[0] = t[0]._replace(state=int(State.WAITING), present=1)
    t[1] = t[1]._replace(request=Request(int(RequestKind.ARM)))
    t[2] = t[2]._replace(state=int(State.TRACKING))
    t[3] = t[3]._replace(state=int(State.FAULT), present=2, latched=2)
    t[4] = t[4]._replace(state=int(State.FAULT), latched=2)
    t[5] = t[5]._replace(state=int(State.FAULT), present=1 << 40, latched=2)
    t[6] = t[6]._replace(request=Request(int(RequestKind.GOTO), (2.5, 0.0)), present=1 << 40, answer=3)
    assert told(tmp_path / "x.mcap", t) == [
        (Level.INFO, "state", "waiting"),
        (Level.WARNING, "fault", f"{FAULTS[0]} present"),
        (Level.INFO, "request", "arm"),
        (Level.INFO, "state", "waiting → disarmed"),
        (Level.INFO, "fault", f"{FAULTS[0]} gone"),
        (Level.INFO, "state", "disarmed → tracking"),
        (Level.ERROR, "state", "tracking → fault"),
        (Level.ERROR, "fault", f"{FAULTS[1]} latched"),
        (Level.INFO, "fault", f"{FAULTS[1]} gone"),
        (Level.WARNING, "fault", "fault 40 present"),
        (Level.WARNING, "request", "goto 2.5 0: blocked"),
        (Level.INFO, "state", "fault → disarmed"),
        (Level.INFO, "fault", f"{FAULTS[1]} cleared"),
    ]


def test_events_tell_when_the_load_begins_to_hunt_and_when_it_ends(tmp_path: Path) -> None:
    t = [tick_at(n * 1_000_000)._replace(hunting=n // 4 % 2 * 3) for n in range(1, 12)]
    assert told(tmp_path / "x.mcap", t)[1:] == [
        (Level.WARNING, "hunting", "friction: check control.friction, valve.dead_zone_v"),
        (Level.INFO, "hunting", "over"),
    ]


def test_events_that_repeat_are_held_back_and_counted(tmp_path: Path) -> None:
    ticks = []
    for n in range(2500):
        tick = tick_at(n * 1_000_000)
        tick = tick._replace(
            command=tick.command._replace(saturated=n % 2),
            measurement=tick.measurement._replace(skipped=1),
        )
        ticks.append(tick)
    events = told(tmp_path / "x.mcap", ticks)
    assert len(events) < 15
    assert (Level.WARNING, "loop", "skipped 1 ticks (999 more since the last message)") in events
    assert any(name == "output" and "saturated (499 more" in words for _, name, words in events)


def test_stamps_in_the_file_are_unix_time(tmp_path: Path) -> None:
    offset = wire.realtime_offset_ns()
    assert abs(time.monotonic_ns() + offset - time.time_ns()) < 10**9
    path = tmp_path / "x.mcap"
    with_frame = record(1)._replace(frames=(Frame(1_400_000, 0x181, b"x"),))
    writer = LogWriter(create_log(path), header()._replace(realtime_offset_ns=offset))
    writer.write(with_frame)
    writer.close()
    (tick,) = read_log(path)
    assert tick.log_time_ns == tick.t_ns + offset
    assert tick.frames == with_frame.frames
