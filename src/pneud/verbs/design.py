"""Gains for a bandwidth, and what they will do."""

from __future__ import annotations

import json as json_
import math
import sys
from typing import NamedTuple

from pneud.config.conversions import axis_of, gains_of, plant_of
from pneud.config.models import Config, ConfigError
from pneud.control.tunables import LAWS as EVERY_LAW
from pneud.control.tunables import in_slot, is_hurwitz
from pneud.loading import load
from pneud.study import gains as rules
from pneud.study import linear
from pneud.study.jit import JitError
from pneud.study.push import Service, service

LAWS = (*dict.fromkeys(law.partition("-")[0] for law in EVERY_LAW),)


class DesignOptions(NamedTuple):
    """What the command line asks for."""

    config: str
    bandwidth_rad_s: float
    error_mm: float
    alpha: float | None
    rate_hz: float | None
    simulate: bool
    json: bool
    law: str | None = None


def design(o: DesignOptions) -> int:
    """Design gains and print them as TOML, with predictions and warnings.

    Returns:
        Exit status: 0 where pneud accepts the gains and, if simulated, they come back from a large error; 1
        where not; 3 where a simulation is asked for without numba.

    Raises:
        ConfigError: the configuration or an option cannot be used.
        DatabaseError: the DBC cannot be used.
    """
    loaded = load(o.config, o.rate_hz)
    alpha = loaded.config.control.alpha if o.alpha is None else o.alpha
    _within("--bandwidth", o.bandwidth_rad_s, 0.1, 5000.0)
    _within("--error-mm", o.error_mm, 1e-3, 1e3)
    _within("--alpha", alpha, 0.51, 1.0)
    law = loaded.config.control.law if o.law is None else o.law
    if law not in LAWS:
        raise ConfigError(f"--law {law}: none of {', '.join(LAWS)}")
    p: rules.Prediction | linear.LinearPrediction
    entry = in_slot(law)
    if entry is None:
        c = rules.designed(loaded.config, o.bandwidth_rad_s, 1e-3 * o.error_mm, alpha)
        c = c.model_copy(update={"control": c.control.model_copy(update={"law": law})})
        p = rules.predict(c, 1e-3 * o.error_mm)
        doubts, good = rules.warnings(c, p), is_hurwitz(gains_of(c))
        lines = _lines(c, p)
    else:
        c = linear.designed(loaded.config, entry, o.bandwidth_rad_s, 1e-3 * o.error_mm)
        p = linear.predict(c, entry)
        doubts, good = linear.warnings(c, entry), True
        lines = _linear_lines(c, p)
    runs: list[tuple[float, Service]] = []
    if o.simulate and good:
        axis, plant = axis_of(c, loaded.codecs.command_lsb_v), plant_of(c)
        try:
            for error_m in (0.0, rules.LARGE_ERROR * c.cylinder.stroke_m):
                runs.append((error_m, service(axis, plant, error_m)))
        except JitError as e:
            print(f"pneud: --simulate: {e}", file=sys.stderr)
            return 3
        near, far = runs[0][1], runs[1][1]
        if not far.recovered(near):
            good = False
            doubts.append(
                f"does not come back: {1e3 * far.rms_m:.3g} mm RMS five seconds after a start error of"
                f" {1e3 * runs[1][0]:.0f} mm, {1e3 * near.rms_m:.3g} mm without"
            )
    print(_as_json(c, p, doubts, runs, good) if o.json else _in_words(c, lines, doubts, runs))
    return 0 if good else 1


def _within(option: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise ConfigError(f"{option} {value:g}: must lie between {low:g} and {high:g}")


def _as_json(
    c: Config, p: NamedTuple, doubts: list[str], runs: list[tuple[float, Service]], good: bool
) -> str:
    prediction = {k: v if math.isfinite(v) else None for k, v in p._asdict().items()}
    return json_.dumps(
        {
            "schema": 1,
            "ok": good,
            "rate_hz": c.loop.rate_hz,
            "control": rules.table_of(c),
            "prediction": prediction,
            "simulated": [{"start_error_m": e, **s._asdict()} for e, s in runs],
            "warnings": doubts,
            "toml": rules.toml(c),
        }
    )


def _compensated(c: Config) -> str:
    return "bridged by prediction" if c.control.predict else "not bridged"


def _linear_lines(c: Config, p: linear.LinearPrediction) -> list[str]:
    return [
        f"# at {c.loop.rate_hz:g} Hz, {p.bandwidth_rad_s:.4g} rad/s",
        f"# noise of the acceleration: {p.acceleration_noise_m_s2:.3g} m/s²",
        f"# delay {1e3 * p.delay_s:.2f} ms ({_compensated(c)}), margin {1e3 * p.delay_margin_s:.2f} ms",
    ]


def _lines(c: Config, p: rules.Prediction) -> list[str]:
    force = f"{rules.PROBE_FORCE_N:g} N"
    return [
        f"# at {c.loop.rate_hz:g} Hz, {p.bandwidth_rad_s:.4g} rad/s at {1e3 * p.error_m:g} mm",
        f"# limit cycle in w3, explicit: {p.explicit_limit_cycle_m_s2:.3g} m/s²; implicit: none",
        f"# noise of the acceleration: {p.acceleration_noise_m_s2:.3g} m/s²",
        f"# static error for {force} that F̂ does not know of: {1e3 * p.static_error_m:.3g} mm",
        f"# noise in the command, mean |Δu|: {p.mean_step_v:.3g} V",
        f"# reaching after a step of {force}: {p.reaching_s:.3g} s, with {p.reaching_v:.2g} V",
        f"# delay {1e3 * p.delay_s:.2f} ms ({_compensated(c)}), margin {1e3 * p.delay_margin_s:.2f} ms at"
        f" {1e3 * p.error_m:g} mm, {1e3 * p.delay_margin_small_s:.2f} ms at {1e6 * rules.SMALL_ERROR_M:g} µm",
        f"# recovery ratio {p.recovery_ratio:.1f} of {rules.MOST_RECOVERY_RATIO:g}",
    ]


def _in_words(c: Config, predicted: list[str], doubts: list[str], runs: list[tuple[float, Service]]) -> str:
    lines = [rules.toml(c), *predicted]
    lines += [
        f"# simulated from {1e3 * e:.0f} mm: RMS {1e3 * s.rms_m:.3g} mm, largest {1e3 * s.max_m:.3g} mm,"
        f" mean |Δu| {s.chatter_v:.3g} V"
        for e, s in runs
    ]
    lines += [f"# warning: {doubt}" for doubt in doubts]
    return "\n".join(lines)
