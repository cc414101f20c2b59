"""The proportional valve: spool dynamics of second order and a dead zone about the centre."""

import math
from typing import NamedTuple


class Bend(NamedTuple):
    """Relative opening over the relative way from an edge: from place to place, all from x5 on."""

    x1: float = 0.2
    y1: float = 0.2
    x2: float = 0.4
    y2: float = 0.4
    x3: float = 0.6
    y3: float = 0.6
    x4: float = 0.8
    y4: float = 0.8
    x5: float = 1.0


STRAIGHT = Bend()


class Valve(NamedTuple):
    """Parameters of a proportional valve."""

    u_max_v: float
    omega_rad_s: float  # natural frequency of the spool; 0 for a spool without lag
    zeta: float
    dead_zone_v: float  # half width about the centre within which nothing flows
    centre_v: float = 0.0  # where that is
    bent: bool = False  # the opening is no straight line from the edge
    plus: Bend = STRAIGHT  # for u > 0
    minus: Bend = STRAIGHT


def bent(x: float, b: Bend) -> float:
    """Relative opening, 0 to 1, at a relative way beyond an edge."""
    if x >= b.x5:
        return 1.0
    return _between(x, b.x1, b.x2, b.x3, b.x4, b.x5, b.y1, b.y2, b.y3, b.y4, 1.0)


def straightened(y: float, b: Bend) -> float:
    """The reverse of `bent`; what is more than the whole opening lies as far beyond its end."""
    if y >= 1.0:
        return b.x5 + (y - 1.0)
    return _between(y, b.y1, b.y2, b.y3, b.y4, 1.0, b.x1, b.x2, b.x3, b.x4, b.x5)


def _between(
    a: float,
    a1: float,
    a2: float,
    a3: float,
    a4: float,
    a5: float,
    b1: float,
    b2: float,
    b3: float,
    b4: float,
    b5: float,
) -> float:
    """What b is at a, straight from place to place, and both from 0 on."""
    if a < a1:
        return b1 * a / a1
    if a < a2:
        return b1 + (b2 - b1) * (a - a1) / (a2 - a1)
    if a < a3:
        return b2 + (b3 - b2) * (a - a2) / (a3 - a2)
    if a < a4:
        return b3 + (b4 - b3) * (a - a3) / (a4 - a3)
    return b4 + (b5 - b4) * (a - a4) / (a5 - a4)


def opening(spool_v: float, valve: Valve) -> float:
    """Effective opening [V] of a spool at `spool_v`: 0 within the dead zone, u_max at and beyond u_max."""
    deviation = spool_v - valve.centre_v
    excess = abs(deviation) - valve.dead_zone_v
    if excess <= 0.0:
        return 0.0
    u = excess * valve.u_max_v / (valve.u_max_v - valve.dead_zone_v)
    if valve.bent:
        u = valve.u_max_v * bent(u / valve.u_max_v, valve.plus if deviation > 0.0 else valve.minus)
    return math.copysign(valve.u_max_v if u > valve.u_max_v else u, deviation)  # NaN stays


def dead_zone_inverse(opening_v: float, valve: Valve, band_v: float) -> float:
    """Command [V] that gives an effective opening; the step across the dead zone is spread over ±band_v."""
    if valve.bent:
        side = valve.plus if opening_v > 0.0 else valve.minus
        straight_v = valve.u_max_v * straightened(abs(opening_v) / valve.u_max_v, side)
        opening_v = math.copysign(straight_v, opening_v)
    scaled = valve.centre_v + opening_v * (valve.u_max_v - valve.dead_zone_v) / valve.u_max_v
    if band_v <= 0.0:
        return scaled + (math.copysign(valve.dead_zone_v, opening_v) if opening_v != 0.0 else 0.0)
    return scaled + valve.dead_zone_v * max(-1.0, min(1.0, opening_v / band_v))


class SpoolTransition(NamedTuple):
    """How a spool's deviation from a constant command and its rate develop over a fixed time."""

    ee: float
    er: float  # [s]
    re: float  # [1/s]
    rr: float


def spool_transition(time_s: float, valve: Valve) -> SpoolTransition:
    """Exact transition of ÿ = ω²(u − y) − 2ζω ẏ over `time_s` for a constant u; all zero without lag."""
    omega, zeta = valve.omega_rad_s, valve.zeta
    if omega <= 0.0:
        return SpoolTransition(0.0, 0.0, 0.0, 0.0)
    damping = zeta * omega
    if zeta < 1.0 - 1e-6:
        root = omega * math.sqrt(1.0 - zeta * zeta)
        scale = math.exp(-damping * time_s)
        c = scale * math.cos(root * time_s)
        s = scale * math.sin(root * time_s) / root
    elif zeta > 1.0 + 1e-6:
        root = omega * math.sqrt(zeta * zeta - 1.0)
        slow = math.exp((root - damping) * time_s)
        fast = math.exp(-(root + damping) * time_s)
        c = 0.5 * (slow + fast)
        s = 0.5 * (slow - fast) / root
    else:
        c = math.exp(-damping * time_s)
        s = c * time_s
    return SpoolTransition(c + damping * s, s, -omega * omega * s, c - damping * s)
