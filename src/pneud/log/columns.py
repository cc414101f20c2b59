"""A log as columns: blocks of some thousand ticks as arrays, for whoever looks at hours.

Ticks are of fixed width, so a block of them is one structured array; frames and timing are decoded for a
whole block at once. What has another form (a tick with a request, another tool's order of bytes) is decoded
by itself.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from pneud.log.reader import LogReader, RawTick
from pneud.log.records import LAYOUTS, LoggedEvent, TickLayout, unpack_frames, unpack_timing
from pneud.signals import Request, Timing

BLOCK = 4096  # ticks

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

BEFORE, AFTER, SENT = 0, 1, 2  # drained before SYNC left; received after it; sent

_MARGIN = 32  # bytes that may be read beyond the end
_VARINT = 10  # bytes of the longest one


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
    timing: Ints  # a column for each field of `Timing`
    frames: FrameColumns
    requests: tuple[tuple[int, Request], ...]  # with the index of their tick within the block
    events: tuple[LoggedEvent, ...]

    def real(self, name: str) -> Floats:
        """A field of the ticks as doubles."""
        return np.asarray(self.ticks[name], dtype=np.float64)

    def part(self, begin: int, end: int) -> Block:
        """Some of the ticks, with all of the events."""
        kept = (self.frames.tick >= begin) & (self.frames.tick < end)
        frames = FrameColumns._make(column[kept] for column in self.frames)
        return Block(
            self.number[begin:end],
            self.log_time_ns[begin:end],
            self.ticks[begin:end],
            self.timing[begin:end],
            frames._replace(tick=frames.tick - begin),
            tuple((index - begin, request) for index, request in self.requests if begin <= index < end),
            self.events,
        )


def blocks(log: LogReader, ticks: int = BLOCK) -> Iterator[Block]:
    """The log from its start.

    Args:
        log: the log; its `truncated`, `damage` and `missing` are valid when the iteration ends.
        ticks: in a block, but for the last one and where the level of detail changes.
    """
    waiting: list[RawTick] = []
    events: list[LoggedEvent] = []
    for raw in log.raw():
        if isinstance(raw, LoggedEvent):
            events.append(raw)
            continue
        if len(waiting) == ticks or (waiting and waiting[0].schema != raw.schema):
            yield from _decoded(log, waiting, events)
            waiting, events = [], []
        waiting.append(raw)
    if waiting or events:
        yield from _decoded(log, waiting, events)


def _decoded(log: LogReader, raws: list[RawTick], events: list[LoggedEvent]) -> Iterator[Block]:
    try:
        yield _block(raws, events)
    except (DecodeError, KeyError, ValueError) as e:
        log.damaged_at(raws[0].number, e)


def _block(raws: Sequence[RawTick], events: list[LoggedEvent]) -> Block:
    layout = LAYOUTS[raws[0].schema if raws else "pneud.Tick"]
    ticks, requests = _ticks(layout, [r.tick for r in raws])
    return Block(
        np.array([r.number for r in raws], dtype=np.int64),
        np.array([r.log_time_ns for r in raws], dtype=np.int64),
        ticks,
        _timing([r.timing for r in raws]),
        _frames([r.frames for r in raws], ticks["t_ns"].astype(np.int64)),
        requests,
        tuple(events),
    )


def _ticks(layout: TickLayout, messages: list[bytes]) -> tuple[NDArray[Any], tuple[tuple[int, Request], ...]]:
    names, formats, offsets, fixed, at = [], [], [], [], 0
    for name, constant, code in layout.parts():
        fixed += [(at + i, byte) for i, byte in enumerate(constant)]
        at += len(constant)
        kind = np.dtype({"q": "<i8", "Q": "<u8", "I": "<u4", "f": "<f4", "d": "<f8", "B": "u1"}[code])
        names.append(name)
        formats.append(kind)
        offsets.append(at)
        at += kind.itemsize
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
    requests = []
    for index in np.flatnonzero(~usual).tolist():
        *values, request = layout.unpack(messages[index])
        found[index] = tuple(values)
        if request is not None:
            requests.append((index, request))
    return found, tuple(requests)


def _joined(messages: Sequence[bytes]) -> tuple[NDArray[np.uint8], Ints, Ints]:
    """Bytes of all messages with a margin, and where each begins and ends."""
    ends = np.cumsum([len(m) for m in messages], dtype=np.int64)
    starts = np.concatenate(([0], ends[:-1])).astype(np.int64) if len(ends) else ends
    return np.frombuffer(b"".join(messages) + bytes(_MARGIN), dtype=np.uint8), starts, ends


def _varints(data: NDArray[np.uint8], at: Ints) -> tuple[NDArray[np.uint64], Ints]:
    """Numbers at some places, and where what follows begins (the place itself where there is none)."""
    value = np.zeros(len(at), dtype=np.uint64)
    end = at.copy()
    open_ = np.ones(len(at), dtype=bool)
    for i in range(_VARINT):
        byte = data[np.minimum(at + i, len(data) - 1)]
        value |= np.where(open_, (byte & 0x7F).astype(np.uint64) << np.uint64(7 * i), np.uint64(0))
        closing = open_ & (byte < 0x80)
        end[closing] = at[closing] + i + 1
        open_ &= byte >= 0x80
        if not open_.any():
            break
    return value, end


def _signed(zigzag: NDArray[np.uint64]) -> Ints:
    half = (zigzag >> np.uint64(1)).astype(np.int64)
    return np.where(zigzag & np.uint64(1), ~half, half)


def _timing(messages: Sequence[bytes]) -> Ints:
    width = len(Timing._fields)
    found = np.empty((len(messages), width), dtype=np.int64)
    data, at, ends = _joined(messages)
    usual = np.ones(len(messages), dtype=bool)
    for i in range(width):
        usual &= data[np.minimum(at, len(data) - 1)] == (i + 1) << 3
        value, end = _varints(data, at + 1)
        found[:, i] = _signed(value)
        usual &= end > at + 1
        at = end
    usual &= at == ends
    for index in np.flatnonzero(~usual).tolist():
        found[index] = unpack_timing(messages[index])
    return found


# index of the tick, place within its part of the message, stamp after t_ns, identifier, length, data, if sent
_Rows = list[tuple[Ints, Ints, Ints, Ints, Ints, NDArray[np.uint64], Ints]]
_NONE = np.zeros(0, dtype=np.int64)


def _frames(messages: Sequence[bytes], t_ns: Ints) -> FrameColumns:
    data, at, ends = _joined(messages)
    found: _Rows = [(_NONE, _NONE, _NONE, _NONE, _NONE, _NONE.astype(np.uint64), _NONE)]
    usual = data[at] == 0x09
    at, usual = _run_of_frames(data, at + 9, ends, usual, 0x12, found)
    usual &= data[np.minimum(at, len(data) - 1)] == 0x18
    before, at = _varints(data, at + 1)
    at, usual = _run_of_frames(data, at, ends, usual, 0x22, found)
    usual &= at == ends
    before_count = before.astype(np.int64)
    columns: list[Any] = [np.concatenate(parts) for parts in zip(*found, strict=True)]
    if not usual.all():
        columns = [column[usual[columns[0]]] for column in columns]
        columns = _with_unusual(messages, usual, columns, before_count)
    tick, order, after_ns, can_id, length, payload, sent = columns
    part = np.where(sent == 1, SENT, np.where(order < before_count[tick], BEFORE, AFTER))
    # a tick's sent frames follow those received
    sorting = np.lexsort((order, sent, tick))
    return FrameColumns(
        tick[sorting],
        (t_ns[tick] + after_ns)[sorting],
        can_id[sorting],
        length[sorting],
        payload[sorting],
        part[sorting],
    )


def _run_of_frames(
    data: NDArray[np.uint8], at: Ints, ends: Ints, usual: NDArray[np.bool_], tag: int, into: _Rows
) -> tuple[Ints, NDArray[np.bool_]]:
    """The frames that follow each other from `at` on, one of each message in every round."""
    last = len(data) - 1
    at, usual = at.copy(), usual.copy()
    active = np.flatnonzero(usual)
    order = 0
    while True:
        active = active[(at[active] < ends[active]) & (data[np.minimum(at[active], last)] == tag)]
        if not len(active):
            return at, usual
        start = at[active] + 2
        end = start + data[np.minimum(at[active] + 1, last)]
        good = (end - start < 0x80) & (end <= ends[active]) & (data[np.minimum(start, last)] == 0x08)
        after, place = _varints(data, start + 1)
        good &= data[np.minimum(place, last)] == 0x10
        can_id, place = _varints(data, place + 1)
        good &= data[np.minimum(place, last)] == 0x1A
        length = data[np.minimum(place + 1, last)].astype(np.int64)
        place = place + 2
        good &= (length <= 8) & (place + length == end)
        usual[active[~good]] = False
        active, place, length = active[good], place[good], length[good]
        payload = np.zeros(len(active), dtype=np.uint64)
        for i in range(8):
            byte = np.where(i < length, data[np.minimum(place + i, last)], 0)
            payload |= byte.astype(np.uint64) << np.uint64(8 * i)
        into.append(
            (
                active,
                np.full(len(active), order, dtype=np.int64),
                _signed(after[good]),
                can_id[good].astype(np.int64),
                length,
                payload,
                np.full(len(active), int(tag == 0x22), dtype=np.int64),
            )
        )
        at[active] = end[good]
        order += 1


def _with_unusual(
    messages: Sequence[bytes], usual: NDArray[np.bool_], columns: list[Any], before: Ints
) -> list[Any]:
    """The columns with the frames of those messages that have another form; fills in their `before`."""
    rows: list[tuple[int, ...]] = []
    for index in np.flatnonzero(~usual).tolist():
        received, before[index], sent = unpack_frames(messages[index], 0)
        for is_sent, group in enumerate((received, sent)):
            for order, (after_ns, can_id, data) in enumerate(group):
                word = int.from_bytes(data[:8], "little")
                rows.append((index, order, after_ns, can_id, len(data), word, is_sent))
    if not rows:
        return columns
    return [
        np.concatenate((column, np.array(values, dtype=column.dtype)))
        for column, values in zip(columns, zip(*rows, strict=True), strict=True)
    ]
