"""Oracles: what has to be so at every step, whatever the seed; told by frames on the bus and the rig."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from pneud.bus.codec import Codecs
from pneud.config.models import Config
from pneud.log.live.ring import Ring
from pneud.loop.loop import Loop
from pneud.prove.canbus import CanBus
from pneud.prove.world import START_NS, Process, World
from pneud.rig.node import PlantNode
from pneud.safety.faults import BLOCKS_ARM, CENTRES, F
from pneud.safety.supervisor import ENGAGES, STEERS, is_engaged
from pneud.signals import (
    ALL_SOURCES,
    Answer,
    Defect,
    Host,
    Record,
    Request,
    RequestKind,
    Source,
    State,
    Tick,
    ValveState,
)

PATIENCE_TICKS = 2
END_S = 30.0  # after which a run that was told to end has to have ended
QUEUE_BYTES = 512 * 1024
CALM_TICKS = 20  # without any trouble, before what comes without any has to be there
STEP_TICKS = 4  # after which a step of the wall clock has to be followed
SETTLES_NS = 50_000_000  # after a trouble of the bus: a frame may still be on its way
LATE_NS = 205_000_000  # after which a request that waits for the loop is turned away
DEATH_S = 0.9  # after which the loop has to have seen that a console or a recorder is gone
ASKED_NS = 1_700_000_000  # console and loop turn away what is older
_TAKEN = int(Answer.TAKEN)
_NEVER_LATE = (int(RequestKind.STOP), int(RequestKind.DISARM))
_UNPROVEN, _CONSOLE_LOST = int(Host.UNPROVEN), int(Host.CONSOLE_LOST)
_RECORDER_LOST, _LOG_LOST = int(Host.RECORDER_LOST), int(Host.RECORDER_LOST | Host.DISK_FULL)
_ENABLED = ValveState.ENABLED
_ENCODER, _PRESSURE, _ODD = int(Source.ENCODER), int(Source.PRESSURE), int(Defect.ODD)
_COMMANDS = frozenset((*ENGAGES, *STEERS, int(RequestKind.RUN)))
_LED = (int(State.MOVING), int(State.TRACKING), int(State.PRESSING))
_ACKNOWLEDGED = {
    verb: int(RequestKind[verb.upper()])
    for verb in ("arm", "disarm", "stop", "hold", "goto", "jog", "track", "force", "clear", "mark", "restart")
}
_ENGAGING = ("arm", "track", "home", "probe")


class Finding(NamedTuple):
    """An oracle that says no."""

    oracle: str
    words: str
    t_s: float
    step: int

    def __str__(self) -> str:
        return f"{self.oracle}: {self.words} (at {self.t_s:.6f} s, step {self.step})"


class Taken(NamedTuple):
    """What the log has to say of a tick."""

    t_ns: int
    state: int
    voltage_v: float
    answer: int


class Session:
    """One run of the loop: what it has decided, and what is kept of it.

    Attributes:
        loop: it.
        ring: of its records.
        log: its file.
        ticks: that were recorded, in order.
        durable: records that the disk was known to have.
        cut: power was cut, so that only what is durable has to be there.
        removed: somebody has removed the log.
    """

    def __init__(self, loop: Loop, ring: Ring, log: Path) -> None:
        self.loop, self.ring, self.log = loop, ring, log
        self.ticks: list[Taken] = []
        self.durable = 0
        self.cut = self.removed = False


class Judge:
    """Looks at everything, and says no.

    Attributes:
        found: what has been found; the first one ends a run.
        sessions: of the daemon, one after the other.
        node: the rig's nodes.
        daemon: the process of the loop that runs.
        engaged_ticks: of all sessions.
    """

    def __init__(self, world: World, bus: CanBus, config: Config, codecs: Codecs, *, by_itself: bool) -> None:
        """Nothing has happened.

        Args:
            world: all of it.
            bus: of the axis.
            config: of the axis.
            codecs: of its frames.
            by_itself: the run may arm the axis.
        """
        self.found: list[Finding] = []
        self.sessions: list[Session] = []
        self.node: PlantNode | None = None
        self.daemon: Process | None = None
        self.rig_is_well: Callable[[], bool] = lambda: True
        self.engaged_ticks = 0
        self._world, self._bus, self._config, self._codecs = world, bus, config, codecs
        self._by_itself = by_itself
        self._period_ns = round(1e9 / config.loop.rate_hz)
        self._wait_ns = round(self._period_ns * config.loop.set_deadline)
        self._timeout_ns = round(1e6 * config.bus.sensor_timeout_ms)
        self._valve_ns = round(1e6 * config.bus.valve_timeout_ms)
        self._slew_v = config.limits.slew_v_s / config.loop.rate_hz
        self._wall_ns = world.wall_ns
        self._idle_ns = 0  # since when nothing is engaged
        self._asked: deque[tuple[int, str]] = deque(maxlen=64)  # when, verb
        self._acknowledged: Counter[int] = Counter()
        self._done: Counter[int] = Counter()
        world.on_death = self._died
        self._begin()

    def _begin(self) -> None:
        self._last: Tick | None = None
        self._last_ns = 0
        self._last_v = 0.0
        self._engaged = self._calm = self._to_blame = 0  # ticks in a row
        self._commanded = False  # an operator has engaged the axis, or led it
        self._console_died = self._recorder_died = self._left = 0  # ticks since then; 0 where it has not
        self._failing = 0  # ticks in which the log is lost, and nobody says so
        self._foreign_ns = 0  # when somebody else's command was there

    def says_no(self, oracle: str, words: str) -> None:
        """Note a finding."""
        world = self._world
        self.found.append(Finding(oracle, words, (world.now_ns - START_NS) * 1e-9, world.steps))
        world.note(f"FINDING {oracle}: {words}")

    # the loop and its bus

    def begins(self, session: Session) -> None:
        """A loop is about to run."""
        self.sessions.append(session)
        self._begin()

    def ended(self, status: int) -> None:
        """A run has ended in order, and has told its status."""
        session = self.sessions[-1]
        if not status and (session.removed or not session.ring.status().finished):
            what = "its log is removed" if session.removed else "its log has no end"
            self.says_no("summary", f"it ends with 0, and {what}")

    def on_frame(self, sender: str, can_id: int, data: bytes) -> None:
        """A frame leaves."""
        if can_id != self._codecs.valve_command.can_id:
            return
        if sender != "loop":
            heard = all(one.kind == "babble" for one in self._bus.troubles)
            if heard and self._codecs.valve_command.valid(data):
                self._foreign_ns = self._foreign_ns or self._world.now_ns
            return
        voltage_v, enable, _ = self._codecs.valve_command.decode(data)
        if not abs(voltage_v) <= min(self._config.valve.u_max_v, 5.0):
            self.says_no("range", f"a command of {voltage_v!r} V")
        if not enable and voltage_v != 0.0:
            self.says_no("idle", f"a command of {voltage_v!r} V that does not enable the valve")

    def decided(self, record: Record) -> None:
        """A loop hands a tick over."""
        session, tick = self.sessions[-1], record.tick
        session.ticks.append(Taken(tick.t_ns, tick.state, tick.command.voltage_v, tick.answer))
        engaged = is_engaged(tick.state)
        self.engaged_ticks += engaged
        self._engaged = self._engaged + 1 if engaged else 0
        self._see_calm(tick)
        self._output(tick, engaged=engaged)
        self._engagement(session, tick, engaged=engaged)
        self._causes(tick, engaged=engaged)
        self._valve(tick)
        self._watches(tick, engaged=engaged)
        self._waiting(record)
        if tick.request is not None and tick.answer == _TAKEN:
            self._done[tick.request.kind] += 1
            self._in_time(session, tick.request.kind)
        before = self._last
        if before is None or before.state != tick.state:
            self._world.note(f"{State(tick.state).label}, faults {tick.latched:x}")
        self._last, self._last_ns, self._last_v = tick, self._world.now_ns, tick.command.voltage_v

    def _see_calm(self, tick: Tick) -> None:
        """Count ticks in which nothing is wrong with bus, rig, machine and loop."""
        m = tick.measurement
        calm = not (self._bus.troubles or m.skipped or m.host & ~_UNPROVEN)
        calm = calm and self._world.now_ns - self._bus.troubled_ns > SETTLES_NS
        held = self.daemon is None or self.daemon.continued_ns > tick.t_ns - 2 * self._period_ns
        calm = calm and not held and self.rig_is_well()
        calm = calm and self._world.now_ns - self._last_ns < 2 * self._period_ns
        self._calm = self._calm + 1 if calm else 0
        if self._world.wall_ns != self._wall_ns:  # what comes in the same tick has a stamp that says nothing
            self._wall_ns = self._world.wall_ns
            self._calm = min(self._calm, CALM_TICKS - STEP_TICKS)

    def _output(self, tick: Tick, *, engaged: bool) -> None:
        c = tick.command
        if not abs(c.voltage_v) <= min(5.0, self._config.valve.u_max_v):
            self.says_no("range", f"{c.voltage_v!r} V in a tick")
        if not engaged and (c.voltage_v != 0.0 or c.enable):
            self.says_no("idle", f"{c.voltage_v!r} V, enable {c.enable} in state {State(tick.state).label}")
        since_ns = 0 if self._last is None else tick.t_ns - self._last.t_ns
        periods = max(1 + tick.measurement.skipped, since_ns / self._period_ns)
        room = self._slew_v * periods + 2.0 * self._codecs.command_lsb_v
        if engaged and c.enable and abs(c.voltage_v - self._last_v) > room:
            self.says_no("slew", f"from {self._last_v!r} to {c.voltage_v!r} V in a tick")

    def _engagement(self, session: Session, tick: Tick, *, engaged: bool) -> None:
        """Nobody engages an axis but an operator, or a run that is to, once its log has begun."""
        before, request = self._last, tick.request
        if not engaged:
            self._commanded = False
            return
        by_itself = self._by_itself and request == Request(RequestKind.ARM, (1.0,))
        if request is not None and tick.answer == _TAKEN and request.kind in _COMMANDS and not by_itself:
            self._commanded = True
        if before is not None and is_engaged(before.state):
            return
        if request is None or request.kind not in ENGAGES:
            self.says_no("arming", "the axis engages, and nobody asks for it")
            return
        if tick.present & BLOCKS_ARM & ~(1 << F.UNPROVEN):
            self.says_no("arming", f"with faults {tick.present:x}")
        if by_itself:
            watch = session.loop.lanes[0].recorder
            if not watch.lost and session.ring.status().heartbeat == 0:
                self.says_no("arming", "before the recorder has begun")
        elif not any(
            t_ns > self._world.now_ns - ASKED_NS and verb in _ENGAGING for t_ns, verb in self._asked
        ):
            self.says_no("arming", "nobody has asked for it lately")
        if tick.measurement.host & _UNPROVEN:
            self.says_no("arming", "without a movement test")

    def _causes(self, tick: Tick, *, engaged: bool) -> None:
        """Causes that can be seen from outside centre the valve within two ticks."""
        cause = self._cause() if engaged else ""
        self._to_blame = self._to_blame + 1 if cause else 0
        if not engaged:
            self._foreign_ns = 0
        if self._to_blame > PATIENCE_TICKS:
            self.says_no("centre", f"{cause}, and the axis goes on for {self._to_blame} ticks")
        if engaged and tick.present & CENTRES:
            self.says_no("centre", f"engaged with faults {tick.present & CENTRES:x}")

    def _cause(self) -> str:
        loop, now_ns = self._bus.party("loop"), self._world.now_ns
        if loop is None:
            return ""
        if loop.down:
            return "the interface is down"
        if self._foreign_ns and now_ns - self._foreign_ns > self._period_ns:
            return "somebody else commands the valve"
        most_ns = self._timeout_ns + 2 * self._period_ns
        for answer in self._codecs.answers:
            heard_ns = loop.heard_ns.get(answer.codec.can_id, 0)
            if now_ns - heard_ns > most_ns:
                return f"{answer.name} is silent for {1e-6 * (now_ns - heard_ns):.1f} ms"
        return ""

    def _valve(self, tick: Tick) -> None:
        """In calm all is heard, and the valve accepts commands of an engaged axis."""
        node = self.node
        if node is None or self._calm < CALM_TICKS or node.valve.state == ValveState.FAULT:
            return
        if self._engaged > PATIENCE_TICKS + 1 and node.valve.state != _ENABLED:
            self.says_no("valve", f"engaged, and the valve is {node.valve.state.name.lower()}")
        m = tick.measurement  # what is held back as odd was heard
        heard = m.fresh | (_ENCODER if m.encoder_defects & _ODD else 0)
        heard |= _PRESSURE if m.pressure_defects & _ODD else 0
        if heard & ALL_SOURCES != ALL_SOURCES:
            self.says_no("heard", f"all answer, and but {m.fresh} is heard")

    def _watches(self, tick: Tick, *, engaged: bool) -> None:
        """The loop sees who has died."""
        most = round(DEATH_S * 1e9 / self._period_ns)
        if self._console_died:
            self._console_died += 1
            if not engaged or tick.measurement.host & _CONSOLE_LOST:
                self._console_died = 0
            elif self._console_died > most:
                self.says_no("console", f"it has died, and the axis goes on for {most} ticks")
        if self._recorder_died:
            self._recorder_died += 1
            if tick.measurement.host & _RECORDER_LOST:
                self._recorder_died = 0
            elif self._recorder_died > most:
                self.says_no("recorder", f"it has died, and nobody says so for {most} ticks")
        if self._calm % 16 == 0 or self._failing:
            failing = self.sessions[-1].ring.status().failing and not tick.measurement.host & _LOG_LOST
            self._failing = self._failing + 1 if failing else 0
            if self._failing > most:
                self.says_no("recorder", f"the disk takes nothing, and nobody says so for {most} ticks")
        if self._left:
            self._left += 1
            if tick.state not in _LED or (tick.request is not None and tick.answer == _TAKEN):
                self._left = 0
            elif self._left > most // 2:
                self.says_no(
                    "attended", f"who has begun the motion is gone, and it goes on for {most // 2} ticks"
                )

    def _in_time(self, session: Session, kind: int) -> None:
        """What has waited for the loop for too long is not done."""
        lane = session.loop.lanes[0]
        age_ns = getattr(getattr(lane._console, "_end", None), "age_ns", 0)
        if lane._asked and kind not in _NEVER_LATE and age_ns > LATE_NS:
            self.says_no("late", f"a request has waited for {1e-6 * age_ns:.0f} ms, and is done")

    def _waiting(self, record: Record) -> None:
        """The loop waits for answers as long as it may, and no longer, unless it stands still."""
        if self.daemon is None or self.daemon.continued_ns > record.tick.t_ns:
            return
        over_ns = record.timing[1] - self._wait_ns
        if over_ns > self._period_ns:
            self.says_no("deadline", f"it waits for answers {1e-6 * over_ns:.1f} ms longer than it may")

    def _died(self, process: Process) -> None:
        """A process is gone."""
        last, session = self._last, self.sessions[-1] if self.sessions else None
        if last is None or session is None or session.ring.closed:
            return
        daemon = self._world.processes.get(process.ppid)
        if process.name == "console" and is_engaged(last.state) and self._commanded:
            self._console_died = self._console_died or 1
        elif process.name == "recorder" and daemon is not None and daemon.alive:
            self._recorder_died = 1

    def look(self) -> None:
        """From time to time: what holds also where no loop runs."""
        world, node = self._world, self.node
        for process in world.processes.values():
            for thing in process.holdings.values():
                if getattr(thing, "waiting", 0) > QUEUE_BYTES:
                    self.says_no("queue", f"{process.name}: {getattr(thing, 'waiting', 0)} bytes wait")
        if world.crashes:
            self.says_no("exception", world.crashes.pop(0))
        if node is None or not self.rig_is_well():
            self._idle_ns = world.now_ns
            return
        last = self._last
        if self._bus.troubled_ns + self._valve_ns > world.now_ns:  # it may have obeyed somebody else
            self._idle_ns = world.now_ns
        if last is not None and is_engaged(last.state) and world.now_ns - last.t_ns < 2 * self._period_ns:
            self._idle_ns = world.now_ns
        most_ns = self._valve_ns + (PATIENCE_TICKS + 4) * self._period_ns + 60_000_000
        if world.now_ns - self._idle_ns > most_ns and node.valve.output_v != 0.0:
            self.says_no("valve", f"nothing is engaged, and it puts out {node.valve.output_v:.3f} V")

    # operators

    def asks(self, verb: str) -> None:
        """An operator is about to ask for something."""
        self._asked.append((self._world.now_ns, verb))

    def told(self, verb: str, reply: dict[str, Any]) -> None:
        """An operator was told that it was done."""
        kind = _ACKNOWLEDGED.get(verb)
        self._world.note(f"told: {verb} is done, {reply.get('state', '')}")
        if kind is None:
            return
        self._acknowledged[kind] += 1
        asked, done = self._acknowledged[kind], self._done[kind]
        if asked > done:
            self.says_no("acknowledged", f"{verb} was told to be done {asked} times, and was {done} times")

    def leaves(self, *, attending: bool) -> None:
        """An operator has hung up; whether the motion under way ends with that."""
        if attending and self._last is not None and self._last.state in _LED:
            self._left = 1
