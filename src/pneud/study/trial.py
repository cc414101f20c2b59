"""Controller and plant in lock step as one compiled call: what a controller is worth on a rig that differs from its model.

Quantisation, noise, transport delay and the valve's step size are in force; what is left out is the bus and
the supervisor.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from pneud.control.reference import Sine, Way, along, sine
from pneud.control.step import Controller, ControllerState, act, join, observe, start
from pneud.physics.plant import PlantParameters
from pneud.rig.dynamics import PlantState, advance, initial_state
from pneud.signals import Estimate, Reference


class Bench(NamedTuple):
    """Controller and plant between two ticks."""

    state: ControllerState
    rig: PlantState
    last_v: float
    seed: int
    r: Reference  # of the last tick
    e: Estimate


class Course(NamedTuple):
    """What is asked: a way, and then the sine where it has an amplitude; a force against the motion [N]."""

    way: Way
    sine: Sine
    force_n: float


class Verdict(NamedTuple):
    """What came of it, from `judged` on."""

    squares: float
    most_m: float
    least_m: float
    steps_v: float
    saturated: int
    outside: int  # the last tick in which the error was beyond the tolerance
    ticks: int
    high_m: float
    low_m: float


def uniform(seed: int) -> int:
    return (seed * 1103515245 + 12345) & 0x7FFFFFFF


def snapped(value: float, step: float) -> float:
    return math.floor(value / step + 0.5) * step if step > 0.0 else value


def wanted(t: float, c: Course) -> Reference:
    if t < c.way.T or c.sine.amplitude_m == 0.0:
        return along(t, c.way)
    return sine(t - c.way.T, c.sine)


def tick(b: Bench, t: float, joins: bool, c: Course, p: Controller, plant: PlantParameters, command_step_v: float) -> Bench:
    rig, seed = b.rig, b.seed
    noise1 = noise2 = noise3 = 0.0
    for _ in range(3):
        seed = uniform(seed)
        noise1 += seed
        seed = uniform(seed)
        noise2 += seed
        seed = uniform(seed)
        noise3 += seed
    scale = 2.0 / 2147483648.0 * plant.pressure_noise_pa
    mean = 3.0 * plant.pressure_noise_pa
    res = plant.pressure_resolution_pa
    p1 = snapped(rig.p1 + (noise1 * scale - mean), res)
    p2 = snapped(rig.p2 + (noise2 * scale - mean), res)
    ps = snapped(plant.gas.supply_pa + (noise3 * scale - mean), res)
    position = snapped(rig.x1 - plant.cylinder.x_e1, plant.encoder_resolution_m)
    state, e = observe(b.state, position, True, p1, p2, ps, b.last_v, p.h, p)
    r = wanted(t, c)
    if joins:
        state = join(state, e, r, p)
    state, out = act(state, e, r, p)
    u_max = p.valve.u_max_v
    u = snapped(max(-u_max, min(u_max, out.u_v)), command_step_v)
    rig = advance(rig, b.last_v, c.force_n, t, t + p.delay_s, plant)
    rig = advance(rig, u, c.force_n, t + p.delay_s, t + p.h, plant)
    return Bench(state, rig, u, seed, r, e)


def trial(
    b: Bench, joins: bool, ticks: int, judged: int, tolerance_m: float, c: Course, p: Controller, plant: PlantParameters, command_step_v: float
) -> tuple[Bench, Verdict]:
    squares = steps = 0.0
    most, least = -1.0, 1.0
    saturated = outside = 0
    high, low = -1e9, 1e9
    for i in range(ticks):
        before = b.last_v
        true_m = b.rig.x1 - plant.cylinder.x_e1
        b = tick(b, i * p.h, joins and i == 0, c, p, plant, command_step_v)
        error = b.r.position_m - true_m
        if abs(error) > tolerance_m:
            outside = i
        if i >= judged:
            squares += error * error
            most = max(most, error)
            least = min(least, error)
            high = max(high, true_m)
            low = min(low, true_m)
            steps += abs(b.last_v - before)
            if abs(b.last_v) >= 0.99 * p.valve.u_max_v:
                saturated += 1
    return b, Verdict(squares, most, least, steps, saturated, outside, ticks - judged, high, low)


def begin(x_m: float, p: Controller, plant: PlantParameters, seed: int) -> Bench:
    rig = initial_state(plant._replace(initial_x1=x_m + plant.cylinder.x_e1))
    return Bench(start(x_m, rig.p1, rig.p2, plant.gas.supply_pa, p), rig, 0.0, seed, Reference(x_m, 0.0, 0.0, 0.0), Estimate(0.0,0.0,0.0,0.0,0.0,0.0,0.0,0.0))
