"""One tick as protobuf messages, packed by `struct` with the tag bytes baked in, and back again.

A request, which few ticks have, follows what all have.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from operator import attrgetter
from typing import Any, NamedTuple

from google.protobuf.descriptor_pb2 import FieldDescriptorProto as F

from pneud.log.format.frames import FrameBlock
from pneud.log.format.header import Detail
from pneud.log.format.schema import Field, Level, message_class, tick_fields
from pneud.signals import Command, Estimate, Frame, Measurement, Record, Reference, Request, Tick, Timing

_CHECKED = struct.Struct("<8d4d4d")
_CODES = {
    F.TYPE_FLOAT: (5, "f"),
    F.TYPE_DOUBLE: (1, "d"),
    F.TYPE_FIXED32: (5, "I"),
    F.TYPE_FIXED64: (1, "Q"),
    F.TYPE_SFIXED64: (1, "q"),
    F.TYPE_ENUM: (0, "B"),  # below 128, hence one byte
}
_REQUEST = len(tick_fields("compact")[1])  # number of its field
_SHORT = [bytes((i,)) for i in range(128)]
_measurement = attrgetter(*Measurement._fields)
_estimate = attrgetter(*Estimate._fields)
_reference = attrgetter(*Reference._fields)
_command = attrgetter(*Command._fields)
_timing = attrgetter(*Timing._fields)

# Where the parts of a tick's values begin.
_E = 1 + len(Measurement._fields)
_R = _E + len(Estimate._fields)
_C = _R + len(Reference._fields)
_T = _C + len(Command._fields)
_S = _T + len(Timing._fields)

# Of these a compact log keeps 16 significant bits in place of 24, since nobody needs more and the others are
# noise, which cannot be compressed: the lowest byte is zero.
COARSE = frozenset((
    *(name for name in Estimate._fields + Reference._fields if name != "position_m"),
    *("law_v", "s", "ustar"),
))  # fmt: skip
COARSE_ERROR = 2.0**-15  # relative
FLOAT_ERROR = 2.0**-24


def crc_of(tick: Tick) -> int:
    """CRC-32 over the doubles of estimate, reference and command, in their order, little-endian.

    It stands in every record, so that a replay can be compared to the bit with a log that keeps only floats.
    """
    voltage_v, _, _, law_v, s, ustar = tick.command
    return zlib.crc32(_CHECKED.pack(*tick.estimate, *tick.reference, voltage_v, law_v, s, ustar))


def varint(n: int) -> bytes:
    """A non-negative integer as protobuf writes it."""
    if n < 0x80:
        return _SHORT[n]
    if n < 0x4000:
        return bytes((n & 0x7F | 0x80, n >> 7))
    if n < 0x20_0000:
        return bytes((n & 0x7F | 0x80, n >> 7 & 0x7F | 0x80, n >> 14))
    return bytes((n & 0x7F | 0x80,)) + varint(n >> 7)


class TickLayout:
    """A message of fixed length as one `struct`; tags and lengths are put in as bits of one integer."""

    def __init__(self, detail: Detail) -> None:
        name, fields, nested = tick_fields(detail)
        self._class = message_class(f"pneud.{name}")
        codes: list[str] = []
        found: list[tuple[str, bytes, str]] = []
        layout, tags, constants, kept = "<", b"", b"", b""
        pending = b""

        def walk(fields: list[Field], group: str = "") -> None:
            nonlocal layout, tags, constants, kept, pending
            for number, field in enumerate(fields, start=1):
                if field.type == F.TYPE_MESSAGE:
                    inner = nested[field.of.rpartition(".")[2]]
                    pending += varint(number << 3 | 2) + varint(_size(inner))
                    walk(inner, f"{field.name}.")
                    continue
                wire, code = _CODES[field.type]
                pending += varint(number << 3 | wire)
                layout += f"{len(pending)}x{code}"
                width = struct.calcsize("<" + code)
                tags += b"\xff" * len(pending) + bytes(width)
                constants += pending + bytes(width)
                coarse = code == "f" and field.name in COARSE
                kept += bytes(len(pending) + coarse) + b"\xff" * (width - coarse)
                codes.append(code)
                found.append((group + field.name, pending, code))
                pending = b""

        walk(fields[:-1])
        self._struct = struct.Struct(layout)
        self._codes = tuple(codes)
        # name (such as estimate.force_n), constant bytes before it and `struct` code of each value, in order
        self.parts = tuple(found)
        self._tags, self._constants, self._kept = (
            int.from_bytes(mask, "little") for mask in (tags, constants, kept)
        )

    def pack(self, values: tuple[float, ...]) -> bytes:
        """The message without a request."""
        try:
            packed = self._struct.pack(*values)
        except OverflowError:  # a double beyond the floats
            packed = self._struct.pack(
                *(_as_float(v) if code == "f" else v for code, v in zip(self._codes, values, strict=True))
            )
        bits = int.from_bytes(packed, "little") & self._kept | self._constants
        return bits.to_bytes(len(packed), "little")

    def unpack(self, data: bytes) -> tuple[Any, ...]:
        """The values in their order, and the request or None behind them."""
        if len(data) == self._struct.size and int.from_bytes(data, "little") & self._tags == self._constants:
            return (*self._struct.unpack(data), None)
        # With a request, or in another order of bytes, as a tool that wrote it anew may choose.
        t = self._class.FromString(data)
        return (
            t.t_ns,
            *_measurement(t.measurement),
            *_estimate(t.estimate),
            *_reference(t.reference),
            *_command(t.command),
            *_timing(t.timing),
            t.state,
            t.present,
            t.latched,
            t.answer,
            t.truth_m,
            t.check,
            Request(t.request.kind, tuple(t.request.values)) if t.request.kind else None,
        )


def _as_float(value: float) -> float:
    try:
        struct.pack("<f", value)
    except OverflowError:
        return math.copysign(math.inf, value)
    return value


def _size(fields: list[Field]) -> int:
    return sum(
        len(varint(number << 3)) + struct.calcsize("<" + _CODES[field.type][1])
        for number, field in enumerate(fields, start=1)
    )


LAYOUTS = {"pneud.Tick": TickLayout("compact"), "pneud.FullTick": TickLayout("full")}


def _request(request: Request) -> bytes:
    kind, values = request
    body = b"\x08" + varint(kind)
    if values:
        body += b"\x12" + varint(8 * len(values)) + struct.pack(f"<{len(values)}d", *values)
    return varint(_REQUEST << 3 | 2) + varint(len(body)) + body


class Packer:
    """Packs records at one level of detail."""

    def __init__(self, detail: Detail) -> None:
        self._layout = LAYOUTS["pneud.Tick" if detail == "compact" else "pneud.FullTick"]

    def tick(self, record: Record) -> bytes:
        """The message of `/axis/tick`."""
        tick = record.tick
        packed = self._layout.pack(
            (
                tick.t_ns,
                *tick.measurement,
                *tick.estimate,
                *tick.reference,
                *tick.command,
                *record.timing,
                tick.state,
                tick.present,
                tick.latched,
                tick.answer,
                record.truth_m,
                crc_of(tick),
            )
        )
        return packed if tick.request is None else packed + _request(tick.request)


_Log = message_class("foxglove.Log")


class LoggedEvent(NamedTuple):
    """A message of `/events`."""

    log_time_ns: int  # Unix
    level: Level
    name: str
    message: str


def pack_event(event: LoggedEvent) -> bytes:
    """The message of `/events`."""
    log = _Log(level=event.level, message=event.message, name=event.name)
    log.timestamp.seconds, log.timestamp.nanos = divmod(event.log_time_ns, 10**9)
    packed: bytes = log.SerializeToString()
    return packed


def unpack_event(log_time_ns: int, data: bytes) -> LoggedEvent:
    """An event as read."""
    log = _Log.FromString(data)
    return LoggedEvent(log_time_ns, Level(log.level), log.name, log.message)


class LoggedTick(NamedTuple):
    """One record as read. In a compact log its reals are floats of 32 bits; `check` is of the doubles."""

    number: int  # counts the records of the loop from 1; a gap is where records were dropped
    log_time_ns: int  # Unix
    t_ns: int
    measurement: Measurement
    request: Request | None
    estimate: Estimate
    reference: Reference
    command: Command
    state: int
    present: int
    latched: int
    answer: int
    check: int
    frames: tuple[Frame, ...]
    before: int
    sent: tuple[Frame, ...]
    timing: Timing
    truth_m: float

    @property
    def skipped(self) -> int:
        """Ticks skipped just before this one."""
        return self.measurement.skipped

    @property
    def host(self) -> int:
        """Bits of `Host`."""
        return self.measurement.host

    @property
    def record(self) -> Record:
        """The record as the loop handed it over (to the bit where the log's detail is full)."""
        tick = Tick(
            self.t_ns,
            self.measurement,
            self.request,
            self.estimate,
            self.reference,
            self.command,
            self.state,
            self.present,
            self.latched,
            self.answer,
        )
        return Record(tick, self.timing, self.frames, self.before, self.sent, self.truth_m)


class TickMessage(NamedTuple):
    """A message of `/axis/tick` as read."""

    number: int  # counts the records of the loop
    log_time_ns: int  # Unix
    schema: str  # name of the message, which tells the level of detail
    data: bytes


def unpack(ticks: list[TickMessage], frames: FrameBlock) -> Iterator[LoggedTick]:
    """Ticks and their frames, put together.

    Args:
        ticks: messages of `/axis/tick`.
        frames: of the same ticks.

    Raises:
        google.protobuf.message.DecodeError: not such messages.
        ValueError: not as many ticks as the frames are of.
    """
    values = [LAYOUTS[tick.schema].unpack(tick.data) for tick in ticks]
    parts = frames.ticks(v[0] for v in values)
    for (number, log_time_ns, _, _), v, (received, before, sent) in zip(ticks, values, parts, strict=True):
        state, present, latched, answer, truth_m, check, request = v[_S:]
        yield LoggedTick(
            number,
            log_time_ns,
            v[0],
            Measurement._make(v[1:_E]),
            request,
            Estimate._make(v[_E:_R]),
            Reference._make(v[_R:_C]),
            Command._make(v[_C:_T]),
            state,
            present,
            latched,
            answer,
            check,
            received,
            before,
            sent,
            Timing._make(v[_T:_S]),
            truth_m,
        )
