"""Validate a configuration and everything it names; say what is wrong where."""

from __future__ import annotations

import json as json_
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from pneud import resources
from pneud.axis.cycle import Axis
from pneud.bus.load import load_of, most_axes, most_hz
from pneud.config import conversions, flow
from pneud.config.models import Config
from pneud.config.places import line_of
from pneud.config.sections import ConfigError
from pneud.control.tunables import in_slot
from pneud.loading import Loaded, devices_of, load_axes
from pneud.physics import ratings
from pneud.safety.unnoticed import Unnoticed, unnoticed
from pneud.scenario import verdict
from pneud.scenario.files import is_scenario, load_axis, load_scenario
from pneud.study import gains, linear
from pneud.study.plausibility import Doubt, findings
from pneud.verbs import FileArgument, JsonOption


def check(
    file: FileArgument,
    json: JsonOption = False,
) -> int:
    """Load a configuration and its DBC as the daemon would, or a scenario, and say what they describe.

    Raises:
        ConfigError: names the file, the key, the value and the bound.
        DatabaseError: names the DBC, the message and the signal.
    """
    if is_scenario(file):
        return _check_scenario(file, json)
    axes = load_axes(file)
    reports = [_report(loaded) for loaded in axes]
    for loaded, report in zip(axes, reports, strict=True) if len(axes) > 1 else ():
        report.lines.append(f"its command acts {loaded.config.bus.command_delay_us:g} µs after sampling")
    bus = _bus(axes)
    if json:
        found = [report.found for report in reports]
        if len(axes) == 1:
            print(json_.dumps({"schema": 1, "ok": True, **found[0], "bus": bus}))
        else:
            print(json_.dumps({"schema": 1, "ok": True, "file": file, "bus": bus, "axes": found}))
        return 0
    for report in reports:
        print("\n".join(report.lines))
        if report is reports[-1]:
            print(_bus_in_words(bus, axes[0].config.name, len(axes)))
        for doubt in report.found["warnings"]:
            print(f"warning: {doubt}")
    return 0


class _Report(NamedTuple):
    """What there is to say of one axis."""

    found: dict[str, Any]
    lines: list[str]


def _report(loaded: Loaded) -> _Report:
    """What an axis is.

    Raises:
        ConfigError: it cannot be.
    """
    c, codecs = loaded.config, loaded.codecs
    Axis(conversions.axis_of(c, codecs.command_lsb_v))
    conversions.plant_of(c)
    entry = in_slot(c.control.law)
    bandwidth = (gains.predict(c) if entry is None else linear.predict(c, entry)).bandwidth_rad_s
    found = findings(c, codecs.command_lsb_v, bandwidth)
    if wrong := [_placed(loaded, finding) for finding in found if finding.is_error]:
        raise ConfigError(f"{loaded.path}: {'; '.join(wrong)}")
    doubts = [_placed(loaded, finding) for finding in found] + linear.doubts_of(c)
    blind = unnoticed(devices_of(c, codecs))
    believed, true = _flowing(c), _flowing(conversions.truth_of(c))
    stroke, mass = c.cylinder.stroke_m, c.cylinder.moving_mass_kg
    form = "" if entry is not None else f"{c.control.discretisation}, "
    start = c.control.adaptation.start.log
    lines = [
        f"{loaded.path}: {'fine' if not doubts else f'usable, {len(doubts)} to look at'}",
        f"axis {c.name}: {stroke:g} m stroke, {mass:g} kg, {c.loop.rate_hz:g} Hz",
        f"valve {_in_words(believed)}",
        *([f"the plant's: {_in_words(true)}"] if true != believed else []),
        f"law {c.control.law}, {form}on {c.bus.channel} with {loaded.dbc.name}",
        *([_led_in_words(c)] if c.reference.follow is not None else []),
        *([f"adaptation starts from {start}"] if start else []),
        *(f"not noticed here: {', '.join(names)} ({why})" for why, names in _by_reason(blind).items()),
    ]
    named: dict[str, Any] = {"name": c.name, "file": str(loaded.path), "warnings": doubts, "valve": believed}
    named["follow"] = c.reference.follow.model_dump() if c.reference.follow is not None else None
    named["unnoticed"] = [{"fault": one.name, "why": one.why, "wholly": one.wholly} for one in blind]
    return _Report(named, lines)


