"""What sensor noise does to the command: impulse responses of the loop, linearised at the noise's size."""

from __future__ import annotations

import math
from typing import NamedTuple

from pneud.config.conversions import (
    command_delay_s,
    cylinder_of,
    gains_of,
    lead_s,
    motion_of,
    valve_of,
)
from pneud.config.flow import gas_of
from pneud.config.models import Config
from pneud.control.motion import MotionState, correct, predict
from pneud.control.prediction import Motion, Rates, Spool, ahead, follow
from pneud.physics.cylinder import F0
from pneud.physics.valve import spool_transition

RESPONSE_S = 0.5  # length of the impulse responses
PASSES = 4  # gains follow from the noise and the noise from the gains
BLIND_PASSES = 0.32  # part of the encoder's noise that a blind band of half a step lets through: simulated
UNSTABLE_V = 1e3  # a response beyond this grows without end


class Slopes(NamedTuple):
    """Gains that stand for the law's powers, its clip and the observer's root."""

    n1: float
    n2: float
    n3: float
    reaching: float
    kept: float  # part of the innovation that stays in x̂3
    learnt: float  # part of it that goes into d̂, per second


def mean_step_v(c: Config) -> float:
    """Expected mean |Δu| [V] from the encoder's resolution and the pressures' noise; infinite if unstable.

    White noise drives the law's filter, observer, predictor and feedback and a frictionless load at
    mid-stroke, chambers at half the supply pressure. Powers, clip and root are replaced by the gains that
    pass Gaussian noise of the same size (statistical linearisation). The motion filter's blind band
    is a factor found by simulation. Left out: what the reference and friction ask for, the dead zone and its
    hold, the resolution of the command.
    """
    s, k = c.plant.sensors, c.cylinder
    blind_m = c.control.motion.encoder_resolution_m
    resolution_m = (s.encoder_resolution_m or blind_m) * (BLIND_PASSES if blind_m > 0.0 else 1.0)
    each_pa = math.sqrt(s.pressure_noise_pa**2 + s.pressure_step_pa**2 / 12.0)
    noises = (
        resolution_m / math.sqrt(12.0),
        each_pa * math.hypot(k.piston_area_1_m2, k.piston_area_2_m2),
    )
    sizes = [1e-6, 1e-4, 1e-2, 1e-2]  # of w1, w2, w3, s
    step = 0.0
    for _ in range(PASSES):
        slopes = slopes_at(c, sizes, noises[1])
        sums = [0.0] * 5
        for channel, noise in enumerate(noises):
            for i, power in enumerate(responses(c, slopes, channel)):
                sums[i] += noise * noise * power
        if not sums[4] < UNSTABLE_V**2:
            return math.inf
        sizes = [math.sqrt(max(x, 1e-24)) for x in sums[:4]]
        step = math.sqrt(2.0 / math.pi * sums[4])
    return step * (c.valve.u_max_v - c.valve.dead_zone_v) / c.valve.u_max_v


def passed(k: float, a: float, size: float) -> float:
    """Gain of k sig^a for Gaussian noise of a standard deviation: E[w k sig^a(w)]/E[w²]."""
    moment: float = 2.0 ** (0.5 * (a + 1.0)) * math.gamma(0.5 * a + 1.0) / math.sqrt(math.pi)
    return float(k * size ** (a - 1.0) * moment)


def slopes_at(c: Config, sizes: list[float], x3_noise_n: float) -> Slopes:
    """The gains for noise of these standard deviations in w1, w2, w3, s and x3."""
    law, h = c.control, 1.0 / c.loop.rate_hz
    g = gains_of(c)
    n1, n2, n3 = passed(g.k1, g.a1, sizes[0]), passed(g.k2, g.a2, sizes[1]), passed(g.k3, g.a3, sizes[2])
    T = horizon_s(c)
    reaching = math.erf(law.eta_m_s3 * T / (math.sqrt(2.0) * sizes[3])) / T
    if law.discretisation == "implicit":
        whole = 1.0 + T * (n3 + T * (n2 + T * n1))
        n1, n2, n3 = n1 / whole, (n2 + T * n1) / whole, (n3 + T * (n2 + T * n1)) / whole
    o = law.observer
    b = math.sqrt(2.0) * x3_noise_n
    in_band = h * h * o.lambda1 * o.gain_n_s2
    if b <= in_band:
        return Slopes(n1, n2, n3, reaching, 0.0, 1.0 / h)
    half = 0.5 * h * o.lambda0 * math.sqrt(o.gain_n_s2)
    root = math.sqrt(half * half + b - in_band) - half
    return Slopes(n1, n2, n3, reaching, root * root / b, in_band / (h * b))


