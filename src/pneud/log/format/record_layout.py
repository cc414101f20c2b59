"""The layout of a record in a log: which numbers it has, in which order, and what each is called.

It follows from the records in `signals` by their annotations, so that a field more in one of them is in the
messages, too. Who reads or packs them asks for names here, and counts no positions.
"""

from __future__ import annotations

from typing import Any, get_type_hints

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
)

PARTS: dict[str, Any] = {
    "measurement": Measurement,
    "estimate": Estimate,
    "reference": Reference,
    "command": Command,
    "timing": Timing,
}
"""The records within a record, in the order of their numbers."""


def _codes(part: str, of: Any) -> dict[str, str]:
    types = get_type_hints(of)
    return {
        f"{part}.{name}": "d" if types[name] is float else "q" if name.endswith("_ns") else "I"
        for name in of._fields
    }


NUMBERS: dict[str, str] = {
    "t_ns": "q",
    **{name: code for part, of in PARTS.items() for name, code in _codes(part, of).items()},
    "state": "B",
    "present": "Q",
    "latched": "Q",
    "answer": "B",
    "truth_m": "d",
    "in_position": "I",
    "hunting": "B",
}
"""All numbers of a record but those of its request and frames, with their codes of `struct`.

Bits of the fault table are Q, enumerations B.
"""

WORD_BITS = 63
"""Bits of the fault table in `present` and `latched`; those from there on have words of their own."""
_WORD = (1 << WORD_BITS) - 1

_NAMES = list(NUMBERS)
_STATE = _NAMES.index("state")


def _place(part: str) -> slice:
    first = _NAMES.index(f"{part}.{PARTS[part]._fields[0]}")
    return slice(first, first + len(PARTS[part]._fields))


_PLACES = [(of, _place(part)) for part, of in PARTS.items()]


def numbers_of(record: Record) -> tuple[Any, ...]:
    """The numbers of a record in the order of `NUMBERS`."""
    tick = record.tick
    return (
        tick.t_ns,
        *tick.measurement,
        *tick.estimate,
        *tick.reference,
        *tick.command,
        *record.timing,
        tick.state,
        tick.present & _WORD,
        tick.latched & _WORD,
        tick.answer,
        record.truth_m,
        tick.in_position,
        tick.hunting,
    )


def beyond(tick: Tick) -> tuple[int, int]:
    """The bits of `present` and `latched` that `NUMBERS` has no room for."""
    return tick.present >> WORD_BITS, tick.latched >> WORD_BITS


def record_of(
    numbers: tuple[Any, ...],
    request: Request | None,
    frames: tuple[Frame, ...],
    before: int,
    sent: tuple[Frame, ...],
    more: tuple[int, int] = (0, 0),
    told: Told | None = None,
    program: Progress | None = None,
    station: Station | None = None,
    weighed: Weighed | None = None,
) -> Record:
    """The record with these numbers and `beyond`; what stands behind those of `NUMBERS` is left out."""
    m, e, r, c, timing = [of._make(numbers[place]) for of, place in _PLACES]
    state, present, latched, answer, truth_m, in_position, hunting = numbers[_STATE : len(NUMBERS)]
    present, latched = present | more[0] << WORD_BITS, latched | more[1] << WORD_BITS
    tick = Tick(numbers[0], m, request, e, r, c, state, present, latched, answer, in_position, hunting)
    return Record(
        tick._replace(told=told, program=program, station=station, weighed=weighed),
        *(timing, frames, before, sent, truth_m),
    )
