"""Timing of a classic CAN bus: bits on the wire, priority by identifier, one frame at a time."""

from __future__ import annotations

from typing import Any, NamedTuple

FRAME_BITS = 47  # standard frame without data, interframe space included
STUFFING = 1.1


def wire_ns(length: int, bitrate_bit_s: float) -> int:
    """Time [ns] that a frame with `length` data bytes takes, stuff bits included; 0 at infinite rate."""
    return round((FRAME_BITS + 8 * length) * STUFFING / bitrate_bit_s * 1e9)


class Item(NamedTuple):
    """A frame on its way: from when it waits for the wire, and what it carries."""

    ready_ns: int
    can_id: int
    duration_ns: int
    load: Any


class Wire:
    """The frames that wait for the wire, and the one under way.

    Nothing is decided before its time: a frame may be added as long as it is not ready before the end of a
    transmission that `take` has already ended.
    """

    def __init__(self) -> None:
        self.waiting: list[Item] = []
        self._free_ns = 0

    def next(self) -> tuple[int, Item] | None:
        """The end of the next transmission and its frame, unless a better one gets ready before it starts."""
        if not self.waiting:
            return None
        start = max(self._free_ns, min(item.ready_ns for item in self.waiting))
        winner = min((item for item in self.waiting if item.ready_ns <= start), key=_priority)
        return start + winner.duration_ns, winner

    def add(self, item: Item) -> None:
        """Let a frame wait for the wire."""
        self.waiting.append(item)

    def replace(self, item: Item) -> None:
        """As `add`, but a waiting frame of the same identifier is overwritten, as in a node's one mailbox."""
        upcoming = self.next()
        under_way = None
        if upcoming is not None and upcoming[0] - upcoming[1].duration_ns <= item.ready_ns:
            under_way = upcoming[1]
        self.waiting = [w for w in self.waiting if w.can_id != item.can_id or w is under_way]
        self.waiting.append(item)

    def take(self, end_ns: int, item: Item) -> None:
        """The transmission that `next` announced has ended."""
        self.waiting.remove(item)
        self._free_ns = end_ns


def _priority(item: Item) -> tuple[int, int]:
    return item.can_id, item.ready_ns