def horizon_s(c: Config) -> float:
    """How far the implicit forms look ahead [s]."""
    h = 1.0 / c.loop.rate_hz
    return max(h, lead_s(min(command_delay_s(c.bus), h), valve_of(c))) if c.control.predict else h


def responses(c: Config, g: Slopes, channel: int) -> tuple[float, float, float, float, float]:
    """Sums of squares of w1, w2, w3, s and Δu after one sample of a sensor was wrong by one unit.

    Args:
        c: the configuration.
        g: the law's gains.
        channel: 0 the encoder [m], 1 x3 [N].
    """
    law, h = c.control, 1.0 / c.loop.rate_hz
    cylinder, gas = cylinder_of(c), gas_of(c)
    M, f1 = cylinder.M, cylinder.F1_nominal
    half_pa = 0.5 * gas.supply_pa
    f0 = F0(0.5 * cylinder.L, half_pa, half_pa, cylinder, gas)
    valve = valve_of(c)._replace(u_max_v=1e12, dead_zone_v=0.0)
    delay = min(command_delay_s(c.bus), h)
    lead = lead_s(delay, valve) if law.predict else 0.0
    before, after = spool_transition(delay, valve), spool_transition(h - delay, valve)
    over_half = spool_transition(0.5 * lead, valve)
    # noise stays within what is answered slowly
    p = motion_of(c)._replace(blind_m=0.0, more_alpha=0.0, more_beta=0.0, more_gamma=0.0)
    smoothing = 1.0 - math.exp(-law.force_rate_bandwidth_rad_s * h)
    composite = 1.0 if law.law == "composite" else 0.0

    spool, truth = Spool(0.0, 0.0), Motion(0.0, 0.0, 0.0)
    motion = MotionState(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    x_hat = d_hat = rate = integral = u = pushed_n = 0.0
    sums = [0.0] * 5
    for k in range(round(RESPONSE_S / h)):
        wrong = 1.0 if k == 0 else 0.0
        x3 = truth.force_n + (wrong if channel == 1 else 0.0)
        found = motion.F
        motion = predict(motion, x3, 0.0, 0.0, M, h)
        motion = correct(motion, truth.x + (wrong if channel == 0 else 0.0), M, h, p)
        rate += smoothing * ((motion.F - found) / h - rate)
        b = x_hat + pushed_n + h * d_hat - x3
        d_hat, x_hat = d_hat - g.learnt * b, x3 + g.kept * b
        force = (x_hat if law.smooth_x3 else x3) - (motion.F if law.estimate_force else 0.0)
        m = Motion(motion.x, motion.v, force)
        if lead > 0.0:
            rates = Rates(f0, f1, f1, composite * d_hat - rate)
            m = ahead(m, spool, u, 0.5 * lead, over_half, M, rates, valve)
        w1, w2, w3 = -m.x, -m.v, -m.force_n / M
        s = w3 - integral
        ustar = -(g.n1 * w1 + g.n2 * w2 + g.n3 * w3)
        last = u
        u = (-f0 * m.v - composite * d_hat + rate + M * (g.reaching * s - ustar)) / f1
        integral += h * ustar
        for i, value in enumerate((w1, w2, w3, s, u - last)):
            sums[i] += value * value
        if abs(u) > UNSTABLE_V * 1e6:
            return (math.inf,) * 5
        # the load: the last command until this one acts, then this one
        middle = follow(spool, last, before)
        end = follow(middle, u, after)
        if valve.omega_rad_s > 0.0:
            mean = 0.5 * (
                delay / h * (spool.position_v + middle.position_v)
                + (1.0 - delay / h) * (middle.position_v + end.position_v)
            )
        else:
            mean = (delay * last + (h - delay) * u) / h
        spool = end
        pushed_n = h * (f0 * truth.v + f1 * mean)
        truth = Motion(
            truth.x + h * (truth.v + h * (truth.force_n / 2.0 + pushed_n / 6.0) / M),
            truth.v + h * (truth.force_n + 0.5 * pushed_n) / M,
            truth.force_n + pushed_n,
        )
    return sums[0], sums[1], sums[2], sums[3], sums[4]
