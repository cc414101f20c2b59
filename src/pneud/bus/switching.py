"""Inputs and outputs on the bus: messages whose signals are on or off, by the names of the configuration.

Input messages come when their node likes, and no tick waits for them; what one said last holds, and how old
it is goes along. Output messages leave when they change, and now and then, so that their node sees that
somebody is there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

from pneud.bus.codec import Codec, Codecs
from pneud.bus.database import MessageSpec, Signal
from pneud.bus.dbc_layout import reader
from pneud.bus.inbox import NEVER_NS, InputState, age_ns
from pneud.bus.mapping import SignalLoader
from pneud.bus.wire import CAN_EFF_FLAG
from pneud.config.bus_tables import BusConfig
from pneud.config.mapping import SignalConfig
from pneud.signals import Frame, Heard


class Switch(NamedTuple):
    """One input or output."""

    name: str
    bit: int
    place: int  # of its signal among those of the message
    mask: int  # of the signal's bits; 0 for all of them
    on: int  # what the masked signal is where it is on
    off: int
    any_on: bool  # every other number is on, too


class SwitchMessage(NamedTuple):
    """A message of inputs or outputs."""

    name: str
    codec: Codec
    read: tuple[Callable[[bytes], int], ...]  # its signals
    switches: tuple[Switch, ...]

    def bits(self, data: bytes) -> int:
        """What is on, by the frame's bytes."""
        raws, found = [read(data) for read in self.read], 0
        for one in self.switches:
            raw = raws[one.place] & one.mask if one.mask else raws[one.place]
            if raw != one.off if one.any_on else raw == one.on:
                found |= 1 << one.bit
        return found

    def encode(self, bits: int, counter: int) -> bytes:
        """The bytes that say what is on."""
        raws = [0] * len(self.read)
        for one in self.switches:
            raws[one.place] |= one.on if bits >> one.bit & 1 else one.off
        return self.codec.encode(*raws, counter=counter % self.codec.counter_values)

    def mask(self) -> int:
        """The bits that it has."""
        return sum(1 << one.bit for one in self.switches)


class Switching(NamedTuple):
    """All inputs and outputs of an axis."""

    inputs: tuple[SwitchMessage, ...]
    outputs: tuple[SwitchMessage, ...]
    period_ns: int  # outputs are sent at least so often

    @property
    def messages(self) -> tuple[SwitchMessage, ...]:
        """Those of both."""
        return (*self.inputs, *self.outputs)

    @property
    def fd_ids(self) -> frozenset[int]:
        """Identifiers of those whose frames are of CAN FD."""
        return frozenset(m.codec.can_id for m in self.messages if m.codec.data_bit_s)


def loaded(bus: BusConfig, path: Path, messages: list[MessageSpec], codecs: Codecs) -> Switching:
    """The messages of `bus.inputs` and `bus.outputs`.

    Args:
        bus: which signals they are.
        path: what to call the DBC in errors.
        messages: of it.
        codecs: of the axis, which has messages of its own.

    Raises:
        DatabaseError: a message or a signal is missing or cannot be used; names it and the cure.
    """
    return _SwitchLoader(path, messages, bus).loaded(codecs)


class _SwitchLoader(SignalLoader):
    """Makes switches of signals."""

    tables = "[bus.inputs] and [bus.outputs]"

    def loaded(self, codecs: Codecs) -> Switching:
        """All of them."""
        inputs, outputs = self._bus.inputs, self._bus.outputs
        period_ns = round(self._bus.output_period_ms * 1e6)
        found = Switching(self._messages("inputs", inputs), self._messages("outputs", outputs), period_ns)
        taken = messages_of(codecs)
        for message in found.messages:
            other = taken.setdefault(message.codec.can_id, message.name)
            if other != message.name or (message in found.inputs and message.name in _names(found.outputs)):
                shown = f"0x{message.codec.can_id & ~CAN_EFF_FLAG:03X}"
                words = f"{shown} is {other}, too; inputs and outputs have messages of their own"
                raise self._error(message.name, None, words)
        return found

    def _messages(self, what: str, told: Mapping[str, SignalConfig]) -> tuple[SwitchMessage, ...]:
        by_message: dict[str, list[tuple[str, int, SignalConfig]]] = {}
        for bit, (name, value) in enumerate(told.items()):
            message, _, _ = str(value.signal).partition(".")
            by_message.setdefault(message, []).append((name, bit, value))
        return tuple(self._message_of(what, name, found) for name, found in by_message.items())

    def _message_of(self, what: str, name: str, told: list[tuple[str, int, SignalConfig]]) -> SwitchMessage:
        message = self._named(name)
        self._refuse_kinds(message)
        places: dict[str, int] = {}
        used: dict[str, int] = {}  # bits of each signal that are somebody's already
        signals: list[Signal] = []
        switches = []
        for own, bit, value in told:
            signal = self._signal(message, str(value.signal).partition(".")[2])
            if signal.name not in places:
                self._take(message, signal, what)
                places[signal.name] = len(signals)
                signals.append(signal)
            switch = self._switch(message, signal, own, bit, places[signal.name], value)
            bits = switch.mask or (1 << signal.length) - 1
            if used.get(signal.name, 0) & bits:
                raise self._error(name, signal.name, f"{own}: these bits are another's; give each its mask")
            used[signal.name] = used.get(signal.name, 0) | bits
            switches.append(switch)
        fields = [self._integer(message, signal) for signal in signals]
        codec = self._codec(message, [*fields], [None] * len(fields), None)
        read = tuple(reader(field, message.length) for field in fields)
        return SwitchMessage(name, codec, read, tuple(switches))

    def _switch(
        self, message: MessageSpec, signal: Signal, name: str, bit: int, place: int, value: SignalConfig
    ) -> Switch:
        mask, values = value.mask or 0, value.values
        for number in (mask, *values):
            if not 0 <= number < 1 << min(signal.length, 64):
                words = f"{name}: {number} is too wide for {signal.length} bits"
                raise self._error(message.name, signal.name, words)
        if signal.signed and signal.length > 1:
            raise self._error(message.name, signal.name, f"{name}: has to be unsigned")
        if not values:
            return Switch(name, bit, place, mask, mask or 1, 0, any_on=True)
        on = [number for number, state in values.items() if state == 1]
        off = [number for number, state in values.items() if state == 0]
        if not on:  # all else is on
            return Switch(name, bit, place, mask, off[0], off[0], any_on=True)
        return Switch(name, bit, place, mask, on[0], off[0] if off else 0, any_on=False)


