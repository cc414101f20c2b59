from __future__ import annotations

import hashlib
import json
import math
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, unknown_fields
from hypothesis import given, settings
from hypothesis import strategies as st

from log_samples import any_record, bits, noisy, tick_at, write_log
from pneud.log.format.frames import FrameBlock, FramesPacker
from pneud.log.format.header import Detail
from pneud.log.format.meanings import SCHEMA
from pneud.log.format.record_layout import NUMBERS, numbers_of
from pneud.log.format.records import (
    COARSE,
    LoggedEvent,
    LoggedTick,
    Packer,
    TickMessage,
    crc_of,
    pack_event,
    unpack,
    unpack_event,
    varint,
)
from pneud.log.format.rows import RowPacker, Rows
from pneud.log.format.schema import Level, message_class, topics
from pneud.signals import (
    Command,
    Estimate,
    Frame,
    Measurement,
    Record,
    Reference,
    Request,
    RequestKind,
    Station,
    Timing,
)

NAMES: dict[Detail, str] = {"compact": "pneud.Tick", "full": "pneud.FullTick"}
PARTS = (Measurement, Estimate, Reference, Command, Timing)


def as_float32(value: float) -> float:
    try:
        return float(struct.unpack("<f", struct.pack("<f", value))[0])
    except OverflowError:
        return math.copysign(math.inf, value)


def reals(parsed: Any, of: Any) -> tuple[Any, ...]:
    return tuple(getattr(parsed, name) for name in of._fields)


def cut(value: float) -> float:
    (word,) = struct.unpack("<I", struct.pack("<f", value))
    return float(struct.unpack("<f", struct.pack("<I", word & 0xFFFFFF00))[0])


def kept(name: str, value: Any, detail: Detail) -> Any:
    if detail == "full" or not isinstance(value, float):
        return value
    return cut(as_float32(value)) if name in COARSE else as_float32(value)


def rounded(values: Any, detail: Detail) -> tuple[Any, ...]:
    part = type(values).__name__.lower()
    named = zip(values._fields, values, strict=True)
    return tuple(kept(f"{part}.{name}", v, detail) for name, v in named)


def same(got: tuple[Any, ...], expected: tuple[Any, ...]) -> bool:
    """Equal to the bit, but that a NaN may lose its payload on the way through 32 bits."""
    return all(
        (math.isnan(a) and math.isnan(b)) if isinstance(b, float) and math.isnan(b) else bits(a) == bits(b)
        for a, b in zip(got, expected, strict=True)
    )


@pytest.mark.parametrize("detail", ["compact", "full"])
@given(record=any_record())
@settings(max_examples=30, deadline=None)
def test_what_is_packed_by_struct_is_what_protobuf_parses(detail: Detail, record: Record) -> None:
    packer = Packer(detail)
    packed = packer.tick(record)
    parsed = message_class(NAMES[detail]).FromString(packed)
    tick = record.tick
    for name in ("t_ns", "state", "answer", "in_position", "hunting"):
        assert getattr(parsed, name) == getattr(tick, name)
    for name in ("present", "latched"):
        assert getattr(parsed, name) | getattr(parsed, f"{name}_more") << 63 == getattr(tick, name)
    for of, values in zip(
        PARTS,
        (tick.measurement, tick.estimate, tick.reference, tick.command, record.timing),
        strict=True,
    ):
        assert same(reals(getattr(parsed, of.__name__.lower()), of), rounded(values, detail))
    if tick.request is None:
        assert parsed.request.kind == 0
    else:
        assert same((parsed.request.kind, *parsed.request.values), (tick.request.kind, *tick.request.values))
    assert same((parsed.truth_m,), (kept("truth_m", record.truth_m, detail),))
    assert parsed.check == crc_of(tick)
    assert not unknown_fields.UnknownFieldSet(parsed)


def packed_frames(records: list[Record]) -> bytes:
    packer = FramesPacker()
    for record in records:
        packer.add(record)
    return packer.take()


@given(records=st.lists(any_record(), max_size=5))
@settings(max_examples=30, deadline=None)
def test_frames_come_back_from_their_columns(records: list[Record]) -> None:
    block = FrameBlock(packed_frames(records))
    assert list(block.ticks(r.tick.t_ns for r in records)) == [(r.frames, r.before, r.sent) for r in records]


