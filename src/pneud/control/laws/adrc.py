"""Linear active disturbance rejection control (ADRC): feedback of a state that an observer completes.

The observer is the [x, v, F] filter, which knows the force by the pressures; or one of fourth order that sees
encoder and opening only, and finds a total disturbance instead.
"""

import math
from typing import NamedTuple

from pneud.control.laws.open_loop import OpenLoop, cube_root
from pneud.control.laws.situation import Situation, errors, within
from pneud.control.motion import MotionFilter, beyond
from pneud.control.prediction import Motion, Rates, ahead
from pneud.signals import Estimate


class Adrc(NamedTuple):
    """Gains."""

    k1: float  # [1/s³]
    k2: float  # [1/s²]
    k3: float  # [1/s]
    reach_m: float  # position error that feedback takes at most, so that large errors are driven home evenly
    observer_rad_s: float  # of the observer of fourth order; 0: the [x, v, F] filter is the observer
    g1: float = 0.0  # gains of the former, without dimension, from `quadruple_pole`
    g2: float = 0.0
    g3: float = 0.0
    g4: float = 0.0


class AdrcState(NamedTuple):
    """What the observer of fourth order carries from tick to tick."""

    x: float = 0.0  # [m]
    v: float = 0.0  # [m/s]
    a: float = 0.0  # [m/s²]
    f: float = 0.0  # total disturbance [m/s³]


def quadruple_pole(omega_rad_s: float, h: float) -> tuple[float, float, float, float]:
    """Gains for x, v h, a h² and f h³ that put all four poles at exp(−ω h)."""
    q = math.exp(-omega_rad_s * h)
    p = 1.0 - q
    return (
        1.0 - q**4,
        p * p * (11.0 + 14.0 * q + 11.0 * q * q) / 6.0,
        2.0 * p**3 * (1.0 + q),
        p**4,
    )


def at_rest(e: Estimate) -> AdrcState:
    """The state of an observer that begins with a load at rest."""
    return AdrcState(e.position_m, e.velocity_m_s, 0.0, 0.0)


def in_motion(s: Situation) -> AdrcState:
    """The state, a sample ago, of an observer that agrees with the estimates of now."""
    u, h = s.e.opening_v, s.h
    f1 = s.f1_fill if u >= 0.0 else s.f1_exhaust
    f = -s.force_rate / s.M
    jerk = f + (s.f0 * s.now.v + f1 * u) / s.M
    a = s.now.force_n / s.M - h * jerk
    v = s.now.v - h * (a + 0.5 * h * jerk)
    return AdrcState(s.now.x - h * (v + h * (0.5 * a + h * jerk / 6.0)), v, a, f)


def reading(e: Estimate, p: MotionFilter) -> float:
    """The encoder's reading [m] that the estimate has been corrected with."""
    r, more = beyond(e.innovation_m, p)
    return e.position_m - (p.alpha * r + p.more_alpha * more) + e.innovation_m


def extend(own: AdrcState, s: Situation, g: Adrc) -> AdrcState:
    """One sample of the observer of fourth order: encoder and opening, no pressure."""
    h, u = s.h, s.e.opening_v
    f1 = s.f1_fill if u >= 0.0 else s.f1_exhaust
    jerk = own.f + (s.f0 * own.v + f1 * u) / s.M
    x = own.x + h * (own.v + h * (0.5 * own.a + h * jerk / 6.0))
    v = own.v + h * (own.a + 0.5 * h * jerk)
    a = own.a + h * jerk
    r = reading(s.e, s.filter) - x
    r -= within(r, s.filter.blind_m)
    return AdrcState(x + g.g1 * r, v + g.g2 * r / h, a + g.g3 * r / (h * h), own.f + g.g4 * r / (h * h * h))


def demand(own: AdrcState, s: Situation, g: Adrc) -> float:
    """Rate of the force [N/s] in M x''' = F0 x' + F1 u + M f, f estimated or x'' known by the pressures."""
    motion, known = s.motion, s.friction.rate_n_s + s.force_rate
    if g.observer_rad_s > 0.0:
        known = s.friction.rate_n_s - s.M * own.f
        motion = Motion(own.x, own.v, s.M * own.a)
        if s.lead_s > 0.0:
            rest = s.M * own.f - s.friction.ahead_n / s.lead_s
            rates = Rates(s.f0, s.f1_fill, s.f1_exhaust, rest)
            motion = ahead(motion, s.spool, s.applied_v, 0.5 * s.lead_s, s.spool_ahead, s.M, rates, s.valve)
    w1, w2, w3 = errors(motion, s.goal, s.M)
    w1 = within(w1, g.reach_m)
    feedback = g.k1 * w1 + g.k2 * w2 + g.k3 * w3
    return s.M * (s.goal.jerk_m_s3 + feedback) + known - s.f0 * motion.v


def after(own: AdrcState, s: Situation) -> AdrcState:
    """The observer's state once the friction until the next sample is known."""
    return AdrcState(own.x, own.v, own.a - s.friction.step_n / s.M, own.f)


def made(values: tuple[float, ...], h: float) -> Adrc:
    """Gains from their values in order, for a sample time [s]."""
    k1, k2, k3, reach_m, observer_rad_s = values
    return Adrc(k1, k2, k3, reach_m, observer_rad_s, *quadruple_pole(observer_rad_s, h))


def is_sound(g: Adrc) -> bool:
    """Whether each gain is one of its kind (finite)."""
    return min(g.k1, g.k2, g.k3, g.reach_m) > 0.0 and g.observer_rad_s >= 0.0


def loop(g: Adrc) -> OpenLoop:
    """(k3 s² + k2 s + k1)/s³, stable where k2 k3 > k1; or with the observer of fourth order in it."""
    k1, k2, k3 = g.k1, g.k2, g.k3
    numerator: tuple[float, ...] = (k3, k2, k1)
    denominator: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)
    if g.observer_rad_s > 0.0:
        w = g.observer_rad_s
        b1, b2, b3, b4 = 4.0 * w, 6.0 * w * w, 4.0 * w * w * w, w * w * w * w
        numerator = (
            k1 * b1 + k2 * b2 + k3 * b3 + b4,
            k1 * b2 + k2 * b3 + k3 * b4,
            k1 * b3 + k2 * b4,
            k1 * b4,
        )
        denominator = (1.0, b1 + k3, b2 + k2 + k3 * b1, b3 + k1 + k2 * b1 + k3 * b2, 0.0, 0.0, 0.0, 0.0)
    return OpenLoop(
        hurwitz=k2 * k3 > k1,
        criterion="k2·k3 > k1",
        bandwidth_rad_s=cube_root(k1),
        fastest_rad_s=max(k3, g.observer_rad_s),
        numerator=numerator,
        denominator=denominator,
    )


def rule(omega_rad_s: float) -> dict[str, float]:
    """Gains that put all three poles of the loop at −ω."""
    return {"k1": omega_rad_s**3, "k2": 3.0 * omega_rad_s**2, "k3": 3.0 * omega_rad_s}
