"""The records that a program's file may have: by what each does, its fields and their bounds."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from pneud.control import program

SCHEMA = 1
FAST, EXACT, START = "fast", "exact", "start"
CLASSES = {START: program.AT_ONCE, FAST: program.FAST, EXACT: program.EXACT}
NUMBER, WHOLE, PLACE, LABEL, NAME, TRUTH, CLASS = (
    "number",
    "whole",
    "place",
    "label",
    "name",
    "truth",
    "class",
)
MOST_MM, MOST_RATE = 1e6, 1e9
LEAST = 1e-3
LEAST_RAMP_N_S = 1.0  # as the axis takes it


UNUSABLE = "program"  # the type of the console's error about a program that it cannot use


class ProgramError(Exception):
    """A program cannot be used; one line for a person, with the record and the cure."""

    exit_code = 2


class Field(NamedTuple):
    """What a field of a record takes."""

    takes: str
    low: float = -math.inf
    high: float = math.inf
    required: bool = False


_LABEL, _AXIS = Field(LABEL), Field(NAME)
_RATE, _TIME = Field(NUMBER, LEAST, MOST_RATE), Field(NUMBER, 0.0, program.LONGEST_S)
_LENGTH, _FORCE = Field(NUMBER, -MOST_MM, MOST_MM), Field(NUMBER, -1e6, 1e6)
_LATE = {"timeout_s": Field(NUMBER, LEAST, program.LONGEST_S), "otherwise": _LABEL}
_MOTION = {
    "speed_mm_s": _RATE,
    "acceleration_mm_s2": _RATE,
    "jerk_mm_s3": _RATE,
    "class": Field(CLASS),
    "tolerance_mm": Field(NUMBER, LEAST, MOST_MM),
    "settle_s": _TIME,
    "standing_mm_s": _RATE,
    "mass_kg": Field(NUMBER, 0.0, 1e4),
    **_LATE,
}
_ALL = {"label": _LABEL, "axis": _AXIS}
FIELDS: dict[str, dict[str, Field]] = {
    "goto": {**_ALL, "to_mm": Field(PLACE, required=True), **_MOTION},
    "move": {**_ALL, "by_mm": Field(PLACE, required=True), **_MOTION},
    "track": {**_ALL, "for_s": _TIME._replace(required=True), "mass_kg": _MOTION["mass_kg"], **_LATE},
    "force": {
        **_ALL,
        "force_n": _FORCE._replace(required=True),
        "ramp_n_s": _RATE._replace(low=LEAST_RAMP_N_S),
        "low_mm": _LENGTH,
        "high_mm": _LENGTH,
        "speed_mm_s": _RATE,
        "settle_s": _TIME,
        **_LATE,
    },
    "wait": {**_ALL, "for_s": _TIME._replace(required=True)},
    "until": {
        **_ALL,
        "above_mm": _LENGTH,
        "below_mm": _LENGTH,
        "above_n": _FORCE,
        "below_n": _FORCE,
        "input": Field(NAME),
        "on": Field(TRUTH),
        "for_s": _TIME,
        **_LATE,
    },
    "jump": {**_ALL, "to": _LABEL._replace(required=True)},
    "repeat": {
        **_ALL,
        "to": _LABEL._replace(required=True),
        "times": Field(WHOLE, 1, program.MOST_TIMES, required=True),
    },
    "output": {**_ALL, "output": Field(NAME, required=True), "on": Field(TRUTH, required=True)},
}
"""Fields by what a record does."""

CODES = {name: code for code, name in enumerate(FIELDS, start=program.GOTO)}
TOP = ("schema", "name", "points", "defaults", "record")
DEFAULTS = tuple(name for name in _MOTION if name not in ("otherwise", "mass_kg"))
UNTILS = ("above_mm", "below_mm", "above_n", "below_n", "input")


def told(place: int, record: Mapping[str, Any]) -> str:
    """A record as messages call it."""
    label = record.get("label")
    return f"record {place} ({record.get('do')})" + (f", {label!r}" if isinstance(label, str) else "")


def checked(place: int, record: Any, points: Mapping[str, Any], axes: tuple[str, ...]) -> dict[str, Any]:
    """The fields of a record, each of its kind, points in numbers.

    Args:
        place: of the record, from 1.
        record: as the file has it.
        points: by their names [mm], or a table of such by the names of axes.
        axes: names of all.

    Raises:
        ProgramError: it is none.
    """
    if not isinstance(record, Mapping):
        raise ProgramError(f"record {place}: is a table: [[record]], do = …")
    do = record.get("do")
    fields = FIELDS.get(do) if isinstance(do, str) else None
    if fields is None:
        raise ProgramError(f"record {place}: do is one of {', '.join(FIELDS)}, not {do!r}")
    found: dict[str, Any] = {"do": do}
    where = told(place, record)
    for name, value in record.items():
        if name == "do":
            continue
        if name not in fields:
            raise ProgramError(f"{where}: has no {name!r}; a {do} takes {', '.join(fields)}")
        found[name] = _value(where, name, value, fields[name], points, axes)
    for name, field in fields.items():
        if field.required and name not in found:
            raise ProgramError(f"{where}: needs {name}")
    if "axis" in found and found["axis"] not in axes:
        raise ProgramError(f"{where}: no axis {found['axis']!r}; there is {', '.join(axes)}")
    return found


def _value(
    where: str, name: str, value: Any, field: Field, points: Mapping[str, Any], axes: tuple[str, ...]
) -> Any:
    takes = field.takes
    if takes == PLACE:
        return _place(f"{where}: {name}", value, points, axes)
    if takes == TRUTH:
        if not isinstance(value, bool):
            raise ProgramError(f"{where}: {name} is true or false, not {value!r}")
        return value
    if takes == CLASS:
        if not isinstance(value, str) or value not in CLASSES:
            raise ProgramError(f"{where}: {name} is one of {', '.join(CLASSES)}, not {value!r}")
        return value
    if takes in (LABEL, NAME):
        if not isinstance(value, str) or not 0 < len(value) <= 64 or not value.isprintable():
            raise ProgramError(f"{where}: {name} is a name of at most 64 characters, not {value!r}")
        return value
    if takes == WHOLE and not (isinstance(value, int) and not isinstance(value, bool)):
        raise ProgramError(f"{where}: {name} is a whole number, not {value!r}")
    return _number(f"{where}: {name}", value, field.low, field.high)


def _number(what: str, value: Any, low: float, high: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise ProgramError(f"{what} is a number from {low:g} to {high:g}, not {value!r}")
    return float(value)


def _place(what: str, value: Any, points: Mapping[str, Any], axes: tuple[str, ...]) -> Any:
    """A number, or one by the names of axes."""
    if isinstance(value, str):
        if value not in points:
            if value.removeprefix("-").replace(".", "", 1).isdecimal():
                raise ProgramError(f"{what}: {value!r} is a text; a number has no quotation marks")
            known = f"there is {', '.join(points)}" if points else "there are no points"
            raise ProgramError(f"{what}: no point {value!r}; {known}: pneud teach {value} makes it")
        value = points[value]
    if isinstance(value, Mapping):
        unknown = [name for name in value if name not in axes]
        if unknown or not value:
            raise ProgramError(f"{what}: is a position, or one by axis ({', '.join(axes)}), not {value!r}")
        return {name: _number(what, number, -MOST_MM, MOST_MM) for name, number in value.items()}
    return _number(what, value, -MOST_MM, MOST_MM)
