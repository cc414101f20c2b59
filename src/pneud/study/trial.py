"""Controller and plant in lock step as one function: what a controller is worth on a rig unlike its model.

Quantisation, noise, transport delay and the valve's step size are in force; what is left out is the bus and
the supervisor. Written so that it can be compiled whole: a minute at a kilohertz takes a tenth of a second.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

from pneud.control.reference import Sine, Way, along, rest, sine
from pneud.control.step import Controller, ControllerState, act, join, observe, start
from pneud.physics.plant import PlantParameters
from pneud.rig.dynamics import PlantState, advance, initial_state
from pneud.rig.sensors import quantised, sensed
from pneud.rt.folders import cache_folder
from pneud.signals import Reference
from pneud.study.closed_loop import supply_flow_kg_s
from pure2c import BuildError, compile_functions

MOST_SEED = 0x7FFFFFFF
SATURATED = 0.99


class Pair(NamedTuple):
    """Controller and plant between two ticks."""

    state: ControllerState
    rig: PlantState
    last_v: float  # command on its way or acting
    seed: int  # of the sensors' noise
    reference_m: float  # of the last tick


class Errand(NamedTuple):
    """What is asked: a way, and behind it the sine, or rest where that has no amplitude."""

    way: Way
    sine: Sine
    force_n: float = 0.0  # external, against positive motion


class Verdict(NamedTuple):
    """What came of it, true positions."""

    rms_m: float  # of the error
    max_m: float
    high_m: float  # greatest position
    low_m: float
    step_v: float  # mean |Δu|
    saturated: int  # ticks
    outside: int  # the last tick with an error beyond the tolerance, 0 without one
    air_kg: float  # from the supply


def uniform(seed: int) -> int:
    """The next number from 0 to 2³¹ − 1."""
    return (seed * 1103515245 + 12345) & MOST_SEED


def noise(seed: int) -> tuple[int, float]:
    """The next seed, and a number of mean 0 and standard deviation 1: the sum of three uniform ones."""
    one = uniform(seed)
    two = uniform(one)
    three = uniform(two)
    return three, 2.0 * ((one + two + three) / MOST_SEED - 1.5)


def asked(t: float, c: Errand) -> Reference:
    """Where the load should be at t [s]."""
    if t < c.way.T:
        return along(t, c.way)
    if c.sine.amplitude_m == 0.0:
        return rest(along(c.way.T, c.way).position_m)
    return sine(t - c.way.T, c.sine)


def tick(
    b: Pair, t: float, joins: bool, c: Errand, p: Controller, plant: PlantParameters, command_step_v: float
) -> Pair:
    """One sample at t [s], and the plant until the next one."""
    rig, deviation, step = b.rig, plant.pressure_noise_pa, plant.pressure_resolution_pa
    seed, noise1 = noise(b.seed)
    seed, noise2 = noise(seed)
    seed, noise3 = noise(seed)
    there = sensed(rig, plant)
    p1 = quantised(there.p1_pa + deviation * noise1, step)
    p2 = quantised(there.p2_pa + deviation * noise2, step)
    supply = quantised(there.supply_pa + deviation * noise3, step)
    shown_m = there.position_m
    if plant.detail.encoder_noise_m > 0.0:
        seed, noise4 = noise(seed)
        shown_m += plant.detail.encoder_noise_m * noise4
    position = quantised(shown_m, plant.encoder_resolution_m)
    state, e = observe(b.state, position, True, p1, p2, supply, b.last_v, p.h, p)
    r = asked(t, c)
    if joins:
        state = join(state, e, r, p)
    state, out = act(state, e, r, p)
    u_max = p.valve.u_max_v
    u = quantised(max(-u_max, min(u_max, out.u_v)), command_step_v)
    rig = advance(rig, b.last_v, c.force_n, t, t + p.delay_s, plant)
    rig = advance(rig, u, c.force_n, t + p.delay_s, t + p.h, plant)
    return Pair(state, rig, u, seed, r.position_m)


def trial(
    b: Pair,
    joins: bool,
    ticks: int,
    judged: int,
    tolerance_m: float,
    c: Errand,
    p: Controller,
    plant: PlantParameters,
    command_step_v: float,
) -> tuple[Pair, Verdict]:
    """Go along a course.

    Args:
        b: where to go on from.
        joins: the law takes over in the first tick.
        ticks: how many.
        judged: from this tick on the errors count.
        tolerance_m: error that is looked for in all ticks.
        c: the course; its time begins with the first tick.
        p: the controller.
        plant: the plant.
        command_step_v: step of the DAC, 0 for a continuous one [V].

    Returns:
        Where to go on from, and what came of it.
    """
    squares = steps = most = air = 0.0
    high, low = -1e9, 1e9
    saturated = outside = 0
    for i in range(ticks):
        before, true_m = b.last_v, b.rig.x1 - plant.cylinder.x_e1
        b = tick(b, i * p.h, joins and i == 0, c, p, plant, command_step_v)
        error = b.reference_m - true_m
        if abs(error) > tolerance_m:
            outside = i
        if i >= judged:
            squares += error * error
            most = max(most, abs(error))
            high, low = max(high, true_m), min(low, true_m)
            steps += abs(b.last_v - before)
            air += supply_flow_kg_s(b.rig, plant)
            if abs(b.last_v) >= SATURATED * p.valve.u_max_v:
                saturated += 1
    count = max(1, ticks - judged)
    return b, Verdict(
        math.sqrt(squares / count), most, high, low, steps / count, saturated, outside, air * p.h
    )


def begin(position_m: float, p: Controller, plant: PlantParameters, seed: int = 1) -> Pair:
    """A load at rest at a position [m], nothing learnt yet."""
    rig = initial_state(plant._replace(initial_x1=position_m + plant.cylinder.x_e1))
    state = start(position_m, rig.p1, rig.p2, plant.gas.supply_pa, p)
    return Pair(state, rig, 0.0, seed, position_m)


@cache
def compiled() -> tuple[Callable[..., Any], str]:
    """`trial` in C; where that cannot be had in Python, and why."""
    try:
        return compile_functions([trial], cache=cache_folder("compiled")).functions[0], ""
    except (BuildError, OSError) as e:
        return trial, str(e)


def step_v(p: Controller, plant: PlantParameters) -> float:
    """Step of the plant's DAC [V], 0 for a continuous one."""
    return 2.0 * p.valve.u_max_v / 2**plant.dac_bits if plant.dac_bits else 0.0
