"""The daemon, on a rig or with the software plant on a virtual bus."""

from __future__ import annotations

import importlib.util
import json
import os
import socket as socket_
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pneud.axis.cycle import Axis
from pneud.bus.inbox import Inbox
from pneud.bus.link import Link, LinkError, open_link, refuse_if_driven
from pneud.compiled.backend import Backend, backend
from pneud.config import conversions
from pneud.config.models import Config, ConfigError, LogConfig
from pneud.console import endpoint, handoff
from pneud.console.facts import Run
from pneud.crew import Stage, end, end_screen, fork_console, fork_live, fork_plant, fork_screen, wait
from pneud.loading import Loaded, bus_name, listening_s, load_axis, load_scenario
from pneud.log.files.naming import open_log
from pneud.log.format.header import LogHeader, Rotation
from pneud.log.live import notes
from pneud.log.live.recorder import start_recorder
from pneud.log.live.ring import Ring
from pneud.loop.loop import Loop, options_of
from pneud.loop.summary import in_words, summarise
from pneud.rig.truth import TruthReader, truth_memory
from pneud.rt import setup
from pneud.safety.faults import BLOCKS_ARM, FAULT_NAMES, names
from pneud.scenario import verdict
from pneud.signals import State

if TYPE_CHECKING:
    from pneud.scenario.format import Scenario

RECORDER_PATIENCE_S = 15.0
CONSOLE_PATIENCE_S = 1.0
PATIENCE_S = 20.0  # with processes that have a scenario to end


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


def run(o: RunOptions) -> int:
    """Run until told to stop.

    Returns:
        Exit status: 0, or 1 where there was a fault or the axis never came to track.

    Raises:
        ConfigError: the configuration cannot be used.
        DatabaseError: the DBC cannot be used.
        LinkError: the bus cannot be used.
        LogError: the log cannot be written.
        BuildError: the compiled law is required and cannot be had.
        PlaceError: the console's socket cannot be made.
    """
    viewers = _viewers(o.live) if o.live is not None else None
    if o.arm and ("INVOCATION_ID" in os.environ or "NOTIFY_SOCKET" in os.environ):
        raise ConfigError("--arm is for benches and tests; a service is armed by an operator: pneud arm")
    scenario = load_scenario(o.scenario) if o.scenario is not None else None
    axis = load_axis(o.config, o.rate_hz, scenario)
    channel = bus_name(o.bus, axis.config)
    if scenario is not None:
        verdict.check_names(scenario)
        if scenario.needs_interface and not channel.startswith("socketcan:"):
            raise ConfigError(f"scenario {scenario.name}: takes a CAN interface; --bus socketcan:vcan0")
    if channel == "auto" and not o.virtual:
        raise ConfigError(f"{axis.path}: bus auto is for virtual runs; name the rig's bus with --bus")
    codecs = axis.codecs
    p = conversions.axis_of(axis.config, codecs.command_lsb_v)
    how = backend(axis.config.loop.compiled, p)
    if how.reason:
        print(f"pneud: the law runs in Python: {how.reason}", file=sys.stderr)
    log_file, descriptor = open_log(o.log, axis.config.name)
    try:
        link = open_link(channel, virtual=o.virtual, by=how.carriage)
        if channel != "auto":
            own = (codecs.sync.can_id, codecs.valve_command.can_id)
            refuse_if_driven(link, own, listening_s(axis.config))
        socket = endpoint.bind(axis.config.name, o.socket, virtual=o.virtual)
    except (LinkError, endpoint.PlaceError):
        os.close(descriptor)
        log_file.unlink(missing_ok=True)
        raise
    with link:
        if link.note:
            print(f"pneud: {link.note}", file=sys.stderr)
        try:
            return _run(o, axis, how.axis(p), how, scenario, link, socket, log_file, descriptor, viewers)
        finally:
            socket.path.unlink(missing_ok=True)


