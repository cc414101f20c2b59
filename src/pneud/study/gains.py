"""Gains from physics, and what gains will do: rules and predictions that need no simulation.

The rules are engineering ones, stated where they are applied; the predictions are of the linearised loop
and of the pure chain (13), each with what it leaves out.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from pneud.config.conversions import (
    command_delay_s,
    cylinder_of,
    gains_of,
    hold_v,
    lead_s,
    valve_of,
)
from pneud.config.flow import gas_of
from pneud.config.models import Config
from pneud.config.plant import FrictionConfig
from pneud.config.toml import toml_text
from pneud.control.homogeneous import Feedback, feedback
from pneud.control.laws.slot import IN_SLOT
from pneud.control.tunables import MOST_H_OMEGA, bandwidth, delay_margin, is_hurwitz
from pneud.physics.cylinder import F0
from pneud.study.noise import horizon_s, mean_step_v

MISMATCH = 0.1  # assumed relative error of the model's F0 and F1: orifice, gas temperature, heat exchange
REACHING_MARGIN = 2.0
FILTER_PER_BANDWIDTH = 4.5  # motion filter over loop; less costs phase, more costs noise
CALM_FILTER_PER_BANDWIDTH = 3.0  # where noise would move the command by more than
CALM_V = 0.05  # a sample
PUSH_PER_FILTER = 1.9  # where pushes are answered faster
FORCE_RATE_PER_BANDWIDTH = 8.0
FASTEST_FILTER = 0.5  # ω h above which a sampled triple pole no longer filters
UNKNOWN_FRICTION = 0.3  # part of dry friction that its model may be wrong by
FILTERED_STEP = 2.0 * math.exp(-2.0)  # greatest error of a triple pole at ω after a step a of w2', in a/ω²
BEYOND_STEPS = 1.5  # encoder steps; half a step is blind, and two whole ones are no noise
LEAST_BEYOND_M = 1e-6
PROBE_FORCE_N = 1.0
LARGE_ERROR = 0.4  # of the stroke
MOST_RECOVERY_RATIO = 10.0  # 134/13 rad/s came back from 400 mm in simulation, 188/13 rad/s did not
MOST_CHATTER_V = 0.1
LEAST_NOISE_M_S2 = 1e-3  # taken where none is configured
SMALL_ERROR_M = 1e-5  # where homogeneous gains are steepest in service: delay is judged here, too


class Prediction(NamedTuple):
    """What gains will do."""

    bandwidth_rad_s: float  # of the linear loop with the same k1 at `error_m`
    error_m: float
    ahead_s: float  # horizon of the implicit form
    explicit_limit_cycle_m_s2: float  # amplitude in w3
    implicit_limit_cycle_m_s2: float  # of the chain: none
    acceleration_noise_m_s2: float  # standard deviation of x3/M, from the pressures
    static_error_m: float  # for PROBE_FORCE_N that F̂ does not know of
    reaching_s: float  # for a step of s by PROBE_FORCE_N/M
    reaching_v: float  # command that the reaching term takes at most
    delay_s: float  # from sample to effect, with half a sample of hold
    delay_margin_s: float  # at `error_m`
    delay_margin_small_s: float  # at SMALL_ERROR_M
    disturbance_rate_n_s2: float  # sup |ḋ| along the reference
    mean_step_v: float  # mean |Δu| that sensor noise makes
    recovery_ratio: float  # bandwidth at an error of 0.4 strokes, over what the valve's authority sets


def scaled_gains(omega_rad_s: float, error_m: float, alpha: float) -> Feedback:
    """Gains whose terms equal those of a linear triple pole at ω, taken at errors A, ωA and ω²A.

    k1 A^α1 = ω³ A, k2 (ωA)^α2 = 3ω² ωA and k3 (ω²A)^α3 = 3ω ω²A, therefore k1 = ω³ A^(1−α1),
    k2 = 3 ω^(3−α2) A^(1−α2), k3 = 3 ω^(3−2α3) A^(1−α3).

    Args:
        omega_rad_s: bandwidth ω.
        error_m: A, the position error at which homogeneous and linear feedback agree.
        alpha: α of (21).
    """
    w, a = omega_rad_s, error_m
    unit = feedback(1.0, 1.0, 1.0, alpha)
    return unit._replace(
        k1=w**3 * a ** (1.0 - unit.a1),
        k2=3.0 * w ** (3.0 - unit.a2) * a ** (1.0 - unit.a2),
        k3=3.0 * w ** (3.0 - 2.0 * unit.a3) * a ** (1.0 - unit.a3),
    )


def limit_cycle(g: Feedback, h: float) -> float:
    """Amplitude [m/s²] of w3 in the explicit form on the chain (13): (h k3/2)^(1/(1−α3)).

    With α3 = 1 there is none up to h k3 = 2, and beyond it no bound.
    """
    half = 0.5 * h * g.k3
    if g.a3 < 1.0:
        exponent = math.log(half) / (1.0 - g.a3)
        return math.exp(exponent) if exponent < 700.0 else math.inf
    return 0.0 if half < 1.0 else math.inf


def static_error(g: Feedback, force_n: float, mass_kg: float, ahead_s: float) -> float:
    """Position error [m] at rest under a force that nobody estimates.

    [(k3/k1)|F/M|^α3 + (k2/k1)|T F/M|^α2]^(1/α1), T the horizon of the implicit form, 0 for the explicit one.
    """
    a = abs(force_n) / mass_kg
    inner = (g.k3 * a**g.a3 + g.k2 * (ahead_s * a) ** g.a2) / g.k1
    return float(inner ** (1.0 / g.a1))


def disturbance_rate(c: Config) -> float:
    """Greatest |ḋ| [N/s²] along the reference, the model's terms being wrong by MISMATCH.

    d = ε (F0 v + F1 u), and u makes up for F0 v, M x_d''' and the change of friction. So |ḋ| is at most
    ε (|F0| a + M |x_d''''| + F_c (π/T)²), the last for friction that turns over by half a sine while the
    velocity crosses the Stribeck range ±v_s, T = 2 v_s/a. Terms in the rate of F0 itself are left out.
    """
    r = c.reference
    omega = 2.0 * math.pi * r.frequency_hz
    acceleration = r.amplitude_m * omega**2
    cylinder, gas = cylinder_of(c), gas_of(c)
    half = 0.5 * gas.supply_pa
    stiffness = abs(F0(0.5 * cylinder.L, half, half, cylinder, gas))
    turning_s = 0.0
    if acceleration > 0.0:
        turning_s = 2.0 * c.control.friction.stribeck_speed_m_s / acceleration
    friction = c.control.friction.coulomb_n * (math.pi / turning_s) ** 2 if turning_s > 0.0 else 0.0
    return MISMATCH * (stiffness * acceleration + cylinder.M * acceleration * omega**2 + friction)


def acceleration_noise(c: Config) -> float:
    """Standard deviation [m/s²] of x3/M, from noise and resolution of the pressures in [plant.sensors]."""
    s, k = c.plant.sensors, c.cylinder
    each_pa = math.sqrt(s.pressure_noise_pa**2 + s.pressure_step_pa**2 / 12.0)
    return each_pa * math.hypot(k.piston_area_1_m2, k.piston_area_2_m2) / k.moving_mass_kg


def error_scale_m(c: Config) -> float:
    """The error at which a bandwidth is stated where nobody says: a thousandth of the stroke [m].

    For the homogeneous law error and bandwidth are one parameter: all gains are those of ω A^((1−α)/(3−2α)).
    """
    return 1e-3 * c.cylinder.stroke_m


def designed(c: Config, omega_rad_s: float, error_m: float, alpha: float) -> Config:
    """The configuration with gains by rule, rounded to four digits; all else in [control] stays.

    η = 2 h sup|ḋ|/M: within its band the implicit observer lags by one sample. The observer's gain is
    sup|ḋ|, λ = (5.3, 1.1). Filter at 4.5 ω, or 3 ω where noise would move the command too much; rate of the
    force at 8 ω, neither faster than the sampling carries. Nothing is checked: see `warnings`.
    """
    h = 1.0 / c.loop.rate_hz
    g = scaled_gains(omega_rad_s, error_m, alpha)
    gain = max(disturbance_rate(c), 1.0)  # a reference at rest still has a model that drifts
    law = c.control
    observer = law.observer.model_copy(
        update={"discretisation": "implicit", "lambda0": 5.3, "lambda1": 1.1, "gain_n_s2": rounded(gain)}
    )
    own = {
        "k1": rounded(g.k1),
        "k2": rounded(g.k2),
        "k3": rounded(g.k3),
        "alpha": alpha,
        "eta_m_s3": rounded(REACHING_MARGIN * h * gain / c.cylinder.moving_mass_kg),
        "observer": observer,
    }
    quick = with_filters(c, omega_rad_s, own, g.k1)
    if mean_step_v(quick) <= CALM_V:
        return quick
    return with_filters(c, omega_rad_s, own, g.k1, CALM_FILTER_PER_BANDWIDTH)


def with_filters(
    c: Config, omega_rad_s: float, own: dict[str, Any], k1: float, ratio: float = FILTER_PER_BANDWIDTH
) -> Config:
    """The configuration with a law's own values, and what of [control] filters or is a threshold.

    Args:
        c: the configuration.
        omega_rad_s: bandwidth of the loop.
        own: values of the law.
        k1: jerk that the law asks for by position error, near a small one.
        ratio: motion filter over loop.
    """
    h, law = 1.0 / c.loop.rate_hz, c.control
    rate = min(FORCE_RATE_PER_BANDWIDTH * omega_rad_s, 1.0 / h) if law.estimate_force else 0.0
    slow = min(ratio * omega_rad_s, FASTEST_FILTER / h)
    step_m = c.plant.sensors.encoder_resolution_m or law.motion.encoder_resolution_m
    quick = law.motion.push_bandwidth_rad_s is not None
    motion = law.motion.model_copy(
        update={
            "bandwidth_rad_s": rounded(slow),
            "encoder_resolution_m": step_m,
            "push_bandwidth_rad_s": rounded(PUSH_PER_FILTER * slow) if quick else None,
            "push_beyond_m": rounded(push_beyond_m(c, step_m, slow)) if quick else law.motion.push_beyond_m,
            "encoder_noise_m": None,
            "force_walk_n_rs": None,
        }
    )
    update = {**own, "force_rate_bandwidth_rad_s": rounded(rate), "motion": motion}
    found = c.model_copy(update={"control": law.model_copy(update=update)})
    held = found.control.model_copy(update={"dead_zone_hold_v": rounded(worth_crossing_v(found, k1))})
    return found.model_copy(update={"control": held})


def push_beyond_m(c: Config, step_m: float, filter_rad_s: float) -> float:
    """Innovation beyond half a step that is a push: more than the encoder's steps and friction make.

    What friction's model misses of a reversal, 2 · 0.3 F_c, is an acceleration that the filter learns late.
    """
    missed = 2.0 * UNKNOWN_FRICTION * c.control.friction.coulomb_n / c.cylinder.moving_mass_kg
    return max(BEYOND_STEPS * step_m, FILTERED_STEP * missed / filter_rad_s**2, LEAST_BEYOND_M)


def worth_crossing_v(c: Config, k1: float) -> float:
    """Opening that is not worth a way across the dead zone: what the law asks for at half a step [V].

    Half the dead zone at most: of a larger opening the valve knows, wherever its edges are.
    """
    asking = c.control.model_copy(update={"k1": k1, "dead_zone_hold_v": 1.0})
    asked_v = hold_v(c.model_copy(update={"control": asking}), cylinder_of(c))
    return min(asked_v, 0.5 * c.valve.dead_zone_v)


def rounded(x: float) -> float:
    """To four significant digits, as printed."""
    return float(f"{x:.4g}")


def predict(c: Config, error_m: float = 1e-3) -> Prediction:
    """What the gains of a configuration will do.

    Args:
        c: the configuration; its [control] need not be one that pneud would accept.
        error_m: position error at which the homogeneous feedback is linearised.
    """
    g, h, mass = gains_of(c), 1.0 / c.loop.rate_hz, c.cylinder.moving_mass_kg
    implicit = c.control.discretisation == "implicit"
    ahead = horizon_s(c) if implicit else 0.0
    eta = c.control.eta_m_s3
    return Prediction(
        bandwidth_rad_s=bandwidth(g, error_m),
        error_m=error_m,
        ahead_s=ahead,
        explicit_limit_cycle_m_s2=limit_cycle(g, h),
        implicit_limit_cycle_m_s2=0.0,
        acceleration_noise_m_s2=acceleration_noise(c),
        static_error_m=static_error(g, PROBE_FORCE_N, mass, ahead),
        reaching_s=PROBE_FORCE_N / mass / eta if eta > 0.0 else math.inf,
        reaching_v=mass * eta / cylinder_of(c).F1_nominal,
        delay_s=lead_s(min(command_delay_s(c.bus), h), valve_of(c)) + 0.5 * h,
        delay_margin_s=delay_margin(g, error_m),
        delay_margin_small_s=delay_margin(g, SMALL_ERROR_M),
        disturbance_rate_n_s2=disturbance_rate(c),
        mean_step_v=mean_step_v(c),
        recovery_ratio=recovery_ratio(c),
    )


def recovery_ratio(c: Config) -> float:
    """How far the bandwidth at an error of 0.4 strokes exceeds (J/error)^(1/3), J the valve's greatest jerk.

    A triple integrator whose input saturates does not come back from any error; this ratio says how deep in
    saturation the law works.
    """
    error = LARGE_ERROR * c.cylinder.stroke_m
    cylinder = cylinder_of(c)
    jerk = cylinder.F1_nominal * c.valve.u_max_v / cylinder.M
    return float(bandwidth(gains_of(c), error) * (error / jerk) ** (1.0 / 3.0))


def warnings(c: Config, p: Prediction) -> list[str]:
    """What is wrong with the gains of a configuration, a line each.

    Args:
        c: the configuration.
        p: its prediction.
    """
    law, g, h = c.control, gains_of(c), 1.0 / c.loop.rate_hz
    omega = p.bandwidth_rad_s
    explicit = law.discretisation == "explicit"
    noise = max(p.acceleration_noise_m_s2, LEAST_NOISE_M_S2)
    found = []
    if not is_hurwitz(g):
        found.append(f"not Hurwitz: k2·k3 = {g.k2 * g.k3:.4g} must exceed k1 = {g.k1:.4g} (Lemma 2)")
    if explicit and p.explicit_limit_cycle_m_s2 > noise:
        found.append(
            f"explicit limit cycle of {p.explicit_limit_cycle_m_s2:.2g} m/s² in w3, above"
            f' the acceleration noise of {noise:.2g} m/s²; take discretisation = "implicit" or a higher rate'
        )
    if h * omega > MOST_H_OMEGA:
        found.append(
            f"{c.loop.rate_hz:g} Hz are few for {omega:.0f} rad/s (h ω = {h * omega:.2g},"
            f" above {MOST_H_OMEGA:g} little is gained); take a higher rate"
        )
    if not law.predict and p.delay_margin_small_s < p.delay_s:
        found.append(
            f"delay of {1e3 * p.delay_s:.2f} ms against a margin of {1e3 * p.delay_margin_small_s:.2f} ms at"
            f" {1e6 * SMALL_ERROR_M:g} µm: oscillates; take predict = true, or less bandwidth"
        )
    if law.predict and p.delay_margin_s < 0.5 * p.delay_s:
        found.append(
            f"delay of {1e3 * p.delay_s:.2f} ms is more than twice the margin of"
            f" {1e3 * p.delay_margin_s:.2f} ms: all hangs on the prediction; take less bandwidth"
        )
    if p.reaching_v > 0.5 * c.valve.u_max_v:
        found.append(f"η = {law.eta_m_s3:g} m/s³ alone takes {p.reaching_v:.2g} V of {c.valve.u_max_v:g} V")
    if p.recovery_ratio > MOST_RECOVERY_RATIO:
        found.append(
            f"may not come back from {1e3 * LARGE_ERROR * c.cylinder.stroke_m:.0f} mm: recovery ratio"
            f" {p.recovery_ratio:.1f}, above {MOST_RECOVERY_RATIO:g}; take less bandwidth or a smaller alpha"
        )
    if math.isinf(p.mean_step_v):
        found.append("unstable where it is linearised at the size of its noise; take less bandwidth")
    elif p.mean_step_v > MOST_CHATTER_V:
        found.append(f"noise moves the command by {p.mean_step_v:.2g} V a sample, above {MOST_CHATTER_V:g} V")
    if not law.estimate_force:
        found.append(
            f"forces are not estimated: {PROBE_FORCE_N:g} N costs {1e3 * p.static_error_m:.2g} mm at rest"
        )
    return found


def table_of(c: Config) -> dict[str, Any]:
    """[control] of a configuration, without the tables of laws that are neither chosen nor given."""
    table = c.control.model_dump(exclude_none=True)
    for law in IN_SLOT:
        own = getattr(c.control, law.name)
        if law.name != c.control.law and own == type(own)():
            del table[law.name]
    return table


def toml(c: Config) -> str:
    """The [control] tables of a configuration, ready to paste."""
    control = table_of(c)
    if c.control.friction == FrictionConfig():
        control.pop("friction", None)
    return toml_text({"control": control}).lstrip()
