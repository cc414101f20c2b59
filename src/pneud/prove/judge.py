"""Oracles: what has to be so whatever the seed; those of an axis alone are in `axis_judge`."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from pneud.loading import Loaded, plans_of_plant
from pneud.loop.company import ties_of
from pneud.prove.axis_judge import AxisJudge, Session
from pneud.prove.canbus import CanBus
from pneud.prove.program_judge import ASKED
from pneud.prove.tie_judge import TieJudge
from pneud.prove.world import FOREVER_NS, START_NS, Process, World
from pneud.signals import RequestKind

if TYPE_CHECKING:
    from pneud.prove.node_judge import NodeJudge

END_S = 30.0  # after which a run that was told to end has to have ended
QUEUE_BYTES = 512 * 1024
ASKED_NS = 300_000_000  # after who has asked has gone: console and loop turn away what is older
_VERBS = ("arm", "disarm", "stop", "hold", "goto", "jog", "track", "force", "clear", "mark", "restart", "run")
_ACKNOWLEDGED = {verb: int(RequestKind[verb.upper()]) for verb in _VERBS}
_ACKNOWLEDGED["goto_all"] = int(RequestKind.GOTO)
_BY_ALL = ("arm", "goto_all", "restart")  # or by none; of all else some may have nothing to do
_ENGAGING = ("arm", "track", "home", "probe")


class Finding(NamedTuple):
    """An oracle that says no."""

    oracle: str
    words: str
    t_s: float
    step: int

    def __str__(self) -> str:
        return f"{self.oracle}: {self.words} (at {self.t_s:.6f} s, step {self.step})"


class Asked:
    """Something that an operator asks for.

    Attributes:
        until_ns: he has waited for it.
    """

    def __init__(self, verb: str, axis: str | None) -> None:
        self.verb, self.axis = verb, axis
        self.until_ns = FOREVER_NS


class Judge:
    """Looks at everything, and says no.

    Attributes:
        world: all of it.
        bus: of the axes.
        by_itself: the run may arm the axes.
        axes: those who look at each.
        nodes: who looks at nodes that have to be configured; None where there are none.
        tie: who looks at an axis together with the one that leads it; None where there are none.
        found: what has been found; the first one ends a run.
        sessions: of all axes, one after the other.
        daemon: the process of the loop that runs.
    """

    def __init__(self, world: World, bus: CanBus, axes: Sequence[Loaded], *, by_itself: bool) -> None:
        """Nothing has happened."""
        self.world, self.bus, self.by_itself = world, bus, by_itself
        self.found: list[Finding] = []
        self.sessions: list[Session] = []
        self.daemon: Process | None = None
        self.rig_is_well: Callable[[], bool] = lambda: True
        self.axes = [AxisJudge(self, axis, number) for number, axis in enumerate(axes)]
        self.nodes = self._nodes(axes[0])
        ties = ties_of([axis.config for axis in axes])
        self.tie = TieJudge(self, ties[0]) if ties else None
        self._commands = {axis.command_id: axis for axis in self.axes}
        self._asked: deque[Asked] = deque(maxlen=64)
        self._acknowledged: Counter[tuple[str, int]] = Counter()  # by axis, or "" for some of all
        world.on_death = self._died

    def _nodes(self, axis: Loaded) -> NodeJudge | None:
        if not (plans := plans_of_plant(axis)):
            return None
        from pneud.prove.node_judge import NodeJudge  # noqa: PLC0415 - what it takes is loaded for few seeds

        return NodeJudge(self, plans)

    def says_no(self, oracle: str, words: str) -> None:
        """Note a finding."""
        world = self.world
        self.found.append(Finding(oracle, words, (world.now_ns - START_NS) * 1e-9, world.steps))
        world.note(f"FINDING {oracle}: {words}")

    # the loop and its bus

    def begins(self, sessions: Sequence[Session]) -> None:
        """A loop is about to run, with all axes."""
        self.sessions += sessions
        for axis, session in zip(self.axes, sessions, strict=True):
            axis.begins(session)
        for more in (self.nodes, self.tie):
            if more is not None:
                more.begins()

    def ended(self, status: int) -> None:
        """A run has ended in order, and has told its status."""
        for session in self.sessions[-len(self.axes) :]:
            if not status and (session.removed or not session.ring.status().finished):
                what = "its log is removed" if session.removed else "its log has no end"
                self.says_no("summary", f"it ends with 0, and {what}")

    def on_frame(self, sender: str, can_id: int, data: bytes) -> None:
        """A frame leaves."""
        if can_id in self._commands:
            self._commands[can_id].on_command(sender, data)

    def held_since(self, t_ns: int) -> bool:
        """Whether the loop has stood still after an instant, and is not to blame."""
        return self.daemon is None or self.daemon.continued_ns > t_ns

    def _died(self, process: Process) -> None:
        for axis in self.axes:
            axis.died(process)
        if self.nodes is not None:
            self.nodes.died(process)

    def look(self) -> None:
        """From time to time: what holds also where no loop runs."""
        for process in self.world.processes.values():
            for thing in process.holdings.values():
                if getattr(thing, "waiting", 0) > QUEUE_BYTES:
                    self.says_no("queue", f"{process.name}: {getattr(thing, 'waiting', 0)} bytes wait")
        if self.world.crashes:
            self.says_no("exception", self.world.crashes.pop(0))
        for axis in self.axes:
            axis.look()

    # operators

    def asks(self, verb: str, axis: str | None, **fields: Any) -> Asked:
        """An operator is about to ask for something, of an axis that he names or of all."""
        if "program" in fields and (programs := self.axes[0].programs) is not None:
            programs.asks(**{name: fields[name] for name in ASKED if name in fields})
        self._asked.append(asked := Asked(verb, axis))
        return asked

    def was_asked_to_engage(self, name: str) -> bool:
        """Whether somebody waits for what engages an axis, or has done so just now."""
        since_ns, names = self.world.now_ns - ASKED_NS, {None, name}
        if self.tie is not None and self.tie.gantry:
            names |= {axis.name for axis in self.axes}  # who arms one half arms both
        return any(
            one.until_ns > since_ns and one.verb in _ENGAGING and one.axis in names for one in self._asked
        )

    def told(self, verb: str, reply: dict[str, Any]) -> None:
        """An operator was told that it was done."""
        kind = _ACKNOWLEDGED.get(verb)
        self.world.note(f"told: {verb} is done, {reply.get('state', '')}")
        if kind is None:
            return
        names, told = reply.get("axes") or [reply["axis"]], self._acknowledged
        if len(names) > 1 and verb not in _BY_ALL:
            told["", kind] += 1
            asked = sum(told[name, kind] for name in ("", *(axis.name for axis in self.axes)))
            self._are_done(verb, asked, sum(axis.done[kind] for axis in self.axes))
            return
        for axis in self.axes:
            if axis.name in names:
                told[axis.name, kind] += 1
                self._are_done(verb, told[axis.name, kind], axis.done[kind])

    def _are_done(self, verb: str, asked: int, done: int) -> None:
        if asked > done:
            self.says_no("acknowledged", f"{verb} was told to be done {asked} times, and was {done} times")
