"""Parts of a rig with all that `physics.plant.Detail` has: play, leaks, heat, a supply that gives way.

Of the same kind as the plain rig's: each is exact or stable in itself, so that steps of 0.1 ms will do.
"""

import math
from typing import NamedTuple

from pneud.physics.friction import Friction
from pneud.physics.gas import Gas
from pneud.physics.plant import FRICTION_AT_PA, Detail, PlantParameters
from pneud.physics.slip import Elements
from pneud.rig.chamber import exchange


class Hoses(NamedTuple):
    """Opening [V] on its way to the chambers, a third of it after another."""

    near_v: float = 0.0
    middle_v: float = 0.0
    far_v: float = 0.0


class Depth(NamedTuple):
    """State of what a plain rig does not have."""

    spool_v: float = 0.0  # behind the play
    mass1_kg: float = 0.0  # of the air in the chambers
    mass2_kg: float = 0.0
    supply_pa: float = 0.0
    shown1_pa: float = 0.0  # what the pressure sensors have come to
    shown2_pa: float = 0.0
    shown_supply_pa: float = 0.0
    elements: Elements = Elements()
    hoses: Hoses = Hoses()


PLAIN = Depth()


class Chamber(NamedTuple):
    """The air in a chamber."""

    pressure_pa: float
    mass_kg: float
    drawn_kg: float  # through the edge, or from the supply, in the last step


def behind_play(before_v: float, spool_v: float, play_v: float) -> float:
    """Where what is moved by the spool is: it follows once the play is used up."""
    return max(spool_v - play_v, min(spool_v + play_v, before_v))


def later(q: Hoses, u_v: float, h: float, d: Detail) -> Hoses:
    """The hoses a step later: three lags in a row, which delay, and smear as hoses do."""
    if d.hose_s <= 0.0:
        return Hoses(u_v, u_v, u_v)
    kept = math.exp(-3.0 * h / d.hose_s)
    near_v = u_v + (q.near_v - u_v) * kept
    middle_v = near_v + (q.middle_v - near_v) * kept
    return Hoses(near_v, middle_v, middle_v + (q.far_v - middle_v) * kept)


def through(
    c: Chamber,
    other_pa: float,
    opening_v: float,
    volume_m3: float,
    one_way: bool,
    h: float,
    p: PlantParameters,
    g: Gas,
) -> Chamber:
    """A chamber after an edge has been open for a step, at fixed volume; `drawn_kg` is what came in.

    Args:
        c: the chamber.
        other_pa: on the edge's other side, where the air is at the supply's temperature.
        opening_v: of the edge.
        volume_m3: of the chamber.
        one_way: nothing flows backwards: into the supply, or from the atmosphere.
        h: step [s].
        p: the plant.
        g: the gas as it flows through the edge.
    """
    n = p.polytropic_exponent
    into = c.pressure_pa < other_pa
    if one_way or opening_v <= 0.0:
        return Chamber(c.pressure_pa, c.mass_kg, 0.0)
    temperature_k = g.temperature_k
    if p.detail.wall_s > 0.0 and not into:
        temperature_k = c.pressure_pa * volume_m3 / (c.mass_kg * g.R)
    # mass flow goes with 1/√T, the energy that it carries with T
    rate = n / g.k * p.cylinder.c1 * opening_v / volume_m3 * math.sqrt(temperature_k / g.temperature_k)
    after = exchange(c.pressure_pa, other_pa, rate, 0.0, h, g)
    came_kg = volume_m3 * (after - c.pressure_pa) / (n * g.R * temperature_k)
    return Chamber(after, c.mass_kg + came_kg, came_kg)


def breathe(
    c: Chamber,
    fill_v: float,
    empty_v: float,
    supply_pa: float,
    volume_m3: float,
    h: float,
    p: PlantParameters,
) -> Chamber:
    """A chamber after a step at fixed volume: through its edges, and the heat of its wall.

    Args:
        c: the chamber.
        fill_v: opening of the edge from the supply.
        empty_v: of the edge to the atmosphere.
        supply_pa: as it is.
        volume_m3: of the chamber.
        h: step [s].
        p: the plant.
    """
    atmosphere_pa, one_way = p.gas.atmosphere_pa, not p.reverse_flow
    filled = through(c, supply_pa, fill_v, volume_m3, one_way and c.pressure_pa > supply_pa, h, p, p.gas)
    pa = filled.pressure_pa
    inwards = one_way and pa < atmosphere_pa
    emptied = through(filled, atmosphere_pa, empty_v, volume_m3, inwards, h, p, p.cylinder.vent)
    return Chamber(
        warmed(emptied.pressure_pa, emptied.mass_kg, volume_m3, h, p.gas, p.detail),
        emptied.mass_kg,
        filled.drawn_kg,
    )


def warmed(pressure_pa: float, mass_kg: float, volume_m3: float, h: float, g: Gas, d: Detail) -> float:
    """The pressure [Pa] after the air has taken heat from the wall, or given it."""
    if d.wall_s <= 0.0:
        return pressure_pa
    at_rest_pa = mass_kg * g.R * g.temperature_k / volume_m3
    return at_rest_pa + (pressure_pa - at_rest_pa) * math.exp(-h / d.wall_s)


def supplied(supply_pa: float, drawn_kg: float, h: float, g: Gas, d: Detail) -> float:
    """The supply's pressure [Pa] after air has been drawn from its receiver, and some has flown after."""
    if d.receiver_pa_kg <= 0.0:
        return g.supply_pa
    pa = supply_pa - drawn_kg * d.receiver_pa_kg
    missing = g.supply_pa - pa
    return (
        g.supply_pa - missing * math.exp(-h * d.regulator_kg_s_pa * d.receiver_pa_kg) if missing > 0.0 else pa
    )


def rubbing(v: float, mean_pa: float, f: Friction, d: Detail) -> Friction:
    """The friction at a mean pressure of the chambers, in the direction of a velocity."""
    share = 1.0 + d.rise_1_pa * (mean_pa - FRICTION_AT_PA)
    share *= 1.0 + (d.forward_share if v > 0.0 else -d.forward_share)
    share = max(0.0, share)
    return Friction(
        f.coulomb_n * share,
        f.static_n * share,
        f.stribeck_m_s,
        f.viscous_n_s_m * share,
        f.sigma0_n_m,
        f.sigma1_n_s_m,
    )


def touching(x: float, v: float, d: Detail) -> float:
    """Force [N] against positive motion of what the load runs into; it pushes, and never pulls."""
    if d.contact_n_m <= 0.0:
        return 0.0
    deep_m = d.contact_side * (x - d.contact_m)
    if deep_m <= 0.0:
        return 0.0
    return d.contact_side * max(0.0, d.contact_n_m * deep_m + d.contact_n_s_m * d.contact_side * v)


def shown(before_pa: float, pressure_pa: float, h: float, d: Detail) -> float:
    """What a pressure sensor has come to after a step."""
    if d.pressure_lag_s <= 0.0:
        return pressure_pa
    return pressure_pa + (before_pa - pressure_pa) * math.exp(-h / d.pressure_lag_s)
