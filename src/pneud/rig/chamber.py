"""One chamber at fixed volume: flow through the valve with its slope, and a stable step of the pressure."""

from __future__ import annotations

import math

from pneud.physics.gas import LINEAR_FROM, Gas
from pneud.physics.series import decay


def inflow(pressure_pa: float, other_pa: float, g: Gas) -> tuple[float, float]:
    """Signed flow γ·P [Pa] into a chamber, and its derivative with the chamber's pressure.

    Args:
        pressure_pa: in the chamber.
        other_pa: on the orifice's other side.
        g: the gas.
    """
    filling = pressure_pa < other_pa
    r = pressure_pa / other_pa if filling else other_pa / pressure_pa
    # γ(r) of `gas.flow_factor` and its derivative; written out, since it is much of the plant's time
    if r <= g.critical_ratio:
        factor, slope = g.gamma_choked, 0.0
    elif r < LINEAR_FROM and g.exponent > 0.0:
        x = (r - g.critical_ratio) / (1.0 - g.critical_ratio)
        rest = 1.0 - x * x
        factor = g.gamma_choked * math.pow(rest, g.exponent)
        slope = -2.0 * g.exponent * x * factor / (rest * (1.0 - g.critical_ratio))
    elif r < LINEAR_FROM:
        k = g.k
        q = math.pow(r, 1.0 / k)
        factor = math.sqrt(2.0 / (k - 1.0) * q * (q - r))
        slope = q * ((2.0 * q - r) / (k * r) - 1.0) / ((k - 1.0) * factor)
    else:
        slope = -g.gamma_linear / (1.0 - LINEAR_FROM)
        factor = slope * (r - 1.0)
    if filling:
        return other_pa * factor, slope
    return -pressure_pa * factor, r * slope - factor


def exchange(
    pressure_pa: float, other_pa: float, rate_1_s: float, drift_pa_s: float, h: float, g: Gas
) -> float:
    """Pressure [Pa] after a step at fixed volume.

    Exponential Rosenbrock–Euler: second order, and exact for the stiff pole near r = 1.

    Args:
        pressure_pa: at the start.
        other_pa: pressure on the orifice's other side, which flow alone cannot carry the chamber across.
        rate_1_s: what flow γ·P is multiplied with, from the opening and the volume.
        drift_pa_s: rate of change by anything else.
        h: step [s].
        g: the gas.
    """
    flow, slope = inflow(pressure_pa, other_pa, g)
    mean, _ = decay(-rate_1_s * slope * h)
    after = pressure_pa + h * mean * (rate_1_s * flow + drift_pa_s)
    if pressure_pa < other_pa < after:
        return min(after, other_pa + h * max(drift_pa_s, 0.0))
    if after < other_pa < pressure_pa:
        return max(after, other_pa + h * min(drift_pa_s, 0.0))
    return after
