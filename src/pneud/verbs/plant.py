"""The software plant node alone, on a virtual bus."""

from __future__ import annotations

import signal
import sys

from pneud import parameters
from pneud.bus.link import open_link, refuse_if_driven
from pneud.compiled.law import law
from pneud.config import ConfigError
from pneud.loading import bus_name, listening_s, load
from pneud.plant.node import PlantNode
from pneud.plant.process import serve
from pneud.rt import setup
from pneud.signals import ValveState


def plant(config_file: str, bus: str, seed: int) -> int:
    """Run the plant until Ctrl-C or SIGTERM; says on standard error what its valve node does.

    Raises:
        ConfigError: the configuration or the bus name cannot be used.
        DatabaseError: the DBC cannot be used.
        LinkError: the bus cannot be used, or is no virtual one.
        BuildError: the compiled law is required and cannot be had.
    """
    axis = load(config_file)
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
    with open_link(channel, virtual=True) as link:
        refuse_if_driven(link, answers, listening_s(config), "other nodes answer there")
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, stop)
        how = law(config.loop.compiled, parameters.axis_of(config, codecs.command_lsb_v))
        node = PlantNode(parameters.plant_of(config), codecs, seed, advance=how.advance)
        print(f"plant {config.name} on {link.name}; Ctrl-C stops", file=sys.stderr, flush=True)
        setup.apply(max(0, config.realtime.priority - 10), None, False)
        serve(link, node, stop=lambda: stopped, on_valve_state=say)
    return 0
