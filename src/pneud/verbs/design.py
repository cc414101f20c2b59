"""Gains for a bandwidth, as TOML, with what they will do and what is wrong with them."""

from __future__ import annotations

import json as json_
import os
import sys
from typing import Annotated, Any, NamedTuple

import typer

from pneud.config.conversions import axis_of, plant_of
from pneud.config.models import Config
from pneud.config.sections import ConfigError
from pneud.loading import Loaded, load
from pneud.loop.summary import finite
from pneud.study import fastest, judging, linear, trial
from pneud.study import gains as rules
from pneud.study.judging import Judged, Lengths
from pneud.study.proposing import LAWS, Proposal, propose
from pneud.study.push import Pushed, service
from pneud.verbs import AxisOption, FileArgument, JsonOption, ProgressOption
from pneud.view.progress import each, progress


class Aim(NamedTuple):
    """What is asked for."""

    loaded: Loaded
    omega_rad_s: float | None  # None: to be found
    error_m: float
    alpha: float
    within_m: float


class Design(NamedTuple):
    """Gains and what came of them."""

    proposal: Proposal
    omega_rad_s: float
    judged: tuple[Judged, ...] = ()
    faster: fastest.Tried | None = None  # the next bandwidth that was looked at

    @property
    def holds(self) -> bool:
        """Whether pneud takes them, and all that was judged is within its limits."""
        return self.proposal.sound and not any(j.missed for j in self.judged)


def design(
    bandwidth: Annotated[
        str,
        typer.Option(
            "--bandwidth", metavar="RAD_S", help="Of the closed loop; or auto: the fastest that holds."
        ),
    ],
    file: FileArgument = "virtual.toml",
    error_mm: Annotated[
        float | None,
        typer.Option(
            "--error-mm", metavar="A", help="Error at which it is that; default 1/1000 of the stroke."
        ),
    ] = None,
    law: Annotated[
        str | None,
        typer.Option("--law", metavar="LAW", help="composite, ismc, pid, adrc; default as in FILE."),
    ] = None,
    alpha: Annotated[
        float | None, typer.Option("--alpha", metavar="X", help="Exponent; default the configuration's.")
    ] = None,
    rate: Annotated[float | None, typer.Option("--rate", metavar="HZ", help="Ticks per second.")] = None,
    axis: AxisOption = None,
    simulate: Annotated[
        bool, typer.Option("--simulate", help="Try what people do, on rigs unlike the model, too.")
    ] = False,
    within_mm: Annotated[
        float, typer.Option("--within-mm", metavar="MM", help="RMS error that a sine may have.")
    ] = 1e3 * judging.WITHIN_M,
    compare: Annotated[bool, typer.Option("--compare", help="Try all laws.")] = False,
    json: JsonOption = False,
    how: ProgressOption = "auto",
) -> int:
    """Design gains and print them as TOML, with predictions and warnings.

    Returns:
        Exit status: 0 where pneud accepts the gains and, if they were tried, everything holds; 1 where not.

    Raises:
        ConfigError: the configuration or an option cannot be used.
        DatabaseError: the DBC cannot be used.
    """
    loaded = load(file, rate, axis=axis)
    c = loaded.config
    alpha = c.control.alpha if alpha is None else alpha
    omega = None if bandwidth == "auto" else _number("--bandwidth", bandwidth)
    error_mm = 1e3 * rules.error_scale_m(c) if error_mm is None else error_mm
    if omega is not None:
        _within("--bandwidth", omega, 0.1, 5000.0)
    _within("--error-mm", error_mm, 1e-3, 1e3)
    _within("--within-mm", within_mm, 1e-3, 1e3)
    _within("--alpha", alpha, 0.51, 1.0)
    law = c.control.law if law is None else law
    if law not in LAWS:
        raise ConfigError(f"--law {law}: none of {', '.join(LAWS)}")
    aim = Aim(loaded, omega, 1e-3 * error_mm, alpha, 1e-3 * within_mm)
    if omega is None or simulate or compare:
        laws = (law, *(other for other in LAWS if other != law)) if compare else (law,)
        designs = _tried(aim, laws, how)
    else:
        designs = {law: Design(propose(c, law, omega, aim.error_m, alpha), omega)}
    found = designs[law]
    runs = _from_large_errors(aim, found) if found.judged else []
    print(_as_json(designs, runs) if json else _in_words(aim, designs, runs))
    return 0 if found.holds else 1


