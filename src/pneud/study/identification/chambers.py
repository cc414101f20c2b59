"""Both chambers under the measured motion and command: simulated over many windows and guesses at once.

The equations are those of `pneud.rig.dynamics`, for arrays: half a step of drift with polytropic compression,
the flow at fixed volume, the other half. The flow is the paper's orifice, or that of ISO 6358.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pneud.physics.gas import LINEAR_FROM, Gas, flow_factor
from pneud.physics.valve import Valve, spool_transition
from pneud.study.identification import heat

Floats = NDArray[np.float64]
Share = Callable[[Floats], tuple[Floats, Floats]]
"""Share of the choked flow at a pressure ratio, and its slope."""
Mask = NDArray[np.bool_]

SUBSTEP_S = 5e-4  # longest step
WARM_S = 0.03  # before a window, in which only the spool moves
PLAYS_V = np.geomspace(5e-4, 0.25, 19)  # for which it is computed where the edges are before a window
_GRID = 4096


class Windows(NamedTuple):
    """Equally long pieces of a log as (window, tick); one sample more than ticks that count."""

    x_m: Floats  # measured position, smoothed
    p1_pa: Floats
    p2_pa: Floats
    p1_start_pa: Floats  # smoothed, where the window begins
    p2_start_pa: Floats
    supply_pa: Floats  # smoothed
    applied_v: Floats
    behind: Floats  # of the play, for `PLAYS_V`, where the edges are at first: −1 to 1 (window, play)
    warmth: Floats  # of the air, for rates of the wall: (window, rate, chamber, tick)
    warm: int  # ticks before the start


def some(w: Windows, most: int) -> Windows:
    """Some of the windows, evenly from all."""
    count = len(w.x_m)
    rows = np.unique(np.linspace(0, count - 1, min(most, count)).astype(int))
    return Windows._make([*(part[rows] for part in w[:-1]), w.warm])


class Rig(NamedTuple):
    """What is taken for granted."""

    area1_m2: float
    area2_m2: float
    stroke_m: float
    u_max_v: float
    damping: float  # of the spool
    gas: Gas
    h: float  # sample time [s]


class Guess(NamedTuple):
    """One guess each; numbers, or columns of them for many guesses."""

    flow: Floats  # of a fully open edge: R T C ρ [m³/s]
    plus_v: Floats  # edges, as commands
    minus_v: Floats
    bandwidth_hz: Floats
    delay_s: Floats  # from the sampling instant until the command of that tick acts, below a sample
    dead1_m: Floats
    dead2_m: Floats
    exponent: Floats
    seep: Floats  # of each closed edge from the supply, relative to a fully open one
    seep_out: Floats  # and of those to the atmosphere
    play_v: Floats  # half of the spool's hysteresis
    exhaust: Floats  # flow of the edges to the atmosphere, relative to those from the supply
    critical: Floats  # of ISO 6358; not looked at where the flow is an orifice's
    critical_out: Floats  # of the edges to the atmosphere, likewise
    wall_1_s: Floats  # rate at which air comes to the wall's temperature; 0: it never does


def orifice(g: Gas) -> Share:
    """Of the paper's orifice, from a table."""
    ratios = np.linspace(0.0, 1.0, _GRID)
    shares = np.array([flow_factor(float(r), g) for r in ratios]) / g.gamma_choked
    last = g.gamma_linear / g.gamma_choked / (1.0 - LINEAR_FROM)
    slopes = np.gradient(shares, ratios)
    slopes[ratios <= g.critical_ratio] = 0.0

    def share(r: Floats) -> tuple[Floats, Floats]:
        near = r > LINEAR_FROM
        value = np.where(near, last * (1.0 - r), np.interp(r, ratios, shares))
        return value, np.where(near, -last, np.interp(r, ratios, slopes))

    return share


def iso6358(b: Floats) -> Share:
    """Of ISO 6358 with a critical ratio, one for each guess."""
    width = 1.0 - b
    top = (LINEAR_FROM - b) / width
    last = np.sqrt(1.0 - top * top) / (1.0 - LINEAR_FROM)

    def share(r: Floats) -> tuple[Floats, Floats]:
        x = np.clip((r - b) / width, 0.0, top)
        value = np.sqrt(1.0 - x * x)
        near = r > LINEAR_FROM
        return np.where(near, last * (1.0 - r), value), np.where(near, -last, -x / (width * value))

    return share


