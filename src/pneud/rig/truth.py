"""The true position at each SYNC, from the plant's process to the control process by shared memory."""

from __future__ import annotations

import math
import mmap
import struct

SLOTS = 64
_HEAD = 32  # bytes before the slots; the first eight count what was put
# native and aligned: these 64-bit numbers are written and read in one piece
_SEQUENCE = struct.Struct("@Q")
_CONTENT = struct.Struct("@qd")
_SLOT = 32


def truth_memory() -> mmap.mmap:
    """Anonymous shared memory for one writer and its readers; both sides inherit it by fork."""
    return mmap.mmap(-1, _HEAD + SLOTS * _SLOT)


class TruthWriter:
    """Writes the newest positions into a ring; never waits for anyone."""

    def __init__(self, memory: mmap.mmap) -> None:
        self._memory = memory
        self._count = 0

    def put(self, t_ns: int, position_m: float) -> None:
        """The true stroke position [m] at the SYNC sent at `t_ns`."""
        self._count += 1
        offset = _HEAD + self._count % SLOTS * _SLOT
        _SEQUENCE.pack_into(self._memory, offset, self._count)
        _CONTENT.pack_into(self._memory, offset + 8, t_ns, position_m)
        _SEQUENCE.pack_into(self._memory, offset + 24, self._count)
        _SEQUENCE.pack_into(self._memory, 0, self._count)


class TruthReader:
    """Reads the ring."""

    def __init__(self, memory: mmap.mmap) -> None:
        self._memory = memory

    def get(self, t_sync_min_ns: int, t_sync_max_ns: int) -> float:
        """The position [m] at the newest SYNC stamped within the bounds (inclusive), else NaN.

        The plant's stamp of a SYNC and its sender's differ by microseconds, hence bounds.
        """
        memory = self._memory
        (count,) = _SEQUENCE.unpack_from(memory, 0)
        for number in range(count, max(0, count - SLOTS), -1):
            offset = _HEAD + number % SLOTS * _SLOT
            (end,) = _SEQUENCE.unpack_from(memory, offset + 24)
            t_ns, position_m = _CONTENT.unpack_from(memory, offset + 8)
            (begin,) = _SEQUENCE.unpack_from(memory, offset)
            if not begin == end == number or t_ns < t_sync_min_ns:
                break  # overwritten meanwhile, or older than asked for: so are all before it
            if t_ns <= t_sync_max_ns:
                return float(position_m)
        return math.nan
