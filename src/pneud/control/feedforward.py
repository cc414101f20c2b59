"""Friction that the reference's own motion meets: LuGre bristles carried along by the reference's velocity.

Only changes of this force are used. The motion filter adds them to its estimate, so that the estimate has to
find no more than what the friction model misses, and a change of parameters or of reference is no step.
"""

import math
from typing import NamedTuple

from pneud.physics.friction import Friction, friction_force, relaxation_rate
from pneud.signals import Reference


class FrictionAhead(NamedTuple):
    """What the reference's friction will do."""

    bristles_m: float  # deflection at the next sample
    step_n: float  # gained until the next sample
    ahead_n: float  # gained until the command has its effect
    rate_n_s: float  # at that instant
    now_n: float  # at the sample


class Creep(NamedTuple):
    """Where a load creeps: friction that falls with speed is fed forward at the load's own speed there."""

    share: float = 0.0  # of its deviation from the reference's speed; 0 for none
    speed_m_s: float = 1.0  # of the reference, about which it fades
    acceleration_m_s2: float = 1.0  # likewise


def bristles_after(z: float, v: float, a: float, time_s: float) -> float:
    """Deflection [m] after a time at constant velocity: ż = v − a z has an exact solution.

    Args:
        z: deflection now [m].
        v: velocity [m/s].
        a: relaxation rate at that velocity, negative where there is no dry friction [1/s].
        time_s: the time [s].
    """
    if a < 0.0:
        return 0.0
    x = a * time_s
    if x < 1e-5:
        return z * (1.0 - x) + v * time_s
    return z - (v / a - z) * math.expm1(-x)


def held_by_bristles(force_n: float, f: Friction) -> float:
    """What the bristles of a load at rest bear of a force [N]."""
    if f.sigma0_n_m <= 0.0:
        return 0.0
    return max(-f.coulomb_n, min(f.coulomb_n, force_n))


def bristles_under(force_n: float, f: Friction) -> float:
    """Deflection [m] of a load at rest that its bristles hold against a force."""
    if f.sigma0_n_m <= 0.0:
        return 0.0
    return held_by_bristles(force_n, f) / f.sigma0_n_m


def friction_ahead(
    z: float, now: Reference, goal: Reference, h: float, lead_s: float, f: Friction
) -> FrictionAhead:
    """The reference's friction until the next sample and until the command has its effect.

    Args:
        z: deflection now [m].
        now: the reference at the sample.
        goal: the reference when the command has its effect, `lead_s` later.
        h: sample time [s].
        lead_s: time until the command has its effect [s].
        f: the friction as identified.
    """
    v0, v2 = now.velocity_m_s, goal.velocity_m_s
    v1 = v0 + h * (now.acceleration_m_s2 + 0.5 * h * now.jerk_m_s3)
    a1, a2 = relaxation_rate(v1, f), relaxation_rate(v2, f)
    z1, z2 = bristles_after(z, v1, a1, h), bristles_after(z, v2, a2, lead_s)
    force = friction_force(v0, z, f)
    gained1, gained2 = f.viscous_n_s_m * v1 - force, f.viscous_n_s_m * v2 - force
    rate = f.viscous_n_s_m * goal.acceleration_m_s2
    if a2 >= 0.0:
        zdot = v2 - a2 * z2
        rate += f.sigma0_n_m * zdot  # σ1 z̈ is small beside it
        gained1 += f.sigma0_n_m * z1 + f.sigma1_n_s_m * (v1 - a1 * z1)
        gained2 += f.sigma0_n_m * z2 + f.sigma1_n_s_m * zdot
    return FrictionAhead(z1, gained1, gained2, rate, force)


def friction_creeping(
    z: float, now: Reference, goal: Reference, v: float, h: float, lead_s: float, f: Friction, p: Creep
) -> FrictionAhead:
    """As `friction_ahead`, but at the load's own speed where the reference creeps.

    There friction falls with speed, so that a load which lags is held back the more: an unstable pole of
    nearly (F_s − F_c)/(M v_s). Fed forward at the load's speed, that slope is gone, as far as the speed is
    known in time.

    Args:
        z: deflection now [m].
        now: the reference at the sample.
        goal: the reference when the command has its effect, `lead_s` later.
        v: velocity of the load [m/s].
        h: sample time [s].
        lead_s: time until the command has its effect [s].
        f: the friction as identified.
        p: where it creeps.
    """
    speed, acceleration = now.velocity_m_s / p.speed_m_s, now.acceleration_m_s2 / p.acceleration_m_s2
    fast = speed * speed
    more = p.share * (v - now.velocity_m_s) / ((1.0 + fast * fast) * (1.0 + acceleration * acceleration))
    own = Reference(now.position_m, now.velocity_m_s + more, now.acceleration_m_s2, now.jerk_m_s3)
    later = Reference(goal.position_m, goal.velocity_m_s + more, goal.acceleration_m_s2, goal.jerk_m_s3)
    return friction_ahead(z, own, later, h, lead_s, f)


def friction_felt(z: float, v: float, h: float, lead_s: float, f: Friction) -> FrictionAhead:
    """The friction of a load that moves though its reference stands still, until the next sample and beyond.

    Its rate is left out: fed forward, it would take from the bristles what they hold the load with.

    Args:
        z: deflection now [m].
        v: velocity of the load [m/s].
        h: sample time [s].
        lead_s: time until the command has its effect [s].
        f: the friction as identified.
    """
    at = Reference(0.0, v, 0.0, 0.0)
    felt = friction_ahead(z, at, at, h, lead_s, f)
    return FrictionAhead(felt.bristles_m, felt.step_n, felt.ahead_n, 0.0, felt.now_n)


def recalled(z: float, force_n: float, share: float, f: Friction) -> float:
    """Deflection [m] of the bristles of a standing load, drawn towards what a force on them says.

    Args:
        z: deflection as believed [m].
        force_n: that the bristles hold against [N].
        share: of the difference.
        f: the friction as identified.
    """
    if f.sigma0_n_m <= 0.0:
        return z
    held_m = max(-f.static_n, min(f.static_n, force_n)) / f.sigma0_n_m
    return z + share * (held_m - z)
