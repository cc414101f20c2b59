"""Friction that the reference's own motion meets: LuGre bristles carried along by the reference's velocity.

Only changes of this force are used. The motion filter adds them to its estimate, so that the estimate has to
find no more than what the friction model misses, and a change of parameters or of reference is no step.
"""

from __future__ import annotations

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


def bristles_after(z: float, v: float, time_s: float, f: Friction) -> float:
    """Deflection [m] after a time at constant velocity: ż = v − a z has an exact solution."""
    a = relaxation_rate(v, f)
    if a < 0.0:
        return 0.0
    x = a * time_s
    if x < 1e-5:
        return z * (1.0 - x) + v * time_s
    return z + (v / a - z) * -math.expm1(-x)


def bristles_under(force_n: float, f: Friction) -> float:
    """Deflection [m] of a load at rest that its bristles hold against a force."""
    if f.sigma0_n_m <= 0.0:
        return 0.0
    return max(-f.coulomb_n, min(f.coulomb_n, force_n)) / f.sigma0_n_m


def friction_ahead(
    z: float, now: Reference, following: Reference, effect: Reference, h: float, lead_s: float, f: Friction
) -> FrictionAhead:
    """The reference's friction until the next sample and until the command has its effect.

    Args:
        z: deflection now [m].
        now: the reference at the sample.
        following: at the next sample, h later.
        effect: when the command has its effect, `lead_s` later.
        h: sample time [s].
        lead_s: time until the command has its effect [s].
        f: the friction as identified.
    """
    v0, v1, v2 = now.velocity_m_s, following.velocity_m_s, effect.velocity_m_s
    z1 = bristles_after(z, 0.5 * (v0 + v1), h, f)
    z2 = bristles_after(z, 0.5 * (v0 + v2), lead_s, f)
    force = friction_force(v0, z, f)
    rate = f.viscous_n_s_m * effect.acceleration_m_s2
    a = relaxation_rate(v2, f)
    if a >= 0.0:
        rate += f.sigma0_n_m * (v2 - a * z2)  # σ1 z̈ is small beside it
    return FrictionAhead(z1, friction_force(v1, z1, f) - force, friction_force(v2, z2, f) - force, rate)
