"""The rig's equations of motion, (5)–(8) of the paper corrected and completed, in fixed small steps.

One step is a symmetric (Strang) splitting: half a step of drift with polytropic compression, P Vⁿ constant;
the flow of both chambers at fixed volume; velocity and bristles under the mean force; the other half of the
drift. Every part is exact or stable for any stiffness, so the whole is of second order and stable over the
whole travel with the valve fully open.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from pneud.physics.cylinder import Cylinder
from pneud.physics.friction import slide
from pneud.physics.valve import SpoolTransition, opening, spool_transition
from pneud.plant.chamber import inflow, outflow, relax
from pneud.plant.parameters import PlantParameters


class PlantState(NamedTuple):
    """The true state of the rig."""

    x1: float  # effective displacement [m]
    v: float  # [m/s]
    p1: float  # absolute pressure in chamber 1 [Pa]
    p2: float  # absolute pressure in chamber 2 [Pa]
    z: float  # deflection of the LuGre bristles [m]
    y: float  # spool position [V]
    ydot: float  # [V/s]
    a: float  # mean acceleration over the last step [m/s²]


def initial_state(p: PlantParameters) -> PlantState:
    """At rest at x1(0), P2 as given, P1 so that the forces balance (rod side included), spool centred."""
    c = p.cylinder
    p1 = (p.initial_p2_pa * c.A2 + c.rod_force_n) / c.A1
    return PlantState(p.initial_x1, 0.0, p1, p.initial_p2_pa, 0.0, 0.0, 0.0, 0.0)


def stroke_position(state: PlantState, p: PlantParameters) -> float:
    """Position [m] in the stroke coordinate, 0 at the rear end stop."""
    return state.x1 - p.cylinder.x_e1


def disturbances(t_s: float, p: PlantParameters) -> tuple[float, float]:
    """d1, d2 of (5) [Pa/s] at time t: the paper's Case 1 (constant), Case 2 (time-varying), else none."""
    if p.disturbance == 1:
        return 2e5, 2e5
    if p.disturbance == 2:
        return 1e5 * (1.0 + math.sin(t_s)), 1e5 * (1.0 + math.cos(t_s))
    return 0.0, 0.0


def step(
    state: PlantState, command_v: float, force_ext_n: float, t_s: float, h: float, p: PlantParameters
) -> PlantState:
    """The state one step later.

    Args:
        state: at time `t_s`.
        command_v: what the DAC puts out during the step, finite [V].
        force_ext_n: external force against positive motion [N].
        t_s: time since the start, for the disturbances d1, d2 only.
        h: step, at most 0.1 ms [s].
        p: the plant.
    """
    return _step(state, command_v, force_ext_n, t_s, h, spool_transition(0.5 * h, p.valve), p)


def advance(
    state: PlantState, command_v: float, force_ext_n: float, t0_s: float, t1_s: float, p: PlantParameters
) -> PlantState:
    """The state at `t1_s` from that at `t0_s`, in equal steps no longer than `p.step_s`."""
    span = t1_s - t0_s
    if span <= 0.0:
        return state
    count = max(1, math.ceil(span / p.step_s - 1e-6))
    h = span / count
    half = spool_transition(0.5 * h, p.valve)
    for i in range(count):
        state = _step(state, command_v, force_ext_n, t0_s + i * h, h, half, p)
    return state


def _step(
    state: PlantState,
    command_v: float,
    force_ext_n: float,
    t_s: float,
    h: float,
    half: SpoolTransition,
    p: PlantParameters,
) -> PlantState:
    x1, v, p1, p2, z, y, ydot, a = state
    c, g, n, length = p.cylinder, p.gas, p.polytropic_exponent, p.cylinder.L

    # spool: exact for a constant command; its middle position stands for the step
    e = y - command_v
    middle_e = half.ee * e + half.er * ydot
    middle_rate = half.re * e + half.rr * ydot
    y = command_v + half.ee * middle_e + half.er * middle_rate
    ydot = half.re * middle_e + half.rr * middle_rate

    # drift, first half
    x1, v, p1, p2 = _drift(x1, v, p1, p2, 0.5 * h, n, c)

    # flow at fixed volume
    before = p1 * c.A1 - p2 * c.A2
    u = opening(command_v + middle_e, p.valve)
    d1, d2 = disturbances(t_s + 0.5 * h, p)
    rate = n / g.k * c.c1 * abs(u)
    rate1 = rate / (c.A1 * x1)
    rate2 = rate / (c.A2 * (length - x1))
    if u > 0.0:
        flow, slope = inflow(p1, g.supply_pa, p.reverse_flow, g)
        p1 = relax(p1, g.supply_pa, rate1 * flow, rate1 * slope, d1, h)
        flow, slope = outflow(p2, g.atmosphere_pa, p.reverse_flow, g)
        p2 = relax(p2, g.atmosphere_pa, -rate2 * flow, -rate2 * slope, d2, h)
    elif u < 0.0:
        flow, slope = outflow(p1, g.atmosphere_pa, p.reverse_flow, g)
        p1 = relax(p1, g.atmosphere_pa, -rate1 * flow, -rate1 * slope, d1, h)
        flow, slope = inflow(p2, g.supply_pa, p.reverse_flow, g)
        p2 = relax(p2, g.supply_pa, rate2 * flow, rate2 * slope, d2, h)
    else:
        p1 += h * d1
        p2 += h * d2

    # velocity and bristles under the mean force
    force = 0.5 * (before + p1 * c.A1 - p2 * c.A2) - c.rod_force_n - force_ext_n
    mean, z_new = slide(v, z, v + 0.5 * h * a, force, c.M, h, p.friction)
    v_new = 2.0 * mean - v
    if (v_new <= 0.0 and x1 <= c.x_e1) or (v_new >= 0.0 and x1 >= c.x_e1 + c.stroke_m):
        v = a = 0.0  # the stop carries the load, and the bristles stay as they are
    else:
        a = (v_new - v) / h
        v, z = v_new, z_new

    # drift, second half
    x1, v_drift, p1, p2 = _drift(x1, v, p1, p2, 0.5 * h, n, c)
    return PlantState(x1, v_drift, p1, p2, z, y, ydot, a if v_drift == v else 0.0)


def _drift(
    x1: float, v: float, p1: float, p2: float, time_s: float, n: float, c: Cylinder
) -> tuple[float, float, float, float]:
    x = x1 + v * time_s
    front = c.x_e1 + c.stroke_m
    if x < c.x_e1 or x > front:
        x = c.x_e1 if x < c.x_e1 else front
        v = 0.0  # inelastic end stops
    if x == x1:
        return x, v, p1, p2
    return x, v, p1 * (x1 / x) ** n, p2 * ((c.L - x1) / (c.L - x)) ** n
