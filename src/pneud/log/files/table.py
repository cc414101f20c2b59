"""A log's ticks as columns with names and units, and what follows from them beside the fields themselves."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pneud.log.files.columns import Block
from pneud.log.files.reader import LogReader
from pneud.log.format.meanings import meaning_of, unit_of
from pneud.log.format.records import names_of
from pneud.log.format.schema import BEYOND
from pneud.signals import Reference, error_m, state_name, true_error_m

Column = NDArray[Any]

_OWN_MEANINGS = {
    "number": "counts the records of the loop from 1; a gap is where records were dropped",
    "log_time_ns": "instant of the tick as Unix time",
    "request.kind": "what was asked for; 0 where nothing was",
}


def about(name: str) -> dict[str, str]:
    """Unit and meaning of a column."""
    return {"unit": unit_of(name), "description": _OWN_MEANINGS.get(name) or meaning_of(name)}


class TickTable:
    """Makes columns of one block after the other; `t_s` counts from the first tick."""

    def __init__(self, log: LogReader) -> None:
        self._names = log.fault_names
        self._first_ns: int | None = None

    def columns(self, block: Block) -> dict[str, Column]:
        """All numbers of a block in SI units, as doubles and integers of 64 bits; words as objects."""
        ticks = block.ticks
        if self._first_ns is None and len(ticks):
            self._first_ns = int(ticks["t_ns"][0])
        kinds = np.zeros(len(block.number), dtype=np.int64)
        for index, request in block.requests:
            kinds[index] = request.kind
        reference = Reference._make(block.real(f"reference.{name}") for name in Reference._fields)
        offset_ns = ticks["measurement.encoder_offset_ns"]
        return {
            "number": block.number,
            "log_time_ns": block.log_time_ns,
            **{name: _wide(ticks[name]) for name in ticks.dtype.names or ()},
            **{name: _wide(block.faults(name.removesuffix("_more"))[1][1]) for name in BEYOND},
            "request.kind": kinds,
            "t_s": (ticks["t_ns"] - (self._first_ns or 0)) * 1e-9,
            "error_m": error_m(reference, block.real("estimate.position_m")),
            "true_error_m": true_error_m(reference, offset_ns, block.real("truth_m")),
            "state_name": _words(ticks["state"], state_name),
            "fault_names": _words(_faults(block), lambda bits: " ".join(names_of(bits, self._names))),
        }


def _faults(block: Block) -> Column:
    """All bits of faults in a tick; Python's integers where they need them."""
    (_, present), (beyond, more) = (
        (words[0], words[1] | latched[1])
        for words, latched in zip(block.faults("present"), block.faults("latched"), strict=True)
    )
    return present.astype(object) | more.astype(object) << beyond if block.more else present


def _wide(column: Column) -> Column:
    return column.astype(np.float64 if column.dtype.kind == "f" else np.int64)


def _words(numbers: Column, word_of: Any) -> Column:
    """A word for each number, made once for each that there is."""
    found, places = np.unique(numbers, return_inverse=True)
    return np.array([word_of(number) for number in found.tolist()], dtype=object)[places]
