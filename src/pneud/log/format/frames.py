"""The frames of consecutive ticks as one message, by columns, and back again.

Columns of bytes compress to half of what the same frames take one after another; `schema` says how they lie.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice, repeat
from typing import NamedTuple

from pneud.log.format.schema import message_class
from pneud.signals import Frame, Record

MOST_BYTES = 64  # of a frame of CAN FD
_Frames = message_class("pneud.Frames")


class Alike(NamedTuple):
    """One frame of each of some ticks."""

    can_id: int
    length: int
    after_ns: int  # stamp, counted from t_ns of its tick
    data: bytes  # of all of them


class FramesPacker:
    """Gathers the frames of consecutive ticks."""

    def __init__(self) -> None:
        self._clear()

    def _clear(self) -> None:
        self._received: list[int] = []
        self._before: list[int] = []
        self._sent: list[int] = []
        self._order: list[int] = []
        self._columns: dict[tuple[int, int], int] = {}
        self._stamps: list[array[int]] = []
        self._data: list[list[bytes]] = []

    def __len__(self) -> int:
        return len(self._received)

    def add(self, record: Record) -> None:
        """The frames of one more tick.

        Raises:
            ValueError or OverflowError: one is no CAN frame; nothing of the tick is taken then.
        """
        t_ns = record.tick.t_ns
        columns, order, stamps, payloads = self._columns, self._order, self._stamps, self._data
        before = len(order)
        try:
            for stamp_ns, can_id, data in (*record.frames, *record.sent):
                column = columns.get((can_id, len(data)))
                if column is None:
                    column = self._new_column(can_id, len(data))
                stamps[column].append(stamp_ns - t_ns)
                payloads[column].append(data)
                order.append(column)
        except (ValueError, OverflowError):
            for column in order[before:]:
                stamps[column].pop()
                payloads[column].pop()
            del order[before:]
            raise
        self._received.append(len(record.frames))
        self._before.append(record.before)
        self._sent.append(len(record.sent))

    def add_alike(self, ticks: int, received: Sequence[Alike], before: int, sent: Sequence[Alike]) -> None:
        """The frames of so many more ticks, each of which has the same ones.

        Args:
            ticks: how many.
            received: in their order.
            before: how many of them were drained before SYNC left.
            sent: in their order.
        """
        order = []
        for can_id, length, after_ns, data in (*received, *sent):
            column = self._columns.get((can_id, length))
            if column is None:
                column = self._new_column(can_id, length)
            self._stamps[column] += array("q", (after_ns,)) * ticks
            self._data[column].append(data)
            order.append(column)
        self._order += order * ticks
        self._received += [len(received)] * ticks
        self._before += [before] * ticks
        self._sent += [len(sent)] * ticks

    def _new_column(self, can_id: int, length: int) -> int:
        if can_id >> 32 or length > MOST_BYTES:
            raise ValueError(f"a frame {can_id:#x} of {length} bytes")
        self._stamps.append(array("q"))
        self._data.append([])
        self._columns[can_id, length] = column = len(self._columns)
        return column

    def take(self) -> bytes:
        """The message of `/can/frames` of all ticks since the last time."""
        message = _Frames(received=self._received, before=self._before, sent=self._sent, order=self._order)
        for (can_id, length), column in self._columns.items():
            stamps = self._stamps[column]
            message.columns.add(
                can_id=can_id,
                length=length,
                stamp_after_t_ns=_planes(struct.pack(f"<{len(stamps)}q", *stamps), 8),
                data=_planes(b"".join(self._data[column]), length),
            )
        self._clear()
        packed: bytes = message.SerializeToString()
        return packed


def _planes(rows: bytes, width: int) -> bytes:
    """All first bytes of the rows, then all second ones, and so on."""
    return b"".join([rows[i::width] for i in range(width)])


def _rows(planes: bytes, width: int, count: int) -> bytes:
    """The other way round.

    Raises:
        ValueError: not that many rows.
    """
    if len(planes) != width * count:
        raise ValueError(f"a column of {len(planes)} bytes does not hold {count} times {width}")
    rows = bytearray(len(planes))
    for i in range(width):
        rows[i::width] = planes[i * count : (i + 1) * count]
    return bytes(rows)


class Column(NamedTuple):
    """All frames of one identifier and length in a message, in their order."""

    can_id: int
    length: int
    stamp_planes: bytes
    data_planes: bytes
    frame_count: int

    def stamps(self) -> bytes:
        """Their stamps, counted from t_ns of their ticks, as little-endian 64-bit integers."""
        return _rows(self.stamp_planes, 8, self.frame_count)

    def rows(self) -> bytes:
        """Their data, one after another."""
        return _rows(self.data_planes, self.length, self.frame_count)

    def frames(self) -> Iterator[tuple[int, int, bytes]]:
        """Stamp, identifier, data of each."""
        n, rows = self.length, self.rows()
        stamps = struct.unpack(f"<{self.frame_count}q", self.stamps())
        data = [rows[i : i + n] for i in range(0, len(rows), n)] if n else repeat(b"")
        return zip(stamps, repeat(self.can_id), data, strict=False)


def tick_count(data: bytes) -> int:
    """Of how many ticks a message of `/can/frames` is.

    Raises:
        google.protobuf.message.DecodeError: not such a message.
    """
    return len(_Frames.FromString(data).received)


class FrameBlock:
    """A message of `/can/frames` as read.

    Attributes:
        received: frames of each tick.
        before: those among them that were drained before SYNC left.
        sent: frames sent.
        count: number of ticks.
        order: of each frame, in which column it stands; tick by tick, received ones, then sent ones.
        columns: the columns.
    """

    def __init__(self, data: bytes) -> None:
        """Take it apart.

        Raises:
            google.protobuf.message.DecodeError: not such a message.
            ValueError: its columns do not fit together.
        """
        message = _Frames.FromString(data)
        self.received, self.before, self.sent = (
            list(column) for column in (message.received, message.before, message.sent)
        )
        self.count = len(self.received)
        self.order = list(message.order)
        if not self.count == len(self.before) == len(self.sent):
            raise ValueError("frames of some ticks only")
        if sum(self.received) + sum(self.sent) != len(self.order):
            raise ValueError("frames of no tick")
        if self.order and max(self.order) >= len(message.columns):
            raise ValueError("frames in a column that is not there")
        self.columns = [
            Column(c.can_id, c.length, c.stamp_after_t_ns, c.data, self.order.count(index))
            for index, c in enumerate(message.columns)
        ]
        if any(column.length > MOST_BYTES for column in self.columns):
            raise ValueError(f"a frame of more than {MOST_BYTES} bytes")

    def ticks(self, t_ns: Iterable[int]) -> Iterator[tuple[tuple[Frame, ...], int, tuple[Frame, ...]]]:
        """For each tick: frames received, how many of them were drained before SYNC left, frames sent.

        Raises:
            ValueError: not as many as there are ticks, or a column is too short.
        """
        new = tuple.__new__  # half the time of Frame(…)
        columns = [column.frames() for column in self.columns]
        frames = map(next, map(columns.__getitem__, self.order))
        for t, received, before, sent in zip(t_ns, self.received, self.before, self.sent, strict=True):
            yield (
                tuple([new(Frame, (t + s, i, d)) for s, i, d in islice(frames, received)]),
                before,
                tuple([new(Frame, (t + s, i, d)) for s, i, d in islice(frames, sent)]),
            )