def _viewers(where: str) -> tuple[str, int]:
    """Address and port to serve viewers at.

    Raises:
        ConfigError: it is none, or taken, or the package that serves is missing.
    """
    host, colon, port = where.rpartition(":")
    if not colon or not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ConfigError(f"--live-at {where}: must be ADDRESS:PORT, such as 127.0.0.1:8765")
    if importlib.util.find_spec("foxglove") is None:
        raise ConfigError("--live needs foxglove-sdk; install it with: pip install 'pneud[live]'")
    host = host.strip("[]")
    try:
        with socket_.create_server((host, int(port)), family=_family(host)):
            pass
    except OSError as e:
        raise ConfigError(f"--live-at {where}: cannot listen there: {e.strerror}; name another") from None
    return host, int(port)


def _family(host: str) -> socket_.AddressFamily:
    return socket_.AF_INET6 if ":" in host else socket_.AF_INET


def _run(
    o: RunOptions,
    loaded: Loaded,
    axis: Axis,
    how: Backend,
    scenario: Scenario | None,
    link: Link,
    socket: endpoint.Place,
    log_file: Path,
    descriptor: int,
    viewers: tuple[str, int] | None,
) -> int:
    config, path, text, dbc, codecs = loaded
    wanted = config.realtime
    cpu = setup.own_cpu(wanted.cpu)
    ring = Ring.create(pack=how.pack)
    header = LogHeader(
        name=config.name,
        bus=link.name,
        rate_hz=config.loop.rate_hz,
        detail=config.log.detail,
        config_name=path.name,
        config_text=text,
        dbc_name=dbc.name,
        dbc=dbc.read_bytes(),
        fault_names=FAULT_NAMES,
        realtime_offset_ns=link.realtime_offset_ns,
        extra={"law": how.name, **({"seed": str(o.seed)} if o.virtual else {})},
    )
    plant, screen, recorder, console, live, saboteur, truth = 0, 0, 0, 0, 0, 0, None
    stage, report, orders = None, 0, 0
    effects: dict[str, Any] | None = None
    reports: list[setup.Report] = []
    try:
        words, heard = notes.pair()
        asking, taking = handoff.pair()
        reports = [setup.leave_to_the_loop(cpu, wanted.other_cpus)]
        recorder = start_recorder(
            ring,
            descriptor,
            header,
            (path, dbc),
            heard,
            _rotation(config.log, o.log, log_file),
            wanted.recorder_nice,
        )
        # before the others, who must not hold its sockets open
        console = fork_console(
            socket.listener,
            asking,
            words,
            Run(config, path.absolute(), text, link.name, link.note, str(log_file)),
            ring,
        )
        if o.virtual:
            memory = truth_memory()
            truth = TruthReader(memory)
            if scenario is not None:
                report, report_in = os.pipe()
                orders, orders_in = os.pipe()
                stage = Stage(scenario, config.loop.rate_hz, report_in, orders_in)
            plant = fork_plant(
                link.name,
                link,
                conversions.plant_of(config),
                codecs,
                o.seed,
                memory,
                conversions.plant_priority(config.realtime),
                how.advance,
                how.carriage,
                stage,
            )
            if stage is not None and stage.scenario.orders:
                from pneud.scenario.sabotage import Victims, fork_saboteur  # noqa: PLC0415

                kind, _, name = link.name.partition(":")
                victims = Victims(os.getpid(), recorder, plant, name if kind == "socketcan" else "")
                saboteur = fork_saboteur(stage.scenario, orders, victims)
        if not o.headless and sys.stdout.isatty() and not o.json:
            screen = fork_screen(ring, link, config, log_file)
        if viewers is not None:
            live = fork_live(ring, link, header, config, *viewers)
        reports += setup.apply(wanted.priority, cpu, wanted.lock_memory)
        ring.set_notes(setup.as_text(reports))
        fifo = next(r for r in reports if r.name == "fifo")
        loop = Loop(
            axis,
            codecs,
            Inbox(codecs, config.bus),
            link,
            ring,
            options_of(
                config,
                auto_arm=o.virtual or o.arm,
                duration_s=o.duration_s,
                end_on_fault=o.virtual,
                no_realtime=config.realtime.required and not fifo.ok,
            ),
            truth,
            recorder,
            handoff.LoopEnd(taking),
        )
        loop.handle_signals(console)
        loop.run()
    finally:
        ring.set_closed()
        if screen:
            end_screen(screen)
        if saboteur:
            end(saboteur, PATIENCE_S)
        if live:
            end(live, 2.0)
        if plant:
            end(plant, PATIENCE_S if stage is not None else 2.0)
        if stage is not None:
            os.close(stage.report)
            effects = json.loads(os.read(report, 4096) or b"null")
        if console and not wait(console, CONSOLE_PATIENCE_S):
            end(console, 0.0)
        finished = wait(recorder, RECORDER_PATIENCE_S) if recorder else True
    result = None
    if scenario is not None and effects is not None:
        seen = verdict.Seen(loop.ever_present, loop.ever_latched, loop.state, effects["engaged"])
        result = verdict.judge(scenario, config, seen, effects)
    return _report(o, config, loop, ring, log_file, reports, finished, result)


