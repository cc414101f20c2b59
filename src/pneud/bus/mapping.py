"""Codecs for values that are filled from signals, wherever those are: `[bus.signals]`.

A message decodes into a whole row of values, with what it does not carry left open, so that any number of
messages can fill one row. A message with a multiplexer is as many messages as it has kinds.
"""

from __future__ import annotations

import math
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

from pneud.bus.codec import (
    ROLES,
    ROW,
    UNITS,
    Answer,
    Codec,
    Codecs,
    Loader,
    Row,
    assembled,
    can_id_of,
    exact,
)
from pneud.bus.database import MessageSpec, Signal
from pneud.bus.dbc_layout import Code, Guard, SignalField, bit_range, compile_functions, reader
from pneud.bus.wire import CAN_EFF_FLAG
from pneud.config.bus_tables import BusConfig
from pneud.config.mapping import OWN, MessageConfig, SignalConfig, SignalsConfig
from pneud.config.models import GasConfig
from pneud.signals import EncoderStatus, ValveState

SYNC_ID = 0x080  # CANopen's
_NO_ROW = (math.nan, 1, 0.0, math.nan, math.nan, math.nan, math.nan, math.nan, math.nan, int(ValveState.BOOT))
_UNKNOWN = {"status": int(EncoderStatus.ERROR), "state": int(ValveState.FAULT), "enable": 0}
_NUMBERS = {"status": range(8), "state": range(5), "enable": range(2)}  # of the axis
_FLOAT_MOST = {32: (2.0 - 2.0**-23) * 2.0**127, 64: 1.7976931348623157e308}
_NONE = MessageConfig()


def mapped(bus: BusConfig, path: Path, messages: list[MessageSpec], gas: GasConfig | None) -> Codecs:
    """The codecs for `bus.signals`.

    Args:
        bus: with signals.
        path: what to call the DBC in errors.
        messages: of it, or as whoever knows them otherwise has made them.
        gas: where pressures count from the atmosphere, or no sensor tells the supply.

    Raises:
        DatabaseError: a message or a signal is missing or cannot be used; names it and the cure.
        TypeError: gas is needed.
    """
    assert bus.signals is not None
    return _Mapper(path, messages, bus, bus.signals, gas).codecs()


class _Place(NamedTuple):
    """Where a value lies."""

    key: str
    signal: Signal
    field: SignalField


