"""Where the load truly is, from the plant's process to the control process by shared memory.

Told at each SYNC; where sensors run free, whenever they sample, and carried on from there for a few ms.
"""

from __future__ import annotations

import math
import mmap
import struct

SLOTS = 64
_HEAD = 32  # bytes before the slots; the first eight count what was put
# native and aligned: these 64-bit numbers are written and read in one piece
_SEQUENCE = struct.Struct("@Q")
_CONTENT = struct.Struct("@qddd")
_SLOT = 48
_END = 40  # of a slot: where its number stands again
LONGEST_NS = 10_000_000  # for so long a motion is carried on


def truth_memory() -> mmap.mmap:
    """Anonymous shared memory for one writer and its readers; both sides inherit it by fork."""
    return mmap.mmap(-1, _HEAD + SLOTS * _SLOT)


class TruthWriter:
    """Writes the newest positions into a ring; never waits for anyone."""

    def __init__(self, memory: mmap.mmap) -> None:
        self._memory = memory
        self._count = 0

    def put(
        self, t_ns: int, position_m: float, velocity_m_s: float = 0.0, acceleration_m_s2: float = 0.0
    ) -> None:
        """The true stroke position [m] at an instant, such as that of a SYNC, and how it goes on."""
        self._count += 1
        offset = _HEAD + self._count % SLOTS * _SLOT
        _SEQUENCE.pack_into(self._memory, offset, self._count)
        _CONTENT.pack_into(self._memory, offset + 8, t_ns, position_m, velocity_m_s, acceleration_m_s2)
        _SEQUENCE.pack_into(self._memory, offset + _END, self._count)
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
            (end,) = _SEQUENCE.unpack_from(memory, offset + _END)
            t_ns, position_m, _, _ = _CONTENT.unpack_from(memory, offset + 8)
            (begin,) = _SEQUENCE.unpack_from(memory, offset)
            if not begin == end == number or t_ns < t_sync_min_ns:
                break  # overwritten meanwhile, or older than asked for: so are all before it
            if t_ns <= t_sync_max_ns:
                return float(position_m)
        return math.nan

    def near(self, t_ns: int) -> float:
        """The position at an instant, carried on from the newest one that is known by then, else NaN."""
        memory = self._memory
        (count,) = _SEQUENCE.unpack_from(memory, 0)
        offset = _HEAD + count % SLOTS * _SLOT
        (end,) = _SEQUENCE.unpack_from(memory, offset + _END)
        known_ns, position_m, velocity_m_s, acceleration_m_s2 = _CONTENT.unpack_from(memory, offset + 8)
        (begin,) = _SEQUENCE.unpack_from(memory, offset)
        if not begin == end == count or not count or abs(t_ns - known_ns) > LONGEST_NS:
            return math.nan
        t = (t_ns - known_ns) * 1e-9
        return float(position_m + t * (velocity_m_s + 0.5 * t * acceleration_m_s2))