def _rotation(c: LogConfig, option: str | None, log_file: Path) -> Rotation:
    return Rotation(
        path=log_file.absolute(),
        part_bytes=round(c.part_mb * 1e6),
        part_ns=round(c.part_s * 1e9),
        quota_bytes=round(c.quota_mb * 1e6),
        folder=not (option or "").endswith(".mcap"),
        keep_before_ns=round(c.keep_before_s * 1e9),
        keep_after_ns=round(c.keep_after_s * 1e9),
    )


def _report(
    o: RunOptions,
    config: Config,
    loop: Loop,
    ring: Ring,
    log_file: Path,
    reports: list[setup.Report],
    finished: bool,
    result: dict[str, Any] | None,
) -> int:
    status = ring.status()
    # what a recorder that is still at work holds is not lost
    missing = max(0, ring.put_count - status.written) if finished else status.lost
    if not finished:
        print(f"pneud: {log_file} is still being written", file=sys.stderr)
    summary = summarise(
        state=loop.state,
        bus=loop.link.name,
        rate_hz=config.loop.rate_hz,
        ticks=loop.ticks,
        skipped=loop.skipped,
        lateness=loop.lateness,
        latency=loop.latency,
        tracking=loop.tracking,
        counts=loop.inbox.counts(),
        tx=loop.link.tx,
        rx_dropped=loop.link.rx_dropped,
        log=str(log_file),
        log_dropped=missing,
        faults=loop.ever_latched,
    )
    for report in reports:
        if report.asked and not report.ok:
            print(f"pneud: {report.name}: {report.reason}", file=sys.stderr)
    if loop.axis.failure is not None:
        print(f"pneud: exception in the cycle: {loop.axis.failure!r}", file=sys.stderr)
    if missing:
        why = status.error_text or ("the recorder was lost" if loop.recorder_lost else "it could not keep up")
        print(f"pneud: the log lacks {missing} records: {why}", file=sys.stderr)
    if result is not None:
        summary["scenario"] = result
        print(f"pneud: {verdict.in_words(result)}", file=sys.stderr)
    if o.json:
        print(json.dumps(summary))
    else:
        print(in_words(summary))
    wanted = o.virtual or o.arm
    if loop.ever_latched:
        if not o.json:
            print(f"pneud: stopped by {', '.join(names(loop.ever_latched))}", file=sys.stderr)
        return 1
    if not wanted or loop.operated or loop.state == State.TRACKING:
        return 0
    reasons = names(loop.refused | (loop.present & BLOCKS_ARM))
    print(f"pneud: never armed: {', '.join(reasons) or 'the run was too short'}", file=sys.stderr)
    return 1
