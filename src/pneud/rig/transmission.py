"""Timing of a classic CAN bus: bits on the wire, priority by identifier, one frame at a time."""

from typing import Any, NamedTuple

from pneud.bus.wire import CAN_EFF_FLAG


class Item(NamedTuple):
    """A frame on its way: from when it waits for the wire, and what it carries."""

    ready_ns: int
    can_id: int
    duration_ns: int
    load: Any
    mailbox: int = 0  # of the node's, for this identifier


class Wire:
    """The frames that wait for the wire, and the one under way.

    `upcoming` is the end of the next transmission and its frame, unless a better one gets ready before it
    starts; None when nothing waits. Nothing is decided before its time: a frame may be added as long as it is
    not ready before the end of a transmission that `take` has already ended.
    """

    def __init__(self) -> None:
        self.waiting: list[Item] = []
        self._upcoming: tuple[int, Item] | None = None
        self._changed = False  # since `_upcoming` was found
        self._free_ns = 0

    @property
    def upcoming(self) -> tuple[int, Item] | None:
        """End of the next transmission, and its frame."""
        if self._changed:
            self._arbitrate()
        return self._upcoming

    def add(self, item: Item) -> None:
        """Let a frame wait for the wire."""
        self.waiting.append(item)
        self._changed = True

    def replace(self, item: Item) -> None:
        """As `add`, but a frame that waits in the same mailbox for the same identifier is overwritten."""
        for other in self.waiting:
            same = other.can_id == item.can_id and other.mailbox == item.mailbox
            if same and not self._under_way(other, item.ready_ns):
                self.waiting.remove(other)
                break
        self.add(item)

    def take(self) -> tuple[int, Item]:
        """End the upcoming transmission.

        Raises:
            IndexError: nothing waits.
        """
        ended = self.upcoming
        if ended is None:
            raise IndexError("no frame waits for the wire")
        self.waiting.remove(ended[1])
        self._free_ns = ended[0]
        self._changed = True
        return ended

    def clear(self, free_ns: int) -> None:
        """Nothing waits; the wire was free from then on."""
        self.waiting.clear()
        self._changed, self._free_ns = True, free_ns

    def _under_way(self, item: Item, t_ns: int) -> bool:
        upcoming = self.upcoming
        return upcoming is not None and upcoming[1] is item and upcoming[0] - item.duration_ns <= t_ns

    def _arbitrate(self) -> None:
        self._changed = False
        waiting = self.waiting
        if len(waiting) > 1:
            first = min(item.ready_ns for item in waiting)
            start = first if first > self._free_ns else self._free_ns
            item = min([item for item in waiting if item.ready_ns <= start], key=_priority)
        elif waiting:
            item = waiting[0]
            start = item.ready_ns if item.ready_ns > self._free_ns else self._free_ns
        else:
            self._upcoming = None
            return
        self._upcoming = (start + item.duration_ns, item)


def _priority(item: Item) -> tuple[int, int]:
    """The bits that arbitrate as one number: a 29-bit identifier loses against its first 11 alone."""
    can_id = item.can_id
    if not can_id & CAN_EFF_FLAG:
        can_id <<= 18
    return can_id & ~CAN_EFF_FLAG, item.ready_ns