def _number(option: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ConfigError(f"{option} {text}: neither a number nor auto") from None


def _within(option: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise ConfigError(f"{option} {value:g}: must lie between {low:g} and {high:g}")


def _tried(aim: Aim, laws: tuple[str, ...], how: str) -> dict[str, Design]:
    """The designs of these laws, tried on all rigs."""
    why = trial.compiled()[1]
    if why:
        print(f"pneud: this is slow and brief, since nothing can be compiled: {why}", file=sys.stderr)
    c, cases, found = aim.loaded.config, judging.SHORT if why else (), {}
    with judging.judges() as judge, progress(how) as report:

        def judged(p: Proposal, lengths: Lengths) -> tuple[Judged, ...]:
            course = judging.course_of(c, judging.BRIEF if why else lengths, aim.within_m)
            many = judging.tasks(p.config, aim.loaded.codecs.command_lsb_v, course, cases)
            text = f"{p.config.control.law} at {p.prediction.bandwidth_rad_s:.3g} rad/s"
            return tuple(each(judge(many), report, text, len(many), "sessions"))

        for law in laws:

            def proposed(omega_rad_s: float, law: str = law) -> Proposal:
                return propose(c, law, omega_rad_s, aim.error_m, aim.alpha)

            if aim.omega_rad_s is None:
                best, faster = fastest.fastest(proposed, judged, 1.0 / c.loop.rate_hz)
                found[law] = Design(best.proposal, best.bandwidth_rad_s, best.judged, faster)
            else:
                p = proposed(aim.omega_rad_s)
                found[law] = Design(p, aim.omega_rad_s, judged(p, judging.WHOLE) if p.sound else ())
    return found


def _from_large_errors(aim: Aim, found: Design) -> list[tuple[float, Pushed]]:
    """The sine from its centre and from a large error; a doubt is added where that is not forgotten."""
    c = found.proposal.config
    axis, plant = axis_of(c, aim.loaded.codecs.command_lsb_v), plant_of(c)
    errors_m = (0.0, rules.LARGE_ERROR * c.cylinder.stroke_m)
    near, far = (service(axis, plant, error_m) for error_m in errors_m)
    if any(f.part == "return" for j in found.judged for f in j.missed):
        found.proposal.doubts.append(
            f"does not come back: {1e3 * far.rms_m:.3g} mm RMS five seconds after a start error of"
            f" {1e3 * errors_m[1]:.0f} mm, {1e3 * near.rms_m:.3g} mm without"
        )
    return list(zip(errors_m, (near, far), strict=True))


def _as_json(designs: dict[str, Design], runs: list[tuple[float, Pushed]]) -> str:
    found = next(iter(designs.values()))
    c = found.proposal.config
    whole: dict[str, Any] = {
        "schema": 1,
        "ok": found.holds,
        "rate_hz": c.loop.rate_hz,
        "bandwidth_rad_s": found.omega_rad_s,
        "control": rules.table_of(c),
        "prediction": found.proposal.prediction._asdict(),
        "simulated": [{"start_error_m": e, **s._asdict()} for e, s in runs],
        "judged": judging.as_json(found.judged),
        "faster": None
        if found.faster is None
        else {
            "bandwidth_rad_s": found.faster.bandwidth_rad_s,
            "judged": judging.as_json(found.faster.judged),
        },
        "compared": {
            law: {
                "bandwidth_rad_s": d.omega_rad_s,
                "ok": d.holds,
                "control": rules.table_of(d.proposal.config),
                "judged": judging.as_json(d.judged),
            }
            for law, d in list(designs.items())[1:]
        },
        "warnings": found.proposal.doubts,
        "toml": rules.toml(c),
    }
    return json_.dumps(_finite(whole))


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in finite(value).items()}
    return [_finite(v) for v in value] if isinstance(value, list | tuple) else value


def _in_words(aim: Aim, designs: dict[str, Design], runs: list[tuple[float, Pushed]]) -> str:
    found = next(iter(designs.values()))
    c = found.proposal.config
    lines = [*_predicted(c, found.proposal)]
    lines += [
        f"simulated from {1e3 * e:.0f} mm: RMS {1e3 * s.rms_m:.3g} mm, largest {1e3 * s.max_m:.3g} mm,"
        f" mean |Δu| {s.chatter_v:.3g} V"
        for e, s in runs
    ]
    lines += [f"warning: {doubt}" for doubt in found.proposal.doubts]
    if found.judged:
        lines += _judged(aim, designs)
    return "\n".join([rules.toml(c), *(f"# {line}" for line in lines)])


def _judged(aim: Aim, designs: dict[str, Design]) -> list[str]:
    from pneud.study import judging_words as words  # noqa: PLC0415 - needs rich, which is slow to load

    found = next(iter(designs.values()))
    lines = words.lines(found.judged, os.isatty(1))
    if aim.omega_rad_s is None:
        lines.append(_limit(found))
    if len(designs) > 1:
        lines += words.beside(
            {f"{law} {d.omega_rad_s:.4g}": d.judged for law, d in designs.items() if d.judged}
        )
    return lines


def _limit(found: Design) -> str:
    """What keeps the gains from being faster."""
    from pneud.study import judging_words as words  # noqa: PLC0415 - needs rich, which is slow to load

    here = f"{found.omega_rad_s:.4g} rad/s"
    if not found.holds:
        return f"no bandwidth holds on all rigs; {here} misses least"
    faster = found.faster
    if faster is None:
        return f"{here} holds on all rigs; the margin of a faster one would not bear the delay"
    case = judging.ordered(faster.judged)[0]
    return (
        f"{here} is the fastest that holds; at {faster.bandwidth_rad_s:.4g} rad/s"
        f" {case.case} does not: {words.told(case.worst)}"
    )


def _predicted(c: Config, p: Proposal) -> list[str]:
    """What is known of gains without trying them."""
    bridged = "bridged by prediction" if c.control.predict else "not bridged"
    found = p.prediction
    if isinstance(found, linear.LinearPrediction):
        return [
            f"at {c.loop.rate_hz:g} Hz, {found.bandwidth_rad_s:.4g} rad/s",
            f"noise of the acceleration: {found.acceleration_noise_m_s2:.3g} m/s²",
            f"delay {1e3 * found.delay_s:.2f} ms ({bridged}), margin {1e3 * found.delay_margin_s:.2f} ms",
        ]
    force = f"{rules.PROBE_FORCE_N:g} N"
    return [
        f"at {c.loop.rate_hz:g} Hz, {found.bandwidth_rad_s:.4g} rad/s at {1e3 * found.error_m:g} mm",
        f"limit cycle in w3, explicit: {found.explicit_limit_cycle_m_s2:.3g} m/s²; implicit: none",
        f"noise of the acceleration: {found.acceleration_noise_m_s2:.3g} m/s²",
        f"static error for {force} that F̂ does not know of: {1e3 * found.static_error_m:.3g} mm",
        f"noise in the command, mean |Δu|: {found.mean_step_v:.3g} V",
        f"reaching after a step of {force}: {found.reaching_s:.3g} s, with {found.reaching_v:.2g} V",
        f"delay {1e3 * found.delay_s:.2f} ms ({bridged}), margin {1e3 * found.delay_margin_s:.2f} ms at"
        f" {1e3 * found.error_m:g} mm, {1e3 * found.delay_margin_small_s:.2f} ms at"
        f" {1e6 * rules.SMALL_ERROR_M:g} µm",
        f"recovery ratio {found.recovery_ratio:.1f} of {rules.MOST_RECOVERY_RATIO:g}",
    ]
