"""The rig's equations of motion, (5)–(8) of the paper corrected and completed, in fixed small steps.

One step is a symmetric (Strang) splitting: half a step of drift with polytropic compression, P Vⁿ constant;
the flow of both chambers at fixed volume; velocity and bristles under the mean force; the other half of the
drift. Every part is exact or stable for any stiffness, so the whole is of second order and stable over the
whole travel with the valve fully open.
"""

import math
from typing import NamedTuple

from pneud.physics.friction import slide
from pneud.physics.plant import PlantParameters
from pneud.physics.series import power, raised
from pneud.physics.slip import slip
from pneud.physics.valve import opening, spool_transition
from pneud.rig.chamber import exchange
from pneud.rig.detail import (
    PLAIN,
    Chamber,
    Depth,
    behind_play,
    breathe,
    later,
    rubbing,
    shown,
    supplied,
    touching,
)


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
    depth: Depth = PLAIN  # where the plant has details


def initial_state(p: PlantParameters) -> PlantState:
    """At rest at x1(0), P2 as given, P1 so that it bears rod side and load, spool centred."""
    c = p.cylinder
    p1 = max(p.gas.atmosphere_pa, (p.initial_p2_pa * c.A2 + c.rod_force_n + p.load_n) / c.A1)
    return with_depth(PlantState(p.initial_x1, 0.0, p1, p.initial_p2_pa, 0.0, 0.0, 0.0, 0.0), p)


def with_depth(s: PlantState, p: PlantParameters) -> PlantState:
    """The state with all that has been at rest for long: air as warm as the walls, the supply full."""
    if not p.detail.on:
        return s
    c, g = p.cylinder, p.gas
    per_pa = 1.0 / (g.R * g.temperature_k)
    mass1, mass2 = s.p1 * c.A1 * s.x1 * per_pa, s.p2 * c.A2 * (c.L - s.x1) * per_pa
    return s._replace(depth=Depth(s.y, mass1, mass2, g.supply_pa, s.p1, s.p2, g.supply_pa))


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
    if p.detail.on:
        return _march_in_detail(state, command_v, force_ext_n, t_s, h, 1, p)
    return _march(state, command_v, force_ext_n, t_s, h, 1, p)


def advance(
    state: PlantState, command_v: float, force_ext_n: float, t0_s: float, t1_s: float, p: PlantParameters
) -> PlantState:
    """The state at `t1_s` from that at `t0_s`, in equal steps no longer than `p.step_s`."""
    span = t1_s - t0_s
    if span <= 0.0:
        return state
    count = max(1, math.ceil(span / p.step_s - 1e-6))
    if p.detail.on:
        return _march_in_detail(state, command_v, force_ext_n, t0_s, span / count, count, p)
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
    x1, v, p1, p2, z, y, ydot, a, depth = state
    g, c, valve, friction = p.gas, p.cylinder, p.valve, p.friction
    A1, A2, M, length, rear = c.A1, c.A2, c.M, c.L, c.x_e1
    front = rear + c.stroke_m
    n, supply, atmosphere = p.polytropic_exponent, g.supply_pa, g.atmosphere_pa
    filling = n / g.k * c.c1
    emptying = filling * c.exhaust
    load = c.rod_force_n + p.load_n + force_ext_n
    disturbed, reverse = p.disturbance != 0, p.reverse_flow
    d1 = d2 = 0.0
    compressed = power(n)
    ee, er, re, rr = spool_transition(0.5 * h, valve)
    e = y - command_v
    for i in range(count + 1):
        # drift
        x = x1 + v * (h if 0 < i < count else 0.5 * h)
        if x < rear or x > front:
            x = rear if x < rear else front
            v = a = 0.0  # inelastic end stops
        if x != x1:
            p1 *= raised((x1 - x) / x, compressed)
            p2 *= raised((x - x1) / (length - x), compressed)
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
            if u > 0.0:
                p1 = exchange(p1, supply, rate1, d1, h, g)
                p2 = exchange(p2, atmosphere, rate2, d2, h, c.vent)
            else:
                p1 = exchange(p1, atmosphere, rate1, d1, h, c.vent)
                p2 = exchange(p2, supply, rate2, d2, h, g)
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
    return PlantState(x1, v, p1, p2, z, command_v + e, ydot, a, depth)