def _led_in_words(c: Config) -> str:
    """By whom an axis is led, or whom it leads."""
    follow = c.reference.follow
    assert follow is not None
    if follow.skew_m is not None:
        square = f", square at {1e3 * follow.offset_m:+g} mm" if follow.offset_m else ""
        who = "leads" if follow.leads else "is led"
        return f"a gantry with {follow.axis}, and {who}: at most {1e3 * follow.skew_m:g} mm askew{square}"
    what = "reference" if follow.of == "reference" else "measured position"
    return f"follows the {what} of {follow.axis}: {follow.scale:g} of it {1e3 * follow.offset_m:+g} mm"


def _bus(axes: Sequence[Loaded]) -> dict[str, Any] | None:
    """What a tick takes of the bus at worst; None where frames go over no wire."""
    c, frames = axes[0].config, [axis.codecs for axis in axes]
    if not math.isfinite(c.bus.bitrate_bit_s):
        return None
    load = load_of(c, *frames)
    return {
        "bits_per_tick": round(load.tick_s * c.bus.bitrate_bit_s),
        "bitrate_bit_s": c.bus.bitrate_bit_s,
        "axes": len(axes),
        "most_axes": most_axes(c, frames[0]),
        "most_hz": math.floor(most_hz(c, load)),
    }


def _bus_in_words(bus: dict[str, Any] | None, axis: str, axes: int) -> str:
    if bus is None:
        return "bus without a wire: any number of axes, at any rate"
    what = "a tick" if axes == 1 else f"a tick of {axes} axes"
    return (
        f"bus: {what} takes up to {bus['bits_per_tick']} bit times at {1e-3 * bus['bitrate_bit_s']:g} kbit/s:"
        f" up to {bus['most_hz']} Hz; at most {bus['most_axes']} like {axis} at this rate"
    )


def _by_reason(blind: list[Unnoticed]) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for one in blind:
        found.setdefault(one.why, []).append(one.name)
    return found


def _flowing(c: Config) -> dict[str, Any]:
    """What a valve lets through by its rating."""
    g, C = flow.gas_of(c), flow.conductance_of(c)
    found = {
        "nominal_flow_l_min": ratings.nominal_flow_of(C, g) / flow.L_MIN,
        "sonic_conductance_l_s_bar": C / flow.L_S_BAR,
        "critical_ratio": g.critical_ratio,
        "orifice_area_m2": flow.area_of(c),
    }
    return {"flow": c.valve.flow} | {key: float(f"{value:.5g}") for key, value in found.items()}


def _in_words(v: dict[str, Any]) -> str:
    l_min, C, b = v["nominal_flow_l_min"], v["sonic_conductance_l_s_bar"], v["critical_ratio"]
    as_orifice = f"as an orifice of {1e6 * v['orifice_area_m2']:.4g} mm² ({v['flow']})"
    return f"{l_min:.4g} l/min ANR at 6 -> 5 bar, C {C:.4g} l/(s bar), b {b:.2g}, {as_orifice}"


def _placed(loaded: Loaded, finding: Doubt) -> str:
    line = line_of(loaded.text, finding.key.split("."))
    return f"{f'line {line}: ' if line else ''}{finding.key}: {finding.words}"


def _check_scenario(file: str, json: bool) -> int:
    scenario = load_scenario(file)
    verdict.check_names(scenario)
    axis = load_axis(None, None, scenario)
    path = resources.find(file)
    if json:
        print(
            json_.dumps({"schema": 1, "ok": True, "name": scenario.name, "file": str(path), "warnings": []})
        )
        return 0
    kinds = ", ".join(fault.kind for fault in scenario.fault)
    print(f"{path}: fine")
    print(f"scenario {scenario.name} on {axis.config.name}: {kinds} → {scenario.expect.reaction}")
    return 0
