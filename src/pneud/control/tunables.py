"""Gains that may be changed while the axis runs: their order, what they must keep, how the law takes them.

Never limits: what protects the axis is not for tuning.
"""

from __future__ import annotations

import math

from pneud.control.homogeneous import Feedback, feedback
from pneud.control.step import Controller

TUNABLE = ("law", "k1", "k2", "k3", "alpha", "eta_m_s3", "lambda0", "lambda1", "gain_n_s2")
LAWS = ("composite-implicit", "composite-explicit", "ismc-implicit", "ismc-explicit")  # by their code

MOST_H_OMEGA = 1.0  # twice the bandwidth gains a third of the error above it, more than half below it
ERROR_M = 1e-3  # position error at which the homogeneous feedback is linearised
LEAST_MARGIN = 0.5  # delay margin over delay; with less, all hangs on the prediction
MOST_H_K3 = 2.0  # the explicit form grows without bound from here on


def tunables(p: Controller) -> tuple[float, ...]:
    """The present values, in the order of TUNABLE."""
    g, observer = p.sliding.gains, p.observer
    code = 2 * (not p.sliding.compensate_d) + (not p.sliding.implicit)
    alpha = g.a3
    return (
        float(code),
        g.k1,
        g.k2,
        g.k3,
        alpha,
        p.sliding.eta,
        observer.lambda0,
        observer.lambda1,
        observer.L,
    )


def is_sound(values: tuple[float, ...]) -> bool:
    """Whether each value is one of its kind (in order, finite)."""
    law, k1, k2, k3, alpha, eta, lambda0, lambda1, gain = values
    return (
        law in range(len(LAWS))
        and min(k1, k2, k3, lambda0, lambda1, gain) > 0.0
        and 0.5 < alpha <= 1.0
        and eta >= 0.0
    )


def is_stable(values: tuple[float, ...], p: Controller) -> bool:
    """Whether the loop can have sound values: Lemma 2, and what sample rate and delay can carry.

    Hurwitz gains; an observer that follows a disturbance as fast as its gain says (λ1 > 1); h ω within
    MOST_H_OMEGA; a delay margin of LEAST_MARGIN of the delay; h k3 below MOST_H_K3 for an explicit form.
    """
    law, k1, k2, k3, alpha, _, _, lambda1, _ = values
    g = feedback(k1, k2, k3, alpha)
    delay_s = max(p.lead_s, p.delay_s) + 0.5 * p.h
    return (
        is_hurwitz(g)
        and lambda1 > 1.0
        and p.h * bandwidth(g, ERROR_M) <= MOST_H_OMEGA
        and delay_margin(g, ERROR_M) >= LEAST_MARGIN * delay_s
        and (law % 2.0 == 0.0 or p.h * k3 < MOST_H_K3)
    )


def tuned(values: tuple[float, ...], p: Controller) -> Controller:
    """The controller with stable values."""
    law, k1, k2, k3, alpha, eta, lambda0, lambda1, gain = values
    sliding = p.sliding._replace(
        gains=feedback(k1, k2, k3, alpha), eta=eta, implicit=law % 2.0 == 0.0, compensate_d=law < 2.0
    )
    observer = p.observer._replace(lambda0=lambda0, lambda1=lambda1, L=gain)
    return p._replace(sliding=sliding, observer=observer)


def is_hurwitz(g: Feedback) -> bool:
    """Lemma 2: k2 k3 > k1."""
    return g.k2 * g.k3 > g.k1


def bandwidth(g: Feedback, error_m: float) -> float:
    """ω [rad/s] of the linear loop with the same position gain at an error."""
    return float((g.k1 * error_m ** (g.a1 - 1.0)) ** (1.0 / 3.0))


def linearised(g: Feedback, error_m: float) -> tuple[float, float, float]:
    """Gains of a linear feedback with equal terms at errors A, ωA, ω²A [1/s³, 1/s², 1/s]."""
    w = bandwidth(g, error_m)
    return (
        w**3,
        g.k2 * (w * error_m) ** (g.a2 - 1.0),
        g.k3 * (w * w * error_m) ** (g.a3 - 1.0),
    )


def delay_margin(g: Feedback, error_m: float) -> float:
    """Dead time [s] at which the linearised loop (g3 s² + g2 s + g1)/s³ loses its phase margin.

    For a triple pole it is 0.407/ω. Zero where the loop is unstable without any.
    """
    g1, g2, g3 = linearised(g, error_m)
    if g2 * g3 <= g1:
        return 0.0
    low, high = 0.0, g1 + g2 + g3 + 1.0  # Cauchy's bound on the crossover
    for _ in range(200):
        x = 0.5 * (low + high)
        if math.hypot(g1 - g3 * x * x, g2 * x) > x**3:
            low = x
        else:
            high = x
    x = 0.5 * (low + high)
    return max(0.0, math.atan2(g2 * x, g1 - g3 * x * x) - 0.5 * math.pi) / x
