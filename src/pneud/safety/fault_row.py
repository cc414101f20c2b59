"""What a row of the fault table says: which bit, what is done, when, and what a person can do."""

from __future__ import annotations

from enum import Enum, IntEnum
from typing import NamedTuple


class Reaction(Enum):
    """What a fault does; each stronger one includes the weaker."""

    WARN = "shown and logged"
    LIMIT = "limit active"
    NO_ARM = "cannot arm"
    STOP = "controlled stop"
    CENTRE = "centre at once"


class Fault(NamedTuple):
    """One row of the table.

    `debounce` names the field of `checks.Limits` for how long it has to last before it counts; without, the
    first tick counts. `clears` says when it is no longer present, where that is not simply when what is
    named in `when` is over.
    """

    bit: IntEnum
    reaction: Reaction
    when: str
    cure: str
    debounce: str = ""
    clears: str = ""

    @property
    def name(self) -> str:
        """The name in logs, JSON and on the screen."""
        return self.bit.name.lower()

    @property
    def latches(self) -> bool:
        """Whether it holds the axis in FAULT until it is cleared."""
        return self.reaction in (Reaction.STOP, Reaction.CENTRE)
