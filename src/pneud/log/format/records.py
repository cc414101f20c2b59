"""One tick as protobuf messages, packed by `struct` with the tag bytes baked in, and back again.

A request, which few ticks have, follows what all have.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator, Sequence
from operator import attrgetter, itemgetter
from typing import Any, NamedTuple

from google.protobuf.descriptor_pb2 import FieldDescriptorProto as F

from pneud.log.format.frames import FrameBlock
from pneud.log.format.header import Detail
from pneud.log.format.record_layout import NUMBERS, beyond, numbers_of, record_of
from pneud.log.format.schema import (
    BEYOND,
    PROGRAM,
    REQUEST,
    SOMETIMES,
    STATION,
    TOLD,
    WEIGHED,
    Field,
    Level,
    message_class,
    tick_fields,
)
from pneud.signals import (
    Command,
    Estimate,
    Frame,
    Measurement,
    Progress,
    Record,
    Reference,
    Request,
    Station,
    Tick,
    Timing,
    Told,
    Weighed,
    state_name,
)

_CODES = {
    F.TYPE_FLOAT: (5, "f"),
    F.TYPE_DOUBLE: (1, "d"),
    F.TYPE_FIXED32: (5, "I"),
    F.TYPE_FIXED64: (1, "Q"),
    F.TYPE_SFIXED64: (1, "q"),
    F.TYPE_ENUM: (0, "B"),  # below 128, hence one byte
}
_FIELDS = [field.name for field in tick_fields("compact")[1]]
_REQUEST = 1 + _FIELDS.index(REQUEST)  # number of its field
_TOLD = struct.Struct("<Bq" + "Bd" * (len(Told._fields) - 1))
_WEIGHED = struct.Struct("<BdBq")
_TOLD_TAGS = [number << 3 | 1 for number in range(1, 1 + len(Told._fields))]
_SHORT = [bytes((i,)) for i in range(128)]
_NO_MORE = (0, 0)

# Of these a compact log keeps 16 significant bits in place of 24, since nobody needs more and the others are
# noise, which cannot be compressed: the lowest byte is zero.
COARSE = frozenset((
    *(n for n in NUMBERS if n.startswith(("estimate.", "reference.")) and not n.endswith(".position_m")),
    *("command.law_v", "command.s", "command.ustar"),
))  # fmt: skip
COARSE_ERROR = 2.0**-15  # relative
FLOAT_ERROR = 2.0**-24

_real_commands = itemgetter(*(i for i, n in enumerate(Command._fields) if NUMBERS[f"command.{n}"] == "d"))
CHECKED = (
    *(f"estimate.{name}" for name in Estimate._fields),
    *(f"reference.{name}" for name in Reference._fields),
    *(f"command.{name}" for name in _real_commands(Command._fields)),
)
"""The numbers that a record has a checksum over."""
_CHECKED = struct.Struct(f"<{len(CHECKED)}d")


def crc_of(tick: Tick) -> int:
    """CRC-32 over the doubles of estimate, reference and command, in their order, little-endian.

    It stands in every record, so that a replay can be compared to the bit with a log that keeps only floats.
    """
    return zlib.crc32(_CHECKED.pack(*tick.estimate, *tick.reference, *_real_commands(tick.command)))


def varint(n: int) -> bytes:
    """A non-negative integer as protobuf writes it."""
    if n < 0x80:
        return _SHORT[n]
    if n < 0x4000:
        return bytes((n & 0x7F | 0x80, n >> 7))
    if n < 0x20_0000:
        return bytes((n & 0x7F | 0x80, n >> 7 & 0x7F | 0x80, n >> 14))
    return bytes((n & 0x7F | 0x80,)) + varint(n >> 7)


class Place(NamedTuple):
    """Where a number stands in a message: behind these constant bytes, the tags and lengths."""

    name: str  # such as estimate.force_n
    constant: bytes
    code: str  # of `struct`

    @property
    def width(self) -> int:
        """Bytes that the number takes."""
        return struct.calcsize(f"<{self.code}")


def _places(fields: list[Field], nested: dict[str, list[Field]], group: str = "") -> Iterator[Place]:
    for number, field in enumerate(fields, start=1):
        if field.name in SOMETIMES:
            continue
        if field.type == F.TYPE_MESSAGE:
            first, *rest = _places(nested[field.of.rpartition(".")[2]], nested, f"{field.name}.")
            size = sum(len(place.constant) + place.width for place in (first, *rest))
            yield first._replace(constant=varint(number << 3 | 2) + varint(size) + first.constant)
            yield from rest
        else:
            wire, code = _CODES[field.type]
            yield Place(group + field.name, varint(number << 3 | wire), code)


class Else(NamedTuple):
    """What only some messages have."""

    request: Request | None = None
    more: tuple[int, int] = _NO_MORE  # as `beyond` says
    told: Told | None = None
    program: Progress | None = None
    station: Station | None = None
    weighed: Weighed | None = None


NOTHING_ELSE = Else()


class TickLayout:
    """A message of fixed length as one `struct`; tags and lengths are put in as bits of one integer.

    Attributes:
        places: of all numbers, in their order.
    """

    def __init__(self, detail: Detail) -> None:
        name, fields, nested = tick_fields(detail)
        places = {place.name: place for place in _places(fields, nested)}
        self.places = tuple(places[name] for name in (*NUMBERS, "check"))
        self._class = message_class(f"pneud.{name}")
        self._values = attrgetter(*(place.name for place in self.places))
        self._struct = struct.Struct("<" + "".join(f"{len(p.constant)}x{p.code}" for p in self.places))
        tags = constants = kept = b""
        for place in self.places:
            count, width = len(place.constant), place.width
            coarse = place.code == "f" and place.name in COARSE
            tags += b"\xff" * count + bytes(width)
            constants += place.constant + bytes(width)
            kept += bytes(count + coarse) + b"\xff" * (width - coarse)
        self._tags, self._constants, self._kept = (
            int.from_bytes(mask, "little") for mask in (tags, constants, kept)
        )

    def pack(self, values: tuple[float, ...]) -> bytes:
        """The message without a request."""
        try:
            packed = self._struct.pack(*values)
        except OverflowError:  # a double beyond the floats
            pairs = zip(self.places, values, strict=True)
            packed = self._struct.pack(*(_as_float(v) if place.code == "f" else v for place, v in pairs))
        bits = int.from_bytes(packed, "little") & self._kept | self._constants
        return bits.to_bytes(len(packed), "little")

    def unpack(self, data: bytes) -> tuple[Any, ...]:
        """The values in their order, and behind them what only some messages have."""
        if len(data) == self._struct.size and int.from_bytes(data, "little") & self._tags == self._constants:
            return (*self._struct.unpack(data), NOTHING_ELSE)
        station = _station_at(data, self._struct.size)
        if (
            station is not None
        ):  # which every tick of an axis with inputs or outputs has, and most nothing else
            usual = data[: self._struct.size]
            if int.from_bytes(usual, "little") & self._tags == self._constants:
                return (*self._struct.unpack(usual), Else(station=station))
        # With something of that, or in another order of bytes, as a tool that wrote it anew may choose.
        t = self._class.FromString(data)
        asked = Request(t.request.kind, tuple(t.request.values)) if t.request.kind else None
        told = Told._make(getattr(t.told, name) for name in Told._fields) if t.HasField(TOLD) else None
        p = t.program if t.HasField(PROGRAM) else None
        program = Progress(p.step, p.lap, p.stage, p.outputs) if p is not None else None
        s = t.station if t.HasField(STATION) else None
        station = Station(s.inputs, s.outputs, s.brake) if s is not None else None
        w = t.weighed if t.HasField(WEIGHED) else None
        weighed = Weighed(w.force_n, w.age_ns) if w is not None else None
        more = (t.present_more, t.latched_more)
        return (*self._values(t), Else(asked, more, told, program, station, weighed))


_STATION_HEAD = varint(1 + _FIELDS.index(STATION) << 3 | 2) + varint(2 * len(Station._fields))
_STATION_TAGS = bytes(number << 3 for number in range(1, 1 + len(Station._fields)))


def _station_at(data: bytes, begin: int) -> Station | None:
    """The station that stands alone at the end of a message, if it is of small numbers; else None."""
    first = begin + len(_STATION_HEAD)
    if len(data) != first + 2 * len(_STATION_TAGS) or not data.startswith(_STATION_HEAD, begin):
        return None
    numbers = data[first + 1 :: 2]
    if data[first::2] != _STATION_TAGS or max(numbers) > 0x7F:
        return None
    return Station._make(numbers)


def _as_float(value: float) -> float:
    try:
        struct.pack("<f", value)
    except OverflowError:
        return math.copysign(math.inf, value)
    return value


LAYOUTS = {"pneud.Tick": TickLayout("compact"), "pneud.FullTick": TickLayout("full")}


def _request(request: Request) -> bytes:
    kind, values = request
    body = b"\x08" + varint(kind)
    if values:
        body += b"\x12" + varint(8 * len(values)) + struct.pack(f"<{len(values)}d", *values)
    return varint(_REQUEST << 3 | 2) + varint(len(body)) + body


def _told(told: Told) -> bytes:
    body = _TOLD.pack(*(part for pair in zip(_TOLD_TAGS, told, strict=True) for part in pair))
    return varint(1 + _FIELDS.index(TOLD) << 3 | 2) + varint(len(body)) + body


def _weighed(weighed: Weighed) -> bytes:
    body = _WEIGHED.pack(1 << 3 | 1, weighed.force_n, 2 << 3 | 1, weighed.age_ns)
    return varint(1 + _FIELDS.index(WEIGHED) << 3 | 2) + varint(len(body)) + body


def _small(name: str, numbers: tuple[int, ...]) -> bytes:
    """A part of a few numbers, none of them negative."""
    body = b"".join(bytes((number << 3,)) + varint(value) for number, value in enumerate(numbers, 1))
    return varint(1 + _FIELDS.index(name) << 3 | 2) + varint(len(body)) + body


def _beyond(more: tuple[int, int]) -> bytes:
    return b"".join(
        varint(1 + _FIELDS.index(name) << 3 | 1) + struct.pack("<Q", bits)
        for name, bits in zip(BEYOND, more, strict=True)
        if bits
    )


class Packer:
    """Packs records at one level of detail."""

    def __init__(self, detail: Detail) -> None:
        self._layout = LAYOUTS["pneud.Tick" if detail == "compact" else "pneud.FullTick"]

    def tick(self, record: Record) -> bytes:
        """The message of `/axis/tick`."""
        tick = record.tick
        packed = self._layout.pack((*numbers_of(record), crc_of(tick)))
        if tick.request is not None:
            packed += _request(tick.request)
        if tick.told is not None:
            packed += _told(tick.told)
        more = beyond(tick)
        if more != _NO_MORE:
            packed += _beyond(more)
        if tick.program is not None:
            packed += _small(PROGRAM, tick.program)
        if tick.station is not None:
            packed += _small(STATION, tick.station)
        return packed if tick.weighed is None else packed + _weighed(tick.weighed)


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
    check: int
    # as in `Tick`
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
    in_position: int
    hunting: int
    told: Told | None
    program: Progress | None
    station: Station | None
    weighed: Weighed | None
    # as in `Record`
    timing: Timing
    frames: tuple[Frame, ...]
    before: int
    sent: tuple[Frame, ...]
    truth_m: float
    # what the log adds
    t_s: float = 0.0  # since the log's first tick
    fault_names: tuple[str, ...] = ()  # of the bits of `present` and `latched`

    @property
    def error_m(self) -> float:
        """Reference − estimated position [m]; NaN without a reference."""
        return self.tick.error_m

    @property
    def true_error_m(self) -> float:
        """Reference − true position, both at SYNC [m]; NaN where nobody tells."""
        return self.record.true_error_m

    @property
    def progress(self) -> Progress:
        """How far its program is, also where there is none."""
        return self.tick.progress

    @property
    def state_name(self) -> str:
        """The state as people and scripts read it."""
        return state_name(self.state)

    @property
    def skipped(self) -> int:
        """Ticks skipped just before this one."""
        return self.measurement.skipped

    @property
    def host(self) -> int:
        """Bits of `Host`."""
        return self.measurement.host

    @property
    def tick(self) -> Tick:
        """What the axis read and decided."""
        return Tick._make(getattr(self, name) for name in Tick._fields)

    @property
    def record(self) -> Record:
        """The record as the loop handed it over (to the bit where the log's detail is full)."""
        return Record(self.tick, *(getattr(self, name) for name in Record._fields[1:]))


class TickMessage(NamedTuple):
    """A message of `/axis/tick` as read."""

    number: int  # counts the records of the loop
    log_time_ns: int  # Unix
    schema: str  # name of the message, which tells the level of detail
    data: bytes


def names_of(bits: int, names: Sequence[str]) -> tuple[str, ...]:
    """Names of the faults of these bits; those without one have their number."""
    if not bits:
        return ()
    known = tuple(name for bit, name in enumerate(names) if bits >> bit & 1)
    return known + tuple(f"fault {bit}" for bit in range(len(names), bits.bit_length()) if bits >> bit & 1)


def unpack(
    ticks: list[TickMessage], frames: FrameBlock, first_ns: int | None = None, fault_names: Sequence[str] = ()
) -> Iterator[LoggedTick]:
    """Ticks and their frames, put together.

    Args:
        ticks: their messages.
        frames: of all of them.
        first_ns: where `t_s` begins; None for the first of these.
        fault_names: by bit.

    Raises:
        google.protobuf.message.DecodeError: not such messages.
        ValueError: not as many ticks as the frames are of.
    """
    values = [LAYOUTS[tick.schema].unpack(tick.data) for tick in ticks]
    parts = frames.ticks(v[0] for v in values)
    began_ns = values[0][0] if first_ns is None and values else first_ns or 0
    for tick, v, its_frames in zip(ticks, values, parts, strict=True):
        yield logged(tick, v, its_frames, began_ns, fault_names)


def logged(
    message: TickMessage,
    values: tuple[Any, ...],
    frames: tuple[tuple[Frame, ...], int, tuple[Frame, ...]],
    first_ns: int,
    fault_names: Sequence[str],
) -> LoggedTick:
    """A tick, put together.

    Args:
        message: of it.
        values: unpacked.
        frames: of it, as from `FrameBlock.ticks`.
        first_ns: where `t_s` begins.
        fault_names: by bit.
    """
    check, (request, *others) = values[len(NUMBERS) :]
    record = record_of(values, request, *frames, *others)
    t_s, bits = 1e-9 * (values[0] - first_ns), record.tick.present | record.tick.latched
    names = names_of(bits, fault_names)
    return LoggedTick(message.number, message.log_time_ns, check, *record.tick, *record[1:], t_s, names)
