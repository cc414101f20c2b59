"""Whether friction gives way faster than the valve answers: slow motion goes in jumps with any gains then."""

from __future__ import annotations

import math
from collections.abc import Mapping

from pneud.study.identification import parameters as key
from pneud.study.identification.parameters import Estimate

STEEPEST = math.sqrt(2.0 / math.e)  # of (static - Coulomb) / Stribeck speed: the slope of exp(-(v/vs)²)
QUICKER = 2.0  # times as quick as what runs away has a loop to be that holds it
NEEDED = (key.MASS, key.COULOMB, key.STATIC, key.STRIBECK, key.VISCOUS, key.BANDWIDTH)


def growth_rad_s(
    static_n: float, coulomb_n: float, stribeck_m_s: float, viscous_n_s_m: float, mass_kg: float
) -> float:
    """How fast a load runs away that has come loose [1/s]; below 0: it does not.

    Friction that falls with speed is damping of less than nothing; its steepest slope counts.
    """
    return (STEEPEST * (static_n - coulomb_n) / stribeck_m_s - viscous_n_s_m) / mass_kg


def caution(found: Mapping[str, Estimate]) -> str:
    """What to tell of an axis whose valve is too slow for its friction; empty where it is not, or not told.

    A loop holds what runs away at p if its bandwidth is 2 p or more (Skogestad and Postlethwaite,
    Multivariable Feedback Control, chapter 5), and none is quicker than its valve.

    Args:
        found: estimates.
    """
    if not all(name in found and found[name].told for name in NEEDED):
        return ""
    mass_kg, coulomb_n, static_n, stribeck_m_s, viscous_n_s_m, valve_hz = (
        found[name].value for name in NEEDED
    )
    if min(mass_kg, stribeck_m_s) <= 0.0:
        return ""
    growth = growth_rad_s(static_n, coulomb_n, stribeck_m_s, viscous_n_s_m, mass_kg)
    valve_rad_s = 2.0 * math.pi * valve_hz
    if QUICKER * growth <= valve_rad_s:
        return ""
    return (
        f"a load that comes loose runs away at {growth:.0f} rad/s (static friction {static_n:.3g} N, Coulomb"
        f" {coulomb_n:.3g} N), and the valve follows at {valve_rad_s:.0f}: small and slow motion goes in"
        " jumps with any gains; less static friction, more mass or a quicker valve helps"
    )
