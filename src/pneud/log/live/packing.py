"""A record on its way between processes: the tree that it is, as `marshal` writes it.

Whatever fields its parts have, they are there.
`pack.c` beside this file does the same, sooner.
"""

from collections.abc import Callable
from marshal import dumps, loads
from mmap import mmap
from pathlib import Path
from types import NoneType
from typing import Any, NamedTuple, TypeAlias

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

SOURCE = Path(__file__).with_name("pack.c")

Pack: TypeAlias = Callable[[mmap, int, int, Record], None]
"""The one in C: puts a record into memory between two places, or raises one of `REFUSALS`."""

REFUSALS = (ValueError, OverflowError)
"""There is no room, or something that it cannot put there; some of it may be there then."""

_PLAIN = frozenset((float, int, bytes, NoneType))
_WITHOUT_REFERENCES = 2  # a version of `dumps`; to look for what can be referred to takes time


def packed(record: Record) -> bytes:
    """The bytes of a record.

    Raises:
        ValueError: something in it is neither number, bytes nor tuple.
    """
    return dumps(_plain(record), _WITHOUT_REFERENCES)


def _plain(node: Any) -> Any:
    """With tuples and numbers of the classes that `dumps` knows."""
    if isinstance(node, tuple):
        # of a list: tuples of a length that is guessed pile up among those kept for later
        return tuple([part if type(part) in _PLAIN else _plain(part) for part in node])
    return next((kind(node) for kind in (float, int) if isinstance(node, kind)), node)


def unpacked(data: bytes) -> Record:
    """The record again; what follows it is passed over.

    Raises:
        EOFError, TypeError or ValueError: it is none.
    """
    tick, timing, frames, before, sent, truth_m = loads(data)
    t_ns, measurement, request, estimate, reference, command, *rest, told, program, station, weighed = tick
    parts = (
        t_ns,
        Measurement._make(measurement),
        None if request is None else Request._make(request),
        Estimate._make(estimate),
        Reference._make(reference),
        Command._make(command),
        *rest,
        None if told is None else Told._make(told),
        None if program is None else Progress._make(program),
        None if station is None else Station._make(station),
        None if weighed is None else Weighed._make(weighed),
    )
    return Record(
        Tick._make(parts),
        Timing._make(timing),
        _frames(frames),
        before,
        _frames(sent),
        truth_m,
    )


def _frames(found: tuple[Any, ...]) -> tuple[Frame, ...]:
    new = tuple.__new__  # half the time of Frame(…)
    return tuple([new(Frame, frame) for frame in found])


class Skimmed(NamedTuple):
    """A few fields of a record."""

    measurement: Measurement
    lateness_ns: int
    latency_ns: int
    saturated: int


class Drawn(NamedTuple):
    """What curves show of a record."""

    t_ns: int
    error_m: float
    position_m: float
    reference_m: float
    p1_pa: float
    p2_pa: float
    supply_pa: float
    voltage_v: float


_MEASUREMENT, _ESTIMATE, _REFERENCE, _COMMAND = map(
    Tick._fields.index, ("measurement", "estimate", "reference", "command")
)
_SATURATED, _VOLTAGE = map(Command._fields.index, ("saturated", "voltage_v"))
_ESTIMATED, _WANTED = (kind._fields.index("position_m") for kind in (Estimate, Reference))
_PRESSURES = tuple(map(Measurement._fields.index, ("p1_pa", "p2_pa", "supply_pa")))
_LATENESS, _LATENCY = map(Timing._fields.index, ("lateness_ns", "latency_ns"))


def skimmed(data: bytes) -> Skimmed:
    """As `unpacked`, but for a few fields, at a fraction of the cost."""
    tick, timing, *_ = loads(data)
    return Skimmed(
        Measurement._make(tick[_MEASUREMENT]),
        timing[_LATENESS],
        timing[_LATENCY],
        tick[_COMMAND][_SATURATED],
    )


def drawn(data: bytes) -> Drawn:
    """As `skimmed`, for curves."""
    tick = loads(data)[0]
    position_m, reference_m, m = tick[_ESTIMATE][_ESTIMATED], tick[_REFERENCE][_WANTED], tick[_MEASUREMENT]
    p1, p2, supply = _PRESSURES
    return Drawn(
        tick[0],
        reference_m - position_m,
        position_m,
        reference_m,
        m[p1],
        m[p2],
        m[supply],
        tick[_COMMAND][_VOLTAGE],
    )
