"""The protobuf messages of a log, built at run time from the layout of a record.

Field names are those of the records, units included. Whoever changes what comes out of here raises the
`SCHEMA` of `meanings`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from enum import IntEnum
from typing import Any, NamedTuple

from google.protobuf import descriptor_pool, message_factory, timestamp_pb2
from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    EnumDescriptorProto,
    FieldDescriptorProto,
    FileDescriptorProto,
    FileDescriptorSet,
)

from pneud.log.format.header import Detail
from pneud.log.format.meanings import meaning_of, unit_of
from pneud.log.format.record_layout import NUMBERS, PARTS
from pneud.signals import Answer, Hold, Hunting, Progress, RequestKind, Stage, State, Station, Told

METADATA = "pneud"  # name of the metadata on the run
SETUP = "setup"  # name of the metadata on the real-time set-up

KEPT = "kept"  # name of the metadata on why a part of a log is kept
COPY = "copy"  # name of the metadata that repeats the head, in case that it is damaged

REQUEST = "request"  # field of a tick

TICK = "/axis/tick"
STATE = "/axis/state"
FRAMES = "/can/frames"
EVENTS = "/events"

F = FieldDescriptorProto
# numbers of the fields of descriptors, of which paths to comments consist
F_MESSAGE = FileDescriptorProto.MESSAGE_TYPE_FIELD_NUMBER
M_FIELD, M_NESTED = DescriptorProto.FIELD_FIELD_NUMBER, DescriptorProto.NESTED_TYPE_FIELD_NUMBER
_PREFIX = ".pneud."


class Field(NamedTuple):
    """One field: its protobuf type, and the name of its message or enumeration where it has one."""

    name: str
    type: F.Type.ValueType
    of: str = ""
    repeated: bool = False


_TYPES = {"q": F.TYPE_SFIXED64, "Q": F.TYPE_FIXED64, "I": F.TYPE_FIXED32, "B": F.TYPE_ENUM}  # by code
_ENUMS = {"state": "State", "answer": "Answer", "hunting": "Hunting"}
STANDING = ("in_position", "hunting")  # fields that messages of schema 2 lack: they stand behind the others
WITHOUT_STANDING = frozenset({"2"})
TOLD, PROGRAM, STATION, WEIGHED = "told", "program", "station", "weighed"
BEYOND = ("present_more", "latched_more")
SOMETIMES = (REQUEST, TOLD, *BEYOND, PROGRAM, STATION, WEIGHED)
"""Fields that only ticks have in which there is something to say: a request, another axis, and so on."""


DERIVED = (
    Field("t_s", F.TYPE_DOUBLE),
    Field("error_m", F.TYPE_DOUBLE),
    Field("true_error_m", F.TYPE_DOUBLE),
    Field("state_name", F.TYPE_STRING),
    Field("fault_names", F.TYPE_STRING, repeated=True),
)
"""Fields that follow from the others, behind them in ticks for viewers (`derived`)."""


def tick_fields(detail: Detail) -> tuple[str, list[Field], dict[str, list[Field]]]:
    """Name, fields and nested messages of `/axis/tick`.

    Every field is of fixed width and always present, but for those of `SOMETIMES`.
    """
    real = F.TYPE_FLOAT if detail == "compact" else F.TYPE_DOUBLE
    name = "Tick" if detail == "compact" else "FullTick"
    fields: list[Field] = []
    later: list[Field] = []
    nested: dict[str, list[Field]] = {}
    for number, code in NUMBERS.items():
        part, _, own = number.rpartition(".")
        field = Field(own, _TYPES.get(code, real), _ENUMS.get(number, ""))
        if not part:
            (later if number in STANDING else fields).append(field)
            continue
        inner = PARTS[part].__name__
        if inner not in nested:
            nested[inner] = []
            fields.append(Field(part, F.TYPE_MESSAGE, f"{name}.{inner}"))
        nested[inner].append(field)
    fields += [Field("check", F.TYPE_FIXED32), Field(REQUEST, F.TYPE_MESSAGE, f"{name}.Request"), *later]
    fields += [Field(TOLD, F.TYPE_MESSAGE, f"{name}.Told"), *(Field(more, F.TYPE_FIXED64) for more in BEYOND)]
    fields.append(Field(PROGRAM, F.TYPE_MESSAGE, f"{name}.Progress"))
    fields.append(Field(STATION, F.TYPE_MESSAGE, f"{name}.Station"))
    fields.append(Field(WEIGHED, F.TYPE_MESSAGE, f"{name}.Weighed"))
    nested["Weighed"] = [Field("force_n", F.TYPE_DOUBLE), Field("age_ns", F.TYPE_SFIXED64)]
    nested["Request"] = [
        Field("kind", F.TYPE_ENUM, "RequestKind"),
        Field("values", F.TYPE_DOUBLE, repeated=True),
    ]
    nested["Told"] = [
        Field(own, F.TYPE_SFIXED64 if own.endswith("_ns") else F.TYPE_DOUBLE) for own in Told._fields
    ]
    nested["Progress"] = [
        Field(own, *((F.TYPE_ENUM, "Stage") if own == "stage" else (F.TYPE_UINT32,)))
        for own in Progress._fields
    ]
    nested["Station"] = [
        Field(own, *((F.TYPE_ENUM, "Hold") if own == "brake" else (F.TYPE_UINT32,)))
        for own in Station._fields
    ]
    return name, fields, nested


# Frames of consecutive ticks by columns, which take half the room that they take one after another. A column
# holds all frames of one identifier and length: first the first bytes of all its stamps (as little-endian
# 64-bit integers), then the second ones, …; its data alike.
_COLUMN = [
    Field("can_id", F.TYPE_UINT32),
    Field("length", F.TYPE_UINT32),
    Field("stamp_after_t_ns", F.TYPE_BYTES),
    Field("data", F.TYPE_BYTES),
]
_FRAMES = [
    Field("received", F.TYPE_UINT32, repeated=True),  # frames of each tick
    Field("before", F.TYPE_UINT32, repeated=True),  # those among them that were drained before SYNC left
    Field("sent", F.TYPE_UINT32, repeated=True),
    Field("order", F.TYPE_UINT32, repeated=True),  # columns that the frames lie in: received, then sent ones
    Field("columns", F.TYPE_MESSAGE, "Column", repeated=True),
]


def _message(name: str, fields: Iterable[Field]) -> DescriptorProto:
    message = DescriptorProto(name=name)
    for number, field in enumerate(fields, start=1):
        message.field.append(
            F(
                name=field.name,
                number=number,
                type=field.type,
                label=F.LABEL_REPEATED if field.repeated else F.LABEL_OPTIONAL,
                type_name=_PREFIX + field.of if field.of else None,
            )
        )
    return message


def _enum(name: str, prefix: str, values: Iterable[IntEnum], *, none: bool = False) -> EnumDescriptorProto:
    enum = EnumDescriptorProto(name=name)
    if none:
        enum.value.add(name=f"{prefix}NONE", number=0)
    for value in values:
        enum.value.add(name=prefix + value.name, number=value.value)
    return enum


def _tick_message(detail: Detail, derived: bool = False) -> DescriptorProto:
    name, fields, nested = tick_fields(detail)
    message = _message(name, [*fields, *(DERIVED if derived else ())])
    message.nested_type.extend(_message(inner, inner_fields) for inner, inner_fields in nested.items())
    return message


def _comment(file: FileDescriptorProto, name: str) -> None:
    """Unit and meaning of each field of a tick's message, as comments in its schema."""
    place = [message.name for message in file.message_type].index(name)
    message = file.message_type[place]
    groups = {f.type_name.rpartition(".")[2]: f"{f.name}." for f in message.field if f.type == F.TYPE_MESSAGE}
    own: list[tuple[str, tuple[int, ...], DescriptorProto]] = [("", (F_MESSAGE, place), message)]
    for number, inner in enumerate(message.nested_type):
        own.append((groups[inner.name], (F_MESSAGE, place, M_NESTED, number), inner))
    for group, path, part in own:
        for number, field in enumerate(part.field):
            meaning, unit = meaning_of(group + field.name), unit_of(field.name)
            if meaning:
                words = f" [{unit}] {meaning}\n" if unit else f" {meaning}\n"
                file.source_code_info.location.add(
                    path=(*path, M_FIELD, number), span=(0, 0, 0), leading_comments=words
                )


