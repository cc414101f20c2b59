"""Oracles of one axis: what has to be so in every tick; told by its records, its frames, and its rig."""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from pneud.loading import Loaded
from pneud.log.live.ring import Ring
from pneud.loop.lane import Lane
from pneud.prove.program_judge import START, ProgramJudge
from pneud.prove.world import Process
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

if TYPE_CHECKING:
    from pneud.prove.judge import Judge

PATIENCE_TICKS = 2
CALM_TICKS = 20  # without any trouble, before what comes without any has to be there
STEP_TICKS = 4  # after which a step of the wall clock has to be followed
SETTLES_NS = 50_000_000  # after a trouble of the bus: a frame may still be on its way
LATE_NS = 205_000_000  # after which a request that waits for the loop is turned away
DEATH_S = 0.9  # after which the loop has to have seen that a process is gone
_TAKEN = int(Answer.TAKEN)
_STOP, _CENTRE, _ARM = int(RequestKind.STOP), int(RequestKind.CENTRE), int(RequestKind.ARM)
_DISARM = int(RequestKind.DISARM)
_STOPPING = int(State.STOPPING)
_TOUCHES = {"stop": _STOP, "centre": _CENTRE, "go_on": 0}
_NEVER_LATE = (_STOP, _DISARM)
_UNPROVEN, _CONSOLE_LOST = int(Host.UNPROVEN), int(Host.CONSOLE_LOST)
_RECORDER_LOST, _LOG_LOST = int(Host.RECORDER_LOST), int(Host.RECORDER_LOST | Host.DISK_FULL)
_ENABLED = ValveState.ENABLED
_ENCODER, _PRESSURE, _ODD = int(Source.ENCODER), int(Source.PRESSURE), int(Defect.ODD)
_COMMANDS = frozenset((*ENGAGES, *STEERS, int(RequestKind.RUN)))
LED = (int(State.MOVING), int(State.TRACKING), int(State.PRESSING))


class Taken(NamedTuple):
    """What the log has to say of a tick."""

    t_ns: int
    state: int
    voltage_v: float
    answer: int


class Session:
    """An axis in one run of the loop: what it has decided, and what is kept of it.

    Attributes:
        lane: of the loop.
        ring: of its records.
        log: its file.
        recorder: that writes it, by its process id.
        asking: where operators' requests come to the loop.
        offset_ns: CLOCK_REALTIME minus CLOCK_MONOTONIC, as the log and viewers have it.
        ticks: that were recorded, in order.
        durable: records that the disk was known to have.
        cut: power was cut, so that only what is durable has to be there.
        removed: somebody has removed the log.
    """

    def __init__(
        self, lane: Lane, ring: Ring, log: Path, recorder: int, asking: Any, offset_ns: int = 0
    ) -> None:
        self.lane, self.ring, self.log, self.recorder, self.asking = lane, ring, log, recorder, asking
        self.offset_ns = offset_ns
        self.ticks: list[Taken] = []
        self.durable = 0
        self.cut = self.removed = False

    def has_decided(self, t_ns: int) -> bool:
        """Whether there was a tick with SYNC then."""
        place = bisect_left(self.ticks, t_ns, key=_sync_ns)
        return place < len(self.ticks) and self.ticks[place].t_ns == t_ns


def _sync_ns(tick: Taken) -> int:
    return tick.t_ns


