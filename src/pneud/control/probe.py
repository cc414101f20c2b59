"""A small bounded opening of the valve without any loop: what moves, and which way, is looked at afterwards.

The opening grows slowly from nothing until a bound is come to, or until the force shows that the load has
come loose, whatever the encoder says. With its chambers shut a load would coast: that way counts before it
is gone, and a load that moves is braked by the reverse opening before the valve is centred.
"""

import math
from typing import NamedTuple

from pneud.physics.cylinder import Cylinder
from pneud.physics.gas import Gas
from pneud.signals import Estimate, Measurement

MOST_TRAVEL_M, MOST_SPEED_M_S = 5e-3, 0.1  # whatever is asked for
LONGEST_NS = 20_000_000_000
BRAKES_NS = 150_000_000  # at most
BRAKES_OPEN_S = 0.03  # in which the reverse opening grows by the probe's goal: its edge may lie further off
BRAKED = 0.5  # of the greatest speed
USUAL_S = 0.5  # in which a force becomes usual
PUSHED = 0.1  # of the force's bound: less may be noise
LET_GO = UNDONE = 0.7  # of the greatest force: the load has given way; it has lost its push
LETS_GO_NS = 150_000_000  # within which it does
STALLED_NS = 250_000_000  # a force that has not grown for so long moves something


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
    usual_n: float = 0.0  # the force, slowly followed: what leaks is no push
    most_n: float = 0.0  # greatest deviation from it
    most_ns: int = 0  # when
    braked_ns: int = 0  # since when the load is braked, 0 for not
    fastest_m_s: float = 0.0  # since then
    braked_n: float = 0.0  # the force at that time


NO_PROBE = Probe(0.0, 0.0, 0.0, 0.0, 0.0, 0)


class Progress(NamedTuple):
    """What a tick of a probe has come to."""

    probe: Probe
    over: bool = False


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
    until_ns = p.braked_ns if p.braked_ns else now_ns
    opened_v = min(abs(p.goal_v), p.rate_v_s * (until_ns - p.since_ns) * 1e-9)
    if p.braked_ns:
        opened_v = -min(
            abs(p.goal_v), opened_v + abs(p.goal_v) * (now_ns - p.braked_ns) * 1e-9 / BRAKES_OPEN_S
        )
    return math.copysign(1.0, p.goal_v) * opened_v


def coast_m(e: Estimate, m: Measurement, c: Cylinder, g: Gas) -> float:
    """How far a load goes on whose chambers are shut, without friction, where the air is softest."""
    stiffness_n_m = 2.0 * g.k * (m.p1_pa * c.A1 + m.p2_pa * c.A2) / c.L
    return abs(e.velocity_m_s) * math.sqrt(c.M / stiffness_n_m)


def proceed(p: Probe, e: Estimate, m: Measurement, now_ns: int, h: float, c: Cylinder, g: Gas) -> Progress:
    """One tick on.

    Args:
        p: the probe, after the last tick.
        e: the estimate.
        m: the measurement.
        now_ns: the instant that the estimate holds for.
        h: sample time [s].
        c: the cylinder.
        g: the gas.
    """
    push_n, speed_m_s = abs(e.x3_n - p.usual_n), abs(e.velocity_m_s)
    if p.braked_ns:
        p = p._replace(fastest_m_s=max(p.fastest_m_s, speed_m_s))
        # either way: it may not be the load that has given way
        undone = abs(e.x3_n - p.braked_n) >= UNDONE * p.most_n
        late = now_ns - p.braked_ns > BRAKES_NS
        return Progress(p, p.lease < 0 or late or undone or speed_m_s <= BRAKED * p.fastest_m_s)
    usual_n = p.usual_n + (e.x3_n - p.usual_n) * h / USUAL_S
    if push_n > p.most_n:
        p = p._replace(usual_n=usual_n, most_n=push_n, most_ns=now_ns)
    else:
        p = p._replace(usual_n=usual_n)
    if p.lease >= 0 and _moves(p, e, m, push_n, now_ns, c, g):
        return Progress(p._replace(braked_ns=now_ns, fastest_m_s=speed_m_s, braked_n=e.x3_n))
    over = (
        p.lease < 0
        or now_ns - p.since_ns > LONGEST_NS
        or p.rate_v_s * (now_ns - p.since_ns) * 1e-9 > abs(p.goal_v)
        or abs(e.x3_n - p.from_n) >= p.force_n
        or (p.most_n >= PUSHED * p.force_n and now_ns - p.most_ns > STALLED_NS)
    )
    return Progress(p, over)


def _moves(p: Probe, e: Estimate, m: Measurement, push_n: float, now_ns: int, c: Cylinder, g: Gas) -> bool:
    """Whether the load has moved as far or as fast as it may, or has given way."""
    return (
        abs(e.velocity_m_s) >= p.speed_m_s
        or abs(e.position_m - p.from_m) + coast_m(e, m, c, g) >= p.travel_m
        or (
            p.most_n >= PUSHED * p.force_n and now_ns - p.most_ns <= LETS_GO_NS and push_n < LET_GO * p.most_n
        )
    )
