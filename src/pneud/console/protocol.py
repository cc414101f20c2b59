"""What operators' clients and the console say to each other: one JSON object a line, with a version.

Lengths are millimetres in the stroke coordinate, times seconds. A request that these models let through is
well formed; whether it may be done is for the console and the axis to say.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import from_json

from pneud.console.line_stream import VERSION, line
from pneud.console.records import UNUSABLE

MAX_PIECES = 32  # of a profile in one line


class Error(StrEnum):
    """Why a request was not done; the axis's own refusals have the names of `Answer` in lower case."""

    MALFORMED = "malformed"  # not one JSON object in UTF-8
    TOO_LONG = "too_long"
    VERSION = "version"
    UNKNOWN_VERB = "unknown_verb"
    INVALID = "invalid"  # a field is missing, surplus, or out of bounds
    READ_ONLY = "read_only"
    BUSY = "busy"  # another client commands
    FULL = "full"  # too many requests wait
    DISPLACED = "displaced"  # too many clients, or a stop came first
    SILENT = "silent"  # the loop does not answer
    LATE = "late"  # the loop came to it too late and has not done it
    CONFIGURATION = "configuration"  # the file cannot be used
    OUT_OF_TRAVEL = "out_of_travel"
    BEYOND_LIMITS = "beyond_limits"
    PROGRAM = UNUSABLE  # it cannot be used: which record, and why


class ProtocolError(Exception):
    """A request that is not done, with the type and the words for the client."""

    def __init__(self, kind: str, message: str, number: int | None = None, **more: Any) -> None:
        super().__init__(message)
        self.kind = str(kind)
        self.message = message
        self.number = number
        self.more = more
        self.axis = ""  # that says so, where there are several


Number = Annotated[int, Field(ge=0, le=2**31 - 1)]
Millimetres = Annotated[float, Field(ge=-1e6, le=1e6)]
Rate = Annotated[float, Field(ge=1e-3, le=1e9)]


