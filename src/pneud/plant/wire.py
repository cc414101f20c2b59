"""Timing of a classic CAN bus: bits on the wire, priority by identifier, one frame at a time."""

from __future__ import annotations

from typing import Any, NamedTuple

FRAME_BITS = 47  # standard frame without data, interframe space included
STUFFING = 1.1


def wire_ns(length: int, bitrate_bit_s: float) -> int:
    """Time [ns] that a frame with `length` data bytes occupies the wire, with 10 % stuff bits; 0 at infinite rate."""
    return round((FRAME_BITS + 8 * length) * STUFFING / bitrate_bit_s * 1e9)


class Item(NamedTuple):
    """A frame on its way: from when it waits for the wire, and what it carries."""

    ready_ns: int
    can_id: int
    duration_ns: int
    load: Any


class Wire:
    """Frames waiting, and the one under way. Time only moves forward: ask and add in order of time."""

    def __init__(self) -> None:
        self.waiting: list[Item] = []
        self._free_ns = 0

    def add(self, item: Item) -> None:
        """Let a frame wait for the wire from `item.ready_ns` on."""
        self.waiting.append(item)

    def next(self) -> tuple[int, Item] | None:
        """When the next transmission will end, and of which waiting frame, unless a better one comes in time."""
        if not self.waiting:
            return None
        start = max(self._free_ns, min(item.ready_ns for item in self.waiting))
        winner = min((item for item in self.waiting if item.ready_ns <= start), key=_priority)
        return start + winner.duration_ns, winner

    def take(self, end_ns: int, item: Item) -> None:
        """The transmission that `next` announced has ended."""
        self.waiting.remove(item)
        self._free_ns = end_ns


def _priority(item: Item) -> tuple[int, int]:
    return item.can_id, item.ready_ns
