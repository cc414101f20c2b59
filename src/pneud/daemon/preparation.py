"""What a run needs before anything is forked; whatever can be refused is refused here."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from pneud.axis.cycle import Axis
from pneud.bus.codec import fd_of
from pneud.bus.link import Link, LinkError, open_link, refuse_if_driven
from pneud.compiled.backend import Backend, backend
from pneud.config import conversions
from pneud.config.models import Config
from pneud.config.proof import Proof, digest, proven
from pneud.config.sections import ConfigError
from pneud.console import endpoint
from pneud.loading import Loaded, Together, bus_name, listening_s, plans_of_nodes
from pneud.log.files.naming import LogError, mileage_file, open_log
from pneud.scenario import verdict
from pneud.scenario.files import load_all, load_scenario, place_of
from pure2c import BuildError

if TYPE_CHECKING:
    from pneud.daemon.places import ViewersPlace
    from pneud.scenario.format import Scenario


class RunOptions(NamedTuple):
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


class AxisReady(NamedTuple):
    """What one axis begins with."""

    loaded: Loaded
    how: Backend
    axis: Axis
    log_file: Path
    descriptor: int  # of the log file
    unproven: bool  # it has to pass its movement test before it is armed
    mileage: Path | None  # where it is kept what the axis has done


class Ready(NamedTuple):
    """All that a run begins with."""

    options: RunOptions
    name: str  # of the daemon
    axes: tuple[AxisReady, ...]
    scenario: Scenario | None
    struck: int  # place of the axis that the scenario happens to
    link: Link
    socket: endpoint.Endpoint
    viewers: ViewersPlace | None

    @property
    def config(self) -> Config:
        """The first axis's; what concerns the bus, the tick and the machine is the same in all."""
        return self.axes[0].loaded.config


@contextmanager
def prepared(o: RunOptions) -> Iterator[Ready]:
    """Open and check everything; afterwards the bus is closed, and the console's socket is gone.

    Raises:
        ConfigError: the configuration cannot be used.
        DatabaseError: the DBC cannot be used.
        LinkError: the bus cannot be used.
        LogError: the log cannot be written.
        EdsError: the EDS of a node cannot be used.
        ExtraError: there are nodes, and nothing installed that configures them.
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
    scenario, axes, channel = _named(o)
    several = len(axes) > 1
    if several and (o.log or "").endswith(".mcap"):
        raise ConfigError(f"--log {o.log}: each of {len(axes)} axes has a log of its own; give a folder")
    ready: list[AxisReady] = []
    try:
        for axis in axes:
            ready.append(_axis(o, axis, channel, f"{axis.config.name}: " if several else ""))
        link = _join(channel, axes, ready[0].how, o.virtual)
        socket = endpoint.bind(axes.name, o.socket, virtual=o.virtual)
    except (LinkError, endpoint.PlaceError, LogError, BuildError):
        for one in ready:
            os.close(one.descriptor)
            one.log_file.unlink(missing_ok=True)
        raise
    with link:
        if link.note:
            print(f"pneud: {link.note}", file=sys.stderr)
        if viewers is not None:
            link_too = f", or open {viewers.link}" if viewers.link else ""
            print(f"pneud: {viewers.note}{link_too}", file=sys.stderr)
        struck = place_of(scenario, axes)
        try:
            yield Ready(o, axes.name, tuple(ready), scenario, struck, link, socket, viewers)
        except BaseException:
            for one in ready:
                with suppress(OSError):
                    if one.log_file.stat().st_size == 0:  # nothing had begun that could be looked up
                        one.log_file.unlink()
            raise
        finally:
            socket.path.unlink(missing_ok=True)


def _axis(o: RunOptions, axis: Loaded, channel: str, whose: str) -> AxisReady:
    config = axis.config
    p = conversions.axis_of(config, axis.codecs.command_lsb_v)
    how = backend(config.loop.compiled, p)
    if config.bus.nodes:
        from pneud.canopen.keeper import check_library  # noqa: PLC0415 - for rigs with nodes only

        check_library()
        plans_of_nodes(axis)
    lacks = lacks_proof(o, axis, channel, whose)
    mileage = mileage_file(o.log, config.name, airless=o.virtual or is_airless(channel))
    return AxisReady(axis, how, how.axis(p), *open_log(o.log, config.name), lacks, mileage)


def lacks_proof(o: RunOptions, axis: Loaded, channel: str, whose: str = "") -> bool:
    """Whether the axis may not be armed for want of a movement test; on a virtual bus that is but said."""
    if o.virtual:
        return False
    found = proven(axis.proof_file, digest(axis.config, axis.dbc.read_bytes()))
    if found == Proof.PASSED:
        return False
    words = {Proof.FAILED: "failed", Proof.CHANGED: "was with another rig", Proof.MISSING: "is lacking"}[
        found
    ]
    if o.unproven or (found != Proof.FAILED and is_airless(channel)):
        print(f"pneud: {whose}the movement test {words}; pneud commission makes it", file=sys.stderr)
        return False
    return True


def is_airless(channel: str) -> bool:
    """Whether no rig with air can be on a bus."""
    return channel.startswith(("unixcan:", "socketcan:vcan"))


def _named(o: RunOptions) -> tuple[Scenario | None, Together, str]:
    """The scenario, the axes and the bus that were asked for.

    Raises:
        ConfigError: one cannot be used, or they do not go together.
    """
    scenario = load_scenario(o.scenario) if o.scenario is not None else None
    axes = load_all(o.config, o.rate_hz, scenario)
    channel = bus_name(o.bus, axes[0].config)
    if scenario is not None:
        verdict.check_names(scenario)
        if scenario.needs_interface and not channel.startswith("socketcan:"):
            raise ConfigError(f"scenario {scenario.name}: takes a CAN interface; --bus socketcan:vcan0")
    if channel == "auto" and not o.virtual:
        raise ConfigError(f"{axes[0].path}: bus auto is for virtual runs; name the rig's bus with --bus")
    return scenario, axes, channel


def _join(channel: str, axes: Sequence[Loaded], how: Backend, virtual: bool) -> Link:
    link = open_link(channel, virtual=virtual, by=how.carriage, fd=fd_of(axis.codecs for axis in axes))
    if channel != "auto":
        first = axes[0]
        sync = [first.codecs.sync.can_id] if first.config.bus.sync is True else []  # else it is anybody's
        own = [*sync, *(axis.codecs.valve_command.can_id for axis in axes)]
        refuse_if_driven(link, own, listening_s(first.config))
    return link