class SignalLoader(Loader):
    """Takes signals from one database, each for one purpose only."""

    tables = "[bus.signals]"  # which name them

    def __init__(self, path: Path, messages: list[MessageSpec], bus: BusConfig) -> None:
        super().__init__(path, messages, bus)
        self._jobs: dict[tuple[str, str], str] = {}  # (message, signal) → what it is for

    def _named(self, name: str) -> MessageSpec:
        """The message of a name, which any value may have."""
        named = [message for message in self.messages if message.name == name]
        if not named:
            there = ", ".join(sorted({message.name for message in self.messages})) or "none"
            raise self._error(name, None, f"not in the database; {self.tables} can name: {there}")
        if len(named) > 1:
            which = " and ".join(f"0x{message.can_id:03X}" for message in named)
            raise self._error(name, None, f"is there {len(named)} times, as {which}; give each its own name")
        self._data_bit_s(named[0])
        return named[0]

    def _signal(self, message: MessageSpec, name: str) -> Signal:
        for signal in message.signals:
            if signal.name == name:
                return signal
        there = ", ".join(signal.name for signal in message.signals) or "none"
        raise self._error(message.name, name, f"not in the message; it has: {there}")

    def _take(self, message: MessageSpec, signal: Signal, job: str) -> None:
        other = self._jobs.setdefault((message.name, signal.name), job)
        if other != job:
            raise self._error(
                message.name, signal.name, f"is {other} and {job}; each needs its own under {self.tables}"
            )

    def _integer(self, message: MessageSpec, signal: Signal) -> SignalField:
        if signal.floating or signal.scale != 1 or signal.offset != 0:
            raise self._error(message.name, signal.name, "has to be an integer with factor 1 and offset 0")
        return self._placed(message, signal, Fraction(1), integer=True)

    def _placed(self, message: MessageSpec, signal: Signal, unit: Fraction, *, integer: bool) -> SignalField:
        if signal.length > 64:
            raise self._error(message.name, signal.name, f"is {signal.length} bits wide; 64 are the most")
        if not signal.floating:
            return super()._placed(message, signal, unit, integer=integer)
        if signal.length not in _FLOAT_MOST:
            raise self._error(message.name, signal.name, f"is no float of {signal.length} bits; 32 or 64")
        place = super()._placed(message, signal._replace(minimum=None, maximum=None), unit, integer=False)
        most, scale, offset = _FLOAT_MOST[signal.length], float(signal.scale), float(signal.offset)
        low, high = -most, most
        if signal.minimum is not None and signal.maximum is not None and signal.minimum < signal.maximum:
            first, last = sorted(((signal.minimum - offset) / scale, (signal.maximum - offset) / scale))
            low, high = max(low, first), min(high, last)
        return place._replace(floating=True, low=low, high=high)

    def _codec(
        self,
        message: MessageSpec,
        fields: list[SignalField | None],
        defaults: list[float | None],
        fixed: tuple[SignalField, int] | None,
        given: MessageConfig | None = None,
    ) -> Codec:
        """The codec of a message with what `[bus.messages]` says of it."""
        given = given or self._bus.messages.get(message.name, _NONE)
        counter = None
        if given.counter is not None:
            signal = self._signal(message, given.counter)
            if signal.floating or signal.selected_by:
                raise self._error(message.name, signal.name, "a counter is an integer in every frame")
            self._take(message, signal, "the counter")
            counter = self._counter(message, given.counter)
        for name, job in ((given.crc, "the checksum"), (given.data_id_nibble, "data_id_nibble")):
            if name is not None:
                self._take(message, self._signal(message, name), job)
        guard = self._guard(f"bus.messages.{message.name}", message, given, counter)
        if counter is not None:
            counter = counter._replace(high=min(counter.high, guard.counter_values - 1))
        made = self._made(can_id_of(message), message.length, fields, defaults, fixed, counter, guard)
        return made._replace(data_bit_s=self._data_bit_s(message))

    def _made(
        self,
        can_id: int,
        length: int,
        fields: list[SignalField | None],
        defaults: list[float | None],
        fixed: tuple[SignalField, int] | None,
        counter: SignalField | None,
        guard: Guard,
    ) -> Codec:
        functions = compile_functions(can_id, length, fields, defaults, counter, guard, fixed)
        age = fields[ROW.index("age_s")] if len(fields) == len(ROW) else None
        return Codec(
            can_id,
            length,
            guard.counter_values,
            *functions,
            counter_field=counter,
            age_field=age,
            guard=guard,
        )


