"""One chamber at fixed volume: flow through the valve with its slope, and a stable step of the pressure."""

from __future__ import annotations

import math

from pneud.physics.gas import LINEAR_FROM, Gas


def factor_and_slope(r: float, g: Gas) -> tuple[float, float]:
    """Flow factor γ(r) of `gas.flow_factor` and its derivative, for 0 ≤ r ≤ 1."""
    if r <= g.critical_ratio:
        return g.gamma_choked, 0.0
    if r < LINEAR_FROM:
        q = r ** (1.0 / g.k)
        factor = math.sqrt(2.0 / (g.k - 1.0) * q * (q - r))
        return factor, q * ((2.0 * q - r) / (g.k * r) - 1.0) / ((g.k - 1.0) * factor)
    slope = -g.gamma_linear / (1.0 - LINEAR_FROM)
    return slope * (r - 1.0), slope


def inflow(pressure_pa: float, source_pa: float, reverse: bool, g: Gas) -> tuple[float, float]:
    """Signed flow γ·P [Pa] from a source into the chamber, and its derivative with the chamber's pressure.

    Args:
        pressure_pa: in the chamber.
        source_pa: in the supply.
        reverse: False closes the orifice to flow from the chamber back into the source.
        g: the gas.
    """
    if pressure_pa < source_pa:
        factor, slope = factor_and_slope(pressure_pa / source_pa, g)
        return source_pa * factor, slope
    if not reverse:
        return 0.0, 0.0
    r = source_pa / pressure_pa
    factor, slope = factor_and_slope(r, g)
    return -pressure_pa * factor, r * slope - factor


def outflow(pressure_pa: float, sink_pa: float, reverse: bool, g: Gas) -> tuple[float, float]:
    """Signed flow γ·P [Pa] from the chamber into a sink, and its derivative with the chamber's pressure."""
    flow, slope = inflow(sink_pa, pressure_pa, reverse, g)
    # homogeneous of degree one in both pressures, so Euler's theorem gives the other derivative
    return flow, (flow - slope * sink_pa) / pressure_pa


def relax(
    pressure_pa: float, far_pa: float, flow_pa_s: float, slope_1_s: float, drift_pa_s: float, h: float
) -> float:
    """Pressure [Pa] after a step at fixed volume.

    Exponential Rosenbrock–Euler: second order, and exact for the stiff pole near r = 1.

    Args:
        pressure_pa: at the start.
        far_pa: pressure on the orifice's other side, which flow alone cannot carry the chamber across.
        flow_pa_s: rate of change by flow at the start.
        slope_1_s: its derivative with the pressure, ≤ 0.
        drift_pa_s: rate of change by anything else.
        h: step [s].
    """
    z = slope_1_s * h
    mean = math.expm1(z) / z if z < -1e-9 else 1.0
    after = pressure_pa + h * mean * (flow_pa_s + drift_pa_s)
    if pressure_pa < far_pa < after:
        return min(after, far_pa + h * max(drift_pa_s, 0.0))
    if after < far_pa < pressure_pa:
        return max(after, far_pa + h * min(drift_pa_s, 0.0))
    return after
