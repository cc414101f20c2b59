"""What follows from the other fields of a tick, as viewers get it behind them.

A log goes without: it would grow by a tenth of what whoever reads it can make himself.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

from pneud.log.format.records import names_of, varint
from pneud.log.format.schema import DERIVED, tick_fields
from pneud.signals import Record, state_name

_FIRST = 1 + len(tick_fields("compact")[1])  # number of the first of these fields
_NUMBERS = 3  # come first, each a double
_TAGS = [varint(_FIRST + i << 3 | (1 if i < _NUMBERS else 2)) for i in range(len(DERIVED))]
_STATE_NAME, _FAULT_NAMES = _TAGS[_NUMBERS:]


class Deriver:
    """Makes it for one tick after the other; `t_s` counts from the first one."""

    def __init__(self, fault_names: Sequence[str]) -> None:
        """Nothing yet; names of the faults are by bit."""
        self._fault_names = tuple(fault_names)
        self._first_ns: int | None = None

    def behind(self, record: Record) -> bytes:
        """What stands behind the packed record, in a message with the fields `DERIVED`."""
        tick = record.tick
        if self._first_ns is None:
            self._first_ns = tick.t_ns
        values = (1e-9 * (tick.t_ns - self._first_ns), tick.error_m, record.true_error_m)
        parts = [tag + struct.pack("<d", value) for tag, value in zip(_TAGS, values, strict=False)]
        parts.append(_text(_STATE_NAME, state_name(tick.state)))
        names = names_of(tick.present | tick.latched, self._fault_names)
        parts += [_text(_FAULT_NAMES, name) for name in names]
        return b"".join(parts)


def _text(tag: bytes, text: str) -> bytes:
    encoded = text.encode()
    return tag + varint(len(encoded)) + encoded
