from __future__ import annotations

import hashlib
import math
import struct
import zlib
from pathlib import Path
from typing import Any

import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, unknown_fields
from hypothesis import given, settings
from hypothesis import strategies as st

from log_samples import any_record, bits, noisy, tick_at, write_log
from pneud.log.header import Detail
from pneud.log.records import LoggedEvent, Packer, crc_of, pack_event, unpack, unpack_event, varint, zigzag
from pneud.log.schema import SCHEMA, Level, message_class, topics
from pneud.signals import Command, Estimate, Frame, Measurement, Record, Reference, Timing

NAMES: dict[Detail, str] = {"compact": "pneud.Tick", "full": "pneud.FullTick"}
PARTS = (Measurement, Estimate, Reference, Command)


def as_float32(value: float) -> float:
    try:
        return float(struct.unpack("<f", struct.pack("<f", value))[0])
    except OverflowError:
        return math.copysign(math.inf, value)


def reals(parsed: Any, of: Any) -> tuple[Any, ...]:
    return tuple(getattr(parsed, name) for name in of._fields)


def rounded(values: tuple[Any, ...], detail: Detail) -> tuple[Any, ...]:
    return tuple(as_float32(v) if detail == "compact" and isinstance(v, float) else v for v in values)


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
    assert (parsed.t_ns, parsed.state, parsed.present, parsed.latched, parsed.answer) == (
        tick.t_ns,
        tick.state,
        tick.present,
        tick.latched,
        tick.answer,
    )
    for of, values in zip(
        PARTS, (tick.measurement, tick.estimate, tick.reference, tick.command), strict=True
    ):
        assert same(reals(getattr(parsed, of.__name__.lower()), of), rounded(values, detail))
    if tick.request is None:
        assert parsed.request.kind == 0
    else:
        assert same((parsed.request.kind, *parsed.request.values), (tick.request.kind, *tick.request.values))
    assert same((parsed.truth_m,), rounded((record.truth_m,), detail))
    assert parsed.check == crc_of(tick)
    assert not unknown_fields.UnknownFieldSet(parsed)


@given(record=any_record())
@settings(max_examples=30, deadline=None)
def test_frames_and_timing_are_what_protobuf_parses(record: Record) -> None:
    packer = Packer("compact")
    frames = message_class("pneud.Frames").FromString(packer.frames(record))
    t_ns = record.tick.t_ns

    def back(parsed: Any) -> tuple[Frame, ...]:
        return tuple(Frame(t_ns + f.stamp_after_t_ns, f.can_id, f.data) for f in parsed)

    assert frames.t_ns == t_ns
    assert back(frames.received) == record.frames
    assert back(frames.sent) == record.sent
    assert frames.before == record.before
    timing = message_class("pneud.Timing").FromString(packer.timing(record))
    assert reals(timing, Timing) == record.timing


@given(record=any_record())
@settings(max_examples=30, deadline=None)
def test_full_detail_comes_back_to_the_bit(record: Record) -> None:
    packer = Packer("full")
    messages = packer.tick(record), packer.frames(record), packer.timing(record)
    logged = unpack(5, 6, "pneud.FullTick", *messages)
    assert bits(logged.record) == bits(record)
    assert logged.check == crc_of(record.tick)
    assert (logged.skipped, logged.host) == (record.tick.measurement.skipped, record.tick.measurement.host)


@given(record=any_record(), detail=st.sampled_from(["compact", "full"]))
@settings(max_examples=20, deadline=None)
def test_a_message_written_anew_by_protobuf_reads_the_same(record: Record, detail: Detail) -> None:
    packer, name = Packer(detail), NAMES[detail]
    tick, rest = packer.tick(record), (packer.frames(record), packer.timing(record))
    anew = message_class(name).FromString(tick).SerializeToString()
    assert bits(unpack(1, 2, name, anew, *rest)) == bits(unpack(1, 2, name, tick, *rest))


@given(st.integers(0, 2**64 - 1), st.integers(-(2**63), 2**63 - 1))
def test_varints(unsigned: int, signed: int) -> None:
    timing = message_class("pneud.Timing").FromString(b"\x08" + zigzag(signed))
    assert timing.lateness_ns == signed
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
    assert parsed.estimate.x3_n == as_float32(3.4e38)
    assert parsed.estimate.velocity_m_s == as_float32(tick.estimate.velocity_m_s)


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
        pool = descriptor_pool.DescriptorPool()
        for file in descriptor_pb2.FileDescriptorSet.FromString(topic.descriptors).file:
            pool.Add(file)
        assert message_factory.GetMessageClass(pool.FindMessageTypeByName(topic.schema)) is not None


def test_the_schema_number_belongs_to_the_schema() -> None:
    """Whoever changes the messages raises SCHEMA and writes the new digest here."""
    digest = hashlib.sha256(b"".join(t.descriptors for d in NAMES for t in topics(d))).hexdigest()[:16]
    assert (SCHEMA, digest) == (2, "42bc553dd9cbc91c")


def test_an_hour_takes_the_space_that_is_documented(tmp_path: Path) -> None:
    records = list(noisy(1500))
    sizes = {}
    for detail in NAMES:
        path = tmp_path / f"{detail}.mcap"
        write_log(path, records, detail)
        sizes[detail] = path.stat().st_size / len(records) * 3.6e6 / 1e9
    assert sizes["compact"] < 1.0
    assert sizes["full"] < 1.5
