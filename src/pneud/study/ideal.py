"""The paper's own simulation: law and observer on exact states, a zero-order hold, and the ideal plant.

No filter, no quantisation, no frames and no delay stand between plant and law. Also the chain of integrators
(13), on which the law's mathematics shows without any plant. Pure functions on numbers, compiled or not.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from pneud.control.disturbance import EXPLICIT, Observer, ObserverState
from pneud.control.disturbance import observe as observe_disturbance
from pneud.control.homogeneous import Feedback, explicit_ustar, implicit_ustar
from pneud.control.laws.sliding import Sliding, engage, law
from pneud.control.reference import Sine, sine
from pneud.physics.cylinder import F0, F1_FLOOR, Cylinder, F1_exhaust, F1_fill, x3_of
from pneud.physics.gas import Gas, signed_flow
from pneud.physics.plant import PlantParameters
from pneud.rig.dynamics import PlantState, advance, disturbances

# columns of a trace, one row a sample
W1, W2, W3, X1, V, U, P1, P2, E3, ED, S, WORST, SQUARE = range(13)
COLUMNS = 13


class IdealLoop(NamedTuple):
    """One closed loop."""

    plant: PlantParameters
    sliding: Sliding
    observer: Observer
    h: float  # sample time [s]
    reference: Sine  # of the effective displacement x1
    reverse_model: bool  # the law's F1 knows flow from a chamber back into the supply


def f1_pair(x1: float, p1_pa: float, p2_pa: float, reverse: bool, c: Cylinder, g: Gas) -> tuple[float, float]:
    """F1 of (8) for u ≥ 0 and for u < 0 [N/(s V)], floored.

    Args:
        x1: effective displacement [m].
        p1_pa: absolute pressure of chamber 1.
        p2_pa: absolute pressure of chamber 2.
        reverse: True: signed flow. False: an orifice through which nothing flows backwards.
        c: the cylinder.
        g: the gas.
    """
    if reverse:
        return F1_fill(x1, p1_pa, p2_pa, g.supply_pa, c, g), F1_exhaust(x1, p1_pa, p2_pa, g.supply_pa, c, g)
    rest = c.L - x1
    fill = (
        max(signed_flow(g.supply_pa, p1_pa, g), 0.0) / x1
        + max(signed_flow(p2_pa, g.atmosphere_pa, g), 0.0) / rest
    )
    exhaust = (
        max(signed_flow(p1_pa, g.atmosphere_pa, g), 0.0) / x1
        + max(signed_flow(g.supply_pa, p2_pa, g), 0.0) / rest
    )
    floor = F1_FLOOR * c.F1_nominal
    return max(c.c1 * fill, floor), max(c.c1 * exhaust, floor)


def run_ideal(begin: PlantState, loop: IdealLoop, force_ext_n: float, trace: Any) -> PlantState:
    """Track the reference for as many samples as `trace` has rows; x̂3(0) = x3(0), d̂(0) = 0, s(0) = 0.

    The explicit observer takes the model's right-hand side at the last sample, as forward Euler has it; the
    others its mean over the interval.

    Args:
        begin: state of the plant at t = 0.
        loop: the loop.
        force_ext_n: constant force on the load against positive motion [N].
        trace: array (n, COLUMNS), filled: errors w1, w2, w3 of (9) [m, m/s, m/s²], x1 [m], velocity [m/s],
            command [V], P1, P2 [Pa], e3 [N], e_d [N/s], s [m/s²], all at the sample; then the greatest |w1|
            [m] and the mean of w1² [m²] over the plant's steps in the interval that follows.

    Returns:
        The plant's state at the end.
    """
    plant, h = loop.plant, loop.h
    c, g, u_max = plant.cylinder, plant.gas, plant.valve.u_max_v
    steps = max(1, math.ceil(h / plant.step_s - 1e-6))
    dt = h / steps
    rig = begin
    x3 = x3_of(rig.p1, rig.p2, c)
    observer = ObserverState(x3, 0.0, 0.0)
    drift, fill, exhaust, u = 0.0, 0.0, 0.0, 0.0
    r = sine(0.0, loop.reference)
    state = engage(r.acceleration_m_s2 - x3 / c.M)
    for k in range(trace.shape[0]):
        t = k * h
        x3 = x3_of(rig.p1, rig.p2, c)
        f_before = drift + (fill if u >= 0.0 else exhaust) * u
        drift = F0(rig.x1, rig.p1, rig.p2, c, g) * rig.v
        fill, exhaust = f1_pair(rig.x1, rig.p1, rig.p2, loop.reverse_model, c, g)
        if k > 0:
            f_now = drift + (fill if u >= 0.0 else exhaust) * u
            f = f_before if loop.observer.form == EXPLICIT else 0.5 * (f_before + f_now)
            observer = observe_disturbance(observer, x3, f, h, loop.observer)
        r = sine(t, loop.reference)
        w1 = r.position_m - rig.x1
        w2 = r.velocity_m_s - rig.v
        w3 = r.acceleration_m_s2 - x3 / c.M
        state, out = law(
            state,
            w1,
            w2,
            w3,
            r.jerk_m_s3,
            drift,
            observer.d_hat,
            0.0,
            fill,
            exhaust,
            h,
            loop.sliding,
            plant.valve,
        )
        u = max(-u_max, min(u_max, out.u_v))
        d1, d2 = disturbances(t, plant)
        trace[k, W1] = w1
        trace[k, W2] = w2
        trace[k, W3] = w3
        trace[k, X1] = rig.x1
        trace[k, V] = rig.v
        trace[k, U] = u
        trace[k, P1] = rig.p1
        trace[k, P2] = rig.p2
        trace[k, E3] = observer.e3
        trace[k, ED] = observer.d_hat - (c.A1 * d1 - c.A2 * d2)
        trace[k, S] = out.s
        worst, square = abs(w1), 0.0
        for i in range(steps):
            rig = advance(rig, u, force_ext_n, t + i * dt, t + (i + 1) * dt, plant)
            e = sine(t + (i + 1) * dt, loop.reference).position_m - rig.x1
            worst = max(worst, abs(e))
            square += e * e
        trace[k, WORST] = worst
        trace[k, SQUARE] = square / steps
    return rig


def run_chain(w1: float, w2: float, w3: float, h: float, gains: Feedback, implicit: bool, trace: Any) -> None:
    """The chain of integrators (13) under sampled and held u*, integrated exactly.

    Args:
        w1: first state at the start.
        w2: its derivative.
        w3: its second derivative.
        h: sample time [s].
        gains: of u*.
        implicit: which form of u*.
        trace: array (n, 3), filled with the states at the samples.
    """
    for k in range(trace.shape[0]):
        trace[k, 0] = w1
        trace[k, 1] = w2
        trace[k, 2] = w3
        ustar = implicit_ustar(w1, w2, w3, h, gains) if implicit else explicit_ustar(w1, w2, w3, gains)
        w1 += h * (w2 + h * (0.5 * w3 + h * ustar / 6.0))
        w2 += h * (w3 + 0.5 * h * ustar)
        w3 += h * ustar
