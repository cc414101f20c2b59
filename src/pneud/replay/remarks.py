"""What is to be said of a recording: what was passed over, where and why."""

from __future__ import annotations


class Remarks:
    """Remarks by their kind, each with the place where it holds first.

    Attributes:
        partial: something that was in the recording, or should have been, could not be read.
    """

    def __init__(self) -> None:
        self.partial = False
        self._found: dict[str, tuple[str, str]] = {}  # place and details of the first
        self._counts: dict[str, int] = {}

    def add(self, kind: str, place: str, detail: str = "", *, partial: bool = True, count: int = 1) -> None:
        """Note something.

        Args:
            kind: what and why; the same words for what is to be counted together.
            place: where.
            detail: what holds for this one only.
            partial: something is lost by it.
            count: how many there are.
        """
        self.partial |= partial
        self._found.setdefault(kind, (place, detail))
        self._counts[kind] = self._counts.get(kind, 0) + count

    def count(self, kind: str = "") -> int:
        """How many there are, of a kind or in all."""
        return self._counts.get(kind, 0) if kind else sum(self._counts.values())

    def lines(self) -> list[str]:
        """A line for each kind."""
        said = []
        for kind, (place, detail) in self._found.items():
            more = self._counts[kind] - 1
            said.append(f"{place}{f' and {more} more' if more else ''}: {kind}{detail}")
        return said
