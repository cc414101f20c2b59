"""A small bounded opening of the valve without any loop: what moves, and which way, is looked at afterwards.

The opening grows slowly from nothing, and the valve is centred as soon as a bound is come to. With its
chambers shut a load still coasts: that way counts before it is gone.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from pneud.physics.cylinder import Cylinder
from pneud.physics.gas import Gas
from pneud.signals import Estimate, Measurement

MOST_TRAVEL_M, MOST_SPEED_M_S = 5e-3, 0.1  # whatever is asked for
LONGEST_NS = 20_000_000_000


class Probe(NamedTuple):
    """What is asked for, and where it began."""

    goal_v: float  # where the opening grows to, signed
    rate_v_s: float
    travel_m: float  # from where it began
    speed_m_s: float
    force_n: float  # change of the pressures' force
    lease: int  # ticks that nobody has to renew it for
    since_ns: int = 0
    from_m: float = 0.0
    from_n: float = 0.0


NO_PROBE = Probe(0.0, 0.0, 0.0, 0.0, 0.0, 0)


def is_allowed(p: Probe, u_max_v: float) -> bool:
    """Whether a probe lies within what any probe may do."""
    return (
        0.0 < abs(p.goal_v) <= u_max_v
        and p.rate_v_s > 0.0
        and 0.0 < p.travel_m <= MOST_TRAVEL_M
        and 0.0 < p.speed_m_s <= MOST_SPEED_M_S
        and p.force_n > 0.0
    )


def opening_v(p: Probe, now_ns: int) -> float:
    """What is asked of the valve [V], not limited."""
    return math.copysign(min(abs(p.goal_v), p.rate_v_s * (now_ns - p.since_ns) * 1e-9), p.goal_v)


def coast_m(e: Estimate, m: Measurement, c: Cylinder, g: Gas) -> float:
    """How far a load goes on whose chambers are shut, without friction, where the air is softest."""
    stiffness_n_m = 2.0 * g.k * (m.p1_pa * c.A1 + m.p2_pa * c.A2) / c.L
    return abs(e.velocity_m_s) * math.sqrt(c.M / stiffness_n_m)


def is_over(p: Probe, e: Estimate, m: Measurement, now_ns: int, c: Cylinder, g: Gas) -> bool:
    """Whether a bound has been come to, or the end of the ramp.

    Args:
        p: the probe.
        e: the estimate.
        m: the measurement.
        now_ns: the instant that the estimate holds for.
        c: the cylinder.
        g: the gas.
    """
    return (
        p.lease < 0
        or now_ns - p.since_ns > LONGEST_NS
        or p.rate_v_s * (now_ns - p.since_ns) * 1e-9 > abs(p.goal_v)
        or abs(e.velocity_m_s) >= p.speed_m_s
        or abs(e.x3_n - p.from_n) >= p.force_n
        or abs(e.position_m - p.from_m) + coast_m(e, m, c, g) >= p.travel_m
    )