def _pneud_file(derived: bool = False) -> FileDescriptorProto:
    file = FileDescriptorProto(name="pneud.proto", package="pneud", syntax="proto3")
    # Values of an enumeration share the package's name space, hence the prefixes.
    file.enum_type.append(_enum("State", "STATE_", State))
    file.enum_type.append(_enum("RequestKind", "REQUEST_", RequestKind, none=True))
    file.enum_type.append(_enum("Answer", "ANSWER_", Answer))
    file.enum_type.append(_enum("Hunting", "HUNTING_", Hunting))
    file.enum_type.append(_enum("Stage", "STAGE_", Stage))
    file.enum_type.append(_enum("Hold", "HOLD_", Hold))
    file.message_type.append(_tick_message("compact", derived))
    file.message_type.append(_tick_message("full", derived))
    file.message_type.append(_message("Column", _COLUMN))
    file.message_type.append(_message("Frames", _FRAMES))
    return file


class Level(IntEnum):
    """Levels of `foxglove.Log`."""

    UNKNOWN = 0
    DEBUG = 1
    INFO = 2
    WARNING = 3
    ERROR = 4
    FATAL = 5


def _log_file() -> FileDescriptorProto:
    file = FileDescriptorProto(
        name="foxglove/Log.proto",
        package="foxglove",
        syntax="proto3",
        dependency=[timestamp_pb2.DESCRIPTOR.name],
    )
    log = _message(
        "Log",
        [
            Field("timestamp", F.TYPE_MESSAGE),
            Field("level", F.TYPE_ENUM),
            Field("message", F.TYPE_STRING),
            Field("name", F.TYPE_STRING),
            Field("file", F.TYPE_STRING),
            Field("line", F.TYPE_FIXED32),
        ],
    )
    log.field[0].type_name = ".google.protobuf.Timestamp"
    log.field[1].type_name = ".foxglove.Log.Level"
    log.enum_type.append(_enum("Level", "", Level))
    file.message_type.append(log)
    return file


