"""A load cell on the bus: the force with which the load presses, from a signal of `bus.load_cell`.

Its message comes when its node likes, and no tick waits for it; what it said last holds, and how old that is
goes along.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from pneud.bus.codec import UNITS, Codec, Codecs
from pneud.bus.database import MessageSpec
from pneud.bus.inbox import CellState, age_ns
from pneud.bus.mapping import SignalLoader
from pneud.bus.switching import Listener, messages_of
from pneud.bus.wire import CAN_EFF_FLAG
from pneud.config.bus_tables import BusConfig
from pneud.config.mapping import SignalConfig
from pneud.signals import Frame


class LoadCell(NamedTuple):
    """Its message."""

    name: str
    codec: Codec  # of one value, the force [N]


def loaded(bus: BusConfig, path: Path, messages: list[MessageSpec], codecs: Codecs) -> LoadCell:
    """The message of `bus.load_cell`.

    Args:
        bus: which signal it is.
        path: what to call the DBC in errors.
        messages: of it.
        codecs: of the axis, which has messages of its own.

    Raises:
        DatabaseError: the message or the signal is missing or cannot be used; names it and the cure.
    """
    assert bus.load_cell is not None
    return _CellLoader(path, messages, bus).loaded(bus.load_cell, codecs)


class _CellLoader(SignalLoader):
    """Makes a force of a signal."""

    tables = "[bus] load_cell"

    def loaded(self, told: SignalConfig, codecs: Codecs) -> LoadCell:
        """The load cell."""
        name, _, signal_name = str(told.signal).partition(".")
        message = self._named(name)
        self._refuse_kinds(message)
        signal = self._signal(message, signal_name)
        self._take(message, signal, "the load cell's force")
        units, text = UNITS["n"], told.unit or signal.unit or ""
        if text not in units:
            shown = f"unit {text!r}" if text else "no unit"
            raise self._error(
                name, signal_name, f"{shown}; a force needs one: unit, one of {', '.join(units)}"
            )
        if signal.scale == 0:
            raise self._error(name, signal_name, "has the factor 0; give it its resolution")
        field = self._placed(message, signal, units[text], integer=False)
        codec = self._codec(message, [field._replace(offset=field.offset + told.offset)], [None], None)
        other = messages_of(codecs).get(codec.can_id)
        if other is not None:
            shown = f"0x{codec.can_id & ~CAN_EFF_FLAG:03X}"
            raise self._error(name, None, f"{shown} is {other}, too; a load cell has a message of its own")
        return LoadCell(name, codec)


class Weighing(Listener):
    """What a load cell has said, and when.

    Attributes:
        can_id: of its message.
    """

    def __init__(self, cell: LoadCell) -> None:
        super().__init__()
        self.can_id = cell.codec.can_id
        self._codec = cell.codec
        self._known = CellState()

    def take(self, frame: Frame) -> None:
        """A frame of it; one that is not valid changes nothing."""
        stamp_ns, _, data = frame
        counter = self._counter(self._codec, self._known.counter, data)
        if counter >= 0:
            self._known = CellState(counter, stamp_ns, self._codec.decode(data)[0])

    @property
    def force_n(self) -> float:
        """What it said last; NaN before."""
        return self._known.force_n

    def age_ns(self, t_ns: int) -> int:
        """How old that is at a tick's SYNC."""
        return age_ns(self._known.stamp_ns, t_ns)

    def freeze(self) -> CellState:
        """The state between two ticks, to be logged."""
        return self._known

    def thaw(self, state: CellState) -> None:
        """Go on from a frozen state."""
        self._known = state
