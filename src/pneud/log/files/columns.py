"""A log as columns: blocks of some thousand ticks as arrays, for whoever looks at hours.

Ticks are of fixed width, so a block of them is one structured array; frames stand in columns already. What
has another form (a tick with a request, another tool's order of bytes) is decoded by itself.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from pneud.log.files.reader import LoggedState, LogReader, RowBatch
from pneud.log.files.stretches import TickRows, rows_of
from pneud.log.format.frames import FrameBlock
from pneud.log.format.record_layout import WORD_BITS
from pneud.log.format.records import LAYOUTS, LoggedEvent, TickLayout
from pneud.log.format.schema import BEYOND
from pneud.signals import Request

BLOCK = 4096  # ticks

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

_WORD_BYTES = 8

BEFORE, AFTER, SENT = 0, 1, 2  # drained before SYNC left; received after it; sent


class FrameColumns(NamedTuple):
    """The frames of a block; those of a tick in the order in which replay feeds them, then the sent ones."""

    tick: Ints  # index of the tick within the block
    stamp_ns: Ints
    can_id: Ints  # as in struct can_frame, with its flag bits
    length: Ints
    data: NDArray[np.uint64]  # the bytes as one little-endian integer, the first eight of more
    part: Ints  # BEFORE, AFTER or SENT


class Block(NamedTuple):
    """Ticks in a row as they stand in the log."""

    number: Ints  # counts the records of the loop from 1; a gap is where records were dropped
    log_time_ns: Ints  # Unix
    ticks: NDArray[Any]  # structured, named as in the message: `t_ns`, `estimate.force_n`, …
    frames: FrameColumns
    requests: tuple[tuple[int, Request], ...]  # with the index of their tick within the block
    events: tuple[LoggedEvent, ...]
    states: tuple[LoggedState, ...]
    more: Mapping[str, NDArray[np.uint64]] = MappingProxyType({})  # words of `BEYOND`, if there are any
    long: Mapping[int, bytes] = MappingProxyType({})  # data of frames of more than eight bytes, by place

    def faults(self, name: str) -> tuple[tuple[int, NDArray[np.uint64]], ...]:
        """The bits of `present` or `latched` as words, each with the number of its first bit."""
        more = self.more.get(f"{name}_more")
        none = np.zeros(len(self.number), dtype=np.uint64)
        return (0, self.ticks[name]), (WORD_BITS, none if more is None else more)

    def real(self, name: str) -> Floats:
        """A field of the ticks as doubles."""
        return np.asarray(self.ticks[name], dtype=np.float64)

    def part(self, begin: int, end: int) -> Block:
        """Some of the ticks, with all of the events and snapshots."""
        kept = (self.frames.tick >= begin) & (self.frames.tick < end)
        frames = FrameColumns._make(column[kept] for column in self.frames)
        places = np.cumsum(kept) - 1
        return Block(
            self.number[begin:end],
            self.log_time_ns[begin:end],
            self.ticks[begin:end],
            frames._replace(tick=frames.tick - begin),
            tuple((index - begin, request) for index, request in self.requests if begin <= index < end),
            self.events,
            self.states,
            {name: words[begin:end] for name, words in self.more.items()},
            {int(places[i]): data for i, data in self.long.items() if kept[i]},
        )


def blocks(log: LogReader, ticks: int = BLOCK, *, frames: bool = True) -> Iterator[Block]:
    """The log from its start.

    Args:
        log: the log; its `truncated`, `damage` and `missing` are valid when the iteration ends.
        ticks: at least so many are in a block, but for the last one and where the level of detail changes.
        frames: wanted; else none are in the blocks, which is sooner done.
    """
    waiting: list[RowBatch] = []
    events: list[LoggedEvent] = []
    states: list[LoggedState] = []
    count = 0
    for raw in log.rows():
        if isinstance(raw, LoggedEvent):
            events.append(raw)
        elif isinstance(raw, LoggedState):
            states.append(raw)
        elif isinstance(raw, RowBatch):
            if count >= ticks or (waiting and waiting[0].ticks[0].schema != raw.ticks[0].schema):
                yield from _decoded(log, waiting, events, states, frames)
                waiting, events, states, count = [], [], [], 0
            waiting.append(raw)
            count += sum(len(run.number) for run in raw.ticks)
    if waiting or events or states:
        yield from _decoded(log, waiting, events, states, frames)


def _decoded(
    log: LogReader,
    batches: list[RowBatch],
    events: list[LoggedEvent],
    states: list[LoggedState],
    frames: bool,
) -> Iterator[Block]:
    try:
        yield _block(batches, events, states, frames)
    except (DecodeError, KeyError, ValueError) as e:
        log.damaged_at(int(batches[0].ticks[0].number[0]), e)


_NOTHING = TickRows(np.zeros(0, np.int64), np.zeros(0, np.int64), "pneud.Tick", np.zeros((0, 0), np.uint8))


def _block(
    batches: Sequence[RowBatch], events: list[LoggedEvent], states: list[LoggedState], framed: bool
) -> Block:
    runs = [run for batch in batches for run in batch.ticks] or [_NOTHING]
    ticks, requests, more = _ticks(LAYOUTS[runs[0].schema], runs)
    messages = [FrameBlock(batch.frames) for batch in batches] if framed else []
    frames, long = _frames(messages, ticks["t_ns"].astype(np.int64))
    return Block(
        np.concatenate([run.number for run in runs]),
        np.concatenate([run.log_time_ns for run in runs]),
        ticks,
        frames,
        requests,
        tuple(events),
        tuple(states),
        more,
        long,
    )


class _Table(NamedTuple):
    """Where the numbers of a message are, if it is of the usual form."""

    plain: np.dtype[Any]
    packed: np.dtype[Any]
    places: Ints  # of the bytes between them
    constant: NDArray[np.uint8]  # what those are

    @classmethod
    @lru_cache(maxsize=4)
    def of(cls, layout: TickLayout) -> _Table:
        """Of a level of detail."""
        names, formats, offsets, fixed, at = [], [], [], [], 0
        for place in layout.places:
            fixed += [(at + i, byte) for i, byte in enumerate(place.constant)]
            at += len(place.constant)
            names.append(place.name)
            formats.append(np.dtype(f"<{place.code}"))
            offsets.append(at)
            at += place.width
        return cls(
            np.dtype({"names": names, "formats": formats}),
            np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": at}),
            np.array([place for place, _ in fixed]),
            np.array([byte for _, byte in fixed], dtype=np.uint8),
        )


def usual_ticks(runs: Sequence[TickRows]) -> NDArray[Any] | None:
    """The numbers of ticks, named as in the message; None where one has more than that, or another form."""
    table = _Table.of(LAYOUTS[runs[0].schema])
    if any(run.rows.shape[1] != table.packed.itemsize for run in runs):
        return None
    rows = rows_of(runs, table.packed.itemsize)
    if not (rows[:, table.places] == table.constant).all():
        return None
    return np.ascontiguousarray(rows).view(table.packed)[:, 0]


def _ticks(
    layout: TickLayout, runs: Sequence[TickRows]
) -> tuple[NDArray[Any], tuple[tuple[int, Request], ...], dict[str, NDArray[np.uint64]]]:
    table = _Table.of(layout)
    length = table.packed.itemsize
    usual = np.concatenate([np.full(len(run.number), run.rows.shape[1] == length) for run in runs])
    found = np.empty(len(usual), dtype=table.plain)
    rows = rows_of(runs, length)
    same = (rows[:, table.places] == table.constant).all(axis=1)
    usual[usual] = same
    found[usual] = np.ascontiguousarray(rows[same]).view(table.packed)[:, 0].astype(table.plain)
    requests, words = [], {}
    for index, message in _others(runs, usual):
        *values, more = layout.unpack(message)
        found[index] = tuple(values)
        if any(more.more):
            words[index] = more.more
        if more.request is not None:
            requests.append((index, more.request))
    beyond = {name: np.zeros(len(usual), dtype=np.uint64) for name in BEYOND} if words else {}
    for index, each in words.items():
        for name, bits in zip(BEYOND, each, strict=True):
            beyond[name][index] = bits
    return found, tuple(requests), beyond


def _others(runs: Sequence[TickRows], usual: NDArray[np.bool_]) -> Iterator[tuple[int, bytes]]:
    """The messages that are of another form, with their places."""
    first = 0
    for run in runs:
        count = len(run.number)
        for index in np.flatnonzero(~usual[first : first + count]).tolist():
            yield first + index, run.rows[index].tobytes()
        first += count


def _frames(messages: Iterable[FrameBlock], t_ns: Ints) -> tuple[FrameColumns, dict[int, bytes]]:
    none = np.zeros(0, dtype=np.int64)
    parts = [FrameColumns(none, none, none, none, none.astype(np.uint64), none)]
    long: dict[int, bytes] = {}
    first = place = 0
    for message in messages:
        parts.append(_frames_of(message, t_ns[first : first + message.count], first))
        long.update((place + i, data) for i, data in _long(message))
        first += message.count
        place += len(message.order)
    return FrameColumns(*(np.concatenate(columns) for columns in zip(*parts, strict=True))), long


def _frames_of(message: FrameBlock, t_ns: Ints, first: int) -> FrameColumns:
    received, before, sent = (
        np.array(column, dtype=np.int64) for column in (message.received, message.before, message.sent)
    )
    each = received + sent
    tick = np.repeat(np.arange(len(each)), each)
    place = np.arange(len(tick)) - np.repeat(np.cumsum(each) - each, each)  # within the tick
    part = np.where(place >= received[tick], SENT, np.where(place < before[tick], BEFORE, AFTER))
    order = np.array(message.order, dtype=np.int64)
    stamp_ns, can_id, length = (np.zeros(len(order), dtype=np.int64) for _ in range(3))
    data = np.zeros(len(order), dtype=np.uint64)
    for index, column in enumerate(message.columns):
        rows = order == index
        stamp_ns[rows] = np.frombuffer(column.stamps(), dtype="<i8")
        can_id[rows], length[rows] = column.can_id, column.length
        count, kept = column.frame_count, min(column.length, _WORD_BYTES)
        padded = np.zeros((count, _WORD_BYTES), dtype=np.uint8)
        given = np.frombuffer(column.rows(), dtype=np.uint8).reshape(count, column.length)
        padded[:, :kept] = given[:, :kept]
        data[rows] = padded.view("<u8")[:, 0]
    return FrameColumns(first + tick, t_ns[tick] + stamp_ns, can_id, length, data, part)


def _long(message: FrameBlock) -> Iterator[tuple[int, bytes]]:
    """Places and data of frames that do not fit into a word."""
    for index, column in enumerate(message.columns):
        if column.length > _WORD_BYTES:
            places = (i for i, of in enumerate(message.order) if of == index)
            yield from zip(places, (data for _, _, data in column.frames()), strict=True)
