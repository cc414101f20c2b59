"""The proportional valve: spool dynamics of second order and a dead zone about the centre."""

from __future__ import annotations

import math
from typing import NamedTuple


class Valve(NamedTuple):
    """Parameters of a proportional valve."""

    u_max_v: float
    omega_rad_s: float  # natural frequency of the spool; 0 for a spool without lag
    zeta: float
    dead_zone_v: float  # half width about the centre within which nothing flows
    centre_v: float = 0.0  # where that is


def opening(spool_v: float, valve: Valve) -> float:
    """Effective opening [V] of a spool at `spool_v`: 0 within the dead zone, u_max at and beyond u_max."""
    deviation = spool_v - valve.centre_v
    excess = abs(deviation) - valve.dead_zone_v
    if excess <= 0.0:
        return 0.0
    u = excess * valve.u_max_v / (valve.u_max_v - valve.dead_zone_v)
    return math.copysign(valve.u_max_v if u > valve.u_max_v else u, deviation)  # NaN stays


def dead_zone_inverse(opening_v: float, valve: Valve, band_v: float) -> float:
    """Command [V] that gives an effective opening; the step across the dead zone is spread over ±band_v."""
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
