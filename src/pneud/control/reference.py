"""Where the load should be: the tracked motion, and polynomials of degree seven that lead to it and to rest.

A polynomial meets position, velocity, acceleration and jerk at both ends, so that the jerk which (14) feeds
forward never steps. Its duration is the shortest (to a few per cent) within given bounds.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from pneud.signals import Reference

GROWTH = 1.1
MAX_TRIES = 60
MAX_DOUBLINGS = 10
SAMPLES = 16
WAY_SAMPLES = 64
LEAST_S = 0.02


class Sine(NamedTuple):
    """centre + amplitude sin(ω t), in the stroke coordinate."""

    centre_m: float
    amplitude_m: float
    omega_rad_s: float


class Bounds(NamedTuple):
    """What a transfer may not exceed."""

    speed_m_s: float
    acceleration_m_s2: float
    jerk_m_s3: float


class Septic(NamedTuple):
    """Σ c_i (t/T)^i over 0 ≤ t ≤ T."""

    T: float  # [s]
    c0: float  # coefficients [m]
    c1: float
    c2: float
    c3: float
    c4: float
    c5: float
    c6: float
    c7: float


def sine(t: float, p: Sine) -> Reference:
    """The sine and its derivatives at t [s]."""
    w = p.omega_rad_s
    a = p.amplitude_m
    s, c = math.sin(w * t), math.cos(w * t)
    return Reference(p.centre_m + a * s, a * w * c, -a * w * w * s, -a * w * w * w * c)


def rest(position_m: float) -> Reference:
    """Standing still."""
    return Reference(position_m, 0.0, 0.0, 0.0)


def septic(T: float, start: Reference, end: Reference) -> Septic:
    """The polynomial from start to end in T seconds."""
    T2, T3 = T * T, T * T * T
    c0, c1, c2, c3 = (
        start.position_m,
        start.velocity_m_s * T,
        0.5 * start.acceleration_m_s2 * T2,
        start.jerk_m_s3 * T3 / 6.0,
    )
    d0 = end.position_m - (c0 + c1 + c2 + c3)
    d1 = end.velocity_m_s * T - (c1 + 2.0 * c2 + 3.0 * c3)
    d2 = end.acceleration_m_s2 * T2 - (2.0 * c2 + 6.0 * c3)
    d3 = end.jerk_m_s3 * T3 - 6.0 * c3
    return Septic(
        T,
        c0,
        c1,
        c2,
        c3,
        35.0 * d0 - 15.0 * d1 + 2.5 * d2 - d3 / 6.0,
        -84.0 * d0 + 39.0 * d1 - 7.0 * d2 + 0.5 * d3,
        70.0 * d0 - 34.0 * d1 + 6.5 * d2 - 0.5 * d3,
        -20.0 * d0 + 10.0 * d1 - 2.0 * d2 + d3 / 6.0,
    )


def at(t: float, p: Septic) -> Reference:
    """The polynomial and its derivatives at t, clamped to 0 … T."""
    s = min(max(t / p.T, 0.0), 1.0)
    x = p.c0 + s * (p.c1 + s * (p.c2 + s * (p.c3 + s * (p.c4 + s * (p.c5 + s * (p.c6 + s * p.c7))))))
    v = p.c1 + s * (
        2.0 * p.c2
        + s * (3.0 * p.c3 + s * (4.0 * p.c4 + s * (5.0 * p.c5 + s * (6.0 * p.c6 + s * 7.0 * p.c7))))
    )
    a = 2.0 * p.c2 + s * (
        6.0 * p.c3 + s * (12.0 * p.c4 + s * (20.0 * p.c5 + s * (30.0 * p.c6 + s * 42.0 * p.c7)))
    )
    j = 6.0 * p.c3 + s * (24.0 * p.c4 + s * (60.0 * p.c5 + s * (120.0 * p.c6 + s * 210.0 * p.c7)))
    return Reference(x, v / p.T, a / (p.T * p.T), j / (p.T * p.T * p.T))


def excess(p: Septic, bounds: Bounds) -> float:
    """The greatest ratio of speed, acceleration and jerk to their bounds (in SAMPLES + 1 points)."""
    worst = 0.0
    for i in range(SAMPLES + 1):
        r = at(p.T * i / SAMPLES, p)
        worst = max(
            worst,
            abs(r.velocity_m_s) / bounds.speed_m_s,
            abs(r.acceleration_m_s2) / bounds.acceleration_m_s2,
            abs(r.jerk_m_s3) / bounds.jerk_m_s3,
        )
    return worst


def stays(p: Septic, low_m: float, high_m: float) -> bool:
    """Whether the polynomial stays between two positions (looked at in WAY_SAMPLES + 1 points)."""
    return all(low_m <= at(p.T * i / WAY_SAMPLES, p).position_m <= high_m for i in range(WAY_SAMPLES + 1))


def _widened(bounds: Bounds, start: Reference, end: Reference) -> Bounds:
    # what the ends themselves have cannot be forbidden on the way
    return Bounds(
        max(bounds.speed_m_s, 1.5 * abs(start.velocity_m_s), 1.5 * abs(end.velocity_m_s)),
        max(bounds.acceleration_m_s2, 1.5 * abs(start.acceleration_m_s2), 1.5 * abs(end.acceleration_m_s2)),
        max(bounds.jerk_m_s3, 1.5 * abs(start.jerk_m_s3), 1.5 * abs(end.jerk_m_s3)),
    )


def transfer(start: Reference, end: Reference, bounds: Bounds) -> Septic:
    """The polynomial from start to end in about the shortest time within the bounds.

    Where no time keeps every bound, the one that exceeds them least.
    """
    room = _widened(bounds, start, end)
    distance = abs(end.position_m - start.position_m)
    change = abs(end.velocity_m_s - start.velocity_m_s)
    # exact for motions between two rests (first three) and for changes of speed alone (last two)
    T = max(
        2.1875 * distance / room.speed_m_s,
        math.sqrt(7.513 * distance / room.acceleration_m_s2),
        (52.5 * distance / room.jerk_m_s3) ** (1.0 / 3.0),
        1.5 * change / room.acceleration_m_s2,
        math.sqrt(5.0 * change / room.jerk_m_s3),
        LEAST_S,
    )
    best = septic(T, start, end)
    least = excess(best, room)
    for _ in range(MAX_TRIES):
        if least <= 1.0:
            break
        T *= GROWTH
        p = septic(T, start, end)
        over = excess(p, room)
        if over < least:
            best, least = p, over
    return best


def to_rest(start: Reference, bounds: Bounds) -> Septic:
    """The polynomial that brings a motion to rest wherever that leads, about as fast as the bounds allow.

    The end position is the one that makes the highest coefficient vanish: the velocity is then the quintic
    between its ends. Where no time keeps every bound, the one that exceeds them least.
    """
    room = _widened(bounds, start, rest(start.position_m))
    speed = abs(start.velocity_m_s)
    T = max(1.5 * speed / room.acceleration_m_s2, math.sqrt(5.0 * speed / room.jerk_m_s3), LEAST_S)
    best = _halt(T, start)
    least = excess(best, room)
    for _ in range(MAX_TRIES):
        if least <= 1.0:
            break
        T *= GROWTH
        p = _halt(T, start)
        over = excess(p, room)
        if over < least:
            best, least = p, over
    return best


def stop(start: Reference, bounds: Bounds, low_m: float, high_m: float) -> Septic:
    """`to_rest` that stays between two positions: where it would leave them it stops harder than the bounds.

    A start so fast and so close to the end that even the hardest stop leaves them is stopped as hard.
    """
    p = to_rest(start, bounds)
    for _ in range(MAX_DOUBLINGS):
        if stays(p, low_m, high_m):
            break
        bounds = Bounds(bounds.speed_m_s, 2.0 * bounds.acceleration_m_s2, 4.0 * bounds.jerk_m_s3)
        p = to_rest(start, bounds)
    return p


def _halt(T: float, start: Reference) -> Septic:
    # the integral of the quintic that takes velocity, acceleration and jerk to zero
    travel = T * (
        0.5 * start.velocity_m_s + T * (0.1 * start.acceleration_m_s2 + T * start.jerk_m_s3 / 120.0)
    )
    return septic(T, start, rest(start.position_m + travel))
