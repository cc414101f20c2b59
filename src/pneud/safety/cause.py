"""One cause before its many consequences: which of the faults that hold explains the others.

Where no node answers, position and pressures are unknown, too, and so are travel and supply: seven faults, of
whose cures six mislead. Nothing here decides anything; it is what people are told first.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

from pneud.safety.fault_row import Fault, Reaction
from pneud.safety.faults import TABLE

_SENSES = ("encoder", "pressure", "valve")
_OF_ENCODER = (
    *("encoder_unreferenced", "encoder_lost_reference", "encoder_jump", "travel", "unsettled", "moving"),
    *("overspeed", "tracking_error", "braking_distance"),
)
_OF_PRESSURE = ("chamber_pressure", "supply_pressure", "supply_falling", "pressure_jump", "unsettled")
_OF_VALVE = ("valve_timed_out", "valve_rebooted", "valve_disagrees", "valve_active", "unsettled")
_STALLED = (
    *("valve_timed_out", "valve_rebooted", "tracking_error", "encoder_jump", "encoder_stuck", "console_lost"),
    *("pressure_jump", "receive_overflow"),
)
_MISSING = tuple(f"{source}_missing" for source in _SENSES)
_ALL = (*_MISSING, *_OF_ENCODER, *_OF_PRESSURE, *_OF_VALVE)
_BUS = (*_ALL, "send_failed", "send_blocked", "heartbeat_lost")


class Cause(NamedTuple):
    """What is wrong first."""

    words: str  # one sentence without its full stop
    cure: str
    faults: tuple[str, ...]  # those of the present ones that it explains


class _Story(NamedTuple):
    """Faults that, all together, mean something that explains others."""

    of: tuple[str, ...]
    explains: tuple[str, ...]
    words: str = ""  # empty for what the table says of the first one
    cure: str = ""


_STORIES = (
    _Story(("link_down",), (*_BUS, "bus_off", "bus_passive")),
    _Story(("bus_off",), (*_BUS, "bus_passive")),
    _Story(("sync_lost",), (*_ALL, *(f"{source}_late" for source in _SENSES))),
    _Story(
        ("send_blocked", *_MISSING),
        (*_BUS, "bus_passive"),
        "nothing on the bus acknowledges a frame",
        "check the nodes' power, the wiring and its termination, and that all have this bit rate",
    ),
    _Story(
        ("heartbeat_lost", *_MISSING),
        (*_BUS, "bus_passive"),
        "no node answers, and not all of them are operational",
        "check that the nodes have power and are on this bus; where pneud configures them, the journal says"
        " which one it waits for, and why",
    ),
    _Story(
        _MISSING,
        (*_BUS, "bus_passive"),
        "nothing on the bus answers SYNC",
        "check that the nodes have power, are on this bus, and have its bit rate and the DBC's identifiers",
    ),
    _Story(("other_controller",), ("valve_active", "valve_disagrees", "identifier_clash")),
    _Story(("no_realtime", "deadline"), _STALLED),
    _Story(("overloaded", "deadline"), _STALLED),
    _Story(("deadline",), _STALLED),
    _Story(
        ("encoder_missing", "pressure_missing"),
        (*_OF_ENCODER, *_OF_PRESSURE),
        "neither encoder nor pressures answer SYNC",
        "check the two nodes' power and wiring; where they share a branch, check that",
    ),
    *(
        _Story((f"{source}_{lack}",), of)
        for lack in ("missing", "corrupt", "frozen", "late")
        for source, of in zip(_SENSES, (_OF_ENCODER, _OF_PRESSURE, _OF_VALVE), strict=True)
    ),
    _Story(("valve_fault",), _OF_VALVE),
    _Story(("brake_stuck",), ("tracking_error", "encoder_stuck", "force_disagrees", "encoder_jump")),
    _Story(("supply_falling",), ("supply_pressure", "chamber_pressure", "saturated", "saturated_long")),
    _Story(("supply_pressure",), ("chamber_pressure", "saturated", "saturated_long", "tracking_error")),
)
_BY_NAME = {fault.name: fault for fault in TABLE}
_STRENGTH = (Reaction.CENTRE, Reaction.STOP, Reaction.NO_ARM, Reaction.WARN, Reaction.LIMIT)


def first_cause(found: Collection[str]) -> Cause | None:
    """What to tell of first, and what to do about it.

    Args:
        found: names of the faults that are present or latched; those that are not known are passed over.

    Returns:
        None where there are none.
    """
    for story in _STORIES:
        if all(name in found for name in story.of):
            first = _BY_NAME[story.of[0]]
            explained = {*story.of, *story.explains}
            words, cure = story.words or first.when, story.cure or first.cure
            return Cause(words, cure, tuple(name for name in _BY_NAME if name in found and name in explained))
    known = [_BY_NAME[name] for name in _BY_NAME if name in found]
    if not known:
        return None
    worst: Fault = min(known, key=lambda fault: _STRENGTH.index(fault.reaction))
    return Cause(worst.when, worst.cure, (worst.name,))
