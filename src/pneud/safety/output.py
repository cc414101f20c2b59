"""The one door to the valve: finite → slew → ±u_max → quantise → range check.

Finite comes first, since `max(-5, min(5, nan))` is +5 in Python. Leaving the engaged states centres the
valve at once, past the slew limit.
"""

import math
from typing import NamedTuple

from pneud.safety.faults import F

CEILING_V = 5.0  # no configuration can widen it


class OutputLimits(NamedTuple):
    """Bounds of the command."""

    u_max_v: float
    slew_v_s: float
    lsb_v: float  # step of the command on the wire


class Output(NamedTuple):
    """What leaves, and the faults found on the way."""

    voltage_v: float
    enable: int
    saturated: int
    faults: int


CENTRED = Output(0.0, 0, 0, 0)


def emit(law_v: float, last_v: float, h: float, p: OutputLimits) -> Output:
    """The command for an engaged axis.

    Args:
        law_v: what the law asks for [V].
        last_v: the last command that left [V].
        h: time since then [s].
        p: bounds.

    Returns:
        The quantised command; a law that is not finite, or a result out of range, gives the centre,
        disabled, and the fault.
    """
    if not math.isfinite(law_v):
        return Output(0.0, 0, 0, 1 << F.NOT_FINITE)
    room = p.slew_v_s * h
    slewed = max(last_v - room, min(last_v + room, law_v))
    limited = max(-p.u_max_v, min(p.u_max_v, slewed))
    exact = limited / p.lsb_v
    if not math.isfinite(exact):
        return Output(0.0, 0, 0, 1 << F.COMMAND_RANGE)
    steps = round(exact)
    if abs(steps * p.lsb_v) > p.u_max_v:
        steps -= 1 if steps > 0 else -1
    voltage = steps * p.lsb_v
    if not abs(voltage) <= min(p.u_max_v, CEILING_V):
        return Output(0.0, 0, 0, 1 << F.COMMAND_RANGE)
    return Output(voltage, 1, 0 if limited == law_v else 1, 0)
