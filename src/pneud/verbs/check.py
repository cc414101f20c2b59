"""Validate a configuration and everything it names; say what is wrong where."""

from __future__ import annotations

import json as json_
from typing import Annotated

import typer

from pneud import resources
from pneud.axis.cycle import Axis
from pneud.config import conversions
from pneud.loading import is_scenario, load, load_axis, load_scenario
from pneud.scenario import verdict
from pneud.study.gains import predict, warnings
from pneud.verbs import JsonOption


def check(
    file: Annotated[str, typer.Argument(metavar="FILE", help="Configuration.")],
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
    doubts = warnings(c, predict(c))
    if json:
        print(
            json_.dumps(
                {"schema": 1, "ok": True, "name": c.name, "file": str(loaded.path), "warnings": doubts}
            )
        )
        return 0
    print(f"{loaded.path}: fine")
    stroke, mass = c.cylinder.stroke_m, c.cylinder.moving_mass_kg
    print(f"axis {c.name}: {stroke:g} m stroke, {mass:g} kg, {c.loop.rate_hz:g} Hz")
    print(f"law {c.control.law}, {c.control.discretisation}, on {c.bus.channel} with {loaded.dbc.name}")
    for doubt in doubts:
        print(f"warning: {doubt}")
    return 0


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