class RequestBase(BaseModel):
    """What all requests have."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    v: Literal[1]
    id: Number
    axis: Annotated[str, Field(min_length=1, max_length=64)] | None = None  # where there are several


class Plain(RequestBase):
    """One whose verb says it all."""

    verb: Literal[
        "status",  # how the axis is
        "attach",  # the memory in which the loop leaves its records, for reading
        "observe",  # never command from this connection
        "disarm",  # stop, then centre
        "stop",
        "clear",  # what is latched
        "hold",  # come to rest and hold
        "home",  # find the reference
        "restart",  # end in order, and begin anew with what the file says
    ]


class Arm(RequestBase):
    """Engage and hold."""

    verb: Literal["arm"]
    unproven: bool = False  # also without a movement test that was passed, from now on in this run


class Probe(RequestBase):
    """Open the valve slowly and without a loop, within bounds, for as long as the lease is renewed."""

    verb: Literal["probe"]
    voltage_v: Annotated[float, Field(ge=-10, le=10)]
    rate_v_s: Annotated[float, Field(gt=0, le=100)]
    travel_mm: Annotated[float, Field(gt=0, le=1e3)]
    speed_mm_s: Annotated[float, Field(gt=0, le=1e4)]
    force_n: Annotated[float, Field(gt=0, le=1e5)]
    lease_s: Annotated[float, Field(ge=0.02, le=1.0)] = 0.3


class Goto(RequestBase):
    """Go to a position; bounds that are not given are the configured ones."""

    verb: Literal["goto"]
    x_mm: Millimetres
    speed_mm_s: Rate | None = None
    acceleration_mm_s2: Rate | None = None
    jerk_mm_s3: Rate | None = None
    attended: bool = False  # ends, held, where its client goes


class GotoAll(RequestBase):
    """Go to positions with several axes, all at once: they set out together and arrive together."""

    verb: Literal["goto_all"]
    axes: Annotated[dict[str, Millimetres], Field(min_length=1, max_length=32)]


class Jog(RequestBase):
    """Move at a speed for as long as the lease is renewed."""

    verb: Literal["jog"]
    velocity_mm_s: Millimetres
    lease_s: Annotated[float, Field(ge=0.02, le=1.0)] = 0.3


Newtons = Annotated[float, Field(ge=-1e6, le=1e6)]


class Force(RequestBase):
    """Press with a force of the piston; what is not given is as configured, the window all the travel."""

    verb: Literal["force"]
    force_n: Newtons
    rate_n_s: Annotated[float, Field(ge=1, le=1e9)] | None = None
    low_mm: Millimetres | None = None
    high_mm: Millimetres | None = None
    speed_mm_s: Rate | None = None
    timeout_s: Annotated[float, Field(gt=0, le=3600)] | None = None
    attended: bool = False  # ends, held, where its client goes


class Track(RequestBase):
    """Follow the configured reference, or the uploaded profile."""

    verb: Literal["track"]
    what: Literal["reference", "profile"]
    attended: bool = False  # ends, held, where its client goes


class Run(RequestBase):
    """Go through a program, record by record."""

    verb: Literal["run"]
    program: dict[str, Any] | None = None  # as its file has it, points in a table; the one that was stopped
    record: Annotated[int, Field(ge=1, le=256)] = 1  # to begin with, where there is a program
    cycles: Annotated[int, Field(ge=0, le=1_000_000_000)] = 1  # 0: without end
    load: bool = False  # hand it over, and begin nothing: the input start does
    attended: bool = False  # ends, held, where its client goes


class Upload(RequestBase):
    """Pieces of a profile: duration [s], then eight coefficients of powers of time, metres.

    Whole or nothing: where a piece is refused, or the client goes before its last one, no profile is left.
    """

    verb: Literal["upload"]
    first: bool  # empties the profile that is there
    last: bool = True  # False where more are to follow
    pieces: Annotated[
        list[Annotated[list[float], Field(min_length=9, max_length=9)]],
        Field(min_length=1, max_length=MAX_PIECES),
    ]


class TuneGet(RequestBase):
    """The running gains, reference, and what is believed of the rig."""

    verb: Literal["tune_get"]


class TuneSet(RequestBase):
    """Change some of what `tune_get` tells, all at once or none."""

    verb: Literal["tune_set"]
    gains: Annotated[dict[str, float | str], Field(min_length=1, max_length=32)]


class TuneReload(RequestBase):
    """Take gains and reference of the configuration on the disk."""

    verb: Literal["tune_reload"]


class Mark(RequestBase):
    """A remark for the log."""

    verb: Literal["mark"]
    text: Annotated[str, Field(min_length=1, max_length=200)]


Request = (
    Plain
    | Arm
    | Goto
    | GotoAll
    | Jog
    | Probe
    | Force
    | Track
    | Run
    | Upload
    | TuneGet
    | TuneSet
    | TuneReload
    | Mark
)
VERBS: dict[str, type[Request]] = {
    verb: kind for kind in Request.__args__ for verb in kind.model_fields["verb"].annotation.__args__
}


def parse(line: bytes) -> Request:
    """The request in a line.

    Raises:
        ProtocolError: there is none; with the request's number where that could be read.
    """
    try:
        found = from_json(line, allow_inf_nan=False)
    except ValueError as e:
        raise ProtocolError(Error.MALFORMED, f"not JSON: {_one_line(str(e))}") from None
    if not isinstance(found, dict):
        raise ProtocolError(Error.MALFORMED, "a request is one JSON object")
    number = found.get("id")
    if type(number) is not int or not 0 <= number < 2**31:
        number = None
    version = found.get("v")
    if type(version) is not int or version != VERSION:
        raise ProtocolError(
            Error.VERSION, f"this console speaks version {VERSION}: give v = {VERSION}", number
        )
    verb = found.get("verb")
    kind = VERBS.get(verb) if isinstance(verb, str) else None
    if kind is None:
        raise ProtocolError(Error.UNKNOWN_VERB, f"verb is one of {', '.join(VERBS)}", number)
    try:
        return kind.model_validate(found)
    except ValidationError as e:
        first = e.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        raise ProtocolError(Error.INVALID, _one_line(f"{where}: {first['msg']}"), number) from None


def reply(number: int | None, axis: str, **fields: Any) -> bytes:
    """The line that says that a request was done, by which axis."""
    return line({"v": VERSION, "id": number, "ok": True, "axis": axis, **fields})


def refusal(error: ProtocolError, axis: str) -> bytes:
    """The line that says that a request was not done by an axis, and why."""
    axis = error.axis or axis
    told = {"type": error.kind, "message": error.message, **error.more}
    return line({"v": VERSION, "id": error.number, "ok": False, "axis": axis, "error": told})


def _one_line(text: str) -> str:
    """Short and printable, whatever a client made it quote."""
    return "".join(c if c.isprintable() else "?" for c in text[:200])
