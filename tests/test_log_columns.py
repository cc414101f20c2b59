"""Blocks of columns say the same as the ticks one by one."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from log_samples import any_record, noisy, write_log
from pneud.bus.codec import Answer, Codec
from pneud.bus.dbc_layout import Guard, SignalField, compile_functions
from pneud.log.files import columns
from pneud.log.files.columns import AFTER, BEFORE, SENT, blocks
from pneud.log.files.reader import LogReader, RawBatch, RowBatch, read_log
from pneud.log.files.stretches import TickRows
from pneud.log.format.header import Detail
from pneud.log.format.records import LoggedTick
from pneud.log.format.schema import message_class
from pneud.report.health import SourceHealth
from pneud.signals import Frame, Record, Request, RequestKind


def same(one: Any, other: Any) -> bool:
    return bool(one == other) or (one != one and other != other)


def check(block: columns.Block, ticks: list[LoggedTick]) -> None:
    place = 0
    requests = dict(block.requests)
    for i, tick in enumerate(ticks):
        assert block.number[i] == tick.number
        assert block.log_time_ns[i] == tick.log_time_ns
        assert requests.get(i) == tick.request or same(repr(requests.get(i)), repr(tick.request))
        for name in ("present", "latched"):
            assert sum(int(words[i]) << first for first, words in block.faults(name)) == getattr(tick, name)
        for name in set(block.ticks.dtype.names or ()) - {"present", "latched"}:
            group, _, field = name.rpartition(".")
            value = getattr(getattr(tick, group) if group else tick, field)
            assert same(block.ticks[name][i].item(), value), name
        for order, frame in enumerate((*tick.frames, *tick.sent)):
            part = BEFORE if order < tick.before else AFTER
            found = tuple(int(column[place]) for column in block.frames)
            word = int.from_bytes(frame.data[:8], "little")
            assert block.long.get(place) == (frame.data if len(frame.data) > 8 else None)
            expected = (i, frame.stamp_ns, frame.can_id, len(frame.data), word)
            assert found == (*expected, SENT if order >= len(tick.frames) else part)
            place += 1
    assert place == len(block.frames.tick)


@pytest.mark.parametrize("detail", ["compact", "full"])
def test_blocks_are_the_ticks(tmp_path: Path, detail: Detail) -> None:
    records = list(noisy(60))
    request = Request(int(RequestKind.ARM), (1.0,))
    records[7] = records[7]._replace(tick=records[7].tick._replace(request=request))
    write_log(tmp_path / "x.mcap", records, detail, per_chunk=15)
    log = read_log(tmp_path / "x.mcap")
    found = list(blocks(log, 25))
    ticks = list(log)
    assert [len(b.number) for b in found] == [30, 30]
    for number, block in enumerate(found):
        check(block, ticks[30 * number : 30 * number + 30])
    assert [b.requests for b in found] == [((7, request),), ()]
    assert [e for b in found for e in b.events] == list(log.events())


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(records=st.lists(any_record(), min_size=1, max_size=4))
def test_any_record(tmp_path: Path, records: list[Record]) -> None:
    path = tmp_path / "x.mcap"
    path.unlink(missing_ok=True)
    write_log(path, records)
    log = read_log(path)
    found, ticks = list(blocks(log)), list(log)
    if ticks:
        check(found[0], ticks)


def test_messages_in_another_order_of_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A tool that wrote the messages anew may leave out zeros and order the fields as it likes."""
    write_log(tmp_path / "x.mcap", list(noisy(20)))
    log = read_log(tmp_path / "x.mcap")
    ticks = list(log)

    def turned(name: str, data: bytes) -> bytes:
        message = message_class(name).FromString(data)
        first = type(message)()
        descriptor = message.DESCRIPTOR.fields[-2 if name == "pneud.FullTick" else -1]
        rest = type(message)()
        for field, value in message.ListFields():
            target = first if field.number == descriptor.number else rest
            if hasattr(value, "extend"):
                getattr(target, field.name).extend(value)
            elif field.message_type is not None:
                getattr(target, field.name).CopyFrom(value)
            else:
                setattr(target, field.name, value)
        joined: bytes = first.SerializeToString() + rest.SerializeToString()
        return joined

    (raw,) = (r for r in log.raw() if isinstance(r, RawBatch))
    ticks_anew = [
        tick._replace(data=turned("pneud.FullTick", tick.data)) if tick.number % 3 == 0 else tick
        for tick in raw.ticks
    ]
    runs = [
        TickRows(
            np.array([tick.number]),
            np.array([tick.log_time_ns]),
            tick.schema,
            np.frombuffer(tick.data, np.uint8).reshape(1, -1),
        )
        for tick in ticks_anew
    ]
    anew = RowBatch(runs, turned("pneud.Frames", raw.frames))
    monkeypatch.setattr(LogReader, "rows", lambda _: [anew])
    (block,) = blocks(log)
    check(block, ticks)


