"""Ticks of one kind by the thousand, as messages: columns put where a tick's message has its numbers."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pneud.log.format.frames import Alike
from pneud.log.format.header import Detail
from pneud.log.format.record_layout import NUMBERS, record_of
from pneud.log.format.records import CHECKED, COARSE, LAYOUTS
from pneud.signals import Record, Timing

_CHANGING = ("state", "present", "latched", "hunting", "command.saturated")
_TELLING = ("measurement.skipped", "measurement.encoder_defects", "measurement.pressure_defects")
_TIMING = "timing."


class Rows(NamedTuple):
    """Ticks without a request or anything else that only some have, and with the same frames."""

    ticks: NDArray[Any]  # structured, with all of `NUMBERS` but the timing
    timing: Timing  # of each of them
    received: tuple[Alike, ...]
    before: int  # how many of those were drained before SYNC left
    sent: tuple[Alike, ...]

    def part(self, begin: int, end: int) -> Rows:
        """Some of the ticks."""
        received, sent = (
            tuple(one._replace(data=one.data[begin * one.length : end * one.length]) for one in of)
            for of in (self.received, self.sent)
        )
        return self._replace(ticks=self.ticks[begin:end], received=received, sent=sent)

    def number(self, name: str) -> Any:
        """A column, or the one number that all of them have."""
        return (
            getattr(self.timing, name.removeprefix(_TIMING)) if name.startswith(_TIMING) else self.ticks[name]
        )

    def record(self, place: int) -> Record:
        """One of them, without its frames."""
        timing = {f"{_TIMING}{name}": value for name, value in self.timing._asdict().items()}
        named = timing | dict(zip(self.ticks.dtype.names or (), self.ticks[place].tolist(), strict=True))
        return record_of(tuple(named[name] for name in NUMBERS), None, (), self.before, ())

    def telling(self) -> Iterator[int]:
        """The places of those in which something changes or has to be told, the first one among them."""
        told = np.zeros(len(self.ticks), dtype=np.bool_)
        told[:1] = True
        for name in _CHANGING:
            told[1:] |= np.diff(self.ticks[name]) != 0
        for name in _TELLING:
            told |= self.ticks[name] != 0
        yield from np.flatnonzero(told).tolist()


class RowPacker:
    """Packs ticks at one level of detail."""

    def __init__(self, detail: Detail) -> None:
        places = LAYOUTS["pneud.Tick" if detail == "compact" else "pneud.FullTick"].places
        names, formats, offsets, constants = [], [], [], b""
        for place in places:
            constants += place.constant
            names.append(place.name)
            formats.append(f"<{place.code}")
            offsets.append(len(constants))
            constants += bytes(place.width)
        self._constants = constants
        self._coarse = [
            at
            for at, name, code in zip(offsets, names, formats, strict=True)
            if code == "<f" and name in COARSE
        ]
        self._dtype = np.dtype(
            {
                "names": names,
                "formats": formats,
                "offsets": offsets,
                "itemsize": len(constants),
            }
        )

    def messages(self, rows: Rows) -> NDArray[np.uint8]:
        """The messages of `/axis/tick`, a row each."""
        count = len(rows.ticks)
        made = np.empty((count, self._dtype.itemsize), dtype=np.uint8)
        made[:] = np.frombuffer(self._constants, dtype=np.uint8)
        fields = made.view(self._dtype)[:, 0]
        with np.errstate(over="ignore"):  # a double beyond the floats is infinite
            for name in NUMBERS:
                fields[name] = rows.number(name)
        fields["check"] = checks(rows)
        for at in self._coarse:
            made[:, at] = 0
        return made


def checks(rows: Rows) -> list[int]:
    """As `records.crc_of`, of each."""
    numbers = np.empty((len(rows.ticks), len(CHECKED)))
    for i, name in enumerate(CHECKED):
        numbers[:, i] = rows.ticks[name]
    return list(map(zlib.crc32, numbers.view(f"V{8 * len(CHECKED)}")[:, 0].tolist()))
