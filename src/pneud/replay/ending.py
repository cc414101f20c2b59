"""Where in a log its run was told to end: what comes behind that is not the run's, but its end."""

from __future__ import annotations

from pneud.log.files.columns import Block
from pneud.signals import Answer, RequestKind


class Ending:
    """Looks for it in the blocks of a log, one after the other."""

    def __init__(self) -> None:
        self._ended = False
        self._stalled = False  # whoever was to know of a stall has been told

    def look(self, block: Block) -> tuple[int, int | None]:
        """How much of the next block is the run's.

        Returns:
            How many ticks; and the index of the first one behind them, once: what was skipped before it is of
            a stall that went on to the end, which is the run's. None where that is in another block.
        """
        end = 0 if self._ended else self._end_of(block)
        if not self._ended or self._stalled or end == len(block.number):
            return end, None
        self._stalled = True
        return end, end

    def _end_of(self, block: Block) -> int:
        answers = block.ticks["answer"]
        for index, request in block.requests:
            taken = request.kind == RequestKind.RESTART and answers[index] == Answer.TAKEN
            if taken or request.kind == RequestKind.SHUTDOWN:
                self._ended = True
                return index + taken  # a restart begins with the next tick
        return len(block.number)
