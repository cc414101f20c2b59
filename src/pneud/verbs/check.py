"""Validate a configuration and everything it names; say what is wrong where."""

from __future__ import annotations

import json as json_
from typing import Any

from pneud import resources
from pneud.axis.cycle import Axis
from pneud.config import conversions, flow
from pneud.config.models import Config
from pneud.config.places import line_of
from pneud.config.sections import ConfigError
from pneud.control.tunables import in_slot
from pneud.loading import Loaded, devices_of, load
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
    loaded = load(file)
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
    if json:
        found_so = {"schema": 1, "ok": True, "name": c.name, "file": str(loaded.path), "warnings": doubts}
        found_so["unnoticed"] = [{"fault": one.name, "why": one.why, "wholly": one.wholly} for one in blind]
        print(json_.dumps(found_so | {"valve": believed}))
        return 0
    print(f"{loaded.path}: {'fine' if not doubts else f'usable, {len(doubts)} to look at'}")
    stroke, mass = c.cylinder.stroke_m, c.cylinder.moving_mass_kg
    print(f"axis {c.name}: {stroke:g} m stroke, {mass:g} kg, {c.loop.rate_hz:g} Hz")
    print(f"valve {_in_words(believed)}")
    if true != believed:
        print(f"the plant's: {_in_words(true)}")
    form = "" if entry is not None else f"{c.control.discretisation}, "
    print(f"law {c.control.law}, {form}on {c.bus.channel} with {loaded.dbc.name}")
    if c.control.adaptation.start.log:
        print(f"adaptation starts from {c.control.adaptation.start.log}")
    for why, names in _by_reason(blind).items():
        print(f"not noticed here: {', '.join(names)} ({why})")
    for doubt in doubts:
        print(f"warning: {doubt}")
    return 0


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
