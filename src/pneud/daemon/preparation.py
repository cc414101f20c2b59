"""What a run needs before anything is forked; whatever can be refused is refused here."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from pneud.axis.cycle import Axis
from pneud.bus.link import Link, LinkError, open_link, refuse_if_driven
from pneud.compiled.backend import Backend, backend
from pneud.config import conversions
from pneud.config.models import Config
from pneud.config.proof import Proof, digest, proven
from pneud.config.sections import ConfigError
from pneud.console import endpoint
from pneud.loading import Loaded, bus_name, listening_s, plans_of_nodes
from pneud.log.files.naming import open_log
from pneud.scenario import verdict
from pneud.scenario.files import load_axis, load_scenario

if TYPE_CHECKING:
    from pneud.daemon.places import ViewersPlace
    from pneud.scenario.format import Scenario


@dataclass(frozen=True, slots=True)
class RunOptions:
    """What was asked for on the command line."""

    config: str | None
    bus: str | None
    virtual: bool
    arm: bool
    duration_s: float | None
    rate_hz: float | None
    headless: bool
    json: bool
    log: str | None
    scenario: str | None
    seed: int
    socket: str | None
    live: str | None  # ADDRESS:PORT to serve viewers at
    live_origins: tuple[str, ...] = ()  # of pages elsewhere that may look
    unproven: bool = False  # arm without a movement test


class Ready(NamedTuple):
    """All that a run begins with."""

    options: RunOptions
    loaded: Loaded
    scenario: Scenario | None
    how: Backend
    axis: Axis
    link: Link
    socket: endpoint.Endpoint
    log_file: Path
    descriptor: int  # of the log file
    viewers: ViewersPlace | None
    unproven: bool = False  # it has to pass its movement test before it is armed

    @property
    def config(self) -> Config:
        """The axis's."""
        return self.loaded.config


@contextmanager
def prepared(o: RunOptions) -> Iterator[Ready]:
    """Open and check everything; afterwards the bus is closed, and the console's socket is gone.

    Raises:
        ConfigError: the configuration cannot be used.
        DatabaseError: the DBC cannot be used.
        LinkError: the bus cannot be used.
        LogError: the log cannot be written.
        EdsError: the EDS of a node cannot be used.
        MissingLibraryError: there are nodes, and nothing installed that configures them.
        BuildError: the compiled law is required and cannot be had.
        PlaceError: the console's socket cannot be made.
    """
    if o.live is None:
        with _prepared(o, None) as ready:
            yield ready
        return
    from pneud.daemon.places import viewers_place  # noqa: PLC0415 - for a few runs only

    viewers = viewers_place(o.live, o.live_origins)
    with viewers.listener, _prepared(o, viewers) as ready:
        yield ready


@contextmanager
def _prepared(o: RunOptions, viewers: ViewersPlace | None) -> Iterator[Ready]:
    if o.arm and ("INVOCATION_ID" in os.environ or "NOTIFY_SOCKET" in os.environ):
        raise ConfigError("--arm is for benches and tests; a service is armed by an operator: pneud arm")
    scenario, loaded, channel = _named(o)
    config = loaded.config
    p = conversions.axis_of(config, loaded.codecs.command_lsb_v)
    how = backend(config.loop.compiled, p)
    if how.reason:
        print(f"pneud: the law runs in Python: {how.reason}", file=sys.stderr)
    if config.bus.nodes:
        from pneud.canopen.keeper import check_library  # noqa: PLC0415 - for rigs with nodes only

        check_library()
        plans_of_nodes(loaded)
    lacks = lacks_proof(o, loaded, channel)
    log_file, descriptor = open_log(o.log, config.name)
    try:
        link = _join(channel, loaded, how, o.virtual)
        socket = endpoint.bind(config.name, o.socket, virtual=o.virtual)
    except (LinkError, endpoint.PlaceError):
        os.close(descriptor)
        log_file.unlink(missing_ok=True)
        raise
    with link:
        if link.note:
            print(f"pneud: {link.note}", file=sys.stderr)
        if viewers is not None:
            link_too = f", or open {viewers.link}" if viewers.link else ""
            print(f"pneud: {viewers.note}{link_too}", file=sys.stderr)
        try:
            yield Ready(
                o, loaded, scenario, how, how.axis(p), link, socket, log_file, descriptor, viewers, lacks
            )
        except BaseException:
            with suppress(OSError):
                if log_file.stat().st_size == 0:  # nothing had begun that could be looked up
                    log_file.unlink()
            raise
        finally:
            socket.path.unlink(missing_ok=True)


def lacks_proof(o: RunOptions, axis: Loaded, channel: str) -> bool:
    """Whether the axis may not be armed for want of a movement test; on a virtual bus that is but said."""
    if o.virtual:
        return False
    found = proven(axis.path, digest(axis.config, axis.dbc.read_bytes()))
    if found == Proof.PASSED:
        return False
    words = {Proof.FAILED: "failed", Proof.CHANGED: "was with another rig", Proof.MISSING: "is lacking"}[
        found
    ]
    airless = found != Proof.FAILED and channel.startswith(("unixcan:", "socketcan:vcan"))
    if o.unproven or airless:
        print(f"pneud: the movement test {words}; pneud commission makes it", file=sys.stderr)
        return False
    return True


def _named(o: RunOptions) -> tuple[Scenario | None, Loaded, str]:
    """The scenario, the axis and the bus that were asked for.

    Raises:
        ConfigError: one cannot be used, or they do not go together.
    """
    scenario = load_scenario(o.scenario) if o.scenario is not None else None
    axis = load_axis(o.config, o.rate_hz, scenario)
    channel = bus_name(o.bus, axis.config)
    if scenario is not None:
        verdict.check_names(scenario)
        if scenario.needs_interface and not channel.startswith("socketcan:"):
            raise ConfigError(f"scenario {scenario.name}: takes a CAN interface; --bus socketcan:vcan0")
    if channel == "auto" and not o.virtual:
        raise ConfigError(f"{axis.path}: bus auto is for virtual runs; name the rig's bus with --bus")
    return scenario, axis, channel


def _join(channel: str, axis: Loaded, how: Backend, virtual: bool) -> Link:
    link = open_link(channel, virtual=virtual, by=how.carriage)
    if channel != "auto":
        command, sync = axis.codecs.valve_command.can_id, axis.codecs.sync.can_id
        own = (sync, command) if axis.config.bus.sync else (command,)  # without, it is anybody's
        refuse_if_driven(link, own, listening_s(axis.config))
    return link
