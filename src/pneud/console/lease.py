"""Who commands: at most one client at a time, and only for as long as it goes on asking."""

from __future__ import annotations

from typing import Generic, TypeVar

LEASE_S = 2.0

Holder = TypeVar("Holder")


class Lease(Generic[Holder]):
    """The right to command; times are seconds of a clock that only goes forward."""

    def __init__(self, span_s: float = LEASE_S) -> None:
        """Nobody's lease; it holds for so long after each command."""
        self._span_s = span_s
        self._holder: Holder | None = None
        self._until_s = 0.0

    def holder(self, now_s: float) -> Holder | None:
        """Who commands, if anybody."""
        if now_s >= self._until_s:
            self._holder = None
        return self._holder

    def left_s(self, now_s: float) -> float:
        """For how long yet [s]."""
        return max(0.0, self._until_s - now_s) if self.holder(now_s) is not None else 0.0

    def take(self, who: Holder, now_s: float, *, by_force: bool = False) -> bool:
        """Take or renew it, by force from whoever holds it.

        Returns:
            Whether `who` commands now.
        """
        if not by_force and self.holder(now_s) not in (None, who):
            return False
        self._holder = who
        self._until_s = now_s + self._span_s
        return True

    def drop(self, who: Holder) -> None:
        """Give it back; nothing happens where somebody else holds it."""
        if self._holder is who:
            self._holder = None
