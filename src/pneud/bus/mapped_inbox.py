"""The inbox of an axis whose values are filled from signals: several messages make one source.

A source is fresh when all that it is made of has come in this tick. Of a multiplexed message, of which not
every kind need come in every tick, what has come waits for the rest. What no device tells is known otherwise:
constants, one pressure by the other, and the valve by the last command.
"""

from __future__ import annotations

from collections.abc import Sequence

from pneud.bus.codec import ROW, SOURCES, Codecs
from pneud.bus.inbox import CORRUPT, FROZEN, NEVER_NS, Inbox, InboxState, Origin, OriginState
from pneud.config.bus_tables import BusConfig
from pneud.signals import EncoderStatus, Frame, Measurement, ValveState

_POSITION, _STATUS, _AGE, _SECOND, _P1, _P2, _DIFFERENCE, _SUPPLY, _APPLIED, _STATE = range(len(ROW))
_ERROR = int(EncoderStatus.ERROR)
_KINDS_FROM = 1 << 32  # identifiers of the kinds of a multiplexed message: beyond all that a bus has
_UNKNOWN = OriginState(-1, 0, 0, -NEVER_NS, ())


def inbox_of(codecs: Codecs, bus: BusConfig) -> Inbox:
    """The inbox for these codecs."""
    return Inbox(codecs, bus) if codecs.row is None else MappedInbox(codecs, bus)


class _Gate:
    """What is common to the kinds of a multiplexed message."""

    def __init__(self, codecs: Codecs, can_id: int) -> None:
        assert codecs.row is not None
        self.kind_of = codecs.row.kind_of[can_id]
        self.parts: dict[int, Origin] = {}  # by kind
        self.counter = -1


