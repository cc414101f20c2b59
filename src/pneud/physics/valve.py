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


def dead_zone(u_v: float, valve: Valve) -> float:
    """Effective opening [V] of a spool at u_v: 0 within the dead zone, u_max at u_max."""
    excess = abs(u_v) - valve.dead_zone_v
    if excess <= 0.0:
        return 0.0
    return math.copysign(excess * valve.u_max_v / (valve.u_max_v - valve.dead_zone_v), u_v)


def dead_zone_inverse(opening_v: float, valve: Valve, band_v: float) -> float:
    """Command [V] that gives an effective opening; the step across the dead zone is spread over ±band_v."""
    scaled = opening_v * (valve.u_max_v - valve.dead_zone_v) / valve.u_max_v
    if band_v <= 0.0:
        return scaled + (math.copysign(valve.dead_zone_v, opening_v) if opening_v != 0.0 else 0.0)
    return scaled + valve.dead_zone_v * max(-1.0, min(1.0, opening_v / band_v))
