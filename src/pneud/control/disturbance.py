"""The finite-time disturbance observer (10): x̂3 and d̂ from x3 and the applied command.

Evaluated when a sample arrives, with the mean of the model's right-hand side over the interval since the
last one.
"""

import math
from typing import NamedTuple

EXPLICIT = 0  # forward Euler
IMPLICIT = 1  # backward Euler: exact zero of e3 in finitely many samples, no chatter
MATCHED = 2  # eigenvalues of the error system mapped by exp(s h): dead-beat near zero


class Observer(NamedTuple):
    """Gains of (10)."""

    lambda0: float
    lambda1: float
    L: float  # observer gain, at least sup |ḋ| [N/s²]
    form: int


class ObserverState(NamedTuple):
    """What the observer carries from sample to sample."""

    x_hat: float  # x̂3 [N]
    d_hat: float  # d̂ [N/s]
    e3: float  # x̂3 − x3 at the last sample [N]


def observe(state: ObserverState, x3: float, f_mean: float, h: float, p: Observer) -> ObserverState:
    """One sample of (10).

    Args:
        state: of the last sample.
        x3: measured now [N].
        f_mean: mean of F0 x2 + F1 u over the interval [N/s], u as applied.
        h: length of the interval [s].
        p: gains.
    """
    root = p.lambda0 * math.sqrt(p.L)
    if p.form == IMPLICIT:
        b = state.x_hat + h * (f_mean + state.d_hat) - x3
        c = h * h * p.lambda1 * p.L
        if abs(b) <= c:
            return ObserverState(x3, state.d_hat - b / h, 0.0)
        a = h * root
        rho = -0.5 * a + math.sqrt(0.25 * a * a + abs(b) - c)
        sign = 1.0 if b > 0.0 else -1.0  # that of a NaN would depend on the compiler
        e3 = sign * (rho * rho)
        return ObserverState(x3 + e3, state.d_hat - sign * (h * p.lambda1 * p.L), e3)
    e = state.e3
    size = abs(e)
    if p.form == MATCHED:
        trace, product = 0.0, 0.0  # of the discrete eigenvalues; 0 as |e| → 0
        if size > 0.0:
            # e and d̂ − d are linear with the poles s = p/√|e|, p² + λ0√L p + λ1 L = 0
            scale = h / math.sqrt(size)
            discriminant = 0.25 * root * root - p.lambda1 * p.L
            spread = math.sqrt(abs(discriminant)) * scale
            decay = -0.5 * root * scale
            product = math.exp(2.0 * decay)
            if discriminant < 0.0:
                trace = 2.0 * math.exp(decay) * math.cos(spread)
            else:
                trace = math.exp(decay + spread) + math.exp(decay - spread)
        x_hat = state.x_hat + h * (f_mean + state.d_hat) + (trace - 2.0) * e
        d_hat = state.d_hat + (trace - 1.0 - product) * e / h
    else:
        sign = math.copysign(1.0, e) if e != 0.0 else 0.0
        x_hat = state.x_hat + h * (f_mean + state.d_hat - root * math.sqrt(size) * sign)
        d_hat = state.d_hat - h * p.lambda1 * p.L * sign
    return ObserverState(x_hat, d_hat, x_hat - x3)
