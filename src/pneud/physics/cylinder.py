"""The cylinder's force dynamics ẋ3 = F0 x2 + F1 u + d, equation (8) of the paper, corrected."""

import math
from typing import NamedTuple

from pneud.physics.gas import Gas, signed_flow

F1_FLOOR = 0.1  # least authority the law assumes, as a part of the nominal one


class Cylinder(NamedTuple):
    """Geometry, load and valve size; made by `cylinder`."""

    A1: float  # piston area of chamber 1 (cap end) [m²]
    A2: float  # piston area of chamber 2 (rod end) [m²]
    M: float  # moving mass [kg]
    stroke_m: float
    x_e1: float  # dead length of chamber 1 [m]
    L: float  # stroke and both dead lengths [m]
    c1: float  # k √(R k T) A0max/umax [m²/s · √.. per V], the factor of F1 with the temperature's root in it
    F1_nominal: float  # F1 at mid-stroke, chambers at half the supply pressure [N/(s V)]
    rod_force_n: float  # Patm (A1 − A2), static force of the atmosphere on the rod side
    vent: Gas  # the gas as it flows through the edges to the atmosphere
    reverse_flow: bool = True  # F1 has air go back into a supply that is below a chamber
    exhaust: float = 1.0  # flow of the edges to the atmosphere over that of those from the supply


def cylinder(
    A1: float,
    A2: float,
    M: float,
    stroke_m: float,
    x_e1: float,
    x_e2: float,
    orifice_m2: float,
    u_max_v: float,
    g: Gas,
    vent: Gas,
    exhaust: float = 1.0,
) -> Cylinder:
    """Constants of one axis; `orifice_m2` is the opening of the edges from the supply at `u_max_v`."""
    length = stroke_m + x_e1 + x_e2
    c1 = g.k * math.sqrt(g.R * g.k * g.temperature_k) * orifice_m2 / u_max_v
    half = 0.5 * g.supply_pa
    per_length = signed_flow(g.supply_pa, half, g) + exhaust * signed_flow(half, g.atmosphere_pa, vent)
    return Cylinder(
        A1=A1,
        A2=A2,
        M=M,
        stroke_m=stroke_m,
        x_e1=x_e1,
        L=length,
        c1=c1,
        F1_nominal=c1 * per_length / (0.5 * length),
        rod_force_n=g.atmosphere_pa * (A1 - A2),
        vent=vent,
        exhaust=exhaust,
    )


def x3_of(p1_pa: float, p2_pa: float, c: Cylinder) -> float:
    """x3 = P1 A1 − P2 A2 [N]."""
    return p1_pa * c.A1 - p2_pa * c.A2


def F0(x1: float, p1_pa: float, p2_pa: float, c: Cylinder, g: Gas) -> float:
    """F0 of (8) [N/m]: change of x3 with displacement of the piston.

    Args:
        x1: effective displacement [m], stroke coordinate plus `x_e1`.
        p1_pa: pressure of chamber 1, absolute.
        p2_pa: pressure of chamber 2, absolute.
        c: the cylinder.
        g: the gas.
    """
    return -g.k * (p1_pa * c.A1 / x1 + p2_pa * c.A2 / (c.L - x1))


def F1_fill(x1: float, p1_pa: float, p2_pa: float, supply_pa: float, c: Cylinder, g: Gas) -> float:
    """F1 of (8) for u ≥ 0 [N/(s V)]: supply to chamber 1, chamber 2 to atmosphere; signed flow, floored."""
    out = c.exhaust * _flow(p2_pa, g.atmosphere_pa, c, c.vent)
    f1 = c.c1 * (_flow(supply_pa, p1_pa, c, g) / x1 + out / (c.L - x1))
    return max(f1, F1_FLOOR * c.F1_nominal)


def F1_exhaust(x1: float, p1_pa: float, p2_pa: float, supply_pa: float, c: Cylinder, g: Gas) -> float:
    """F1 of (8) for u < 0 [N/(s V)]: chamber 1 to atmosphere, supply to chamber 2; signed flow, floored."""
    out = c.exhaust * _flow(p1_pa, g.atmosphere_pa, c, c.vent)
    f1 = c.c1 * (out / x1 + _flow(supply_pa, p2_pa, c, g) / (c.L - x1))
    return max(f1, F1_FLOOR * c.F1_nominal)


def _flow(upstream_pa: float, downstream_pa: float, c: Cylinder, g: Gas) -> float:
    flow = signed_flow(upstream_pa, downstream_pa, g)
    return flow if flow > 0.0 or c.reverse_flow else 0.0