def _march_in_detail(
    state: PlantState,
    command_v: float,
    force_ext_n: float,
    t_s: float,
    h: float,
    count: int,
    p: PlantParameters,
) -> PlantState:
    # the same splitting, with all that a plant may have besides
    x1, v, p1, p2, z, y, ydot, a, depth = state
    behind, mass1, mass2, supply, shown1, shown2, shown_supply, elements, hoses = depth
    c, d, n = p.cylinder, p.detail, p.polytropic_exponent
    rear, front, length = c.x_e1, c.x_e1 + c.stroke_m, c.L
    load = c.rod_force_n + p.load_n + force_ext_n
    half, compressed = spool_transition(0.5 * h, p.valve), power(n)
    e = y - command_v
    for i in range(count):
        x, v, a = _drifted(x1, v, a, 0.5 * h, rear, front)
        p1 *= raised((x1 - x) / x, compressed)
        p2 *= raised((x - x1) / (length - x), compressed)

        middle = half.ee * e + half.er * ydot
        ydot = half.re * e + half.rr * ydot
        behind = behind_play(behind, command_v + middle, d.play_v)
        hoses = later(hoses, opening(behind, p.valve), h, d)
        u = hoses.far_v
        e = half.ee * middle + half.er * ydot
        ydot = half.re * middle + half.rr * ydot

        before = p1 * c.A1 - p2 * c.A2
        d1, d2 = disturbances(t_s + (i + 0.5) * h, p)
        fill1, fill2 = max(u, 0.0) + d.leak_in_v, max(-u, 0.0) + d.leak_in_v
        empty1, empty2 = c.exhaust * max(-u, 0.0) + d.leak_out_v, c.exhaust * max(u, 0.0) + d.leak_out_v
        one = breathe(Chamber(p1 + h * d1, mass1, 0.0), fill1, empty1, supply, c.A1 * x, h, p)
        two = breathe(Chamber(p2 + h * d2, mass2, 0.0), fill2, empty2, supply, c.A2 * (length - x), h, p)
        p1, mass1, p2, mass2 = one.pressure_pa, one.mass_kg, two.pressure_pa, two.mass_kg
        supply = supplied(supply, one.drawn_kg + two.drawn_kg, h, p.gas, d)

        guess = v + 0.5 * h * a
        force = 0.5 * (before + p1 * c.A1 - p2 * c.A2) - load - touching(x, guess, d)
        f = rubbing(guess, 0.5 * (p1 + p2), p.friction, d)
        z_new, bent = z, elements
        if d.slips:
            mean, bent = slip(v, elements, guess, force, c.M, h, f)
        else:
            mean, z_new = slide(v, z, guess, force, c.M, h, f)
        v_new = 2.0 * mean - v
        if (v_new <= 0.0 and x <= rear) or (v_new >= 0.0 and x >= front):
            v = a = 0.0
        else:
            a = (v_new - v) / h
            v, z, elements = v_new, z_new, bent

        x1, v, a = _drifted(x, v, a, 0.5 * h, rear, front)
        p1 *= raised((x - x1) / x1, compressed)
        p2 *= raised((x1 - x) / (length - x1), compressed)
        shown1, shown2 = shown(shown1, p1, h, d), shown(shown2, p2, h, d)
        shown_supply = shown(shown_supply, supply, h, d)
    depth = Depth(behind, mass1, mass2, supply, shown1, shown2, shown_supply, elements, hoses)
    return PlantState(x1, v, p1, p2, z, command_v + e, ydot, a, depth)


def _drifted(
    x: float, v: float, a: float, time_s: float, rear: float, front: float
) -> tuple[float, float, float]:
    """Position, velocity and acceleration after a drift, with inelastic end stops."""
    x += v * time_s
    if x < rear or x > front:
        return (rear if x < rear else front), 0.0, 0.0
    return x, v, a
