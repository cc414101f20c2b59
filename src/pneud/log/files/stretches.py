"""Messages of ticks by the hundred: those that follow one another and are alike, as one array of bytes.

What a chunk holds is mostly ticks of one length, so that numbers, times and contents of a whole chunk are
columns of its bytes. What is between them, or of another form, is taken one by one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from pneud.log.files.reader import RowBatch, numbered
from pneud.log.format.framing import (
    HEAD,
    MESSAGE,
    MESSAGE_HEAD,
    OPCODE_MESSAGE,
    LoggedMessage,
    item_at,
)

Ints = NDArray[np.int64]

_ALIKE = HEAD.size + 2  # bytes that begin messages of one channel and length


class Stretch(NamedTuple):
    """Messages in a row, of one channel and one length."""

    channel: int
    sequence: Ints
    log_time_ns: NDArray[np.uint64]
    rows: NDArray[np.uint8]  # what each says

    def singly(self) -> Iterator[LoggedMessage]:
        """One by one."""
        for sequence, time_ns, row in zip(
            self.sequence.tolist(), self.log_time_ns.tolist(), self.rows, strict=True
        ):
            yield LoggedMessage(self.channel, sequence, time_ns, time_ns, row.tobytes())


def together(data: bytes) -> Iterator[Schema | Channel | LoggedMessage | Stretch]:
    """What a chunk holds, decompressed; messages that are alike and follow one another as one.

    Raises:
        one of `framing.NONSENSE`.
    """
    offset, end = 0, len(data)
    while offset < end:
        found = _stretch(data, offset) if data[offset] == OPCODE_MESSAGE else None
        if found is not None:
            yield found
            offset += len(found.rows) * (MESSAGE_HEAD + found.rows.shape[1])
            continue
        item, offset = item_at(data, offset)
        if item is not None:
            yield item


def _stretch(data: bytes, offset: int) -> Stretch | None:
    """The messages from a place on that are alike; None where it is no more than one."""
    _, length = HEAD.unpack_from(data, offset)
    size = HEAD.size + length
    head = data[offset : offset + _ALIKE]
    if length < MESSAGE.size or data[offset + size : offset + size + _ALIKE] != head:
        return None
    most = (len(data) - offset) // size
    if most < 2:
        return None
    rows = np.frombuffer(data, dtype=np.uint8, count=most * size, offset=offset).reshape(most, size)
    same = (rows[:, :_ALIKE] == np.frombuffer(head, dtype=np.uint8)).all(axis=1)
    count = most if same.all() else int(same.argmin())
    table: Any = np.frombuffer(data, dtype=_record(size), count=count, offset=offset)
    return Stretch(
        int(table["channel"][0]),
        table["sequence"].astype(np.int64),
        table["log_time_ns"],
        rows[:count, MESSAGE_HEAD:],
    )


@lru_cache(maxsize=64)
def _record(size: int) -> np.dtype[Any]:
    """A message of so many bytes, head and all."""
    return np.dtype(
        {
            "names": ["channel", "sequence", "log_time_ns"],
            "formats": ["<u2", "<u4", "<u8"],
            "offsets": [HEAD.size, HEAD.size + 2, HEAD.size + 6],
            "itemsize": size,
        }
    )


class TickRows(NamedTuple):
    """Messages of `/axis/tick` with consecutive numbers, of one schema and length."""

    number: Ints  # counts the records of the loop
    log_time_ns: Ints
    schema: str
    rows: NDArray[np.uint8]

    def part(self, begin: int, end: int) -> TickRows:
        """Some of them."""
        return TickRows(
            self.number[begin:end], self.log_time_ns[begin:end], self.schema, self.rows[begin:end]
        )


class Together:
    """Ticks that wait for their frames."""

    @staticmethod
    def split(data: bytes) -> Iterator[Schema | Channel | LoggedMessage | Stretch]:
        """As it is said there."""
        return together(data)

    def __init__(self) -> None:
        self._runs: list[TickRows] = []

    def __len__(self) -> int:
        return sum(len(run.number) for run in self._runs)

    @staticmethod
    def latest_ns(message: LoggedMessage | Stretch) -> int:
        """The latest time of one message, or of several."""
        times = message.log_time_ns
        return times if isinstance(times, int) else int(times.max())

    def put(self, message: LoggedMessage | Stretch, schema: str, last: int) -> None:
        """Some more, behind the tick with this number."""
        if isinstance(message, LoggedMessage):
            number = np.array([numbered(message.sequence, last)], dtype=np.int64)
            times = np.array([message.log_time_ns], dtype=np.int64)
            self._runs.append(
                TickRows(number, times, schema, np.frombuffer(message.data, dtype=np.uint8).reshape(1, -1))
            )
            return
        number = numbered(message.sequence, last)
        times = message.log_time_ns.astype(np.int64)
        breaks = (np.flatnonzero(np.diff(number) != 1) + 1).tolist()
        for begin, end in zip([0, *breaks], [*breaks, len(number)], strict=True):
            self._runs.append(TickRows(number[begin:end], times[begin:end], schema, message.rows[begin:end]))

    def take(self, first: int, count: int, frames: bytes) -> RowBatch | None:
        """So many with consecutive numbers; None where one is not there."""
        found: list[TickRows] = []
        left, wanted, end = list(self._runs), first, first + count
        while wanted < end:
            place = next((i for i, run in enumerate(left) if run.number[0] <= wanted <= run.number[-1]), -1)
            if place < 0:
                return None
            run = left[place]
            begin = wanted - int(run.number[0])
            upto = min(len(run.number), end - int(run.number[0]))
            found.append(run.part(begin, upto))
            rest = run.part(0, begin), run.part(upto, len(run.number))
            left[place : place + 1] = [some for some in rest if len(some.number)]
            wanted = int(run.number[upto - 1]) + 1
        self._runs = left
        return RowBatch(found, frames) if found else None


def rows_of(runs: Sequence[TickRows], length: int) -> NDArray[np.uint8]:
    """All rows of this length, one after another."""
    return np.concatenate(
        [run.rows for run in runs if run.rows.shape[1] == length] or [np.empty((0, length), np.uint8)]
    )