def _names(messages: tuple[SwitchMessage, ...]) -> tuple[str, ...]:
    return tuple(message.name for message in messages)


def messages_of(codecs: Codecs) -> dict[int, str]:
    """What each identifier is that an axis has so far."""
    taken = {codecs.sync.can_id: "SYNC", codecs.valve_command.can_id: "the valve's command"}
    taken |= {answer.codec.can_id: answer.name for answer in codecs.answers}
    switches = () if codecs.switching is None else codecs.switching.messages
    return taken | {message.codec.can_id: message.name for message in switches}


class Listener:
    """Who hears messages that no tick waits for; a frame that is not valid changes nothing.

    Attributes:
        crc: frames with a wrong checksum or length.
        stale: frames whose counter stood still.
    """

    def __init__(self) -> None:
        self.crc = self.stale = 0

    def _counter(self, codec: Codec, known: int, data: bytes) -> int:
        """The counter of a frame that says something, behind a known one; −1 of any other."""
        counter = codec.check(data)
        if counter < 0:
            self.crc += 1
        elif codec.counter_values > 1 and counter == known:
            self.stale += 1
            return -1
        return counter


class Hearing(Listener):
    """What input messages have said, and when."""

    def __init__(self, messages: tuple[SwitchMessage, ...]) -> None:
        super().__init__()
        self._messages = {message.codec.can_id: message for message in messages}
        self._known = dict.fromkeys(self._messages, InputState())

    def hears(self, can_id: int) -> bool:
        """Whether a frame with this identifier is one of inputs."""
        return can_id in self._messages

    def take(self, frame: Frame) -> None:
        """A frame of inputs; one that is not valid changes nothing."""
        stamp_ns, can_id, data = frame
        message = self._messages[can_id]
        counter = self._counter(message.codec, self._known[can_id].counter, data)
        if counter >= 0:
            self._known[can_id] = InputState(counter, stamp_ns, message.bits(data))

    def heard(self, t_ns: int) -> Heard:
        """What they say at this tick's SYNC."""
        bits, oldest_ns = 0, NEVER_NS
        for state in self._known.values():
            bits |= state.bits
            oldest_ns = min(oldest_ns, state.stamp_ns)
        return Heard(bits, age_ns(oldest_ns, t_ns))

    def freeze(self) -> tuple[InputState, ...]:
        """The state between two ticks, to be logged."""
        return tuple(self._known.values())

    def thaw(self, states: tuple[InputState, ...]) -> None:
        """Go on from a frozen state."""
        self._known = dict(zip(self._messages, states, strict=True))


class Saying:
    """Sends output messages: where one has changed, and every so often."""

    def __init__(self, messages: tuple[SwitchMessage, ...], period_ns: int) -> None:
        self._messages = messages
        self._masks = tuple(message.mask() for message in messages)
        self._period_ns = period_ns
        self._counters = [0] * len(messages)
        self._said = [-1] * len(messages)
        self._due_ns = [0] * len(messages)

    def due(self, outputs: int, t_ns: int) -> list[tuple[int, bytes]]:
        """What is to be sent in a tick: identifiers and bytes.

        Args:
            outputs: bits.
            t_ns: this tick's SYNC.
        """
        found = []
        for i, message in enumerate(self._messages):
            bits = outputs & self._masks[i]
            if bits != self._said[i] or t_ns >= self._due_ns[i]:
                found.append((message.codec.can_id, message.encode(bits, self._counters[i])))
                self._counters[i] += 1
                self._said[i], self._due_ns[i] = bits, t_ns + self._period_ns
        return found