def _shares(g: Guess, rig: Rig, iso: bool) -> Callable[[Mask], Share]:
    """Those of edges of which a part is from the supply, and the others are to the atmosphere."""
    came, left = g.critical, g.critical_out
    if iso and not np.array_equal(came, left):
        return lambda supplies: iso6358(np.where(supplies, came, left))
    one = iso6358(came) if iso else orifice(rig.gas)
    return lambda _: one


def _exchange(p: Floats, other: Floats, rate: Floats, share: Share, h: Floats) -> Floats:
    """Pressure after a step at fixed volume; `pneud.rig.chamber.exchange` for arrays."""
    filling = p < other
    high = np.where(filling, other, p)
    r = np.where(filling, p, other) / high
    value, slope = share(r)
    flow = np.where(filling, other * value, -p * value)
    z = np.minimum(rate * h * np.where(filling, slope, r * slope - value), -1e-9)
    after = p + h * rate * flow * np.expm1(z) / z
    return np.where(filling, np.minimum(after, other), np.maximum(after, other))


def openings(y: Floats, g: Guess, u_max_v: float) -> Floats:
    """Relative opening, signed, of a spool at `y` [V]."""
    centre, half = 0.5 * (g.plus_v + g.minus_v), 0.5 * (g.plus_v - g.minus_v)
    deviation = y - centre
    excess = np.maximum(np.abs(deviation) - half, 0.0)
    return np.copysign(np.minimum(excess / (u_max_v - half), 1.0), deviation)


def simulate(w: Windows, guesses: Guess, rig: Rig, iso: bool) -> Floats:
    """Pressures at each tick that counts: (guess, chamber, window, tick) [Pa]."""
    column = Guess._make(np.atleast_1d(np.asarray(value, dtype=float))[:, None] for value in guesses)
    count, (windows, samples) = len(column.flow), w.x_m.shape
    shares = _shares(column, rig, iso)
    moves = [_moves(0, column.delay_s, column, rig), _moves(1, rig.h - column.delay_s, column, rig)]
    y = np.broadcast_to(w.applied_v[:, 0], (count, windows)).copy()
    rate, felt = np.zeros_like(y), y + _behind(w, column.play_v)  # felt: by the edges, behind the play
    p1 = np.broadcast_to(w.p1_start_pa, (count, windows)).copy()
    p2 = np.broadcast_to(w.p2_start_pa, (count, windows)).copy()
    out = np.empty((count, 2, windows, samples - w.warm - 1))
    length = rig.stroke_m + column.dead2_m
    inside = np.clip(w.x_m, 0.0, rig.stroke_m)  # whatever the encoder says
    scale = column.exponent * column.flow
    root, held = _heat(w, column, rig.h)
    for k in range(samples - 1):
        x, step = inside[:, k], inside[:, k + 1] - inside[:, k]
        at, counts = np.zeros_like(column.delay_s), k >= w.warm
        for late, h, n, (ee, er, re, rr) in moves:
            u = w.applied_v[:, k + late]
            for _ in range(n):
                e = y - u
                middle, quick = ee * e + er * rate, re * e + rr * rate
                felt = np.minimum(np.maximum(felt, u + middle - column.play_v), u + middle + column.play_v)
                y, rate = u + ee * middle + er * quick, re * middle + rr * quick
                if counts:
                    a = x + step * (at / rig.h)
                    b = x + step * ((at + h) / rig.h)
                    at = at + h
                    m = 0.5 * (a + b)
                    opening = openings(felt, column, rig.u_max_v)
                    p1 = p1 * ((a + column.dead1_m) / (m + column.dead1_m)) ** column.exponent
                    p2 = p2 * ((length - a) / (length - m)) ** column.exponent
                    v1 = scale / (rig.area1_m2 * (m + column.dead1_m))
                    v2 = scale / (rig.area2_m2 * (length - m))
                    leaving = column.exhaust[:, :, None] * root[..., k - w.warm]
                    edges = _Edges(opening, column.seep, column.seep_out, leaving)
                    p1, p2 = _flows(p1, p2, edges, v1, v2, w.supply_pa[:, k], shares, h, rig.gas)
                    p1 = p1 * ((m + column.dead1_m) / (b + column.dead1_m)) ** column.exponent
                    p2 = p2 * ((length - m) / (length - b)) ** column.exponent
        if counts:
            p1, p2 = p1 * held[:, 0, :, k - w.warm], p2 * held[:, 1, :, k - w.warm]
            out[:, 0, :, k - w.warm], out[:, 1, :, k - w.warm] = p1, p2
    return out


