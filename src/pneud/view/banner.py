"""The banner: how the axis is, why it cannot do more, what to do next, and which key does it. Pure."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

from pneud.signals import HUNTING_CURES, Hold, Host, Record, Stage, State, Station
from pneud.view.info import Cause, ScreenInfo
from pneud.view.text import bit_names, clean, length

SILENT_S = 0.5


class Level(Enum):
    """How much it matters."""

    GOOD = "good"
    LOOK = "look here"
    BAD = "bad"


class Banner(NamedTuple):
    """Two sentences."""

    level: Level
    words: str  # how it is, and why
    then: str  # what to do
    keys: tuple[str, ...]  # that make sense now, as in `hands.KEYS`


_FREE = ("h", "g", "t", "left", "d", "m")


def _keys(*own: str) -> tuple[str, ...]:
    """A stop first, whatever else there is."""
    return (" ", *own, "?", "q")


def banner_of(record: Record | None, info: ScreenInfo, silent_s: float) -> Banner:
    """What to say first; behind it what inputs and outputs say, where there are any."""
    found = _banner_of(record, info, silent_s)
    if record is None or record.tick.station is None:
        return found
    return found._replace(words=f"{found.words} ({switched(record.tick.station, info)})")


def switched(station: Station, info: ScreenInfo) -> str:
    """What inputs, outputs and a brake say."""
    parts = []
    for what, bits, names in (("in", station.inputs, info.inputs), ("out", station.outputs, info.outputs)):
        if names:
            parts.append(f"{what}: {', '.join(bit_names(bits, names)) or 'none'}")
    if station.brake in _BRAKE:
        parts.append(_BRAKE[station.brake])
    return "; ".join(parts)


_BRAKE: dict[int, str] = {
    Hold.ENGAGED: "the brake holds",
    Hold.BALANCING: "the brake holds until the piston bears the load",
    Hold.RELEASING: "the brake lets go",
    Hold.RELEASED: "the brake has let go",
    Hold.ENGAGING: "the brake engages",
}


def _banner_of(record: Record | None, info: ScreenInfo, silent_s: float) -> Banner:
    if record is None:
        if silent_s > SILENT_S:
            words = f"no ticks for {silent_s:.1f} s: the loop does not run, or not yet"
            return Banner(Level.BAD, words, "see what the daemon has said on standard error", _keys())
        return Banner(Level.LOOK, "waiting for the first tick", "", _keys())
    if silent_s > SILENT_S:
        words = f"no ticks for {silent_s:.1f} s: all below is as old"
        return Banner(Level.BAD, words, "see what the daemon says; pneud doctor", _keys())
    tick = record.tick
    found = _PARTS.get(tick.state)
    if found is None:
        return _at_rest(record, info)
    words, own = found
    keys = _keys(*own)
    if tick.state == State.TRACKING:
        words = f"follows the reference, {length(tick.error_m).strip()} off"
    cause = _cause(tick.present, info)
    if tick.hunting:
        words = "hunting: the load, or its command, swings without end"
        return Banner(Level.LOOK, words, f"check {HUNTING_CURES.get(tick.hunting, 'the gains')}", keys)
    if cause is not None:
        return Banner(Level.LOOK, f"{words}; {cause.words}", cause.cure, keys)
    if tick.in_position and tick.state == State.PRESSING:
        words = "presses with the force asked for"
    elif tick.in_position:
        words = f"holds, in position, {length(tick.error_m).strip()} off its target"
    if tick.progress.stage >= Stage.UNDER_WAY:
        rounds = f", {tick.progress.lap} rounds done" if tick.progress.lap else ""
        return Banner(Level.GOOD, f"record {tick.progress.step} of its program{rounds}: {words}", _ENDS, keys)
    if tick.progress.stage == Stage.STOPPED:
        words += f"; its program stopped in record {tick.progress.step}"
    return Banner(Level.GOOD, words, "space stops it" + _MORE.get(State(tick.state), ""), keys)


_PARTS: dict[int, tuple[str, tuple[str, ...]]] = {
    State.TRACKING: ("follows the reference", ("h", "g", "left", "d", "m")),
    State.MOVING: ("moves", _FREE),
    State.HOLDING: ("holds still", _FREE),
    State.HOMING: ("looks for the encoder's reference", ()),
    State.STOPPING: ("comes to rest", ()),
    State.PROBING: ("opens the valve slowly: the movement test", ()),
    State.PRESSING: ("presses with a force", ("h", "g", "d", "m")),
}
_ENDS = "space stops it; h ends the program and holds"
_MORE = {
    State.TRACKING: "; h holds, g goes to a position",
    State.MOVING: "; g goes elsewhere",
    State.PRESSING: "; h holds where it is",
    State.HOLDING: "; g goes to a position, t follows the reference, ← → move",
}


def _at_rest(record: Record, info: ScreenInfo) -> Banner:
    """Of an axis that is not engaged: what it would take."""
    tick = record.tick
    blocking = tick.present & info.blocks_arm
    cause = _cause(tick.latched or blocking, info)
    if tick.state == State.FAULT:
        gone = not tick.latched & tick.present
        why = f"fault: {cause.words}" if cause else f"fault: {_names(tick.latched, info)}"
        if blocking and gone and (other := _cause(blocking, info)) is not None:
            return Banner(Level.BAD, f"{why} (over); now {other.words}", other.cure, _keys("c"))
        if gone:
            then = f"c clears it, then a arms; {_cure(cause)}"
            return Banner(Level.BAD, f"{why} (over)", then, _keys("c", "a"))
        return Banner(Level.BAD, why, f"{_cure(cause)}; then c clears", _keys("c"))
    if blocking:
        state = "cannot be armed" if tick.state == State.DISARMED else "waits"
        words = f"{state}: {cause.words if cause else _names(blocking, info)}"
        if bit_names(blocking, info.fault_names) == ["encoder_unreferenced"]:
            return Banner(Level.LOOK, words, "r homes it", _keys("r"))
        return Banner(Level.LOOK, words, _cure(cause), _keys())
    if tick.state == State.DISARMED:
        words = "disarmed: the valve is centred, and nothing is in the way"
        return Banner(Level.LOOK, words, "a arms it and holds it where it is", _keys("a"))
    return Banner(Level.LOOK, "waits for its nodes", "", _keys())


def _cause(bits: int, info: ScreenInfo) -> Cause | None:
    return info.first_cause(bit_names(bits, info.fault_names)) if bits else None


def _cure(cause: Cause | None) -> str:
    return cause.cure if cause else "see docs/safety.md"


def _names(bits: int, info: ScreenInfo) -> str:
    return ", ".join(bit_names(bits, info.fault_names))


def faults_of(record: Record, info: ScreenInfo) -> list[tuple[str, Level]]:
    """Names of the faults that are latched, then of those that are present, and what the host says."""
    tick = record.tick
    latched = [(name, Level.BAD) for name in bit_names(tick.latched, info.fault_names)]
    others = bit_names(tick.present & ~tick.latched, info.fault_names)
    host = [h.name.lower().replace("_", " ") for h in Host if tick.measurement.host & h and h.name]
    return latched + [(clean(name), Level.LOOK) for name in others + host]