class MappedInbox(Inbox):
    """As `Inbox`, for codecs with a `row`; `echo` is to be set to the last command that left."""

    def __init__(self, codecs: Codecs, bus: BusConfig) -> None:
        assert codecs.row is not None
        self._constants = codecs.row.values
        self._apart_m = bus.encoders_apart_m
        self._gates: dict[int, _Gate] = {}
        self._kinds = 0  # bits of the parts that are kinds
        super().__init__(codecs, bus)
        self._origins = {o.codec.can_id: o for o in self._sources if not o.bit & self._kinds}
        for can_id, gate in self._gates.items():
            for kind, part in gate.parts.items():
                self._origins[_kind_id(can_id, kind)] = part
        tells: list[Origin | None] = [None] * len(ROW)
        for part, answer in reversed(list(zip(self._sources, self._answers, strict=True))):
            for key in answer.filled:
                tells[ROW.index(key)] = part
        self._tells = tells
        self._needed = tuple(
            sum({o.bit for o in (tells[ROW.index(key)] for key in keys) if o is not None})
            for keys in SOURCES.values()
        )
        self._parts_of = tuple([o for o in self._sources if o.bit & need] for need in self._needed)
        self._awaited = 0

    def _listened(self, codecs: Codecs, bus: BusConfig) -> Sequence[Origin]:
        origins = []
        self._answers = sorted(codecs.answers, key=lambda answer: "position_m" not in answer.filled)
        for i, answer in enumerate(self._answers):
            codec = answer.codec
            tells_age = "age_s" in answer.filled or self._constants[_AGE] > 0.0
            aged = "position_m" in answer.filled and tells_age
            # a message's kinds have one counter, which the gate looks at
            counted = answer.kind is None
            told = bus.messages.get(answer.name)
            period_us = None if told is None else told.period_us
            origin = Origin(
                1 << i, codec, self._constants, bus, has_age=aged, counted=counted, period_us=period_us
            )
            if answer.kind is not None:
                gate = self._gates.setdefault(codec.can_id, _Gate(codecs, codec.can_id))
                gate.parts[answer.kind] = origin
                self._kinds |= origin.bit
            origins.append(origin)
        return origins

    def _feed_other(self, stamp_ns: int, can_id: int, data: bytes) -> None:
        gate = self._gates.get(can_id)
        if gate is None:
            super()._feed_other(stamp_ns, can_id, data)
            return
        codec = next(iter(gate.parts.values())).codec
        counter = codec.check(data)
        if counter < 0:
            self._rx += 1
            self._crc += 1
            self._spoil(gate, CORRUPT)
        elif codec.counter_values > 1 and counter == gate.counter:
            self._rx += 1
            self._stale += 1
            self._spoil(gate, FROZEN)
        else:
            gate.counter = counter
            kind = gate.kind_of(data)
            if kind in gate.parts:
                self.feed(Frame(stamp_ns, _kind_id(can_id, kind), data))
            else:
                self._rx += 1

    def _spoil(self, gate: _Gate, defect: int) -> None:
        for part in gate.parts.values():
            part.defects |= defect

    def measurement(self, skipped: int, host: int) -> Measurement:
        """The newest valid values; ends this tick."""
        t_ns, tells = self._t_ns, self._tells
        came = self._fresh | self._awaited
        row = [
            value if part is None else part.values[i]
            for i, (part, value) in enumerate(zip(tells, self._constants, strict=True))
        ]
        if tells[_DIFFERENCE] is not None:
            if tells[_P1] is None:
                row[_P1] = row[_P2] + row[_DIFFERENCE]
            else:
                row[_P2] = row[_P1] - row[_DIFFERENCE]
        encoders = self._needed[0]  # readings of two SYNCs say nothing of each other
        apart_m = abs(row[_POSITION] - row[_SECOND]) if came & encoders == encoders else 0.0
        if tells[_SECOND] is not None and not apart_m <= self._apart_m:
            row[_STATUS] = int(row[_STATUS]) | _ERROR
        echo_v, enabled = self.echo
        if tells[_APPLIED] is None:
            row[_APPLIED] = echo_v
        if tells[_STATE] is None:
            row[_STATE] = int(ValveState.ENABLED if enabled else ValveState.CENTRED)
        offset_ns = self._offset_ns()
        if self._fresh & self._encoder.bit and self.sync:
            readings = self._readings
            self._readings = (readings[1], readings[2], (t_ns, row[_POSITION]))
        fresh, used = 0, 0
        for i, need in enumerate(self._needed):
            if came & need == need:
                fresh |= 1 << i
                used |= need
        encoder_ns, pressure_ns, valve_ns = (
            0 if fresh & 1 << i else max(part.age_ns(t_ns, came) for part in parts)
            for i, parts in enumerate(self._parts_of)
        )
        encoder_defects, pressure_defects, valve_defects = (_united(parts) for parts in self._parts_of)
        self._awaited = came & self._kinds & ~used
        self._fresh = 0
        return Measurement(
            t_ns,
            fresh,
            row[_POSITION],
            row[_P1],
            row[_P2],
            row[_SUPPLY],
            row[_APPLIED],
            int(row[_STATUS]),
            int(row[_STATE]),
            encoder_ns,
            pressure_ns,
            valve_ns,
            encoder_defects,
            pressure_defects,
            valve_defects,
            offset_ns,
            skipped,
            host,
        )

    def freeze(self) -> InboxState:
        """The state after `measurement`, to be logged."""
        return InboxState(
            _UNKNOWN,
            _UNKNOWN,
            _UNKNOWN,
            self.commanded_ns,
            self._syncs,
            self._t_ns,
            self._readings,
            tuple(part.freeze() for part in self._sources),
            tuple(gate.counter for gate in self._gates.values()),
            self._awaited,
            self.echo,
            self._known_offset_ns,
            self._frozen_inputs(),
            self._frozen_cell(),
        )

    def thaw(self, state: InboxState) -> None:
        """Go on from a frozen state."""
        for part, known in zip(self._sources, state.parts, strict=True):
            part.thaw(known)
        for gate, counter in zip(self._gates.values(), state.counters, strict=True):
            gate.counter = counter
        self._awaited, self.echo = state.awaited, state.echo
        self._thaw_times(state)


def _united(parts: Sequence[Origin]) -> int:
    """The defects of any of these."""
    found = 0
    for part in parts:
        found |= part.defects
    return found


def _kind_id(can_id: int, kind: int) -> int:
    return _KINDS_FROM * (kind + 1) + can_id if kind >= 0 else _KINDS_FROM * kind + can_id
