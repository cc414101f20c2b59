"""Who plays: the shipped session with its crew, a rig, operators, a manager that starts the daemon again."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from greenlet import GreenletExit
from rich.console import Console

from pneud import crew
from pneud.bus.link import Link, LinkError, refuse_if_driven
from pneud.compiled.backend import Backend
from pneud.config import conversions
from pneud.console.client import Client, RefusedError
from pneud.console.endpoint import Endpoint, PlaceError
from pneud.daemon.preparation import AxisReady, Ready, RunOptions
from pneud.daemon.result import tell
from pneud.daemon.session import Session
from pneud.loading import Loaded, listening_s, plans_of_plant
from pneud.log.files.naming import LogError, open_log
from pneud.log.live.notes import Teller
from pneud.log.live.ring import Ring
from pneud.loop.loop import Loop
from pneud.prove import lookers
from pneud.prove.axis_judge import Session as Kept
from pneud.prove.canbus import CanBus
from pneud.prove.disk import Disk, File
from pneud.prove.doors import Terminal, TracebackDoor
from pneud.prove.judge import Judge
from pneud.prove.manager import Manager
from pneud.prove.pipes import Listener, Socket
from pneud.prove.plan import Item, Plan
from pneud.prove.world import FOREVER_NS, START_NS, Process, World
from pneud.rig.node import PlantNode
from pneud.rig.plant_process import Rig, answer
from pneud.rt import setup
from pneud.signals import Record

SLOTS = 2048  # of the ring: seconds, at the rate of a run
SETTLES_NS = 200_000_000  # from the rig's beginning until it answers
CATCHES_UP_NS = 300_000_000  # that it takes to pass over what it has been asked while it stood
LOADING_S = (0.0, 0.01, 0.1, 1.0)  # that a process takes at most to load what it needs
AGAIN_S = 0.5  # from a daemon's death to the next one
PATIENCE_S = 5.0  # of an operator
_NOT_SAID = ("who", "verb", "patience_s")
CREW = ("daemon", "recorder", "keeper", "console", "plant", "screen", "nodes", lookers.NAME)
_MANAGER_S = 0.05


class Begin(NamedTuple):
    """What a run begins with."""

    file: Path  # of the configuration
    text: str  # that it has
    axes: tuple[Loaded, ...]
    hows: tuple[Backend, ...]  # each is computed


class Cast:
    """All actors of a run, and what the world needs to know of them."""

    def __init__(self, plan: Plan, world: World, bus: CanBus, disk: Disk, judge: Judge, begin: Begin) -> None:
        self.plan, self.world, self.bus, self.disk, self.judge = plan, world, bus, disk, judge
        self.begin = begin
        self.manager, self.terminal = Manager(judge), Terminal(world)
        self.viewers = lookers.Viewers(judge)
        self.listener: Listener | None = None
        self.daemon: Process | None = None
        self.rig: Process | None = None
        self.finishing = False
        self._alone = len({i.what["who"] for i in plan.items if i.kind == "operator"}) == 1
        self._again_ns = 0
        self._rig_well_ns = FOREVER_NS
        judge.rig_is_well = self._rig_is_well
        disk.on_sync = self._on_sync

    # what takes the place of functions that ask the kernel

    def adapters(self) -> dict[str, Any]:
        """By module and name."""
        ok = [setup.Report(name, True, "a world of its own") for name in ("gc", "fifo")]

        class WatchedRing(Ring):
            """A ring, of whose records a judge is told."""

            told: Callable[[Record], None]

            @classmethod
            def create(cls, slots: int = SLOTS, slot_bytes: int = 1024, pack: Any = None) -> Any:
                made = super().create(slots, slot_bytes, pack)
                os.close(made.descriptor)  # nobody attaches
                made.descriptor = -1
                return made

            def put(self, record: Record) -> None:
                super().put(record)
                self.told(record)

        folder = f"{self.begin.file.parent}/"

        class Words(Teller):
            """Words for the log, which say nothing of where the configuration lies."""

            def say(self, level: int, words: str) -> None:
                super().say(level, words.replace(folder, ""))

        return {
            "pneud.crew.fork": self._fork,
            "pneud.crew.die_with_parent": self._die_with_parent,
            "pneud.rt.setup.own_cpu": lambda *_: None,
            "pneud.rt.setup.leave_to_the_loop": lambda *_: setup.Report("cpus", True, "", asked=False),
            "pneud.rt.setup.hurry": lambda *_: None,
            "pneud.rt.setup.apply": lambda *_: list(ok),
            "pneud.daemon.session.Ring": WatchedRing,
            "pneud.daemon.result.print": lambda *_, **__: None,
            "pneud.log.live.recorder.print": lambda *_, **__: None,
            "pneud.console.worker.Teller": Words,
            "pneud.console.worker.print": lambda *_, **__: None,
            "pneud.console.status_reply.print": lambda *_, **__: None,
            "pneud.console.server.commanding_group": lambda: None,
            "pneud.console.processes.children_of": lambda _: [],
            "pneud.console.processes.counters_of": lambda *_: None,
            "pneud.console.commands.counters_of": lambda *_: None,
            "pneud.console.client.find": self._find,
            "pneud.rig.plant_process.open_link": lambda *_, **__: self.bus.link("rig"),
            "pneud.rig.plant_process.PlantNode": self._node,
            "pneud.view.terminal.Console": lambda **_: Console(file=self.terminal, highlight=False),
            **self._of_nodes(),
            **(lookers.adapters() if self.plan.viewed else {}),
        }

    def _of_nodes(self) -> dict[str, Any]:
        """The same, where there are nodes that have to be configured."""
        nodes = self.judge.nodes
        if nodes is None:
            return {}
        from pneud.prove import canlib  # noqa: PLC0415 - what it takes is loaded for few seeds only
        from pneud.rig.canopen import CanopenRig  # noqa: PLC0415

        def front(*args: Any, **kwargs: Any) -> CanopenRig:
            nodes.front = CanopenRig(*args, **kwargs)
            return nodes.front

        return {"pneud.rig.canopen.CanopenRig": front, **canlib.adapters(self.world, self.bus)}

    def _fork(
        self,
        main: crew.Main,
        *,
        keep: Iterable[int] = (),
        terminal: bool = False,  # noqa: ARG002 - there is none
        orphaned: int | None = signal.SIGKILL,
        name: str = "",
        known: tuple[type[Exception], ...] = (),
    ) -> int:
        """As `crew.fork`."""
        world = self.world
        world.step()
        parent = world.me().process
        loading_s = world.rng.choice(LOADING_S) * world.rng.random()

        def life() -> int:
            crew.ignore_group_signals()
            if orphaned is not None:
                child.handlers[int(signal.SIGTERM)] = signal.SIG_DFL
            world.sleep_until(world.now_ns + round(loading_s * 1e9))
            return self._lived(main, known)

        if name == "plant":
            self._rig_well_ns = FOREVER_NS  # until it has nodes
        child = world.spawn(life, name, parent.pid)
        child.orphaned = None if orphaned is None else int(orphaned)
        child.handlers, child.blocked = dict(parent.handlers), parent.blocked
        for number in keep:
            thing = world.things.get(number)
            if thing is not None:
                thing.share(child.pid)
        return child.pid

    def _lived(self, main: crew.Main, known: tuple[type[Exception], ...] = ()) -> int:
        """Run the life of a process; what it dies of is a finding, unless it is the machine's refusal."""
        world = self.world
        try:
            return main() or 0
        except GreenletExit:
            raise
        except Exception as e:
            if isinstance(e, (OSError, *known)):
                # where the folder lies is not the seed's
                world.note(f"refused: {str(e).replace(f'{self.disk.root}/', '')}")
            else:
                TracebackDoor(world).print_exc()
        return 1

    def _die_with_parent(self, parent: int, number: int = signal.SIGKILL) -> None:
        me = self.world.me().process
        me.orphaned = int(number)
        if me.ppid != parent:
            self.world.kill(me.pid, number)

    def _find(self, _: str | None) -> Socket:
        if self.listener is None:
            raise PlaceError("no daemon")
        try:
            return self.listener.call()
        except OSError as e:
            raise PlaceError(str(e)) from None

    def _node(self, *args: Any, **kwargs: Any) -> PlantNode:
        node = PlantNode(*args, **kwargs)
        whose = next(axis for axis in self.judge.axes if node.takes(axis.command_id))
        whose.node = node
        self._rig_well_ns = self.world.now_ns + SETTLES_NS
        return node

    def _on_sync(self, file: File) -> Callable[[], None]:
        """What the recorder had said to have written when a sync began is there when it is done."""
        session = next((one for one in self.judge.sessions if one.log == file.path), None)
        if session is None:
            return lambda: None
        written = session.ring.status().written
        return lambda: setattr(session, "durable", max(session.durable, written))

    # actors

    def start(self) -> None:
        """Have all begin."""
        if not self.plan.virtual:
            self._start_rig()
        self.world.at(self.world.now_ns + 100_000_000, self._start_daemon)
        self.world.at(self.world.now_ns + 200_000_000, self._manage)
        for operator in {item.what["who"]: None for item in self.plan.items if item.kind == "operator"}:
            items = [i for i in self.plan.items if i.kind == "operator" and i.what["who"] == operator]
            self.world.spawn(partial(self._operator, items), f"operator {operator}")

    def _rig_is_well(self) -> bool:
        rigs = self.world.named(("rig", "plant"))
        now_ns = self.world.now_ns
        stand = any(one.stopped or now_ns < one.continued_ns + CATCHES_UP_NS for one in rigs)
        return bool(rigs) and not stand and now_ns > self._rig_well_ns

    def _start_rig(self) -> None:
        self.rig = self.world.spawn(lambda: self._lived(self._be_the_rig), "rig")
        self._rig_well_ns = FOREVER_NS  # until it has nodes

    def _be_the_rig(self) -> None:
        rigs = [
            Rig(
                conversions.plant_of(axis.config),
                axis.codecs,
                self.plan.seed + number,
                0,
                how.advance,
                how.carriage,
                plans_of_plant(axis),
            )
            for number, (axis, how) in enumerate(zip(self.begin.axes, self.begin.hows, strict=True))
        ]
        stop = crew.asked_to_leave(signal.SIGTERM)
        with self.bus.link("rig") as link:
            answer(link, rigs, None, stop)

    def _start_daemon(self) -> None:
        def life() -> int:
            return self._lived(self._be_the_daemon, (LinkError, LogError))

        self.manager.begins()
        self.daemon = self.judge.daemon = self.world.spawn(life, "daemon")

    def _be_the_daemon(self) -> int:
        """As `pneud` does it, from what it has prepared on."""
        while True:
            with self.bus.link("loop") as link:
                session = self._session(link)
                lanes = session.run()
                status = tell(session, lanes)
            self.judge.ended(status)
            again = not session.told_to_end and any(lane.again for lane in lanes)
            if self.plan.service:
                self.manager.ended(again=again)
            if not again:
                return status
            self.world.me().process.handlers.clear()  # as a program that begins anew has none

    def _session(self, link: Link) -> Session:
        plan, axes = self.plan, self.begin.axes
        options = RunOptions(
            config=str(self.begin.file), bus="prove", virtual=plan.virtual, arm=False, duration_s=None,
            rate_hz=None, headless=True, json=False, log=str(self.disk.root), scenario=None, seed=plan.seed,
            socket=None, live=None, unproven=False,
        )  # fmt: skip
        ready = []
        for loaded, how in zip(axes, self.begin.hows, strict=True):
            wall_s = (self.world.now_ns + self.world.wall_ns) * 1e-9
            log, descriptor = open_log(options.log, loaded.config.name, wall_s)
            axis = how.axis(conversions.axis_of(loaded.config, loaded.codecs.command_lsb_v))
            ready.append(AxisReady(loaded, how, axis, log, descriptor, plan.unproven, None))
        self.listener = Listener(self.world)
        own = [axes[0].codecs.sync.can_id, *(loaded.codecs.valve_command.can_id for loaded in axes)]
        refuse_if_driven(link, own, listening_s(axes[0].config))
        all_ready = Ready(
            options,
            self.begin.file.stem,
            tuple(ready),
            None,
            0,
            link,
            Endpoint(self.listener, Path("prove.sock"), -1),  # type: ignore[arg-type]
            lookers.place(self.world) if plan.viewed else None,
        )
        return _Watched(all_ready, self)

    def _operator(self, items: Sequence[Item]) -> int:
        """Ask for one thing after the other; who is not heard calls again."""
        client: Client | None = None
        world = self.world
        attending: set[str] = set()
        for item in items:
            world.sleep_until(START_NS + round(item.at_s * 1e9))
            verb = item.what["verb"]
            fields = {name: value for name, value in item.what.items() if name not in _NOT_SAID}
            try:
                if verb == "leave":
                    if client is not None:
                        client.close()
                    for axis in self.judge.axes:
                        if axis.name in attending and self._alone:
                            axis.leaves()
                    client = None
                    attending.clear()
                    continue
                if client is None:
                    client = Client()
                client._connection.settimeout(item.what.get("patience_s", PATIENCE_S))
                world.note(f"asks {verb}")
                asked = self.judge.asks(verb, **{"axis": None, **fields})
                try:
                    reply = client.ask(verb, **fields)
                finally:
                    asked.until_ns = world.now_ns
                self.judge.told("load" if fields.get("load") else verb, reply)
                if "order" in reply:
                    attending.difference_update(whose := reply.get("axes") or [reply["axis"]])
                    attending.update(whose if verb == "jog" or fields.get("attended") else ())
            except RefusedError as e:
                world.note(f"refused: {e.kind}")
            except PlaceError as e:
                world.note(f"not heard: {e}")
                if client is not None:
                    client.close()
                client = None
        return 0

    # the manager of services, and of power

    def _manage(self) -> None:
        """Look after daemon and rig, from time to time."""
        world, daemon = self.world, self.daemon
        self.judge.look()
        if self.plan.service:
            self.manager.look()
        world.at(world.now_ns + round(_MANAGER_S * 1e9), self._manage)
        if self.finishing:
            return
        if self.rig is not None and not self.rig.alive:
            self._start_rig()
        if daemon is not None and not daemon.alive:
            if not self._again_ns:
                self._again_ns = world.now_ns + round(AGAIN_S * 1e9)
            elif world.now_ns >= self._again_ns and not world.named(CREW):
                self._again_ns = 0
                self._start_daemon()

    def cut_power(self) -> None:
        """The machine is without power: nobody does anything, and the disk has what it has."""
        self.world.note("power is cut")
        for process in self.world.named(CREW):
            process.orphaned = None
        for process in self.world.named(CREW):
            self.world.die(process, int(signal.SIGKILL))
        for session in self.judge.sessions:
            session.cut = True
        self.disk.cut()


class _Watched(Session):
    """The session, whose loop the judge knows."""

    def __init__(self, ready: Ready, cast: Cast) -> None:
        super().__init__(ready)
        self._judge = cast.judge
        self._shown = cast.plan.shown

    @property
    def _is_shown(self) -> bool:
        return self._shown

    def _loop(self, *args: Any) -> Loop:
        loop, (_, _, asking, _), judge = super()._loop(*args), args, self._judge
        judge.begins(
            [
                Kept(
                    *(lane, axis.ring, axis.ready.log_file, axis.recorder, asking),
                    axis.header.realtime_offset_ns,
                )
                for lane, axis in zip(loop.lanes, self.axes, strict=True)
            ]
        )
        for axis, looks in zip(self.axes, judge.axes, strict=True):
            axis.ring.told = looks.decided  # type: ignore[attr-defined]
        return loop