def test_columns_lie_as_the_schema_says() -> None:
    frames = (Frame(1_000_258, 0x181, b"ab"), Frame(999_999, 0x182, b"c"), Frame(1_000_003, 0x181, b"de"))
    record = Record(tick_at(1_000_000), Timing(0, 0, 0, 0, 0, 0), frames[:2], 1, frames[2:], 0.0)
    message = message_class("pneud.Frames").FromString(packed_frames([record]))
    assert (message.received, message.before, message.sent, message.order) == ([2], [1], [1], [0, 1, 0])
    first, second = message.columns
    assert (first.can_id, first.length, first.data) == (0x181, 2, b"adbe")
    assert first.stamp_after_t_ns == bytes((2, 3, 1)) + bytes(13)
    assert (second.can_id, second.length, second.data) == (0x182, 1, b"c")
    assert second.stamp_after_t_ns == b"\xff" * 8


@pytest.mark.parametrize(
    "wrong",
    [
        {"received": [2]},
        {"sent": []},
        {"order": [3]},
        {"columns": [{"can_id": 1, "length": 1, "stamp_after_t_ns": bytes(8), "data": b"too long"}]},
        {"columns": [{"can_id": 1, "length": 65, "stamp_after_t_ns": bytes(8), "data": bytes(65)}]},
        {"columns": [{"can_id": 1, "length": 1, "stamp_after_t_ns": b"", "data": b"x"}]},
    ],
)
def test_columns_that_do_not_fit_together_are_refused(wrong: dict[str, Any]) -> None:
    column = {"can_id": 1, "length": 1, "stamp_after_t_ns": bytes(8), "data": b"x"}
    right = {"received": [1], "before": [0], "sent": [0], "order": [0], "columns": [column]}
    frames = message_class("pneud.Frames")
    assert len(list(FrameBlock(frames(**right).SerializeToString()).ticks([0]))) == 1
    with pytest.raises(ValueError):
        list(FrameBlock(frames(**{**right, **wrong}).SerializeToString()).ticks([0]))


def logged(record: Record, name: str, tick: bytes) -> LoggedTick:
    (found,) = unpack([TickMessage(5, 6, name, tick)], FrameBlock(packed_frames([record])))
    return found


@given(record=any_record())
@settings(max_examples=30, deadline=None)
def test_full_detail_comes_back_to_the_bit(record: Record) -> None:
    found = logged(record, "pneud.FullTick", Packer("full").tick(record))
    assert bits(found.record) == bits(record)
    assert found.check == crc_of(record.tick)
    assert (found.skipped, found.host) == (record.tick.measurement.skipped, record.tick.measurement.host)


@pytest.mark.parametrize("request_too", [False, True])
@pytest.mark.parametrize("station", [(0, 0, 0), (3, 5, 1), (127, 127, 5), (128, 1, 1), (1, 2**31, 5)])
def test_a_tick_with_inputs_comes_back_however_many_there_are(
    station: tuple[int, int, int], request_too: bool
) -> None:
    (record,) = noisy(1)
    asked = Request(RequestKind.ARM, (1.0,)) if request_too else None
    record = record._replace(tick=record.tick._replace(request=asked, station=Station(*station)))
    assert bits(logged(record, "pneud.FullTick", Packer("full").tick(record)).record) == bits(record)
    assert logged(record, "pneud.Tick", Packer("compact").tick(record)).station == station


@given(record=any_record(), detail=st.sampled_from(["compact", "full"]))
@settings(max_examples=20, deadline=None)
def test_a_message_written_anew_by_protobuf_reads_the_same(record: Record, detail: Detail) -> None:
    name, tick = NAMES[detail], Packer(detail).tick(record)
    anew = message_class(name).FromString(tick).SerializeToString()
    assert bits(logged(record, name, anew)) == bits(logged(record, name, tick))


@given(record=any_record(), detail=st.sampled_from(["compact", "full"]))
@settings(max_examples=10, deadline=None)
def test_a_message_of_schema_2_reads_as_it_was(record: Record, detail: Detail) -> None:
    name, tick = NAMES[detail], Packer(detail).tick(record)
    former = message_class(name).FromString(tick)
    former.ClearField("in_position")
    former.ClearField("hunting")
    for name_since in ("told", "present_more", "latched_more", "program", "station", "weighed"):
        former.ClearField(name_since)
    assert [f.number for f, _ in former.ListFields()] == sorted(
        f.number for f, _ in former.ListFields() if f.number <= 13
    )
    wanted = logged(record, name, tick)._replace(in_position=0, hunting=0)
    low = (1 << 63) - 1
    wanted = wanted._replace(present=wanted.present & low, latched=wanted.latched & low)
    wanted = wanted._replace(told=None, program=None, station=None, weighed=None)
    found = logged(record, name, former.SerializeToString())
    assert bits(found._replace(fault_names=())) == bits(wanted._replace(fault_names=()))


