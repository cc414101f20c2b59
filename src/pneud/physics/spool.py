"""Exact motion of the valve's spool, a second-order lag, under a constant command."""

from __future__ import annotations

import math

from pneud.physics.valve import Valve

CRITICAL = 1e-6  # |1 − ζ²| below which the damping counts as critical


def spool(y: float, rate: float, u_v: float, t: float, valve: Valve) -> tuple[float, float]:
    """Position [V] and its rate [V/s] a time t [s] after (y, rate) with the command u_v held.

    Solves ÿ = ω²(u − y) − 2ζω ẏ in closed form for any damping; ω = 0 stands for a spool without lag.
    """
    w = valve.omega_rad_s
    if w == 0.0:
        return u_v, 0.0
    e = y - u_v
    damping = valve.zeta * w
    d = 1.0 - valve.zeta * valve.zeta
    if d > CRITICAL:
        wd = w * math.sqrt(d)
        c, s = math.cos(wd * t), math.sin(wd * t) / wd
    elif d < -CRITICAL:
        wd = w * math.sqrt(-d)
        c, s = math.cosh(wd * t), math.sinh(wd * t) / wd
    else:
        c, s = 1.0, t
    decay = math.exp(-damping * t)
    return (
        u_v + decay * (e * c + (rate + damping * e) * s),
        decay * (rate * c - (w * w * e + damping * rate) * s),
    )
