"""Frames of one message by the thousand: their bytes as integers, a column for each thing that they say."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pneud.bus import crc8
from pneud.bus.codec import Codec
from pneud.bus.dbc_layout import SignalField, shift

_TABLE = np.frombuffer(crc8.TABLE, dtype=np.uint8)

Ints = NDArray[np.int64]
Words = NDArray[np.uint64]


def raw(field: SignalField, data: Words, length: int) -> Ints:
    """Raw values of a field of many frames."""
    word = data.byteswap() >> np.uint64(64 - 8 * length) if field.big_endian else data
    bits = word >> np.uint64(shift(field, length)) & np.uint64((1 << field.length) - 1)
    value = bits.astype(np.int64)
    if field.signed:
        sign = 1 << (field.length - 1)
        value = (value ^ sign) - sign
    return value


def framed(codec: Codec, raws: Sequence[Ints | int | None], counter: Ints) -> NDArray[np.uint8]:
    """Frames of a message that plays a role, of up to eight bytes and not judged by a call; a row each.

    Args:
        codec: of the message.
        raws: raw values in the order of its `fields`; a field without one is left 0.
        counter: of each frame, counted on.
    """
    inline, count = codec.guard.judged == "inline", len(counter)
    body = codec.length - inline
    little, big = np.zeros(count, dtype=np.uint64), np.zeros(count, dtype=np.uint64)
    placed = [*zip(codec.fields, raws, strict=True), (codec.counter_field, counter % codec.counter_values)]
    for field, value in placed:
        if field is None or value is None:
            continue
        bits = np.asarray(value).astype(np.int64).view(np.uint64) & np.uint64((1 << field.length) - 1)
        word = big if field.big_endian else little
        word |= bits << np.uint64(shift(field, body))
    if body:
        little |= (big << np.uint64(64 - 8 * body)).byteswap()
    rows = np.zeros((count, 8), dtype=np.uint8)
    rows[:] = np.ascontiguousarray(little).view(np.uint8).reshape(count, 8)
    if inline:
        state = np.full(count, crc8.identifier_state(codec.can_id), dtype=np.uint8)
        for i in range(body):
            state = _TABLE[state ^ rows[:, i]]
        rows[:, body] = state ^ crc8.FINAL_XOR
    return rows[:, : codec.length]


def valid(codec: Codec, length: Ints, data: Words) -> NDArray[np.bool_]:
    """Which frames have the right length and, where there is one, checksum."""
    good: NDArray[np.bool_] = length == codec.length
    if codec.guard.judged == "call":
        frames = zip(data.tolist(), length.tolist(), strict=True)
        found = (codec.valid(word.to_bytes(8, "little")[:n]) for word, n in frames)
        return np.fromiter(found, dtype=np.bool_, count=len(data))
    if codec.guard.judged == "inline":
        state = np.full(len(data), crc8.identifier_state(codec.can_id), dtype=np.uint8)
        for i in range(codec.length):
            byte = (data >> np.uint64(8 * i) & np.uint64(0xFF)).astype(np.uint8)
            if i == codec.length - 1:
                good &= state ^ crc8.FINAL_XOR == byte
            state = _TABLE[state ^ byte]
    return good
