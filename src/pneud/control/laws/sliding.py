"""The nonsmooth composite law (14)/(15) and the integral sliding mode control (29), corrected and extended.

The extension: an unmatched force F̂, estimated by the motion filter, stands in w3, and its rate in Z.
"""

import math
from typing import NamedTuple

from pneud.control.homogeneous import Feedback, explicit_ustar, implicit_ustar
from pneud.control.laws.situation import LawOutput
from pneud.physics.valve import Valve, dead_zone_inverse


class Sliding(NamedTuple):
    """Parameters of the law."""

    gains: Feedback
    eta: float  # reaching rate η [m/s³]
    implicit: bool
    horizon_s: float  # how far the implicit forms look ahead where that is further than one sample
    compensate_d: bool  # True: composite (14); False: ISMC (29)
    M: float  # moving mass [kg]
    invert_dead_zone: bool
    hold_v: float  # opening not worth a way across the dead zone


class SlidingState(NamedTuple):
    """What the law carries from tick to tick."""

    integral: float  # ∫u* of (12) [m/s²]


def firmer(p: Sliding, more: float) -> Sliding:
    """The law with a bandwidth `more` times as high, whatever the error."""
    g = p.gains
    gains = Feedback(more * more * more * g.k1, more * more * g.k2, more * g.k3, g.a1, g.a2, g.a3)
    return Sliding(gains, p.eta, p.implicit, p.horizon_s, p.compensate_d, p.M, p.invert_dead_zone, p.hold_v)


def engage(w3: float) -> SlidingState:
    """The state with s(0) = 0, so that engaging does not step."""
    return SlidingState(w3)


def reaching(s: float, ahead_s: float, eta: float, implicit: bool) -> float:
    """η sgn(s) [m/s³]; implicit: η clip(s/(T η), −1, 1), which reaches zero instead of stepping over it."""
    if implicit:
        return max(-eta, min(eta, s / ahead_s))
    return math.copysign(eta, s) if s != 0.0 else 0.0


def feedback_ustar(w1: float, w2: float, w3: float, ahead_s: float, p: Sliding) -> float:
    """u* of (19) in the form asked for [m/s³]."""
    if p.implicit:
        return implicit_ustar(w1, w2, w3, ahead_s, p.gains)
    return explicit_ustar(w1, w2, w3, p.gains)


def resistance(
    state: SlidingState, w1: float, w2: float, w3: float, d_hat: float, h: float, p: Sliding
) -> float:
    """What errors and disturbance take from the jerk in Z of (14), without blend [m/s³]."""
    ahead_s = max(h, p.horizon_s)
    d = d_hat if p.compensate_d else 0.0
    s = w3 - state.integral
    return feedback_ustar(w1, w2, w3, ahead_s, p) - reaching(s, ahead_s, p.eta, p.implicit) + d / p.M


def command(wanted_v: float, last_v: float, p: Sliding, valve: Valve) -> float:
    """Command [V] for an opening; the last one, within the dead zone, where that is not worth crossing it."""
    if not p.invert_dead_zone:
        return wanted_v
    if abs(wanted_v) <= p.hold_v:
        return valve.centre_v + max(-valve.dead_zone_v, min(valve.dead_zone_v, last_v - valve.centre_v))
    return dead_zone_inverse(wanted_v, valve, 0.0)


def law(
    state: SlidingState,
    w1: float,
    w2: float,
    w3: float,
    jerk_d: float,
    drift: float,
    d_hat: float,
    force_rate: float,
    f1_fill: float,
    f1_exhaust: float,
    h: float,
    p: Sliding,
    valve: Valve,
    last_v: float = 0.0,
    blend: float = 0.0,
) -> tuple[SlidingState, LawOutput]:
    """One tick of the law.

    Args:
        state: integral so far.
        w1: position error [m].
        w2: velocity error [m/s].
        w3: acceleration error, with the unmatched force in it [m/s²].
        jerk_d: third derivative of the reference [m/s³].
        drift: F0 x2 [N/s].
        d_hat: d̂ of (10) [N/s].
        force_rate: rate of the unmatched force, fed forward [N/s].
        f1_fill: F1 for u ≥ 0 [N/(s V)].
        f1_exhaust: F1 for u < 0 [N/(s V)].
        h: time to the next tick [s].
        p: parameters.
        valve: for the dead zone and the greatest opening.
        last_v: the command before this one [V].
        blend: added to u*, to lead from one set of gains to another [m/s³].

    Returns:
        The state after this tick and the answer. Where the opening wanted is not the one that comes, because
        the valve saturates or is left in its dead zone, the integral takes what will come, so that s does not
        wind up.
    """
    ahead_s = max(h, p.horizon_s)
    ustar = blend + feedback_ustar(w1, w2, w3, ahead_s, p)
    s = w3 - state.integral
    d = d_hat if p.compensate_d else 0.0
    known = p.M * jerk_d - drift - d + force_rate
    Z = known - p.M * ustar + p.M * reaching(s, ahead_s, p.eta, p.implicit)
    f1 = f1_fill if Z >= 0.0 else f1_exhaust
    wanted = Z / f1
    coming = max(-valve.u_max_v, min(valve.u_max_v, wanted))
    if p.invert_dead_zone and abs(wanted) <= p.hold_v:
        coming = 0.0
    u = command(wanted, last_v, p, valve)
    rate = ustar if coming == wanted else (known - f1 * coming) / p.M
    return SlidingState(state.integral + h * rate), LawOutput(u, s, ustar)
