"""One run of the daemon: its crew in processes of their own, and the loop in this one."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pneud import crew
from pneud.bus.codec import DatabaseError
from pneud.bus.mapped_inbox import inbox_of
from pneud.bus.shared import identifiers
from pneud.config import conversions
from pneud.config.axes import mirrored, own_text
from pneud.config.models import Config
from pneud.config.sections import ConfigError
from pneud.config.toml import flat
from pneud.console import handoff
from pneud.console.facts import RunFacts
from pneud.console.keeper import fork_shared
from pneud.console.worker import Seat
from pneud.daemon.preparation import AxisReady, Ready, RunOptions
from pneud.loading import devices_of, load_axes, plans_of_nodes, plans_of_plant
from pneud.log.format.header import LogHeader, Rotation
from pneud.log.live.recorder import start_recorder
from pneud.log.live.ring import Ring
from pneud.loop.company import Asking, Company
from pneud.loop.lane import Lane
from pneud.loop.loop import Loop, Nodes
from pneud.loop.options import Options
from pneud.loop.recorder_watch import RecorderWatch
from pneud.loop.stopping import stop_on_signals
from pneud.loop.turn import Turn
from pneud.rig.plant_process import Rig, fork_plant
from pneud.rig.truth import TruthReader, truth_memory
from pneud.rt import setup
from pneud.safety.faults import FAULT_NAMES
from pneud.safety.unnoticed import unnoticed
from pneud.view.info import info_of
from pneud.view.processes import Looked, Seen, fork_screen, fork_viewers

if TYPE_CHECKING:
    from pneud.daemon.places import ViewersPlace
    from pneud.scenario.stage import Stage

RECORDER_PATIENCE_S = 15.0
CONSOLE_PATIENCE_S = 1.0
PLANT_PATIENCE_S = VIEWERS_PATIENCE_S = 2.0
KEEPER_PATIENCE_S = 1.0
SCENARIO_PATIENCE_S = 20.0  # with processes that have a scenario to end


class AxisRun:
    """What a run has of one axis.

    Attributes:
        ready: what it began with.
        ring: from the loop to those who write down, and look on.
        header: of its log.
        recorder: its process id.
        recorded: whether the recorder has finished.
    """

    def __init__(self, ready: AxisReady, header: LogHeader) -> None:
        self.ready = ready
        self.ring = Ring.create(pack=ready.how.pack)
        self.header = header
        self.recorder = 0
        self.recorded = True

    @property
    def config(self) -> Config:
        """Its own."""
        return self.ready.loaded.config

    def end_recorder(self) -> None:
        """Wait for the recorder to finish."""
        self.recorded = crew.wait(self.recorder, RECORDER_PATIENCE_S)


class Session:
    """A run: the crew is started one after the other, and ended in the reverse order whatever happens.

    Attributes:
        ready: what it began with.
        axes: its axes.
        reports: what the machine has granted.
        effects: what plant and bus have shown of the scenario; None where they have told nothing.
        told_to_end: by a signal, at any time until now, so that nothing begins anew.
    """

    def __init__(self, ready: Ready) -> None:
        self.ready = ready
        self.axes = [AxisRun(axis, _header(ready, axis)) for axis in ready.axes]
        self.reports: list[setup.Report] = []
        self.effects: dict[str, Any] | None = None
        self.told_to_end = False

    def run(self) -> Sequence[Lane]:
        """Run until told to stop.

        Returns:
            The axes as they have run.
        """
        with ExitStack() as ends:
            try:
                loop = self._start(ends)
                loop.run()
            finally:
                for axis in self.axes:
                    axis.ring.set_closed()
        return loop.lanes

    def _start(self, ends: ExitStack) -> Loop:
        """Start the crew, and make the loop ready."""
        ready, o, wanted = self.ready, self.ready.options, self.ready.config.realtime
        cpu = setup.own_cpu(wanted.cpu)
        words = [crew.pair() for _ in self.axes]
        asking, taking = crew.pair()
        self.reports = [setup.leave_to_the_loop(cpu, wanted.other_cpus)]
        setup.hurry(wanted.priority)
        for axis, (_, heard) in zip(self.axes, words, strict=True):
            self._start_recorder(ends, axis, heard)
        console = self._start_console(ends, asking, [said for said, _ in words])
        stage = self._stage()
        plant, truths = self._start_plant(ends, stage) if o.virtual else (0, [None] * len(self.axes))
        nodes = self._start_keeper(ends) if any(axis.config.bus.nodes for axis in self.axes) else None
        if ready.viewers is not None:
            self._start_viewers(ends, ready.viewers)
        if stage is not None and stage.scenario.orders:
            self._start_saboteur(ends, stage, plant, console)
        if self._is_shown:
            self._start_screen(ends)
        self.reports += setup.apply(wanted.priority, cpu, wanted.lock_memory)
        for axis in self.axes:
            axis.ring.set_notes(setup.as_text(self.reports))
        loop = self._loop(ends, truths, taking, nodes)

        def stop() -> None:
            self.told_to_end = True
            loop.stop()

        stop_on_signals(stop, console)
        return loop

    @property
    def _is_shown(self) -> bool:
        """Whether there is a screen."""
        o = self.ready.options
        return not o.headless and not o.json and sys.stdout.isatty()

    def _loop(
        self,
        ends: ExitStack,
        truths: Sequence[TruthReader | None],
        taking: socket.socket,
        nodes: Nodes | None,
    ) -> Loop:
        ready, config, o = self.ready, self.ready.config, self.ready.options
        fifo = next(r for r in self.reports if r.name == "fifo")
        options = Options(
            rate_hz=config.loop.rate_hz,
            set_deadline=config.loop.set_deadline,
            spin_us=config.loop.spin_us,
            auto_arm=o.virtual or o.arm,
            duration_s=o.duration_s,
            # somebody who looks on wants to see it, and has keys to go on or to end it
            end_on_fault=o.virtual and not (self._is_shown and os.isatty(0)),
            no_realtime=config.realtime.required and not fifo.ok,
            follow_s=1e-3 * config.bus.sensor_timeout_ms if config.bus.follows else None,
        )
        ring = self.axes[0].ring  # all have the same console
        end = handoff.SharedEnd(taking, consoles_gone=lambda: ring.consoles_gone)
        ends.callback(end.close)  # by which the console sees at once that the run is over
        asking = Asking(end, len(self.axes)) if len(self.axes) > 1 else None
        lanes = []
        for number, (axis, truth) in enumerate(zip(self.axes, truths, strict=True)):
            codecs = axis.ready.loaded.codecs
            turn = Turn(axis.ready.axis, inbox_of(codecs, axis.config.bus), codecs)
            watch = RecorderWatch(axis.ring, axis.recorder)
            operator = end if asking is None else asking.ends[number]
            own = options._replace(unproven=axis.ready.unproven)
            known_ids = identifiers(axis.config, codecs)
            lanes.append(Lane(turn, ready.link, watch, own, truth, operator, known_ids))
        company = Company(lanes, [axis.config for axis in self.axes], asking) if asking is not None else None
        return Loop(lanes, ready.axes[0].loaded.codecs, ready.link, options, nodes, company)

    def _start_recorder(self, ends: ExitStack, axis: AxisRun, heard: socket.socket) -> None:
        loaded = axis.ready.loaded
        axis.recorder = start_recorder(
            axis.ring,
            axis.ready.descriptor,
            axis.header,
            (loaded.path, loaded.dbc),
            heard,
            _rotation(axis.ready, self.ready.options),
            axis.config.realtime.recorder_nice,
            axis.ready.mileage,
        )
        ends.callback(axis.end_recorder)

    def _start_console(self, ends: ExitStack, asking: socket.socket, words: Sequence[socket.socket]) -> int:
        config_file = self.ready.options.config or self.ready.axes[0].loaded.path

        def hindrance() -> str:
            try:
                load_axes(config_file, rate_hz=self.ready.options.rate_hz)
            except (ConfigError, DatabaseError) as e:
                return str(e)
            return ""

        seats = tuple(
            Seat(end, self._facts(axis)._replace(hindrance=hindrance), axis.ring)
            for axis, end in zip(self.axes, words, strict=True)
        )
        console = fork_shared(self.ready.socket.listener, asking, self.ready.name, seats)

        def end() -> None:
            if not crew.wait(console, CONSOLE_PATIENCE_S):
                crew.kill(console)

        ends.callback(end)
        return console

    def _facts(self, axis: AxisRun) -> RunFacts:
        """What screen and console are told."""
        (config, path, text, *_), link = axis.ready.loaded, self.ready.link
        given = (self.ready.options.log or "").endswith(".mcap")
        log, among = str(axis.ready.log_file), len(self.axes)
        facts = RunFacts(config, path.absolute(), text, link.name, link.note, log, given)
        if among == 1:
            return facts
        return facts._replace(
            own=partial(own_text, config.name, self.axes.index(axis), among, mirrored(config))
        )

    def _stage(self) -> Stage | None:
        scenario = self.ready.scenario
        if scenario is None or not self.ready.options.virtual:
            return None
        from pneud.scenario.stage import Stage  # noqa: PLC0415 - for a few runs only

        return Stage(scenario, self.ready.config.loop.rate_hz)

    def _start_plant(self, ends: ExitStack, stage: Stage | None) -> tuple[int, list[TruthReader | None]]:
        seed, priority = self.ready.options.seed, conversions.plant_priority(self.ready.config.realtime)
        rigs = [
            Rig(
                conversions.plant_of(axis.config),
                axis.ready.loaded.codecs,
                seed + number,
                priority,
                axis.ready.how.advance,
                axis.ready.how.carriage,
                plans_of_plant(axis.ready.loaded),
                axis.config.plant.odd_nodes,
                axis.config.name,
                conversions.beam_of(axis.config),
            )
            for number, axis in enumerate(self.axes)
        ]
        memories = [truth_memory() for _ in rigs]
        plant = fork_plant(self.ready.link.name, rigs, memories, stage, to=self.ready.struck)

        def end() -> None:
            crew.end(plant, PLANT_PATIENCE_S if stage is None else SCENARIO_PATIENCE_S)
            if stage is not None:
                self.effects = stage.effects()

        ends.callback(end)
        return plant, [TruthReader(memory) for memory in memories]

    def _start_keeper(self, ends: ExitStack) -> Nodes:
        """Have the nodes configured; the loop runs meanwhile, and nothing is armed."""
        from pneud.canopen.keeper import Readiness, fork_keeper  # noqa: PLC0415 - for rigs with nodes only

        each = [plans_of_nodes(axis.ready.loaded) for axis in self.axes]
        readiness = Readiness([{plan.node.id for plan in plans} for plans in each])
        plans = tuple(plan for plans in each for plan in plans)
        keeper = fork_keeper(self.ready.link.name, plans, readiness)

        def end() -> None:
            if not readiness.lost:  # its number may be another process's by now
                crew.end(keeper, KEEPER_PATIENCE_S)

        ends.callback(end)
        return readiness

    def _start_viewers(self, ends: ExitStack, at: ViewersPlace) -> None:
        several = len(self.axes) > 1
        looked = [
            Looked(
                axis.ring,
                axis.header,
                flat(axis.config.model_dump(mode="json", by_alias=True)),
                axis.config.name if several else "",
            )
            for axis in self.axes
        ]
        viewers = fork_viewers(looked, self.ready.name, at.listener, at.admission)
        ends.callback(crew.end, viewers, VIEWERS_PATIENCE_S)

    def _start_saboteur(self, ends: ExitStack, stage: Stage, plant: int, console: int) -> None:
        from pneud.scenario.sabotage import Victims, fork_saboteur  # noqa: PLC0415 - for a few runs only

        kind, _, name = self.ready.link.name.partition(":")
        interface, socket = name if kind == "socketcan" else "", str(self.ready.socket.path)
        recorder = self.axes[self.ready.struck].recorder
        victims = Victims(os.getpid(), recorder, plant, console, socket, interface)
        saboteur = fork_saboteur(stage.scenario, stage.orders, victims)
        ends.callback(crew.end, saboteur, SCENARIO_PATIENCE_S)

    def _start_screen(self, ends: ExitStack) -> None:
        # a service has no screen, and begins without what it takes
        from pneud.console.client import Client  # noqa: PLC0415
        from pneud.console.operator import Operator  # noqa: PLC0415
        from pneud.safety.cause import first_cause  # noqa: PLC0415
        from pneud.view.hands import Leaving  # noqa: PLC0415

        ready, several = self.ready, len(self.axes) > 1
        viewers, socket = ready.viewers, str(ready.socket.path)
        note = " · ".join(filter(None, (ready.link.note, viewers.note if viewers is not None else "")))
        seen = []
        for axis in self.axes:
            info = info_of(self._facts(axis)._replace(note=note).page(), first_cause, _elsewhere(ready))
            whose = axis.config.name if several else None
            seen.append(Seen(axis.ring, info, Operator(partial(Client, socket, whose))))
        daemon, asks = os.getpid(), "" if ready.options.virtual else "End the daemon, with a controlled stop?"
        leaving = Leaving("end", lambda: os.kill(daemon, signal.SIGINT), ends_view=False, asks=asks)
        screen = fork_screen(seen, leaving)
        ends.callback(screen.end)


def _elsewhere(ready: Ready) -> str:
    """The command that shows the run in another terminal, as it was called itself."""
    import shlex  # noqa: PLC0415

    program = sys.argv[0] if Path(sys.argv[0]).name == "pneud" else "pneud"
    if (found := shutil.which("pneud")) and Path(program).exists() and Path(found).samefile(program):
        program = "pneud"
    given = ready.options.socket
    return f"{program} top" + (f" --socket {shlex.quote(given)}" if given else "")


def _header(ready: Ready, axis: AxisReady) -> LogHeader:
    config, path, text, dbc, _ = axis.loaded
    o = ready.options
    several = {"daemon": ready.name, "axes": ", ".join(one.loaded.config.name for one in ready.axes)}
    return LogHeader(
        name=config.name,
        bus=ready.link.name,
        rate_hz=config.loop.rate_hz,
        detail=config.log.detail,
        config_name=path.name,
        config_text=text,
        dbc_name=dbc.name,
        dbc=dbc.read_bytes(),
        fault_names=FAULT_NAMES,
        realtime_offset_ns=ready.link.realtime_offset_ns,
        extra={
            "law": axis.how.name,
            "unnoticed": " ".join(one.name for one in unnoticed(devices_of(config, axis.loaded.codecs))),
            **{what: " ".join(names) for what, names in config.bus.switches.items() if names},
            **({"seed": str(o.seed)} if o.virtual else {}),
            **({"scenario": ready.scenario.name} if ready.scenario is not None else {}),
            **({"movement_test": "not asked for: --unproven"} if o.unproven else {}),
            **(several if len(ready.axes) > 1 else {}),
        },
    )


def _rotation(axis: AxisReady, o: RunOptions) -> Rotation:
    c = axis.loaded.config.log
    return Rotation(
        path=axis.log_file.absolute(),
        part_bytes=round(c.part_mb * 1e6),
        part_ns=round(c.part_s * 1e9),
        quota_bytes=round(c.quota_mb * 1e6),
        folder=not (o.log or "").endswith(".mcap"),
        keep_before_ns=round(c.keep_before_s * 1e9),
        keep_after_ns=round(c.keep_after_s * 1e9),
    )
