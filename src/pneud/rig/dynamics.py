"""The rig's equations of motion, (5)–(8) of the paper corrected and completed, in fixed small steps.

One step is a symmetric (Strang) splitting: half a step of drift with polytropic compression, P Vⁿ constant;
the flow of both chambers at fixed volume; velocity and bristles under the mean force; the other half of the
drift. Every part is exact or stable for any stiffness, so the whole is of second order and stable over the
whole travel with the valve fully open.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from pneud.physics.friction import slide
from pneud.physics.plant import PlantParameters
from pneud.physics.valve import opening, spool_transition
from pneud.rig.chamber import exchange


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
    """At rest at x1(0), P2 as given, P1 so that it bears rod side and load, spool centred."""
    c = p.cylinder
    p1 = max(p.gas.atmosphere_pa, (p.initial_p2_pa * c.A2 + c.rod_force_n + p.load_n) / c.A1)
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
    return _march(state, command_v, force_ext_n, t_s, h, 1, p)


def advance(
    state: PlantState, command_v: float, force_ext_n: float, t0_s: float, t1_s: float, p: PlantParameters
) -> PlantState:
    """The state at `t1_s` from that at `t0_s`, in equal steps no longer than `p.step_s`."""
    span = t1_s - t0_s
    if span <= 0.0:
        return state
    count = max(1, math.ceil(span / p.step_s - 1e-6))
    return _march(state, command_v, force_ext_n, t0_s, span / count, count, p)


def _march(
    state: PlantState,
    command_v: float,
    force_ext_n: float,
    t_s: float,
    h: float,
    count: int,
    p: PlantParameters,
) -> PlantState:
    # Several steps: the second half of one's drift and the first half of the next one's are one drift.
    # It keeps to local numbers, since it is most of a simulation's time.
    x1, v, p1, p2, z, y, ydot, a = state
    g, c, valve, friction = p.gas, p.cylinder, p.valve, p.friction
    A1, A2, M, length, rear = c.A1, c.A2, c.M, c.L, c.x_e1
    front = rear + c.stroke_m
    n, supply, atmosphere = p.polytropic_exponent, g.supply_pa, g.atmosphere_pa
    filling = n / g.k * c.c1
    emptying = filling * c.exhaust
    load = c.rod_force_n + p.load_n + force_ext_n
    disturbed, reverse = p.disturbance != 0, p.reverse_flow
    d1 = d2 = 0.0
    ee, er, re, rr = spool_transition(0.5 * h, valve)
    e = y - command_v
    for i in range(count + 1):
        # drift
        x = x1 + v * (h if 0 < i < count else 0.5 * h)
        if x < rear or x > front:
            x = rear if x < rear else front
            v = a = 0.0  # inelastic end stops
        if x != x1:
            p1 *= math.pow(x1 / x, n)
            p2 *= math.pow((length - x1) / (length - x), n)
            x1 = x
        if i == count:
            break

        # spool: exact for a constant command; its middle position stands for the step
        middle = ee * e + er * ydot
        ydot = re * e + rr * ydot
        u = opening(command_v + middle, valve)
        e = ee * middle + er * ydot
        ydot = re * middle + rr * ydot

        # flow at fixed volume
        if disturbed:
            d1, d2 = disturbances(t_s + (i + 0.5) * h, p)
        before = p1 * A1 - p2 * A2
        if u != 0.0:
            if u > 0.0:
                other1, rate1, other2, rate2 = supply, filling * u, atmosphere, emptying * u
            else:
                other1, rate1, other2, rate2 = atmosphere, emptying * -u, supply, filling * -u
            rate1 /= A1 * x1
            rate2 /= A2 * (length - x1)
            if not reverse:
                rate1 = rate1 if (p1 < other1) == (u > 0.0) else 0.0
                rate2 = rate2 if (p2 < other2) == (u < 0.0) else 0.0
            p1 = exchange(p1, other1, rate1, d1, h, g)
            p2 = exchange(p2, other2, rate2, d2, h, g)
        else:
            p1 += h * d1
            p2 += h * d2

        # velocity and bristles under the mean force
        force = 0.5 * (before + p1 * A1 - p2 * A2) - load
        mean, z_new = slide(v, z, v + 0.5 * h * a, force, M, h, friction)
        v_new = 2.0 * mean - v
        if (v_new <= 0.0 and x1 <= rear) or (v_new >= 0.0 and x1 >= front):
            v = a = 0.0  # the stop carries the load, and the bristles stay as they are
        else:
            a = (v_new - v) / h
            v, z = v_new, z_new
    return PlantState(x1, v, p1, p2, z, command_v + e, ydot, a)