@given(st.integers(0, 2**64 - 1))
def test_varints(unsigned: int) -> None:
    n, shift = 0, 0
    for byte in varint(unsigned):
        n |= (byte & 0x7F) << shift
        shift += 7
    assert n == unsigned


def test_the_check_is_the_crc_of_the_doubles_in_order() -> None:
    tick = tick_at(1)
    e, r, c = tick.estimate, tick.reference, tick.command
    doubles = struct.pack("<16d", *e, *r, c.voltage_v, c.law_v, c.s, c.ustar)
    assert crc_of(tick) == zlib.crc32(doubles)
    for part in ("estimate", "reference"):
        for i, value in enumerate(getattr(tick, part)):
            field = getattr(tick, part)._fields[i]
            nudged = getattr(tick, part)._replace(**{field: math.nextafter(value, 1e9)})
            assert crc_of(tick._replace(**{part: nudged})) != crc_of(tick), field


def test_a_double_beyond_the_floats_becomes_infinite_in_a_compact_log() -> None:
    tick = tick_at(1)
    record = Record(
        tick._replace(estimate=tick.estimate._replace(force_n=-1e300, x3_n=3.4e38)),
        Timing(0, 0, 0, 0, 0, 0), (), 0, (), 0.0,
    )  # fmt: skip
    parsed = message_class("pneud.Tick").FromString(Packer("compact").tick(record))
    assert parsed.estimate.force_n == -math.inf
    assert parsed.estimate.x3_n == cut(3.4e38)
    assert parsed.estimate.position_m == as_float32(tick.estimate.position_m)


def test_events() -> None:
    event = LoggedEvent(1_700_000_000_123_456_789, Level.ERROR, "fault", "over_travel latched")
    parsed = message_class("foxglove.Log").FromString(pack_event(event))
    assert (parsed.timestamp.seconds, parsed.timestamp.nanos) == (1_700_000_000, 123_456_789)
    assert (parsed.level, parsed.name, parsed.message, parsed.file, parsed.line) == (
        4, "fault", "over_travel latched", "", 0,
    )  # fmt: skip
    assert unpack_event(event.log_time_ns, pack_event(event)) == event


@pytest.mark.parametrize("detail", ["compact", "full"])
def test_each_topic_carries_a_schema_that_stands_alone(detail: Detail) -> None:
    for topic in topics(detail):
        if topic.schema_encoding == "jsonschema":
            assert json.loads(topic.descriptors)["type"] == "object"
            continue
        pool = descriptor_pool.DescriptorPool()
        for file in descriptor_pb2.FileDescriptorSet.FromString(topic.descriptors).file:
            pool.Add(file)
        assert message_factory.GetMessageClass(pool.FindMessageTypeByName(topic.schema)) is not None


def test_the_schema_number_belongs_to_the_schema() -> None:
    """Whoever changes the messages raises SCHEMA and writes the new digest here."""
    digest = hashlib.sha256(b"".join(t.descriptors for d in NAMES for t in topics(d))).hexdigest()[:16]
    assert (SCHEMA, digest) == (7, "c3a8e6153d8b3585")


def test_an_hour_takes_the_space_that_is_documented(tmp_path: Path) -> None:
    records = list(noisy(5000))
    sizes = {}
    for detail in NAMES:
        path, head = tmp_path / f"{detail}.mcap", tmp_path / f"{detail}-head.mcap"
        write_log(path, records, detail)
        write_log(head, records[:1], detail)  # which an hour has but once
        sizes[detail] = (path.stat().st_size - head.stat().st_size) / len(records) * 3.6e6 / 1e9
    assert sizes["compact"] < 0.6
    assert sizes["full"] < 1.1


@pytest.mark.parametrize("detail", ["compact", "full"])
@given(record=any_record())
@settings(max_examples=20, deadline=None)
def test_ticks_by_columns_are_packed_as_each_by_itself(detail: Detail, record: Record) -> None:
    only: dict[str, Any] = {"request": None, "told": None, "program": None, "station": None, "weighed": None}
    low: dict[str, Any] = {name: getattr(record.tick, name) % (1 << 63) for name in ("present", "latched")}
    record = record._replace(tick=record.tick._replace(**only, **low))
    formats = [(name, "f8" if code == "d" else "i8") for name, code in NUMBERS.items()]
    ticks = np.array([numbers_of(record)] * 3, dtype=formats)
    rows = Rows(ticks, record.timing, (), 0, ())
    single = Packer(detail).tick(record)
    for message in RowPacker(detail).messages(rows):
        assert message.tobytes() == single
    assert repr(rows.record(1)) == repr(record._replace(frames=(), before=0, sent=()))
