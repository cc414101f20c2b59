"""What the law is compared with: PID with feed-forward, and active disturbance rejection control (ADRC).

Both take what the law takes: the estimates, the reference, the prediction to the instant at which the command
has its effect, the gains F0 and F1, the friction fed forward and the inverse of the dead zone. Only the
feedback differs.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from pneud.control.motion import MotionFilter, beyond
from pneud.control.prediction import Motion, Rates, ahead
from pneud.control.step import Controller, ControllerState, act, carried, errors, outlook
from pneud.physics.friction import friction_force
from pneud.physics.valve import dead_zone_inverse
from pneud.signals import Estimate, Reference

SLIDING, PID, ADRC = 0, 1, 2


class Pid(NamedTuple):
    """Position loop around a force loop, with velocity, acceleration, jerk and friction fed forward."""

    kp: float  # [1/s²]
    ki: float  # [1/s³]
    kd: float  # [1/s]
    kf: float  # of the force loop [1/s]
    quiet_m: float  # the integral rests within this error
    force_max_n: float  # greatest integral


class Adrc(NamedTuple):
    """Linear ADRC: an extended-state observer and feedback of its states."""

    k1: float  # [1/s³]
    k2: float  # [1/s²]
    k3: float  # [1/s]
    pressures: bool  # True: the [x, v, F] filter is the observer, of third order; False: one of fourth order
    g1: float  # gains of the latter, without dimension, from `quadruple_pole`
    g2: float
    g3: float
    g4: float


class Law(NamedTuple):
    """Which law runs, and its gains; those of the sliding law are in `Controller`."""

    kind: int  # SLIDING, PID, ADRC
    reach_m: float  # position error that feedback takes at most, so that large errors are driven home evenly
    pid: Pid
    adrc: Adrc


class LawState(NamedTuple):
    """What the baselines carry from tick to tick."""

    integral_n: float  # of PID
    x: float  # of the observer of fourth order [m]
    v: float  # [m/s]
    a: float  # [m/s²]
    f: float  # total disturbance [m/s³]


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


def begin(e: Estimate) -> LawState:
    """The state of a law that takes over from rest."""
    return LawState(0.0, e.position_m, e.velocity_m_s, 0.0, 0.0)


def reading(e: Estimate, p: MotionFilter) -> float:
    """The encoder's reading [m] that the estimate has been corrected with."""
    r, more = beyond(e.innovation_m, p)
    return e.position_m - (p.alpha * r + p.more_alpha * more) + e.innovation_m


def command(Z: float, state: ControllerState, p: Controller) -> tuple[float, bool]:
    """Command [V] for a wanted rate Z = F1 u of the force [N/s], and whether the valve can give it."""
    wanted = Z / (state.f1_fill if Z >= 0.0 else state.f1_exhaust)
    valve = p.valve
    if p.sliding.invert_dead_zone:
        if abs(wanted) <= p.sliding.hold_v:
            return max(-valve.dead_zone_v, min(valve.dead_zone_v, state.applied_v)), True
        u = dead_zone_inverse(wanted, valve, 0.0)
    else:
        u = wanted
    return u, abs(wanted) <= valve.u_max_v


def act_any(
    state: ControllerState, own: LawState, e: Estimate, r: Reference, p: Controller, law: Law
) -> tuple[ControllerState, LawState, float]:
    """The command [V] of whichever law, for an estimate and a reference of the same instant."""
    if law.kind == PID:
        return act_pid(state, own, e, r, p, law)
    if law.kind == ADRC:
        return act_adrc(state, own, e, r, p, law)
    state, out = act(state, e, r, p)
    return state, own, out.u_v


def act_pid(
    state: ControllerState, own: LawState, e: Estimate, r: Reference, p: Controller, law: Law
) -> tuple[ControllerState, LawState, float]:
    """PID for the force that the load needs, and a force loop through the model's F0 and F1.

    The integral stands still while it would drive a saturated valve further.
    """
    g, M = law.pid, p.cylinder.M
    friction, motion, goal = outlook(state, e, r, p)
    w1, w2, _ = errors(motion, goal, M)
    w1 = max(-law.reach_m, min(law.reach_m, w1))
    rubbing = friction_force(r.velocity_m_s, state.bristles_m, p.friction) + friction.ahead_n
    need = M * (goal.acceleration_m_s2 + g.kp * w1 + g.kd * w2) + rubbing + own.integral_n
    has = motion.force_n + (e.force_n if p.use_force else 0.0)
    Z = M * goal.jerk_m_s3 + friction.rate_n_s + g.kf * (need - has) - state.f0 * motion.v
    u, possible = command(Z, state, p)
    integral = own.integral_n
    if abs(w1) > g.quiet_m and (possible or Z * w1 < 0.0):
        integral += p.h * M * g.ki * w1
    integral = max(-g.force_max_n, min(g.force_max_n, integral))
    new = LawState(integral, own.x, own.v, own.a, own.f)
    return carried(state, state.sliding, friction.bristles_m, friction.step_n, state.blend), new, u


def act_adrc(
    state: ControllerState, own: LawState, e: Estimate, r: Reference, p: Controller, law: Law
) -> tuple[ControllerState, LawState, float]:
    """Linear ADRC: M x''' = F0 x' + F1 u + M f with f estimated, or with x'' known by the pressures."""
    g, M = law.adrc, p.cylinder.M
    friction, motion, goal = outlook(state, e, r, p)
    known = friction.rate_n_s + state.force_rate
    if not g.pressures:
        own = extend(own, state, e, p, g)
        known = friction.rate_n_s - M * own.f
        motion = Motion(own.x, own.v, M * own.a)
        if p.lead_s > 0.0:
            rest = M * own.f - friction.ahead_n / p.lead_s
            rates = Rates(state.f0, state.f1_fill, state.f1_exhaust, rest)
            motion = ahead(
                motion, state.spool, state.applied_v, 0.5 * p.lead_s, p.spool_ahead, M, rates, p.valve
            )
    w1, w2, w3 = errors(motion, goal, M)
    w1 = max(-law.reach_m, min(law.reach_m, w1))
    feedback = g.k1 * w1 + g.k2 * w2 + g.k3 * w3
    u, _ = command(M * (goal.jerk_m_s3 + feedback) + known - state.f0 * motion.v, state, p)
    own = LawState(own.integral_n, own.x, own.v, own.a - friction.step_n / M, own.f)
    return carried(state, state.sliding, friction.bristles_m, friction.step_n, state.blend), own, u


def extend(own: LawState, state: ControllerState, e: Estimate, p: Controller, g: Adrc) -> LawState:
    """One sample of the observer of fourth order: encoder and opening, no pressure."""
    h, u = p.h, e.opening_v
    f1 = state.f1_fill if u >= 0.0 else state.f1_exhaust
    jerk = own.f + (state.f0 * own.v + f1 * u) / p.cylinder.M
    x = own.x + h * (own.v + h * (0.5 * own.a + h * jerk / 6.0))
    v = own.v + h * (own.a + 0.5 * h * jerk)
    a = own.a + h * jerk
    r = reading(e, p.motion) - x
    r -= max(-p.motion.blind_m, min(p.motion.blind_m, r))
    return LawState(
        own.integral_n,
        x + g.g1 * r,
        v + g.g2 * r / h,
        a + g.g3 * r / (h * h),
        own.f + g.g4 * r / (h * h * h),
    )
