"""What a row of the fault table says: which bit, what is done, when, and what a person can do."""

from collections.abc import Sequence
from enum import Enum, IntEnum
from typing import NamedTuple

WIRING = "check the node's power, its wiring and the bus termination"
NOISE = "check shielding and termination; check that no other device uses this identifier"
NODE = "power-cycle the node; it repeats itself"
TIMING = "check the node's configuration (it has to answer SYNC) and the bus load"


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


def unheard(bits: Sequence[IntEnum], none: str, frames: str, node: str) -> tuple[Fault, ...]:
    """The rows of a source that does not come as it should.

    Args:
        bits: missing, corrupt, frozen, late.
        none: when it is missing.
        frames: what its frames are called.
        node: and who counts them.
    """
    missing, corrupt, frozen, late = bits
    found = (
        (missing, none, WIRING),
        (corrupt, f"only {frames} frames with a wrong CRC", NOISE),
        (frozen, f"the {node}'s counter stands still", NODE),
        (late, f"only {frames} frames come that answer an earlier SYNC", TIMING),
    )
    return tuple(Fault(bit, Reaction.CENTRE, when, cure, "sensor_timeout_ns") for bit, when, cure in found)
