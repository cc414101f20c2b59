"""Where the load will be when a command has its effect: transport delay and the spool's lag, bridged.

A spool of second order delays what passes through it by 2ζ/ω. Until the transport delay and this lag are
over, openings follow from commands already sent, so the state can be predicted with the law's own model. Law
and reference are then compared at that instant, and the loop sees hardly any dead time.
"""

from typing import NamedTuple

from pneud.physics.valve import SpoolTransition, Valve, opening
from pneud.signals import Reference


class Spool(NamedTuple):
    """Believed state of the valve's spool."""

    position_v: float
    rate_v_s: float


class Motion(NamedTuple):
    """Motion of the load."""

    x: float  # [m]
    v: float  # [m/s]
    force_n: float  # net force on the load


class Rates(NamedTuple):
    """Model of the net force's rate, as it stands at the sample: f0 v + f1 u + rest."""

    f0: float  # [N/m]
    f1_fill: float  # [N/(s V)] for u ≥ 0
    f1_exhaust: float  # for u < 0
    rest: float  # [N/s]


def follow(s: Spool, command_v: float, t: SpoolTransition) -> Spool:
    """The spool after a constant command."""
    e = s.position_v - command_v
    return Spool(command_v + t.ee * e + t.er * s.rate_v_s, t.re * e + t.rr * s.rate_v_s)


def pushed(m: Motion, u_v: float, time_s: float, M: float, r: Rates) -> Motion:
    """The motion after a time with a constant opening, the force's rate held."""
    rate = r.f0 * m.v + (r.f1_fill if u_v >= 0.0 else r.f1_exhaust) * u_v + r.rest
    gain = time_s * rate
    return Motion(
        m.x + time_s * (m.v + time_s * (0.5 * m.force_n + gain / 6.0) / M),
        m.v + time_s * (m.force_n + 0.5 * gain) / M,
        m.force_n + gain,
    )


def ahead(
    m: Motion,
    s: Spool,
    command_v: float,
    half_s: float,
    over_half: SpoolTransition,
    M: float,
    r: Rates,
    valve: Valve,
) -> Motion:
    """The motion after twice `half_s`.

    Args:
        m: now.
        s: the spool now.
        command_v: the command that acts until the next one does.
        half_s: half of the time to bridge [s].
        over_half: the spool's transition over it.
        M: moving mass [kg].
        r: the force's rate.
        valve: dead zone and greatest opening.
    """
    middle = follow(s, command_v, over_half)
    end = follow(middle, command_v, over_half)
    u0, u1, u2 = (
        opening(s.position_v, valve),
        opening(middle.position_v, valve),
        opening(end.position_v, valve),
    )
    return pushed(pushed(m, 0.5 * (u0 + u1), half_s, M, r), 0.5 * (u1 + u2), half_s, M, r)


def later(r: Reference, time_s: float) -> Reference:
    """A reference a few milliseconds later, its jerk held."""
    a = r.acceleration_m_s2 + time_s * r.jerk_m_s3
    mean = r.acceleration_m_s2 + 0.5 * time_s * r.jerk_m_s3
    return Reference(
        r.position_m
        + time_s * (r.velocity_m_s + time_s * (0.5 * r.acceleration_m_s2 + time_s * r.jerk_m_s3 / 6.0)),
        r.velocity_m_s + time_s * mean,
        a,
        r.jerk_m_s3,
    )
