"""The controller of one tick in two pure functions: what is so (`observe`), and what to do about it (`act`).

State goes in and comes out; nothing is kept. The same functions run in the loop, in simulation, in replay and
compiled by numba.
"""

from __future__ import annotations

from typing import NamedTuple

from pneud.control.disturbance import Observer, ObserverState
from pneud.control.disturbance import observe as observe_disturbance
from pneud.control.motion import MotionFilter, MotionState, at_rest, correct, predict
from pneud.control.sliding import Sliding, SlidingOutput, SlidingState, engage, law
from pneud.physics.cylinder import F0, Cylinder, F1_exhaust, F1_fill, x3_of
from pneud.physics.gas import Gas
from pneud.physics.valve import SpoolTransition, Valve, opening, spool_transition
from pneud.signals import Estimate, Reference

X1_MARGIN = 1e-3  # least chamber length the model is evaluated at [m]


class Controller(NamedTuple):
    """All parameters of the controller."""

    h: float  # nominal sample time [s]
    delay_s: float  # from the sampling instant until the command of that sample acts
    spool_before: SpoolTransition  # of the valve's spool over delay_s
    gas: Gas
    cylinder: Cylinder
    valve: Valve
    motion: MotionFilter
    observer: Observer
    sliding: Sliding
    use_force: bool  # F̂ in w3
    use_force_rate: bool  # its rate in Z


class ControllerState(NamedTuple):
    """All state of the controller."""

    motion: MotionState
    observer: ObserverState
    sliding: SlidingState
    spool_v: float
    spool_rate_v_s: float
    applied_v: float  # command that acted when the last sample was taken
    drift: float  # F0 x2 at the last sample [N/s]
    f1_fill: float  # F1 at the last sample [N/(s V)]
    f1_exhaust: float
    force_rate: float  # rate of F̂ [N/s]


def start(position_m: float, p1_pa: float, p2_pa: float, supply_pa: float, p: Controller) -> ControllerState:
    """State of a load at rest with the valve centred."""
    x1 = chamber_length(position_m, p.cylinder)
    x3 = x3_of(p1_pa, p2_pa, p.cylinder)
    return ControllerState(
        motion=at_rest(position_m, x3, p.cylinder.rod_force_n),
        observer=ObserverState(x3, 0.0, 0.0),
        sliding=SlidingState(0.0),
        spool_v=0.0,
        spool_rate_v_s=0.0,
        applied_v=0.0,
        drift=0.0,
        f1_fill=F1_fill(x1, p1_pa, p2_pa, supply_pa, p.cylinder, p.gas),
        f1_exhaust=F1_exhaust(x1, p1_pa, p2_pa, supply_pa, p.cylinder, p.gas),
        force_rate=0.0,
    )


def chamber_length(position_m: float, c: Cylinder) -> float:
    """Effective displacement x1 [m] of a stroke position, kept where the model has no singularity."""
    return max(X1_MARGIN, min(c.L - X1_MARGIN, position_m + c.x_e1))


def observe(
    state: ControllerState,
    position_m: float,
    measured: bool,
    p1_pa: float,
    p2_pa: float,
    supply_pa: float,
    applied_v: float,
    dt: float,
    p: Controller,
) -> tuple[ControllerState, Estimate]:
    """Take one sample in.

    Args:
        state: after the last sample.
        position_m: encoder, stroke coordinate.
        measured: False where this tick has no encoder reading; the filter then only predicts.
        p1_pa: pressure of chamber 1, absolute.
        p2_pa: pressure of chamber 2, absolute.
        supply_pa: supply pressure, absolute.
        applied_v: command acting when this sample was taken.
        dt: time since the last sample [s].
        p: parameters.

    Returns:
        The state after this sample, and what is believed.
    """
    c = p.cylinder
    x3 = x3_of(p1_pa, p2_pa, c)
    motion = predict(state.motion, x3, c.rod_force_n, c.M, dt)
    if measured:
        motion = correct(motion, position_m, c.M, dt, p.motion)
    x1 = chamber_length(motion.x, c)
    drift = F0(x1, p1_pa, p2_pa, c, p.gas) * motion.v
    f1_fill = F1_fill(x1, p1_pa, p2_pa, supply_pa, c, p.gas)
    f1_exhaust = F1_exhaust(x1, p1_pa, p2_pa, supply_pa, c, p.gas)

    # the command before the last one acts for delay_s, then the last one
    before = min(p.delay_s, dt)
    after = dt - before
    y0 = state.spool_v
    y1, rate = _spool(y0, state.spool_rate_v_s, state.applied_v, p.spool_before)
    y2, rate = _spool(y1, rate, applied_v, spool_transition(after, p.valve))
    u1, u2 = opening(y1, p.valve), opening(y2, p.valve)
    if p.valve.omega_rad_s == 0.0:
        u_mean = (before * u1 + after * u2) / dt  # without lag it jumps at the start of each part
    else:
        u_mean = 0.5 * (before * (opening(y0, p.valve) + u1) + after * (u1 + u2)) / dt

    f1_sum = state.f1_fill + f1_fill if u_mean >= 0.0 else state.f1_exhaust + f1_exhaust
    f_mean = 0.5 * (state.drift + drift + f1_sum * u_mean)
    observer = observe_disturbance(state.observer, x3, f_mean, dt, p.observer)
    force_rate = (motion.F - state.motion.F) / dt
    return (
        ControllerState(
            motion, observer, state.sliding, y2, rate, applied_v, drift, f1_fill, f1_exhaust, force_rate
        ),
        Estimate(motion.x, motion.v, motion.F, x3, observer.x_hat, observer.d_hat, motion.innovation, u_mean),
    )


def errors(e: Estimate, r: Reference, p: Controller) -> tuple[float, float, float]:
    """w1, w2, w3 of (9), w3 with the rod-side and the unmatched force [m, m/s, m/s²]."""
    force = e.x3_n - p.cylinder.rod_force_n - (e.force_n if p.use_force else 0.0)
    return (
        r.position_m - e.position_m,
        r.velocity_m_s - e.velocity_m_s,
        r.acceleration_m_s2 - force / p.cylinder.M,
    )


def join(state: ControllerState, e: Estimate, r: Reference, p: Controller) -> ControllerState:
    """The state with s(0) = 0 for a law that takes over now."""
    return _with_sliding(state, engage(errors(e, r, p)[2]))


def act(
    state: ControllerState, e: Estimate, r: Reference, p: Controller
) -> tuple[ControllerState, SlidingOutput]:
    """The law's command for an estimate and a reference of the same instant."""
    w1, w2, w3 = errors(e, r, p)
    sliding, out = law(
        state.sliding,
        w1,
        w2,
        w3,
        r.jerk_m_s3,
        state.drift,
        e.d_hat_n_s,
        state.force_rate if p.use_force_rate else 0.0,
        state.f1_fill,
        state.f1_exhaust,
        p.h,
        p.sliding,
        p.valve,
    )
    return _with_sliding(state, sliding), out


def _spool(y: float, rate: float, u: float, t: SpoolTransition) -> tuple[float, float]:
    e = y - u
    return u + t.ee * e + t.er * rate, t.re * e + t.rr * rate


def _with_sliding(s: ControllerState, sliding: SlidingState) -> ControllerState:
    # written out, since numba knows no _replace
    return ControllerState(
        s.motion,
        s.observer,
        sliding,
        s.spool_v,
        s.spool_rate_v_s,
        s.applied_v,
        s.drift,
        s.f1_fill,
        s.f1_exhaust,
        s.force_rate,
    )