class AxisJudge:
    """Looks at one axis.

    Attributes:
        session: that runs, or has run last.
        node: the rig's.
        programs: who looks at them; None where no input begins any.
        last: tick.
        punctual: ticks in a row.
        done: requests by kind, in all sessions.
        engaged_ticks: of all sessions.
    """

    def __init__(self, judge: Judge, loaded: Loaded, number: int) -> None:
        """Nothing has happened.

        Args:
            judge: of everything.
            loaded: the axis.
            number: its place among all.
        """
        config, codecs = loaded.config, loaded.codecs
        self.name, self.config, self.codecs = config.name, config, codecs
        self.command_id = codecs.valve_command.can_id
        self.session: Session | None = None
        self.node: PlantNode | None = None
        self.done: Counter[int] = Counter()
        self.engaged_ticks = 0
        self.period_ns = round(1e9 / config.loop.rate_hz)
        self._judge, self._world, self._bus, self._number = judge, judge.world, judge.bus, number
        self._wait_ns = round(self.period_ns * config.loop.set_deadline)
        self._timeout_ns = round(1e6 * config.bus.sensor_timeout_ms)
        self._valve_ns = round(1e6 * config.bus.valve_timeout_ms)
        self._u_max_v = min(config.valve.u_max_v, 5.0)
        self._slew_v = config.limits.slew_v_s / config.loop.rate_hz
        self.programs = ProgramJudge(judge, loaded) if START in config.bus.inputs else None
        self._wall_ns = self._world.wall_ns
        self._idle_ns = 0  # since when it is not engaged
        self._engaged_ns = 0  # when it was last
        self._begin()

    def _begin(self) -> None:
        self.last: Tick | None = None
        self._last_ns = self.punctual = 0
        self._last_v = 0.0
        self._latched = 0
        self._engaged = self._calm = self._to_blame = 0  # ticks in a row
        self._commanded = False  # an operator has engaged the axis, or led it
        self._has_been = False  # engaged in this run
        self._console_died = self._recorder_died = self._left = 0  # ticks since then; 0 where it has not
        self._failing = 0  # ticks in which the log is lost, and nobody says so
        self._foreign_ns = 0  # when somebody else's command was there
        self._touch = self._touched = 0  # what another axis's fault has it do, and ticks since then
        self._owes = False  # and it has not done it yet

    def begins(self, session: Session) -> None:
        """A loop is about to run."""
        self.session = session
        if self.programs is not None:
            self.programs.begins()
        self._begin()

    @property
    def calm(self) -> int:
        """Ticks in a row in which nothing was wrong with its frames, rig, machine and loop."""
        return self._calm

    def _says_no(self, oracle: str, words: str) -> None:
        self._judge.says_no(oracle, words if len(self._judge.axes) == 1 else f"{self.name}: {words}")

    def on_command(self, sender: str, data: bytes) -> None:
        """A command leaves for its valve."""
        command = self.codecs.valve_command
        if sender != "loop":
            heard = all(one.kind == "babble" for one in self._bus.troubles)
            if heard and command.valid(data):
                self._foreign_ns = self._foreign_ns or self._world.now_ns
            return
        voltage_v, enable, _ = command.decode(data)
        if not abs(voltage_v) <= self._u_max_v:
            self._says_no("range", f"a command of {voltage_v!r} V")
        if not enable and voltage_v != 0.0:
            self._says_no("idle", f"a command of {voltage_v!r} V that does not enable the valve")

    def decided(self, record: Record) -> None:
        """The loop hands a tick over."""
        session, tick = self.session, record.tick
        assert session is not None
        session.ticks.append(Taken(tick.t_ns, tick.state, tick.command.voltage_v, tick.answer))
        engaged = is_engaged(tick.state)
        self.engaged_ticks += engaged
        if engaged:
            self._engaged_ns = self._world.now_ns
        self._engaged = self._engaged + 1 if engaged else 0
        self._see_calm(tick)
        self._output(tick, engaged=engaged)
        self._engagement(session, tick, engaged=engaged)
        self._causes(tick, engaged=engaged)
        self._valve(tick)
        self._watches(session, tick, engaged=engaged)
        self._waiting(record)
        if self._judge.nodes is not None:
            self._judge.nodes.decided(tick)
        if self.programs is not None and self.programs.decided(tick):
            self._left = 0  # this motion is not his who is gone
        if len(self._judge.axes) > 1:
            self._others(session, tick, engaged=engaged)
        if tick.request is not None and tick.answer == _TAKEN:
            self.done[tick.request.kind] += 1
            self._in_time(session, tick.request.kind)
        before = self.last
        if before is None or before.state != tick.state:
            self._world.note(f"{self.name} {State(tick.state).label}, faults {tick.latched:x}")
        self.last, self._last_ns, self._last_v = tick, self._world.now_ns, tick.command.voltage_v
        if self._judge.tie is not None and self is self._judge.axes[-1]:
            self._judge.tie.decided()

    def _see_calm(self, tick: Tick) -> None:
        """Count ticks in which nothing is wrong with its frames, rig, machine and loop."""
        m, judge, now_ns = tick.measurement, self._judge, self._world.now_ns
        self.punctual = 0 if m.skipped else self.punctual + 1
        calm = not (m.skipped or m.host & ~_UNPROVEN)
        calm = calm and now_ns - self._bus.troubled_ns(self._number) > SETTLES_NS
        calm = calm and not judge.held_since(tick.t_ns - 2 * self.period_ns) and judge.rig_is_well()
        calm = calm and now_ns - self._last_ns < 2 * self.period_ns
        calm = calm and (judge.nodes is None or judge.nodes.well)
        self._calm = self._calm + 1 if calm else 0
        if self._world.wall_ns != self._wall_ns:  # what comes in the same tick has a stamp that says nothing
            self._wall_ns = self._world.wall_ns
            self._calm = min(self._calm, CALM_TICKS - STEP_TICKS)

    def _output(self, tick: Tick, *, engaged: bool) -> None:
        c = tick.command
        if not abs(c.voltage_v) <= self._u_max_v:
            self._says_no("range", f"{c.voltage_v!r} V in a tick")
        if not engaged and (c.voltage_v != 0.0 or c.enable):
            self._says_no("idle", f"{c.voltage_v!r} V, enable {c.enable} in state {State(tick.state).label}")
        since_ns = 0 if self.last is None else tick.t_ns - self.last.t_ns
        periods = max(1 + tick.measurement.skipped, since_ns / self.period_ns)
        room = self._slew_v * periods + 2.0 * self.codecs.command_lsb_v
        if engaged and c.enable and abs(c.voltage_v - self._last_v) > room:
            self._says_no("slew", f"from {self._last_v!r} to {c.voltage_v!r} V in a tick")

    def _engagement(self, session: Session, tick: Tick, *, engaged: bool) -> None:
        """Nobody engages an axis but an operator, or a run that is to, once its log has begun."""
        before, request = self.last, tick.request
        if not engaged:
            self._commanded = False
            return
        by_itself = self._judge.by_itself and request == Request(RequestKind.ARM, (1.0,))
        if request is not None and tick.answer == _TAKEN and request.kind in _COMMANDS and not by_itself:
            self._commanded = True
        if before is not None and is_engaged(before.state):
            return
        once, self._has_been = self._has_been, True
        if by_itself and once:
            self._says_no("arming", "by itself, though it had been engaged before")
        if request is None or request.kind not in ENGAGES:
            self._says_no("arming", "the axis engages, and nobody asks for it")
            return
        if tick.present & BLOCKS_ARM & ~(1 << F.UNPROVEN):
            self._says_no("arming", f"with faults {tick.present:x}")
        if by_itself:
            if not session.lane.recorder.lost and session.ring.status().heartbeat == 0:
                self._says_no("arming", "before the recorder has begun")
        elif not self._judge.was_asked_to_engage(self.name):
            self._says_no("arming", "nobody has asked for it lately")
        if tick.measurement.host & _UNPROVEN:
            self._says_no("arming", "without a movement test")

    def _causes(self, tick: Tick, *, engaged: bool) -> None:
        """Causes that can be seen from outside centre the valve within two ticks."""
        cause = self._cause() if engaged else ""
        self._to_blame = self._to_blame + 1 if cause else 0
        if not engaged:
            self._foreign_ns = 0
        if self._to_blame > PATIENCE_TICKS:
            self._says_no("centre", f"{cause}, and the axis goes on for {self._to_blame} ticks")
        if engaged and tick.present & CENTRES:
            self._says_no("centre", f"engaged with faults {tick.present & CENTRES:x}")

    def _cause(self) -> str:
        loop, now_ns = self._bus.party("loop"), self._world.now_ns
        if loop is None:
            return ""
        if loop.down:
            return "the interface is down"
        if self._foreign_ns and now_ns - self._foreign_ns > self.period_ns:
            return "somebody else commands the valve"
        most_ns = self._timeout_ns + 2 * self.period_ns
        for answer in self.codecs.answers:
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
            self._says_no("valve", f"engaged, and the valve is {node.valve.state.name.lower()}")
        m = tick.measurement  # what is held back as odd was heard
        heard = m.fresh | (_ENCODER if m.encoder_defects & _ODD else 0)
        heard |= _PRESSURE if m.pressure_defects & _ODD else 0
        if heard & ALL_SOURCES != ALL_SOURCES:
            self._says_no("heard", f"all answer, and but {m.fresh} is heard")

    def _watches(self, session: Session, tick: Tick, *, engaged: bool) -> None:
        """The loop sees who has died."""
        most, host = round(DEATH_S * 1e9 / self.period_ns), tick.measurement.host
        if self._console_died:
            self._console_died += 1
            if not engaged or host & _CONSOLE_LOST:
                self._console_died = 0
            elif self._console_died > most:
                self._says_no("console", f"it has died, and the axis goes on for {most} ticks")
        if self._recorder_died:
            self._recorder_died += 1
            if host & _RECORDER_LOST:
                self._recorder_died = 0
            elif self._recorder_died > most:
                self._says_no("recorder", f"it has died, and nobody says so for {most} ticks")
        if self._calm % 16 == 0 or self._failing:
            failing = session.ring.status().failing and not host & _LOG_LOST
            self._failing = self._failing + 1 if failing else 0
            if self._failing > most:
                self._says_no("recorder", f"the disk takes nothing, and nobody says so for {most} ticks")
        if self._left:
            self._left += 1
            if tick.state not in LED or (tick.request is not None and tick.answer == _TAKEN):
                self._left = 0
            elif self._left > most // 2:
                words = f"who has begun the motion is gone, and it goes on for {most // 2} ticks"
                self._says_no("attended", words)

    def _in_time(self, session: Session, kind: int) -> None:
        """What has waited for too long is not done, and what a dead console has asked does not go on."""
        age_ns = session.asking.age_ns
        if not session.lane._asked or kind in _NEVER_LATE:
            return
        if age_ns > LATE_NS:
            self._says_no("late", f"a request has waited for {1e-6 * age_ns:.0f} ms, and is done")
        if kind in _COMMANDS and not self._world.processes[session.asking.sender].alive:
            self._console_died = self._console_died or 1

    def _waiting(self, record: Record) -> None:
        """The loop waits for answers as long as it may, and no longer, unless it stands still."""
        if self._judge.held_since(record.tick.t_ns):
            return
        over_ns = record.timing[1] - self._wait_ns
        if over_ns > self.period_ns:
            self._says_no("deadline", f"it waits for answers {1e-6 * over_ns:.1f} ms longer than it may")

    # other axes

    def _others(self, session: Session, tick: Tick, *, engaged: bool) -> None:
        """A fault touches others as their tables say, and not otherwise; all arm together, or none."""
        request, asked = tick.request, session.lane._asked
        kind = request.kind if request is not None and not asked else 0
        if (tie := self._judge.tie) is not None and tie.joins(self) is not None:
            if kind in (_STOP, _CENTRE, _DISARM) and not tie.may_centre(self):
                self._says_no("touched", f"it is to {RequestKind(kind).name.lower()}, and its half goes on")
            return
        if kind in (_STOP, _CENTRE) and kind != self._touch:
            self._says_no("touched", f"it is to {RequestKind(kind).name.lower()}, for no fault")
        if self._touch:
            self._touched += 1
            if not engaged or (self._touch == _STOP and tick.state == _STOPPING):
                self._owes = False
            if self._touched > PATIENCE_TICKS:
                if self._owes:
                    name = RequestKind(self._touch).name.lower()
                    self._says_no("touched", f"it is to {name} with another one, and goes on")
                self._touch = 0
        new, self._latched = tick.latched & ~self._latched, tick.latched
        others = [one for one in self._judge.axes if one is not self]
        for other in others if new else ():
            table = other.config.faults.others
            other.touch(_TOUCHES[table.centre if new & CENTRES else table.stop])
        if request is not None and request.kind == _ARM and asked and tick.answer == _TAKEN:
            for other in others:
                assert other.session is not None
                beside = other.session.lane
                if beside._asked and beside.request == request and beside.turn.tick.answer != _TAKEN:
                    self.touch(_CENTRE)

    def touch(self, kind: int) -> None:
        """What has become of another axis has this one stop, or centre; 0: go on."""
        assert self.session is not None
        if kind and is_engaged(self.session.lane.turn.tick.state):
            late = self.last is not None and self.last.t_ns == self.session.lane.turn.tick.t_ns
            self._touch, self._owes = max(kind, self._touch), True
            self._touched = 0 if late else -1  # its tick of now is yet to be looked at

    # all the time

    def died(self, process: Process) -> None:
        """A process of the daemon is gone."""
        last, session = self.last, self.session
        if last is None or session is None or session.ring.closed:
            return
        daemon = self._world.processes.get(process.ppid)
        if process.name == "console" and is_engaged(last.state) and self._commanded:
            self._console_died = self._console_died or 1
        elif process.pid == session.recorder and daemon is not None and daemon.alive:
            self._recorder_died = 1

    def leaves(self) -> None:
        """Whose motion it is has hung up."""
        if self.last is not None and self.last.state in LED:
            self._left = 1

    def look(self) -> None:
        """From time to time: whether the valve is closed where nothing is engaged, and no loop runs."""
        now_ns, node = self._world.now_ns, self.node
        if node is None or not self._judge.rig_is_well():
            self._idle_ns = now_ns
            return
        if self._bus.troubled_ns(self._number) + self._valve_ns > now_ns:  # it may have obeyed somebody else
            self._idle_ns = now_ns
        self._idle_ns = max(self._idle_ns, self._engaged_ns)
        most_ns = self._valve_ns + (PATIENCE_TICKS + 4) * self.period_ns + 60_000_000
        if now_ns - self._idle_ns > most_ns and node.valve.output_v != 0.0:
            self._says_no("valve", f"nothing is engaged, and it puts out {node.valve.output_v:.3f} V")
