"""What goes wrong, as a plan says: done to the world at its time."""

from __future__ import annotations

import signal
from collections.abc import Callable
from functools import partial
from typing import Any

from pneud.bus.wire import CAN_ERR_FLAG
from pneud.prove.axis_judge import AxisJudge
from pneud.prove.canbus import ALL, Trouble
from pneud.prove.cast import Cast
from pneud.prove.plan import Item
from pneud.prove.program_judge import START
from pneud.prove.world import START_NS, Actor, Process

_NS = 1e9
NMT_ID = 0


class Troubles:
    """Does to a world what a plan says."""

    def __init__(self, cast: Cast) -> None:
        self._cast, self._world = cast, cast.world
        self._file, self._good = cast.begin.file, cast.begin.text

    def begin(self) -> None:
        """Have everything happen at its time."""
        for item in self._cast.plan.items:
            if item.kind != "operator":
                self._world.at(START_NS + round(item.at_s * _NS), partial(self._do, item))

    def _do(self, item: Item) -> None:
        if not self._cast.finishing:
            self._world.note(f"* {item.kind} {item.what}")
            does: Callable[[Item], None] = getattr(self, f"_{item.kind}")
            does(item)

    def heal(self) -> None:
        """All is well again, and nothing more goes wrong."""
        cast, world = self._cast, self._world
        cast.finishing = True
        cast.bus.troubles.clear()
        cast.bus.down = cast.bus.full = False
        cast.disk.heal()
        cast.manager.deaf_until_ns = cast.terminal.stands_until_ns = 0
        self._file.write_text(self._good, encoding="utf-8")
        for process in list(world.processes.values()):
            for actor in process.actors:
                actor.fuse = None
            if process.stopped and process.alive:
                world.send(process, signal.SIGCONT)

    # processes

    def _victims(self, who: str) -> list[Process]:
        return self._world.named((who, "plant") if who == "rig" else (who,))

    def _hit(self, item: Item, who: str, hit: Callable[[Process], None]) -> None:
        """Do something to a process, at once or when it has taken so many steps."""
        victims, step = self._victims(who), item.what["step"]
        nth = item.what.get("axis", 0)
        for victim in victims[nth : nth + 1] or victims[:1]:
            actor: Actor = victim.actors[0]
            if step:
                actor.fuse = step, partial(hit, victim)
            else:
                hit(victim)

    def _kill(self, item: Item) -> None:
        def kill(victim: Process) -> None:
            self._world.note(f"kills {victim.name} {victim.pid}")
            self._world.send(victim, signal.SIGKILL)

        self._hit(item, item.what["who"], kill)

    def _terminate(self, item: Item) -> None:
        self._hit(item, "daemon", lambda victim: self._world.send(victim, signal.SIGTERM))

    def _stop(self, item: Item) -> None:
        world = self._world

        def stop(victim: Process) -> None:
            world.note(f"stops {victim.name} {victim.pid}")
            world.send(victim, signal.SIGSTOP)
            world.at(
                world.now_ns + round(item.what["for_s"] * _NS), lambda: world.send(victim, signal.SIGCONT)
            )

        self._hit(item, item.what["who"], stop)

    def _hangup(self, item: Item) -> None:
        match item.what["file"]:
            case "good":
                self._file.write_text(self._good, encoding="utf-8")
            case "bad":
                self._file.write_text(self._good + "\n[nonsense\n", encoding="utf-8")
            case "other":
                text = self._good.replace("k1 = 95000.0", "k1 = 90000.0")
                self._file.write_text(text, encoding="utf-8")
            case _:
                self._file.unlink(missing_ok=True)
        for daemon in self._victims("daemon"):
            self._world.send(daemon, signal.SIGHUP)

    def _power(self, _: Item) -> None:
        self._cast.cut_power()

    def _deaf(self, item: Item) -> None:
        manager, now_ns = self._cast.manager, self._world.now_ns
        if now_ns > manager.deaf_until_ns + _NS:  # else it would not hear in time who is told again and again
            manager.deaf_until_ns = now_ns + round(0.5 * item.what["for_s"] * _NS)

    def _terminal(self, item: Item) -> None:
        self._cast.terminal.stands_until_ns = self._world.now_ns + round(10.0 * item.what["for_s"] * _NS)

    def _look(self, item: Item) -> None:
        self._cast.viewers.looks(item.what["who"], item.what["topic"], on=item.what["on"])

    # clocks, disks

    def _clock(self, item: Item) -> None:
        self._world.wall_ns += round(item.what["by_s"] * _NS)

    def _disk(self, item: Item) -> None:
        disk, world = self._cast.disk, self._world
        match item.what["state"]:
            case "full":
                disk.room = item.what["room"]
            case "failing":
                disk.failing = True
            case "short":
                disk.short = True
            case "removed":
                session = self._axis(item).session
                if session is not None and not session.ring.status().finished:
                    session.log.unlink(missing_ok=True)
                    session.removed = True
            case "forgets":
                disk.forgets = True
            case _:
                disk.sync_ns = round(item.what["for_s"] * _NS)
        world.at(world.now_ns + round(item.what["for_s"] * _NS), disk.heal)

    # the bus

    def _bus(self, item: Item) -> None:
        w, world = item.what, self._world
        until_ns = world.now_ns + round(w["for_s"] * _NS)
        by_ns, whose = round(w["by_s"] * _NS), w.get("axis", ALL)
        trouble = Trouble(w["trouble"], until_ns, w["share"], by_ns, w["towards"], whose)
        self._cast.bus.troubles.append(trouble)

    def _interface(self, item: Item) -> None:
        bus = self._cast.bus
        if bus.party("loop") is None:
            return
        down = item.what["state"] == "down"
        bus.down, bus.full = bus.down or down, bus.full or not down
        for party in bus.parties:
            if party.down:
                self._world.happens(party.readable)

        def up() -> None:
            bus.down = bus.full = False

        self._world.at(self._world.now_ns + round(item.what["for_s"] * _NS), up)

    def _repeat(self, item: Item, every_s: float, does: Callable[[], None]) -> None:
        world, until_ns = self._world, self._world.now_ns + round(item.what["for_s"] * _NS)

        def once() -> None:
            if world.now_ns < until_ns and not self._cast.finishing:
                does()
                world.at(world.now_ns + round(every_s * _NS), once)

        once()

    def _babble(self, item: Item) -> None:
        codecs, draw = self._axis(item).codecs, self._world.rng
        kind = item.what["id"]
        can_id = {
            "command": codecs.valve_command.can_id,
            "sync": codecs.sync.can_id,
            "answer": codecs.answers[0].codec.can_id,
            "emcy": 0x081,
        }.get(kind, 0x7FF)

        def frame() -> None:
            self._trouble(item if kind in ("command", "answer") else None)
            data = draw.randbytes(8)
            if kind == "command":
                data = codecs.valve_command.encode(5.0, 1, 1, counter=draw.randrange(4))
            self._cast.bus.carry(None, can_id | (CAN_ERR_FLAG if draw.random() < 0.05 else 0), data)

        self._repeat(item, item.what["every_s"], frame)

    def _axis(self, item: Item) -> AxisJudge:
        """Whom it happens to."""
        axes = self._cast.judge.axes
        return axes[max(0, int(item.what.get("axis", 0)))]

    def _trouble(self, item: Item | None) -> None:
        """The bus is not as it should be just now, for an axis or for all."""
        whose = self._cast.judge.axes.index(self._axis(item)) if item is not None else ALL
        until_ns = self._world.now_ns + 20_000_000
        self._cast.bus.troubles.append(Trouble("babble", until_ns, 0.0, 0, "", whose))

    def _echo(self, item: Item) -> None:
        """A node answers twice: what was heard comes again."""
        bus, world, codecs = self._cast.bus, self._world, self._axis(item).codecs
        ids = {answer.codec.can_id for answer in codecs.answers}
        until_ns, by_ns = world.now_ns + round(item.what["for_s"] * _NS), round(item.what["by_s"] * _NS)
        before: Any = bus.on_frame

        def on_frame(sender: str, can_id: int, data: bytes) -> None:
            before(sender, can_id, data)
            mine = sender == "rig" and can_id in ids
            if mine and world.now_ns < until_ns and not self._cast.finishing:
                self._trouble(item)
                world.at(world.now_ns + by_ns, lambda: bus.carry(None, can_id, data))

        bus.on_frame = on_frame

    def _node(self, item: Item) -> None:
        node, nodes = self._axis(item).node, self._cast.judge.nodes
        if nodes is not None:
            self._reboots(item, 0.0)
        elif node is not None:
            self._trouble(item)
            node.reboot(item.what["node"])

    def _press(self, item: Item) -> None:
        """Somebody presses start, and lets it go."""
        axis = self._axis(item)
        node = axis.node
        if axis.programs is None or node is None or node.station is None:
            return
        station, mask = node.station, node.station.bit_of(START)
        if not station.inputs & mask:
            axis.programs.press()
        station.inputs |= mask

        def let_go() -> None:
            station.inputs &= ~mask

        self._world.at(self._world.now_ns + round(item.what["for_s"] * _NS), let_go)

    def _slave(self, item: Item) -> None:
        self._reboots(item, item.what["boot_s"])

    def _reboots(self, item: Item, boot_s: float) -> None:
        nodes = self._cast.judge.nodes
        if nodes is not None and nodes.front is not None:
            self._trouble(item)
            slave = nodes.front.slaves[item.what["node"]]
            slave.odd = slave.odd._replace(boot_ms=1e3 * boot_s)
            slave.power_up(self._world.now_ns)

    def _nmt(self, item: Item) -> None:
        """Somebody else is a master of the network, too."""
        self._trouble(item)
        self._cast.bus.carry(None, NMT_ID, bytes((item.what["command"], item.what["node"])))

    # clients

    def _client(self, item: Item) -> None:
        does, size = item.what["does"], item.what["size"]
        cast, world = self._cast, self._world

        def life() -> int:
            if cast.listener is None:
                return 0
            try:
                ends = [cast.listener.call() for _ in range(40 if does == "crowd" else 1)]
                for end in ends:
                    end.setblocking(False)
                data = world.rng.randbytes(size) if does == "garbage" else b'{"v":1,"id":1,"verb":"status"}\n'
                if does == "half":
                    data = b'{"v":1,"id":1,"verb":"arm"'
                for _ in range(200 if does == "mute" else 1):
                    for end in ends:
                        end.send(data)
                    world.sleep_until(world.now_ns + 5_000_000)
                world.sleep_until(world.now_ns + 3_000_000_000)
            except OSError as e:
                world.note(f"client {does}: {e}")
            return 0

        world.spawn(life, "client")
