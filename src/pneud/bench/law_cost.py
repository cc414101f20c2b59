"""The law and its output chain without supervision: what the reference loops compute in every tick.

Written as pure functions, so that the C program computes the very same (`header`). It can be had by itself:
`python -m pneud.bench.law_cost virtual.toml > law.h`.
"""

from __future__ import annotations

import math
import sys
from typing import NamedTuple

from pneud.config import conversions
from pneud.control.step import Controller, ControllerState, act, join, observe, start
from pneud.loading import Loaded, load
from pneud.safety.output import OutputLimits, emit
from pneud.signals import Reference
from pure2c.to_c import Translator


class Law(NamedTuple):
    """All parameters."""

    controller: Controller
    output: OutputLimits
    amplitude_m: float
    omega_rad_s: float


class LawState(NamedTuple):
    """What is carried from tick to tick."""

    controller: ControllerState
    start_m: float  # where the load stood in the beginning
    command_v: float  # the last one


def law_of(axis: Loaded) -> Law:
    """The law of an axis."""
    p = conversions.axis_of(axis.config, axis.codecs.command_lsb_v)
    return Law(p.controller, p.output, p.reference.amplitude_m, p.reference.omega_rad_s)


def reference(start_m: float, t_s: float, p: Law) -> Reference:
    """A sine about start + amplitude, from its lowest point: it begins at rest and needs no transfer."""
    a, w = p.amplitude_m, p.omega_rad_s
    s, c = math.sin(w * t_s), math.cos(w * t_s)
    return Reference(start_m + a * (1.0 - c), a * w * s, a * w * w * c, -a * w * w * w * s)


def begin(position_m: float, p1_pa: float, p2_pa: float, supply_pa: float, p: Law) -> LawState:
    """The state of a load at rest; pressures absolute."""
    c = p.controller
    state = start(position_m, p1_pa, p2_pa, supply_pa, c)
    state, estimate = observe(state, position_m, True, p1_pa, p2_pa, supply_pa, 0.0, c.h, c)
    return LawState(join(state, estimate, reference(position_m, 0.0, p), c), position_m, 0.0)


def tick(
    state: LawState,
    position_m: float,
    p1_pa: float,
    p2_pa: float,
    supply_pa: float,
    applied_v: float,
    t_s: float,
    p: Law,
) -> LawState:
    """One tick: a complete set of measurements in, a state with the command out."""
    c = p.controller
    controller, estimate = observe(
        state.controller, position_m, True, p1_pa, p2_pa, supply_pa, applied_v, c.h, c
    )
    controller, answer = act(controller, estimate, reference(state.start_m, t_s, p), c)
    out = emit(answer.u_v, state.command_v, c.h, p.output)
    return LawState(controller, state.start_m, out.voltage_v)


def header(axis: Loaded) -> str:
    """The law of an axis in C: `begin`, `tick` and their parameters `LAW`.

    Raises:
        TranslationError: the law does something that the translator does not know.
    """
    c = Translator()
    c.function(begin, "begin")
    c.function(tick, "tick")
    c.constant("LAW", law_of(axis))
    return f"/* The law of {axis.path.name}, made by pneud.bench.law_cost. */\n{c.text()}"


if __name__ == "__main__":
    print(header(load(sys.argv[1])), end="")
