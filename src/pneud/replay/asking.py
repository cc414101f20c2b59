"""An operator of a simulation who arms, asks for one thing a tick, and shuts down when it is over."""

from __future__ import annotations

from collections.abc import Iterable

from pneud.safety.faults import BLOCKS_ARM
from pneud.signals import Request, RequestKind, State

ARM = Request(RequestKind.ARM)


class Asking:
    """What is asked of an axis, and when; an `Operator` of `Simulation`.

    Attributes:
        over: there is nothing more to ask for; set by whoever sees what becomes of it.
        begun: the axis has been armed.
    """

    def __init__(self, wanted: Iterable[Request]) -> None:
        """Nothing has been asked for yet.

        Args:
            wanted: one request a tick, once the axis holds.
        """
        self.over = self.begun = False
        self._wanted = [ARM, *wanted]
        self._told = False

    def ask(self, state: int, present: int) -> Request | None:
        """What is asked of the axis in this tick."""
        if self.over:
            told, self._told = self._told, True
            return None if told else Request(RequestKind.SHUTDOWN)
        if not self._wanted:
            return None
        ready = state == State.HOLDING if self.begun else is_armable(state, present)
        if not ready:
            return None
        self.begun = True
        return self._wanted.pop(0)


def is_armable(state: int, present: int) -> bool:
    """Whether an axis would arm in this state, with these bits of faults that hold."""
    return state == State.DISARMED and not present & BLOCKS_ARM
