"""The software plant node alone."""

from __future__ import annotations

import json
import signal
import sys
from typing import Annotated

import typer

from pneud.bus.link import open_link, refuse_if_driven
from pneud.compiled.backend import law
from pneud.config import conversions
from pneud.config.models import ConfigError
from pneud.loading import bus_name, listening_s, load_axis, load_scenario
from pneud.rig.answering import serve
from pneud.rig.node import PlantNode
from pneud.rt import setup
from pneud.scenario.engine import Engine
from pneud.signals import ValveState
from pneud.verbs import ConfigOption, ScenarioOption, SeedOption


def plant(
    bus: Annotated[str, typer.Option("--bus", metavar="BUS", help="socketcan:IF (a vcan) or unixcan:NAME.")],
    config_file: ConfigOption = None,
    scenario_file: ScenarioOption = None,
    seed: SeedOption = 0,
) -> int:
    """Run the plant until Ctrl-C or SIGTERM; says on standard error what its valve node does.

    With a scenario, standard output gets what plant and bus have shown of it, as one JSON object.

    Raises:
        ConfigError: the configuration or the bus name cannot be used.
        DatabaseError: the DBC cannot be used.
        LinkError: the bus cannot be used, or is no virtual one.
        BuildError: the compiled law is required and cannot be had.
    """
    scenario = load_scenario(scenario_file) if scenario_file is not None else None
    if scenario is not None and scenario.orders:
        raise ConfigError(f"scenario {scenario.name}: reaches beyond the plant; pneud --virtual --scenario")
    axis = load_axis(config_file, None, scenario)
    config = axis.config
    channel = bus_name(bus, config)
    if channel == "auto":
        raise ConfigError("--bus auto would find another bus than the daemon; name one, such as unixcan:x")
    stopped = False

    def stop(*_: object) -> None:
        nonlocal stopped
        stopped = True

    def say(state: ValveState) -> None:
        print(f"valve node: {state.name.lower()}", file=sys.stderr, flush=True)

    codecs = axis.codecs
    answers = (codecs.encoder.can_id, codecs.pressure.can_id, codecs.valve_status.can_id)
    how = law(config.loop.compiled, conversions.axis_of(config, codecs.command_lsb_v))
    with open_link(channel, virtual=True, by=how.carriage) as link:
        refuse_if_driven(link, answers, listening_s(config), "other nodes answer there")
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, stop)
        rig, rate_hz = conversions.plant_of(config), config.loop.rate_hz
        engine = None
        if scenario is not None:
            engine = Engine(scenario, rig, codecs, seed, rate_hz, advance=how.advance)
        node = engine.node if engine is not None else PlantNode(rig, codecs, seed, advance=how.advance)
        print(f"plant {config.name} on {link.name}; Ctrl-C stops", file=sys.stderr, flush=True)
        setup.apply(conversions.plant_priority(config.realtime), None, False)
        serve(link, node, stop=lambda: stopped, on_valve_state=say)
    if engine is not None:
        engine.settle()
        print(json.dumps(engine.effects.as_dict()))
    return 0