def test_a_damaged_record_ends_the_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_log(tmp_path / "x.mcap", list(noisy(6)), per_chunk=2)
    log = read_log(tmp_path / "x.mcap")
    raws = [raw for raw in log.rows() if isinstance(raw, RowBatch)]
    raws[2] = raws[2]._replace(frames=b"\xff\xff")
    monkeypatch.setattr(LogReader, "rows", lambda _: raws)
    found = list(blocks(log, 2))
    assert [len(b.number) for b in found] == [2, 2]
    assert log.truncated
    assert "record 5" in log.damage


def test_reals_are_doubles(tmp_path: Path) -> None:
    write_log(tmp_path / "x.mcap", list(noisy(5)), "compact")
    (block,) = blocks(read_log(tmp_path / "x.mcap"))
    force = block.real("estimate.force_n")
    assert force.dtype == float
    assert all(math.isfinite(x) for x in force)
    assert all(a < b for a, b in pairwise(block.ticks["t_ns"].tolist()))


def test_frames_of_can_fd_have_all_their_bytes(tmp_path: Path) -> None:
    records = list(noisy(30))
    for i in (3, 4, 17):
        long = Frame(records[i].tick.t_ns, 0x333, bytes(range(i, i + 48)))
        records[i] = records[i]._replace(frames=(long, *records[i].frames))
    write_log(tmp_path / "x.mcap", records, per_chunk=5)
    (block,) = blocks(read_log(tmp_path / "x.mcap"))
    ticks = list(read_log(tmp_path / "x.mcap"))
    check(block, ticks)
    part = block.part(4, 20)
    assert [part.long[i][:2] for i in sorted(part.long)] == [b"\x04\x05", b"\x11\x12"]
    assert all(part.frames.length[i] == 48 for i in part.long)


def test_frames_that_nobody_wants_are_left_out(tmp_path: Path) -> None:
    write_log(tmp_path / "x.mcap", list(noisy(30)))
    (some,), (all_,) = (list(blocks(read_log(tmp_path / "x.mcap"), frames=on)) for on in (False, True))
    assert len(some.frames.tick) == 0 < len(all_.frames.tick)
    assert (some.ticks == all_.ticks).all()


@pytest.mark.parametrize("big_endian", [False, True])
def test_messages_of_can_fd_are_judged_by_all_of_their_bytes(tmp_path: Path, big_endian: bool) -> None:
    start = 8 * 40 + (7 if big_endian else 0)  # behind what fits into a word
    counter = SignalField("M.Counter", start, 8, big_endian, False, True, 1.0, 0.0, 0, 255)
    guard = Guard(counter_values=256)
    made = compile_functions(0x333, 48, [], [], counter, guard)
    codec = Codec(0x333, 48, 256, *made, counter, None, guard)
    source = SourceHealth(Answer("station", codec, (), ("position_m",)), math.inf)
    records = list(noisy(30))
    for i, record in enumerate(records):
        count = i if i < 10 else i + 2  # two are missing before the eleventh
        data = codec.encode(counter=count) if i != 20 else codec.encode(counter=count)[:32]
        frame = Frame(record.tick.t_ns + 1000, 0x333, data)
        records[i] = record._replace(frames=(frame,) if i != 5 else (frame, frame))
    write_log(tmp_path / "x.mcap", records)
    (block,) = blocks(read_log(tmp_path / "x.mcap"))
    never = np.full(30, -1)
    source.add(block, never, never, True)
    assert (source.frames, source.corrupt, source.frozen, source.lost) == (31, 1, 1, 2)