def _timestamp_file() -> FileDescriptorProto:
    file = FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(file)
    return file


def _pool() -> descriptor_pool.DescriptorPool:
    pool = descriptor_pool.DescriptorPool()
    for file in (_timestamp_file(), _log_file(), _pneud_file()):
        pool.Add(file)
    return pool


_POOL = _pool()


def message_class(name: str) -> Any:
    """The class of a message by its full name, such as `pneud.Frames`."""
    return message_factory.GetMessageClass(_POOL.FindMessageTypeByName(name))


class Topic(NamedTuple):
    """A topic with its schema as MCAP wants it; the state is JSON, everything else protobuf."""

    topic: str
    schema: str
    descriptors: bytes
    encoding: str = "protobuf"
    schema_encoding: str = "protobuf"


def topics(detail: Detail, *, derived: bool = False) -> Iterator[Topic]:
    """The topics of a log, in the order of their channels; for viewers with the fields `DERIVED`."""
    tick, name = _pneud_file(derived), tick_fields(detail)[0]
    _comment(tick, name)
    own, others, log = (
        FileDescriptorSet(file=files).SerializeToString(deterministic=True)
        for files in ([tick], [_pneud_file()], [_timestamp_file(), _log_file()])
    )
    yield Topic(TICK, f"pneud.{name}", own)
    yield Topic(FRAMES, "pneud.Frames", others)
    yield Topic(EVENTS, "foxglove.Log", log)
    yield Topic(STATE, "pneud.State", b'{"type": "object"}', "json", "jsonschema")
