"""A log as columns: blocks of some thousand ticks as arrays, for whoever looks at hours.

Ticks are of fixed width, so a block of them is one structured array; frames stand in columns already. What
has another form (a tick with a request, another tool's order of bytes) is decoded by itself.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from pneud.log.files.reader import LoggedState, LogReader, RawBatch
from pneud.log.format.frames import FrameBlock
from pneud.log.format.record_layout import WORD_BITS
from pneud.log.format.records import LAYOUTS, LoggedEvent, TickLayout
from pneud.log.format.schema import BEYOND
from pneud.signals import Request

BLOCK = 4096  # ticks

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

BEFORE, AFTER, SENT = 0, 1, 2  # drained before SYNC left; received after it; sent


class FrameColumns(NamedTuple):
    """The frames of a block; those of a tick in the order in which replay feeds them, then the sent ones."""

    tick: Ints  # index of the tick within the block
    stamp_ns: Ints
    can_id: Ints  # as in struct can_frame, with its flag bits
    length: Ints
    data: NDArray[np.uint64]  # the bytes as one little-endian integer
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
        return Block(
            self.number[begin:end],
            self.log_time_ns[begin:end],
            self.ticks[begin:end],
            frames._replace(tick=frames.tick - begin),
            tuple((index - begin, request) for index, request in self.requests if begin <= index < end),
            self.events,
            self.states,
            {name: words[begin:end] for name, words in self.more.items()},
        )


def blocks(log: LogReader, ticks: int = BLOCK) -> Iterator[Block]:
    """The log from its start.

    Args:
        log: the log; its `truncated`, `damage` and `missing` are valid when the iteration ends.
        ticks: at least so many are in a block, but for the last one and where the level of detail changes.
    """
    waiting: list[RawBatch] = []
    events: list[LoggedEvent] = []
    states: list[LoggedState] = []
    count = 0
    for raw in log.raw():
        if isinstance(raw, LoggedEvent):
            events.append(raw)
        elif isinstance(raw, LoggedState):
            states.append(raw)
        elif isinstance(raw, RawBatch):
            if count >= ticks or (waiting and waiting[0].ticks[0].schema != raw.ticks[0].schema):
                yield from _decoded(log, waiting, events, states)
                waiting, events, states, count = [], [], [], 0
            waiting.append(raw)
            count += len(raw.ticks)
    if waiting or events or states:
        yield from _decoded(log, waiting, events, states)


def _decoded(
    log: LogReader, batches: list[RawBatch], events: list[LoggedEvent], states: list[LoggedState]
) -> Iterator[Block]:
    try:
        yield _block(batches, events, states)
    except (DecodeError, KeyError, ValueError) as e:
        log.damaged_at(batches[0].ticks[0].number, e)


def _block(batches: Sequence[RawBatch], events: list[LoggedEvent], states: list[LoggedState]) -> Block:
    raws = [tick for batch in batches for tick in batch.ticks]
    layout = LAYOUTS[raws[0].schema if raws else "pneud.Tick"]
    ticks, requests, more = _ticks(layout, [r.data for r in raws])
    return Block(
        np.array([r.number for r in raws], dtype=np.int64),
        np.array([r.log_time_ns for r in raws], dtype=np.int64),
        ticks,
        _frames([FrameBlock(batch.frames) for batch in batches], ticks["t_ns"].astype(np.int64)),
        requests,
        tuple(events),
        tuple(states),
        more,
    )


def _ticks(
    layout: TickLayout, messages: list[bytes]
) -> tuple[NDArray[Any], tuple[tuple[int, Request], ...], dict[str, NDArray[np.uint64]]]:
    names, formats, offsets, fixed, at = [], [], [], [], 0
    for place in layout.places:
        fixed += [(at + i, byte) for i, byte in enumerate(place.constant)]
        at += len(place.constant)
        names.append(place.name)
        formats.append(np.dtype(f"<{place.code}"))
        offsets.append(at)
        at += place.width
    plain = np.dtype({"names": names, "formats": formats})
    packed = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": at})
    places = np.array([place for place, _ in fixed])
    wanted = np.array([byte for _, byte in fixed], dtype=np.uint8)

    usual = np.array([len(m) == at for m in messages], dtype=bool)
    found = np.empty(len(messages), dtype=plain)
    rows = np.frombuffer(b"".join(m for m in messages if len(m) == at), dtype=np.uint8).reshape(-1, at)
    same = (rows[:, places] == wanted).all(axis=1)
    usual[usual] = same
    found[usual] = np.ascontiguousarray(rows[same]).view(packed)[:, 0].astype(plain)
    requests, words = [], {}
    for index in np.flatnonzero(~usual).tolist():
        *values, more = layout.unpack(messages[index])
        found[index] = tuple(values)
        if any(more.more):
            words[index] = more.more
        if more.request is not None:
            requests.append((index, more.request))
    beyond = {name: np.zeros(len(messages), dtype=np.uint64) for name in BEYOND} if words else {}
    for index, each in words.items():
        for name, bits in zip(BEYOND, each, strict=True):
            beyond[name][index] = bits
    return found, tuple(requests), beyond


def _frames(messages: Iterable[FrameBlock], t_ns: Ints) -> FrameColumns:
    none = np.zeros(0, dtype=np.int64)
    parts = [FrameColumns(none, none, none, none, none.astype(np.uint64), none)]
    first = 0
    for message in messages:
        parts.append(_frames_of(message, t_ns[first : first + message.count], first))
        first += message.count
    return FrameColumns(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _frames_of(message: FrameBlock, t_ns: Ints, first: int) -> FrameColumns:
    counts = np.array(message.counts, dtype=np.int64).reshape(-1, 3)
    received, before, sent = counts[:, 0], counts[:, 1], counts[:, 2]
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
        padded = np.zeros((int(rows.sum()), 8), dtype=np.uint8)
        padded[:, : column.length] = np.frombuffer(column.rows(), dtype=np.uint8).reshape(
            padded[:, : column.length].shape
        )
        data[rows] = padded.view("<u8")[:, 0]
    return FrameColumns(first + tick, t_ns[tick] + stamp_ns, can_id, length, data, part)
