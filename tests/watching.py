"""The checks with a memory in one go, as a cycle makes them."""

from __future__ import annotations

from pneud.safety.checks import Limits
from pneud.safety.watch import Watch, is_disagreeing, look, remember
from pneud.signals import Estimate, Measurement


def watch(
    w: Watch, m: Measurement, e: Estimate, state: int, engaged: bool, last_v: float, limited: int, p: Limits
) -> tuple[Watch, int]:
    """What this tick shows beside the ones before.

    Args:
        w: memory.
        m: the measurement.
        e: the estimate, NaN where there is none.
        state: of the last tick.
        engaged: that state is an engaged one.
        last_v: the last command that left [V].
        limited: 1 where the output chain let through less than the law asked for.
        p: what it is compared with.

    Returns:
        The new memory, and bits of the fault table.
    """
    seen, lasting, bits = look(w.seen, m, e, state, engaged, last_v, limited, is_disagreeing(w), p)
    w, found = remember(w, seen, lasting, m.t_ns, p)
    return w, bits | found
