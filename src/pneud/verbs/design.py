"""Gains for a bandwidth, as TOML, with what they will do and what is wrong with them."""

from __future__ import annotations

import json as json_
from typing import Annotated, NamedTuple

import typer

from pneud.config.conversions import axis_of, gains_of, plant_of
from pneud.config.models import Config, ConfigError
from pneud.control.tunables import LAWS as EVERY_LAW
from pneud.control.tunables import in_slot, is_hurwitz
from pneud.loading import load
from pneud.loop.summary import finite
from pneud.study import gains as rules
from pneud.study import linear
from pneud.study.jit import JitError
from pneud.study.push import Pushed, service
from pneud.verbs import JsonOption, VerbError

LAWS = (*dict.fromkeys(law.partition("-")[0] for law in EVERY_LAW),)


def design(
    bandwidth: Annotated[float, typer.Option("--bandwidth", metavar="RAD_S", help="Of the closed loop.")],
    error_mm: Annotated[
        float, typer.Option("--error-mm", metavar="A", help="Error at which the gains are those of a line.")
    ],
    file: Annotated[str, typer.Argument(metavar="FILE", help="Configuration.")] = "virtual.toml",
    law: Annotated[
        str | None,
        typer.Option("--law", metavar="LAW", help="composite, ismc, pid, adrc; default as in FILE."),
    ] = None,
    alpha: Annotated[
        float | None, typer.Option("--alpha", metavar="X", help="Exponent; default the configuration's.")
    ] = None,
    rate: Annotated[float | None, typer.Option("--rate", metavar="HZ", help="Ticks per second.")] = None,
    simulate: Annotated[
        bool, typer.Option("--simulate", help="Try them, also from a start error of 0.4 strokes.")
    ] = False,
    json: JsonOption = False,
) -> int:
    """Design gains and print them as TOML, with predictions and warnings.

    Returns:
        Exit status: 0 where pneud accepts the gains and, if simulated, they come back from a large error; 1
        where not.

    Raises:
        ConfigError: the configuration or an option cannot be used.
        DatabaseError: the DBC cannot be used.
        VerbError: a simulation is asked for without numba.
    """
    loaded = load(file, rate)
    alpha = loaded.config.control.alpha if alpha is None else alpha
    _within("--bandwidth", bandwidth, 0.1, 5000.0)
    _within("--error-mm", error_mm, 1e-3, 1e3)
    _within("--alpha", alpha, 0.51, 1.0)
    law = loaded.config.control.law if law is None else law
    if law not in LAWS:
        raise ConfigError(f"--law {law}: none of {', '.join(LAWS)}")
    p: rules.Prediction | linear.LinearPrediction
    entry = in_slot(law)
    if entry is None:
        c = rules.designed(loaded.config, bandwidth, 1e-3 * error_mm, alpha)
        c = c.model_copy(update={"control": c.control.model_copy(update={"law": law})})
        p = rules.predict(c, 1e-3 * error_mm)
        doubts, good = rules.warnings(c, p), is_hurwitz(gains_of(c))
        lines = _lines(c, p)
    else:
        c = linear.designed(loaded.config, entry, bandwidth, 1e-3 * error_mm)
        p = linear.predict(c, entry)
        doubts, good = linear.warnings(c, entry), True
        lines = _linear_lines(c, p)
    runs: list[tuple[float, Pushed]] = []
    if simulate and good:
        axis, plant = axis_of(c, loaded.codecs.command_lsb_v), plant_of(c)
        try:
            for error_m in (0.0, rules.LARGE_ERROR * c.cylinder.stroke_m):
                runs.append((error_m, service(axis, plant, error_m)))
        except JitError as e:
            raise VerbError(f"--simulate: {e}", 3) from None
        near, far = runs[0][1], runs[1][1]
        if not far.recovered(near):
            good = False
            doubts.append(
                f"does not come back: {1e3 * far.rms_m:.3g} mm RMS five seconds after a start error of"
                f" {1e3 * runs[1][0]:.0f} mm, {1e3 * near.rms_m:.3g} mm without"
            )
    print(_as_json(c, p, doubts, runs, good) if json else _in_words(c, lines, doubts, runs))
    return 0 if good else 1


def _within(option: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise ConfigError(f"{option} {value:g}: must lie between {low:g} and {high:g}")


def _as_json(
    c: Config, p: NamedTuple, doubts: list[str], runs: list[tuple[float, Pushed]], good: bool
) -> str:
    return json_.dumps(
        finite(
            {
                "schema": 1,
                "ok": good,
                "rate_hz": c.loop.rate_hz,
                "control": rules.table_of(c),
                "prediction": p._asdict(),
                "simulated": [{"start_error_m": e, **s._asdict()} for e, s in runs],
                "warnings": doubts,
                "toml": rules.toml(c),
            }
        )
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


def _in_words(c: Config, predicted: list[str], doubts: list[str], runs: list[tuple[float, Pushed]]) -> str:
    lines = [rules.toml(c), *predicted]
    lines += [
        f"# simulated from {1e3 * e:.0f} mm: RMS {1e3 * s.rms_m:.3g} mm, largest {1e3 * s.max_m:.3g} mm,"
        f" mean |Δu| {s.chatter_v:.3g} V"
        for e, s in runs
    ]
    lines += [f"# warning: {doubt}" for doubt in doubts]
    return "\n".join(lines)
