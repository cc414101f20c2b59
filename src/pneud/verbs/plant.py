"""The software plant node alone."""

from __future__ import annotations

import json
import signal
import sys
from typing import Annotated

import typer

from pneud.bus.codec import fd_of
from pneud.bus.link import open_link, refuse_if_driven
from pneud.compiled.backend import Backend, backend
from pneud.config import conversions
from pneud.config.sections import ConfigError
from pneud.crew import asked_to_leave
from pneud.loading import Loaded, bus_name, listening_s, plans_of_plant
from pneud.rig.plant_process import Rig, answer
from pneud.scenario.files import load_all, load_scenario, place_of
from pneud.scenario.stage import Stage
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
    """
    scenario = load_scenario(scenario_file) if scenario_file is not None else None
    if scenario is not None and scenario.orders:
        raise ConfigError(f"scenario {scenario.name}: reaches beyond the plant; pneud --virtual --scenario")
    axes = load_all(config_file, None, scenario)
    config = axes[0].config
    channel = bus_name(bus, config)
    if channel == "auto":
        raise ConfigError("--bus auto would find another bus than the daemon; name one, such as unixcan:x")

    def say(state: ValveState) -> None:
        print(f"valve node: {state.name.lower()}", file=sys.stderr, flush=True)

    how = backend(config.loop.compiled, conversions.axis_of(config, axes[0].codecs.command_lsb_v))
    rigs = [_rig(axis, seed + n, how) for n, axis in enumerate(axes)]
    answers = [answer.codec.can_id for axis in axes for answer in axis.codecs.answers]
    stage = Stage(scenario, config.loop.rate_hz) if scenario is not None else None
    fd = fd_of(axis.codecs for axis in axes)
    with open_link(channel, virtual=True, by=how.carriage, fd=fd) as link:
        refuse_if_driven(link, answers, listening_s(config), "other nodes answer there")
        stop = asked_to_leave(signal.SIGINT, signal.SIGTERM)
        print(f"plant {axes.name} on {link.name}; Ctrl-C stops", file=sys.stderr, flush=True)
        answer(link, rigs, stage, stop, to=place_of(scenario, axes), on_valve_state=say)
    if stage is not None:
        stage.over()
        print(json.dumps(stage.effects()))
    return 0


def _rig(axis: Loaded, seed: int, how: Backend) -> Rig:
    config, codecs = axis.config, axis.codecs
    priority = conversions.plant_priority(config.realtime)
    plans, odd = plans_of_plant(axis), config.plant.odd_nodes
    return Rig(
        conversions.plant_of(config),
        codecs,
        seed,
        priority,
        how.advance,
        how.carriage,
        plans,
        odd,
        config.name,
        conversions.beam_of(config),
    )
