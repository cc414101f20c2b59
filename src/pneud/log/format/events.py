"""What happened, in words, from what changed between one record and the next."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from pneud.log.format.records import LoggedEvent
from pneud.log.format.schema import Level
from pneud.signals import HUNTING_CURES, Answer, Defect, Hold, Hunting, Record, RequestKind, State, Station

_QUIET_NS = 1_000_000_000
_ODD, _CONFIRMED = int(Defect.ODD), int(Defect.CONFIRMED)
_OFTEN = (RequestKind.JOG, RequestKind.PIECE, RequestKind.PROBE)  # asked many times a second


class _Limiter:
    """Lets one event of a kind through per second and counts the others."""

    def __init__(self) -> None:
        self._open_from: dict[str, int] = {}
        self._held: dict[str, int] = {}

    def admit(self, kind: str, t_ns: int) -> str | None:
        """Words on those held back since the last one of the kind; None to hold this one back as well."""
        if t_ns < self._open_from.get(kind, t_ns):
            self._held[kind] = self._held.get(kind, 0) + 1
            return None
        self._open_from[kind] = t_ns + _QUIET_NS
        held = self._held.pop(kind, 0)
        return f" ({held} more since the last message)" if held else ""


class EventSource:
    """Watches the records of one run."""

    def __init__(
        self,
        fault_names: tuple[str, ...],
        offset_ns: int,
        inputs: Sequence[str] = (),
        outputs: Sequence[str] = (),
    ) -> None:
        self._names = fault_names
        self._switches = (("inputs", tuple(inputs)), ("outputs", tuple(outputs)))
        self._station: Station | None = None
        self._offset_ns = offset_ns
        self._limiter = _Limiter()
        self._state = -1
        self._present = 0
        self._latched = 0
        self._saturated = 0
        self._saturated_ticks = 0
        self._hunting = 0

    def after(self, record: Record) -> Iterator[LoggedEvent]:
        """The events of one record, given those before it."""
        tick = record.tick
        t_ns = tick.t_ns
        if tick.request is not None:
            kind, values = tick.request
            words = " ".join([_label(RequestKind, kind), *(f"{value:g}" for value in values)])
            level = Level.INFO
            if tick.answer > Answer.TAKEN:
                level, words = Level.WARNING, f"{words}: {_label(Answer, tick.answer)}"
            if kind in _OFTEN:
                yield from self.message(t_ns, level, "request", words)
            else:
                yield self._event(t_ns, level, "request", words)
        if tick.state != self._state:
            yield self._state_change(t_ns, tick.state)
        if tick.latched != self._latched or tick.present != self._present:
            yield from self._fault_changes(t_ns, tick.present, tick.latched)
        if tick.station is not None and tick.station != self._station:
            yield from self._switched(t_ns, tick.station)
        if tick.measurement.skipped:
            yield from self.message(t_ns, Level.WARNING, "loop", f"skipped {tick.measurement.skipped} ticks")
        if tick.hunting != self._hunting:
            self._hunting = tick.hunting
            words = (
                "over"
                if not tick.hunting
                else f"{_label(Hunting, tick.hunting)}: check {HUNTING_CURES.get(tick.hunting)}"
            )
            yield from self.message(t_ns, Level.WARNING if tick.hunting else Level.INFO, "hunting", words)
        m = tick.measurement
        for name, defects in (("encoder", m.encoder_defects), ("pressure", m.pressure_defects)):
            if defects & _ODD:
                yield from self.message(t_ns, Level.WARNING, name, "reading held back: beyond physics")
            if defects & _CONFIRMED:
                yield from self.message(t_ns, Level.INFO, name, "confirmed by the next reading")
        if tick.command.saturated != self._saturated:
            self._saturated = tick.command.saturated
            words = "saturated" if self._saturated else f"saturation over after {self._saturated_ticks} ticks"
            yield from self.message(t_ns, Level.INFO, "output", words)
            self._saturated_ticks = 0
        self._saturated_ticks += self._saturated

    def pass_over(self, ticks: int) -> None:
        """So many ticks in which nothing happened that had not in the one before."""
        self._saturated_ticks += ticks * self._saturated

    def _state_change(self, t_ns: int, state: int) -> LoggedEvent:
        old, self._state = self._state, state
        label = _label(State, state)
        words = label if old < 0 else f"{_label(State, old)} → {label}"
        return self._event(t_ns, Level.ERROR if state == State.FAULT else Level.INFO, "state", words)

    def _switched(self, t_ns: int, station: Station) -> Iterator[LoggedEvent]:
        before, self._station = self._station or Station(0, 0, int(Hold.NONE)), station
        for (what, names), was, now in zip(self._switches, before, station, strict=False):
            for bit in _bits(was ^ now):
                name = names[bit] if bit < len(names) else str(bit)
                words = f"{name} {'on' if now >> bit & 1 else 'off'}"
                yield from self.message(t_ns, Level.INFO, what, words)
        if before.brake != station.brake:
            yield self._event(t_ns, Level.INFO, "brake", _label(Hold, station.brake))

    def _fault_changes(self, t_ns: int, present: int, latched: int) -> Iterator[LoggedEvent]:
        for bit in _bits(latched & ~self._latched):
            yield self._event(t_ns, Level.ERROR, "fault", f"{self._fault(bit)} latched")
        for bit in _bits(self._latched & ~latched):
            yield self._event(t_ns, Level.INFO, "fault", f"{self._fault(bit)} cleared")
        for bit in _bits(present & ~self._present & ~latched):
            yield from self.message(t_ns, Level.WARNING, "fault", f"{self._fault(bit)} present")
        for bit in _bits(self._present & ~present):
            yield from self.message(t_ns, Level.INFO, "fault", f"{self._fault(bit)} gone")
        self._present, self._latched = present, latched

    def _fault(self, bit: int) -> str:
        return self._names[bit] if bit < len(self._names) else f"fault {bit}"

    def message(self, t_ns: int, level: Level, name: str, words: str) -> Iterator[LoggedEvent]:
        """An event, if its kind is not held back."""
        kind = words if name == "fault" else f"{name} {words.split(maxsplit=1)[0]}"
        held = self._limiter.admit(kind, t_ns)
        if held is not None:
            yield self._event(t_ns, level, name, words + held)

    def _event(self, t_ns: int, level: Level, name: str, words: str) -> LoggedEvent:
        return LoggedEvent(t_ns + self._offset_ns, level, name, words)


def _label(names: type[Answer | Hold | Hunting | RequestKind | State], value: int) -> str:
    try:
        return names(value).name.lower()
    except ValueError:
        return str(value)


def _bits(mask: int) -> Iterator[int]:
    while mask:
        low = mask & -mask
        yield low.bit_length() - 1
        mask ^= low