def _behind(w: Windows, play_v: Floats) -> Floats:
    """How far from the spool the edges are at first: (guess, window) [V]."""
    place = np.interp(np.log(np.maximum(play_v[:, 0], 1e-9)), np.log(PLAYS_V), np.arange(len(PLAYS_V)))
    low = np.minimum(place.astype(int), len(PLAYS_V) - 2)
    part = (place - low)[:, None]
    found: Floats = play_v * ((1.0 - part) * w.behind.T[low] + part * w.behind.T[low + 1])
    return found


def spool(w: Windows, guess: Guess, rig: Rig) -> Floats:
    """Where the edges are at the end of each tick that counts, for one guess: (window, tick) [V]."""
    column = Guess._make(np.atleast_1d(np.asarray(value, dtype=float))[:, None] for value in guess)
    moves = [_moves(0, column.delay_s, column, rig), _moves(1, rig.h - column.delay_s, column, rig)]
    y = w.applied_v[None, :, 0]
    rate, felt = np.zeros_like(y), y + _behind(w, column.play_v)
    out = np.empty((w.x_m.shape[0], w.x_m.shape[1] - 1))
    for k in range(out.shape[1]):
        for late, _, n, (ee, er, re, rr) in moves:
            u = w.applied_v[:, k + late]
            for _ in range(2 * n):
                y, rate = u + ee * (y - u) + er * rate, re * (y - u) + rr * rate
                felt = np.minimum(np.maximum(felt, y - column.play_v), y + column.play_v)
        out[:, k] = felt[0]
    return out[:, w.warm :]


def _moves(late: int, span: Floats, column: Guess, rig: Rig) -> tuple[int, Floats, int, tuple[Floats, ...]]:
    """Part of a tick with one command: its steps, and what the spool does in half of one."""
    n = max(1, math.ceil(float(np.max(span)) / SUBSTEP_S - 1e-6))
    h = span / n
    found = [
        spool_transition(
            0.5 * float(t), Valve(rig.u_max_v, 2.0 * math.pi * max(0.0, float(f)), rig.damping, 0.0)
        )
        for t, f in zip(h[:, 0], column.bandwidth_hz[:, 0], strict=True)
    ]
    return late, h, n, tuple(np.array(values)[:, None] for values in zip(*found, strict=True))


def _heat(w: Windows, column: Guess, h: float) -> tuple[Floats, Floats]:
    """How much faster warm air leaves, what the wall leaves of a pressure: (guess, chamber, window, tick)."""
    if not np.any(column.wall_1_s > 0.0):
        none = np.ones((1, 2, 1, w.p1_pa.shape[1]))
        return none, none
    warmth = heat.at(w.warmth, column.wall_1_s[:, 0])
    taken = -np.expm1(-h * column.wall_1_s)[:, :, None, None]
    return np.exp(0.5 * warmth), 1.0 + taken * np.expm1(-warmth)


class _Edges(NamedTuple):
    """The valve for a step."""

    opening: Floats
    seep: Floats
    seep_out: Floats
    leaving: Floats  # flow to the atmosphere relative to that from the supply: (guess, chamber, window)


def _flows(
    p1: Floats, p2: Floats, e: _Edges, v1: Floats, v2: Floats, supply: Floats,
    shares: Callable[[Mask], Share], h: Floats, g: Gas,
) -> tuple[Floats, Floats]:  # fmt: skip
    """Both pressures after a step at fixed volumes."""
    out, wide, air = e.opening > 0.0, np.abs(e.opening), g.atmosphere_pa
    leaving1, leaving2 = e.leaving[:, 0], e.leaving[:, 1]
    into, from1, from2 = wide + e.seep, leaving1 * (wide + e.seep_out), leaving2 * (wide + e.seep_out)
    one, two = shares(out), shares(~out)
    p1 = _exchange(p1, np.where(out, supply, air), v1 * np.where(out, into, from1), one, h)
    p2 = _exchange(p2, np.where(out, air, supply), v2 * np.where(out, from2, into), two, h)
    if np.any(e.seep > 0.0) or np.any(e.seep_out > 0.0):  # the edges that are shut
        from1, from2 = leaving1 * e.seep_out, leaving2 * e.seep_out
        p1 = _exchange(p1, np.where(out, air, supply), v1 * np.where(out, from1, e.seep), two, h)
        p2 = _exchange(p2, np.where(out, supply, air), v2 * np.where(out, e.seep, from2), one, h)
    return p1, p2
