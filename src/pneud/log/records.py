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

from pneud.log.header import Detail
from pneud.log.schema import Field, Level, message_class, tick_fields
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
_S = _C + len(Command._fields)


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


def zigzag(n: int) -> bytes:
    """A signed integer as protobuf writes a `sint64`."""
    return varint(n << 1 if n >= 0 else (-n << 1) - 1)


class TickLayout:
    """A message of fixed length as one `struct`: constant bytes and values by turns."""

    def __init__(self, detail: Detail) -> None:
        name, fields, nested = tick_fields(detail)
        self._class = message_class(f"pneud.{name}")
        constants: list[bytes] = []
        codes: list[str] = []
        names: list[str] = []
        pending = b""

        def walk(fields: list[Field], group: str = "") -> None:
            nonlocal pending
            for number, field in enumerate(fields, start=1):
                if field.type == F.TYPE_MESSAGE:
                    inner = nested[field.of.rpartition(".")[2]]
                    pending += varint(number << 3 | 2) + varint(_size(inner))
                    walk(inner, f"{field.name}.")
                else:
                    wire, code = _CODES[field.type]
                    constants.append(pending + varint(number << 3 | wire))
                    codes.append(code)
                    names.append(group + field.name)
                    pending = b""

        walk(fields[:-1])
        self._struct = struct.Struct(
            "<" + "".join(f"{len(c)}s{v}" for c, v in zip(constants, codes, strict=True))
        )
        self._codes = tuple(codes)
        self._constants = tuple(constants)
        self.names = tuple(names)  # such as estimate.force_n
        self._template: list[bytes | float] = [b""] * (2 * len(codes))
        self._template[::2] = constants

    def pack(self, values: tuple[float, ...]) -> bytes:
        """The message without a request."""
        arguments = self._template.copy()
        arguments[1::2] = values
        try:
            return self._struct.pack(*arguments)
        except OverflowError:  # a double beyond the floats
            arguments[1::2] = [
                _as_float(value) if code == "f" else value
                for code, value in zip(self._codes, values, strict=True)
            ]
            return self._struct.pack(*arguments)

    def unpack(self, data: bytes) -> tuple[Any, ...]:
        """The values in their order, and the request or None behind them."""
        if len(data) == self._struct.size:
            items = self._struct.unpack(data)
            if items[::2] == self._constants:
                return (*items[1::2], None)
        # With a request, or in another order of bytes, as a tool that wrote it anew may choose.
        t = self._class.FromString(data)
        return (
            t.t_ns,
            *_measurement(t.measurement),
            *_estimate(t.estimate),
            *_reference(t.reference),
            *_command(t.command),
            t.state,
            t.present,
            t.latched,
            t.answer,
            t.truth_m,
            t.check,
            Request(t.request.kind, tuple(t.request.values)) if t.request.kind else None,
        )

    def parts(self) -> Iterator[tuple[str, bytes, str]]:
        """Name, constant bytes before it and `struct` code of each value, in their order."""
        return zip(self.names, self._constants, self._codes, strict=True)


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
        self._ids: dict[int, bytes] = {}

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
                tick.state,
                tick.present,
                tick.latched,
                tick.answer,
                record.truth_m,
                crc_of(tick),
            )
        )
        return packed if tick.request is None else packed + _request(tick.request)

    def frames(self, record: Record) -> bytes:
        """The message of `/can/frames`."""
        t_ns = record.tick.t_ns
        parts = [b"\x09", t_ns.to_bytes(8, "little", signed=True)]
        for frame in record.frames:
            parts += (b"\x12", self._frame(frame, t_ns))
        parts += (b"\x18", varint(record.before))
        for frame in record.sent:
            parts += (b"\x22", self._frame(frame, t_ns))
        return b"".join(parts)

    def _frame(self, frame: Frame, t_ns: int) -> bytes:
        stamp_ns, can_id, data = frame
        identifier = self._ids.get(can_id)
        if identifier is None:
            identifier = b"\x10" + varint(can_id) + b"\x1a"
            if len(self._ids) < 4096:
                self._ids[can_id] = identifier
        body = b"\x08" + zigzag(stamp_ns - t_ns) + identifier + _SHORT[len(data)] + data
        return _SHORT[len(body)] + body

    @staticmethod
    def timing(record: Record) -> bytes:
        """The message of `/loop/timing`."""
        a, b, c, d, e, f = record.timing
        return b"".join(
            (
                b"\x08",
                zigzag(a),
                b"\x10",
                zigzag(b),
                b"\x18",
                zigzag(c),
                b"\x20",
                zigzag(d),
                b"\x28",
                zigzag(e),
                b"\x30",
                zigzag(f),
            )
        )


_Log = message_class("foxglove.Log")
_Frames = message_class("pneud.Frames")
_Timing = message_class("pneud.Timing")


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


def unpack(
    number: int, log_time_ns: int, schema: str, tick: bytes, frames: bytes, timing: bytes
) -> LoggedTick:
    """The three messages of one tick, put together.

    Args:
        number: the messages' sequence number.
        log_time_ns: Unix time.
        schema: name of the tick's message, which tells the level of detail.
        tick: message of `/axis/tick`.
        frames: message of `/can/frames`.
        timing: message of `/loop/timing`.

    Raises:
        google.protobuf.message.DecodeError: not such messages.
    """
    v = LAYOUTS[schema].unpack(tick)
    t_ns = v[0]
    state, present, latched, answer, truth_m, check, request = v[_S:]
    received, before, sent = unpack_frames(frames, t_ns)
    return LoggedTick(
        number,
        log_time_ns,
        t_ns,
        Measurement._make(v[1:_E]),
        request,
        Estimate._make(v[_E:_R]),
        Reference._make(v[_R:_C]),
        Command._make(v[_C:_S]),
        state,
        present,
        latched,
        answer,
        check,
        received,
        before,
        sent,
        unpack_timing(timing),
        truth_m,
    )


def unpack_frames(data: bytes, t_ns: int) -> tuple[tuple[Frame, ...], int, tuple[Frame, ...]]:
    """Frames received, how many of them before SYNC left, and those sent, from a message of `/can/frames`."""
    f = _Frames.FromString(data)
    new = tuple.__new__  # half the time of Frame(…)
    return (
        tuple([new(Frame, (t_ns + r.stamp_after_t_ns, r.can_id, r.data)) for r in f.received]),
        f.before,
        tuple([new(Frame, (t_ns + r.stamp_after_t_ns, r.can_id, r.data)) for r in f.sent]),
    )


def unpack_timing(data: bytes) -> Timing:
    """What a message of `/loop/timing` says."""
    return Timing._make(_timing(_Timing.FromString(data)))
