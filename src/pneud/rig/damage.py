"""Damage to the rig: what a leak, a stuck spool and a seized piston make of the equations of motion.

Wraps the undamaged plant's own step, which stays as it is.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

from pneud.physics.friction import Friction
from pneud.physics.plant import PlantParameters
from pneud.rig.chamber import exchange
from pneud.rig.dynamics import PlantState, advance


class Damage(NamedTuple):
    """What is broken."""

    leak1: float = 0.0  # hole from chamber 1 to the atmosphere, in openings of the whole valve
    leak2: float = 0.0
    spool_v: float | None = None  # where the spool is stuck, whatever the DAC puts out
    seized: bool = False  # the piston does not move


UNDAMAGED = Damage()
SEIZED_KG = 1e12


def leak(state: PlantState, damage: Damage, h: float, p: PlantParameters) -> PlantState:
    """Pressures after both chambers have blown through their holes for `h` [s] at fixed volume."""
    c, g = p.cylinder, p.gas
    full = p.polytropic_exponent / g.k * c.c1 * p.valve.u_max_v  # as the valve, fully open
    p1 = exchange(state.p1, g.atmosphere_pa, damage.leak1 * full / (c.A1 * state.x1), 0.0, h, g)
    p2 = exchange(state.p2, g.atmosphere_pa, damage.leak2 * full / (c.A2 * (c.L - state.x1)), 0.0, h, g)
    if p.detail.on:  # what stays behind expands without heat
        share1, share2 = (p1 / state.p1) ** (1.0 / g.k), (p2 / state.p2) ** (1.0 / g.k)
        depth = state.depth
        masses = {"mass1_kg": share1 * depth.mass1_kg, "mass2_kg": share2 * depth.mass2_kg}
        state = state._replace(depth=depth._replace(**masses))
    return state._replace(p1=p1, p2=p2)


def advance_damaged(
    state: PlantState,
    command_v: float,
    force_ext_n: float,
    t0_s: float,
    t1_s: float,
    p: PlantParameters,
    damage: Damage,
    inner: Callable[..., PlantState] = advance,
) -> PlantState:
    """As `dynamics.advance`, with damage; leaks act in half steps before and after each of its steps.

    Args:
        state: at `t0_s`.
        command_v: what the DAC puts out [V].
        force_ext_n: external force against positive motion [N].
        t0_s: begin.
        t1_s: end.
        p: the plant.
        damage: what is broken.
        inner: `dynamics.advance` or its compiled version.
    """
    if damage.spool_v is not None:
        command_v = damage.spool_v
    if damage.seized:  # a mass that no force moves; the gas flows as ever
        state = state._replace(v=0.0, a=0.0)
        p = p._replace(cylinder=p.cylinder._replace(M=SEIZED_KG))
    if damage.leak1 == 0.0 == damage.leak2:
        return inner(state, command_v, force_ext_n, t0_s, t1_s, p)
    count = max(1, math.ceil((t1_s - t0_s) / p.step_s - 1e-6))
    h = (t1_s - t0_s) / count
    for i in range(count):
        t_s = t0_s + i * h
        state = leak(state, damage, 0.5 * h, p)
        state = inner(state, command_v, force_ext_n, t_s, t_s + h, p)
        state = leak(state, damage, 0.5 * h, p)
    return state


def scaled(f: Friction, factor: float) -> Friction:
    """All friction of a rig times a factor, its bristles as stiff as before for the same deflection."""
    return f._replace(
        coulomb_n=f.coulomb_n * factor,
        static_n=f.static_n * factor,
        viscous_n_s_m=f.viscous_n_s_m * factor,
        sigma0_n_m=f.sigma0_n_m * factor,
        sigma1_n_s_m=f.sigma1_n_s_m * factor,
    )
