"""The nonsmooth composite law (14)/(15) and the integral sliding mode control (29), corrected and extended.

The extension: an unmatched force F̂, estimated by the motion filter, stands in w3, and its rate in Z.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from pneud.control.homogeneous import Feedback, explicit_ustar, implicit_ustar
from pneud.physics.valve import Valve, dead_zone_inverse


class Sliding(NamedTuple):
    """Parameters of the law."""

    gains: Feedback
    eta: float  # reaching rate η [m/s³]
    implicit: bool
    compensate_d: bool  # True: composite (14); False: ISMC (29)
    M: float  # moving mass [kg]
    invert_dead_zone: bool
    dead_zone_band_v: float  # width over which the inverse crosses the dead zone


class SlidingState(NamedTuple):
    """What the law carries from tick to tick."""

    integral: float  # ∫u* of (12) [m/s²]


class SlidingOutput(NamedTuple):
    """The law's answer in one tick."""

    u_v: float  # command it asks for [V], not limited
    s: float  # sliding variable (12) [m/s²]
    ustar: float  # (19) [m/s³]


def engage(w3: float) -> SlidingState:
    """The state with s(0) = 0, so that engaging does not step."""
    return SlidingState(w3)


def reaching(s: float, h: float, eta: float, implicit: bool) -> float:
    """η sgn(s) [m/s³]; implicit: η clip(s/(h η), −1, 1), which reaches zero instead of stepping over it."""
    if implicit:
        return max(-eta, min(eta, s / h))
    return math.copysign(eta, s) if s != 0.0 else 0.0


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
) -> tuple[SlidingState, SlidingOutput]:
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

    Returns:
        The state after this tick and the answer. Where the opening saturates, the integral takes what the
        valve can really give, so that s does not wind up.
    """
    ustar = implicit_ustar(w1, w2, w3, h, p.gains) if p.implicit else explicit_ustar(w1, w2, w3, p.gains)
    s = w3 - state.integral
    d = d_hat if p.compensate_d else 0.0
    known = p.M * jerk_d - drift - d + force_rate
    Z = known - p.M * ustar + p.M * reaching(s, h, p.eta, p.implicit)
    f1 = f1_fill if Z >= 0.0 else f1_exhaust
    opening = Z / f1
    if abs(opening) > valve.u_max_v:
        limited = math.copysign(valve.u_max_v, opening)
        integral = state.integral + h * (known - f1 * limited) / p.M
    else:
        integral = state.integral + h * ustar
    u = dead_zone_inverse(opening, valve, p.dead_zone_band_v) if p.invert_dead_zone else opening
    return SlidingState(integral), SlidingOutput(u, s, ustar)