class _Mapper(SignalLoader):
    """Fills each value from one signal."""

    def __init__(
        self,
        path: Path,
        messages: list[MessageSpec],
        bus: BusConfig,
        signals: SignalsConfig,
        gas: GasConfig | None,
    ) -> None:
        super().__init__(path, messages, bus)
        self._signals = signals
        self._gas = gas

    def codecs(self) -> Codecs:
        """All of them."""
        places = self._places()
        command = self._command(places)
        answers, kind_of = [], {}
        for name in self._signals.messages:
            message = self._named(name)
            found = self._answers(message, places[name])
            if len(found) > 1 or found[0].kind is not None:
                selector = next(s for s in message.signals if s.selects)
                kind_of[found[0].codec.can_id] = reader(self._integer(message, selector), message.length)
            answers += found
        sync = self._sync()
        self._check_apart([sync, command, *answers])
        for name in self._bus.messages:
            if name not in places and name != sync.name and name not in self._bus.io_messages:
                raise self._error(
                    name, None, "fills no value; take [bus.messages] for it out, or map a signal"
                )
        fields = {place.key: place.field for found in places.values() for place in found}
        self._check_age(places)
        row = Row(self._row(), kind_of)
        return assembled(
            *(sync.codec, command.codec, tuple(answers), fields["voltage_v"], fields.get("age_s"), row),
            bus=self._bus,
        )

    def _places(self) -> dict[str, list[_Place]]:
        """What is mapped, by message."""
        places: dict[str, list[_Place]] = {}
        for key, told in self._signals:
            if key == "sync" or told is None or told.signal is None:
                continue
            name, _, signal_name = told.signal.partition(".")
            message = self._named(name)
            signal = self._signal(message, signal_name)
            self._take(message, signal, key)
            places.setdefault(name, []).append(_Place(key, signal, self._told(message, key, signal, told)))
        return places

    def _told(self, message: MessageSpec, key: str, signal: Signal, told: SignalConfig) -> SignalField:
        """A value's place, with what makes it the axis's."""
        name = signal.name
        units = UNITS.get(key.rpartition("_")[2])
        if units is None:
            return self._number(message, key, signal, told)
        counts = told.counts_per_m or told.m_per_count
        if counts:
            unit = 1 / exact(counts) if told.counts_per_m else exact(counts)
        elif (text := told.unit or signal.unit or "") in units:
            unit = units[text]
        else:
            shown = f"unit {text!r}" if text else "no unit"
            cure = f"give unit, one of {', '.join(units)}" + (", or counts_per_m" if "m" in units else "")
            raise self._error(message.name, name, f"{shown}; {key} needs one: {cure}")
        if signal.scale == 0:
            raise self._error(message.name, name, "has the factor 0; give it its resolution")
        place = self._placed(message, signal, unit, integer=False)
        shift = told.offset + (self._needed_gas(key).atmosphere_pa if told.gauge else 0.0)
        return place._replace(offset=place.offset + shift)

    def _number(self, message: MessageSpec, key: str, signal: Signal, told: SignalConfig) -> SignalField:
        """The place of a number without a dimension."""
        place = self._integer(message, signal)
        if not told.mask and not told.values:
            return place
        for wire, axis in told.values.items():
            if not 0 <= wire < 1 << min(signal.length, 64):
                raise self._error(
                    message.name, signal.name, f"{key}: {wire} is too wide for {signal.length} bits"
                )
            if axis not in _NUMBERS[key]:
                least, most = _NUMBERS[key][0], _NUMBERS[key][-1]
                raise self._error(message.name, signal.name, f"{key}: {axis} is none of {least} … {most}")
        write: dict[int, int] = {}
        for wire, axis in told.values.items():
            write.setdefault(axis, wire)
        if key == "enable" and told.values and set(write) != {0, 1}:
            raise self._error(message.name, signal.name, "enable: values has to tell what 0 and what 1 are")
        if write and key != "enable":  # what the device cannot tell it shows as if all were well
            well = write.get(1, next(iter(write.values())))
            write = {axis: write.get(axis, well) for axis in _NUMBERS[key]}
        return place._replace(code=Code(told.mask or 0, dict(told.values), _UNKNOWN[key], write))

    def _answers(self, message: MessageSpec, places: list[_Place]) -> list[Answer]:
        """A node's message, once for each of its kinds."""
        kinds = sorted({kind for place in places for kind in place.signal.selected_by})
        found = []
        for kind in (*kinds,) or (None,):
            here = [p for p in places if not p.signal.selected_by or kind in p.signal.selected_by]
            fields = {p.key: p.field for p in here}
            fixed = None if kind is None else self._fixed(message, places, kind)
            codec = self._codec(message, [fields.get(key) for key in ROW], list(self._row()), fixed)
            filled = tuple(key for key in ROW if key in fields)
            found.append(Answer(message.name, codec, ROW, filled, kind))
        return found

    def _fixed(self, message: MessageSpec, places: list[_Place], kind: int) -> tuple[SignalField, int]:
        """The multiplexer, and its value for one kind of the message."""
        selectors = {p.signal.selector for p in places if p.signal.selected_by}
        selector = self._signal(message, str(selectors.pop()))
        if selectors or selector.selected_by:
            raise self._error(
                message.name, selector.name, "multiplexes what is multiplexed; map one level only"
            )
        field = self._integer(message, selector)
        low, high = bit_range(selector.length, selector.signed)
        if not low <= kind <= high:
            raise self._error(
                message.name, selector.name, f"is never {kind} in {selector.length} bits; mend the DBC"
            )
        return field, kind

    def _command(self, places: dict[str, list[_Place]]) -> Answer:
        """The command, whose values are in one message."""
        keys = list(ROLES["valve_command"])
        told = {name: [p for p in found if p.key in OWN] for name, found in places.items()}
        names = [name for name, found in told.items() if found]
        name = names[0]
        if len(names) > 1:
            raise self._error(
                names[1], None, f"the command is in {name}; all its values have to be in one message"
            )
        if len(told[name]) < len(places[name]):
            other = next(p.key for p in places[name] if p.key not in OWN)
            raise self._error(
                name, None, f"is the command and tells {other}; each needs a message of its own"
            )
        message, fields = self._named(name), {p.key: p.field for p in told[name]}
        kinds = {kind for p in told[name] for kind in p.signal.selected_by}
        if len(kinds) > 1:
            raise self._error(
                name, None, "the command is in several kinds of it; all its values have to be in one"
            )
        fixed = self._fixed(message, told[name], kinds.pop()) if kinds else None
        codec = self._codec(message, [fields.get(key) for key in keys], [None, 1, 0], fixed)
        return Answer(name, codec, tuple(keys), tuple(fields))

    def _sync(self) -> Answer:
        told = self._signals.sync
        if told is None or told.signal is None:
            return Answer("SYNC", self._made(SYNC_ID, 0, [], [], None, None, Guard()), (), ())
        name, _, counter = told.signal.partition(".")
        message = self._named(name)
        given = self._bus.messages.get(name, _NONE)
        if counter and given.counter not in (None, counter):
            raise self._error(name, counter, f"and {given.counter} both count it; leave one out")
        codec = self._codec(
            message, [], [], None, given.model_copy(update={"counter": counter or given.counter})
        )
        return Answer(name, codec, (), ())

    def _row(self) -> tuple[float, ...]:
        """The values before anything is heard: constants, and what stands for what no device has."""
        row = list(_NO_ROW)
        for i, key in enumerate(ROW):
            told: SignalConfig | None = getattr(self._signals, key)
            if told is not None and told.constant is not None:
                row[i] = int(told.constant) if key == "status" else told.constant
            elif told is None and key == "supply_pa":
                row[i] = self._needed_gas(key).supply_pa
        return tuple(row)

    def _needed_gas(self, key: str) -> GasConfig:
        if self._gas is None:
            raise TypeError(f"{key} needs gas")
        return self._gas

    def _check_age(self, places: dict[str, list[_Place]]) -> None:
        for name, found in places.items():
            age = next((place for place in found if place.key == "age_s"), None)
            if age is None:
                continue
            position = next((place for place in found if place.key == "position_m"), None)
            if position is None or position.signal.selected_by != age.signal.selected_by:
                raise self._error(name, age.signal.name, "age_s has to be in the frame of position_m")
            if age.field.floating:
                raise self._error(name, age.signal.name, "age_s has to be an integer with a resolution")

    def _check_apart(self, answers: list[Answer]) -> None:
        """Make sure that no two messages come as the same frame."""
        taken: dict[int, str] = {}
        for answer in answers:
            can_id = answer.codec.can_id
            other = taken.setdefault(can_id, answer.name)
            if other != answer.name:
                shown = f"0x{can_id & ~CAN_EFF_FLAG:03X}"
                raise self._error(
                    answer.name, None, f"and {other} both are {shown}; each message needs its own"
                )
