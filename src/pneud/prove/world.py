"""Virtual time, processes and who goes next: one thread, and a seed decides everything.

An actor is a function that runs as it is, in a greenlet of its own. Where it would call the system it comes
to a door (see `doors`): that costs it time, may have others go first, and may be the last thing it does.
Between two doors nobody else runs. Each step of an actor is at an instant of its own, in order of time.
"""

from __future__ import annotations

import errno
import heapq
import os
import random
import signal
from collections.abc import Callable, Iterable, Iterator
from itertools import count, cycle
from typing import Any, Protocol

from greenlet import GreenletExit, getcurrent, greenlet

START_NS = 1_000_000_000_000
WALL_NS = 1_800_000_000_000_000_000  # CLOCK_REALTIME minus CLOCK_MONOTONIC, to begin with
FIRST_PID = 100
FOREVER_NS = 1 << 62
_COSTS = 4096  # that are drawn beforehand

Handler = Callable[[int, Any], Any] | int | None
Event = Callable[[], None]


class Held(Protocol):
    """What processes have open; it is gone when the last of them has closed it."""

    def release(self, pid: int) -> None:
        """A process has closed it, or is gone."""

    def share(self, pid: int) -> None:
        """Another process has it, too."""


class Happening:
    """What actors may wait for."""

    __slots__ = ("waiters",)

    def __init__(self) -> None:
        self.waiters: list[tuple[Actor, int]] = []


class Process:
    """A process of the world.

    Attributes:
        pid: its number.
        ppid: that of its parent; 1 where that is gone.
        name: what it is.
        status: as `waitpid` tells it; None while it lives.
        reaped: its parent knows.
        stopped: by SIGSTOP.
        ended: happens when it dies.
    """

    def __init__(self, pid: int, ppid: int, name: str) -> None:
        self.pid, self.ppid, self.name = pid, ppid, name
        self.status: int | None = None
        self.reaped = False
        self.stopped = False
        self.continued_ns = 0  # when it went on after that
        self.orphaned: int | None = None  # signal that it gets when its parent dies
        self.handlers: dict[int, Handler] = {}
        self.blocked: frozenset[int] = frozenset()
        self.pending: list[int] = []  # signals that are blocked
        self.todo: list[tuple[Callable[[int, Any], Any], int]] = []  # handlers to be called
        self.signalled = Happening()
        self.ended = Happening()
        self.actors: list[Actor] = []
        self.holdings: dict[int, Held] = {}  # by descriptor

    @property
    def alive(self) -> bool:
        """Whether it has not died."""
        return self.status is None


class Actor:
    """A thread of a process."""

    __slots__ = ("deferred", "done", "ended", "fuse", "greenlet", "process", "token")

    def __init__(self, process: Process, run: Callable[[], None], hub: Any) -> None:
        self.process = process
        self.token = 0  # of what it waits for; older wake-ups say nothing
        self.done = False
        self.deferred = False  # it was to go on while its process was stopped
        self.fuse: tuple[int, Event] | None = None  # what happens after how many of its steps
        self.ended = Happening()
        self.greenlet = greenlet(run, parent=hub)


class World:
    """All processes, their clock, and what is going to happen.

    Attributes:
        now_ns: CLOCK_MONOTONIC.
        wall_ns: CLOCK_REALTIME minus that.
        steps: doors that actors have come to.
        current: who runs; None between two.
        rng: what the schedule leaves to chance.
        crashes: exceptions that have ended a process, in words.
    """

    def __init__(self, seed: int, *, most_steps: int = 1 << 62, slowness: float = 1.0) -> None:
        """Nothing has happened.

        Args:
            seed: of all that is left to chance.
            most_steps: the world ends after so many.
            slowness: factor of what doors and wake-ups take.
        """
        self.now_ns = START_NS
        self.wall_ns = WALL_NS
        self.steps = 0
        self.current: Actor | None = None
        self.rng = random.Random(seed)
        self.crashes: list[str] = []
        self.processes: dict[int, Process] = {}
        self.numbers = count()
        self.things: dict[int, Any] = {}  # what is open, by descriptor
        self.over = False
        self.on_note: Callable[[str, str], None] = lambda *_: None
        self.on_death: Callable[[Process], None] = lambda _: None
        self._most_steps = most_steps
        self._hub = getcurrent()
        self._heap: list[tuple[int, float, int, Any, int]] = []
        self._number = 0
        self._pid = FIRST_PID
        draw = self.rng.random
        some = range(_COSTS)
        self._costs = cycle([round(slowness * (200 + 1800 * draw() ** 3)) for _ in some])
        self._latencies = cycle([round(slowness * (2_000 + 60_000 * draw() ** 4)) for _ in some])
        self._ties = cycle([draw() for _ in some])

    # what happens, and when

    def at(self, t_ns: int, event: Event) -> None:
        """Have something happen, of its own accord."""
        self._push(t_ns, event, -1)

    def _push(self, t_ns: int, what: Actor | Event, token: int) -> None:
        self._number += 1
        heapq.heappush(self._heap, (max(t_ns, self.now_ns), next(self._ties), self._number, what, token))

    def run(self, until: Callable[[], bool]) -> None:
        """Go on until nothing happens any more, or something is so."""
        heap = self._heap
        while heap and not until() and self.steps < self._most_steps:
            t_ns, _, _, what, token = heapq.heappop(heap)
            assert t_ns >= self.now_ns
            self.now_ns = t_ns
            if token < 0:
                what()
                continue
            actor: Actor = what
            if token != actor.token or actor.done:
                continue
            if actor.process.stopped:
                actor.deferred = True
                continue
            actor.token += 1
            self.current = actor
            actor.greenlet.switch()
            self.current = None

    def end(self) -> None:
        """The world is over: whoever is left unwinds, and can do nothing any more."""
        self.over = True
        for process in self.processes.values():
            for actor in process.actors:
                actor.done = True
                while actor.greenlet and not actor.greenlet.dead:
                    self.current = actor
                    actor.greenlet.throw(GreenletExit)
        self.current = None

    def note(self, words: str) -> None:
        """Something worth a line of the trace."""
        who = self.current.process.name if self.current is not None else "world"
        self.on_note(who, words)

    # actors

    def me(self) -> Actor:
        """Who runs.

        Raises:
            GreenletExit: it does not live any longer.
        """
        me = self.current
        assert me is not None
        if me.done:
            raise GreenletExit
        return me

    @property
    def pid(self) -> int:
        """Of who runs."""
        return self.current.process.pid if self.current is not None else 1

    def step(self) -> None:
        """Come to a door."""
        me = self.current
        if me is None:
            return
        if me.done:
            raise GreenletExit
        self.steps += 1
        if me.fuse is not None:
            self._burn(me)
        t_ns = self.now_ns + next(self._costs)
        if self._heap and self._heap[0][0] <= t_ns:
            self.wait(t_ns)
        else:
            self.now_ns = t_ns

    def _burn(self, me: Actor) -> None:
        """See whether something happens at this step."""
        assert me.fuse is not None
        left, happens = me.fuse
        me.fuse = (left - 1, happens) if left > 1 else None
        if left <= 1:
            happens()
            self._go_on(me)
            if me.process.stopped or me.process.todo:
                self.wait(self.now_ns)

    def wait(self, until_ns: int, *happenings: Happening) -> None:
        """Have others go until something happens, or until a time; it may be over sooner, too."""
        me = self.current
        assert me is not None
        if me.done:
            raise GreenletExit
        me.token = token = me.token + 1
        for happening in happenings:
            waiters = happening.waiters
            waiters.append((me, token))
            if len(waiters) > 32:
                happening.waiters = [(actor, token) for actor, token in waiters if actor.token == token]
        if until_ns < FOREVER_NS:
            self._push(until_ns, me, token)
        self._hub.switch()
        if me.done:
            raise GreenletExit
        if me.process.todo:
            self._handle(me)

    def pass_until(self, t_ns: int) -> None:
        """Be busy until a time, or until somebody else's turn."""
        if self._heap and self._heap[0][0] <= t_ns:
            self.wait(t_ns)
        else:
            self.now_ns = max(self.now_ns, t_ns)

    def sleep_until(self, t_ns: int) -> None:
        """Sleep."""
        while self.now_ns < t_ns:
            self.wait(t_ns)

    def happens(self, happening: Happening) -> None:
        """Wake who waits for it."""
        if not happening.waiters:
            return
        waiters, happening.waiters = happening.waiters, []
        for actor, token in waiters:
            if actor.token == token and not actor.done:
                self._push(self.now_ns + next(self._latencies), actor, token)

    def happens_at(self, happening: Happening, t_ns: int) -> None:
        """Wake who waits for it by now, then."""
        for actor, token in happening.waiters:
            if actor.token == token and not actor.done:
                self._push(t_ns + next(self._latencies), actor, token)

    def _handle(self, me: Actor) -> None:
        """Call handlers of signals, as the main thread does."""
        process = me.process
        while process.todo and me is process.actors[0]:
            handler, number = process.todo.pop(0)
            handler(number, None)

    def _go_on(self, me: Actor) -> None:
        """Or not, where somebody has just been killed."""
        if me.done:
            self._hub.switch()
            raise GreenletExit

    # processes

    def spawn(self, main: Callable[[], int | None], name: str, ppid: int = 1) -> Process:
        """A process that runs a function, from the next moment on."""
        self._pid += 1
        process = self.processes[self._pid] = Process(self._pid, ppid, name)

        def run() -> None:
            try:
                code = main() or 0
            except GreenletExit:
                return
            except SystemExit as e:
                code = e.code if isinstance(e.code, int) else 1
            if not self.over:
                self.die(process, code << 8)

        self._begin(process, run)
        self.note(f"starts {name} {process.pid}")
        return process

    def thread(self, run: Callable[[], object]) -> Actor:
        """A thread of who runs."""
        process = self.me().process

        def thread() -> None:
            try:
                run()
            except GreenletExit:
                return
            except Exception as e:
                self.crashes.append(f"a thread of {process.name}: {type(e).__name__}: {e}")
            actor.done = True
            self.happens(actor.ended)

        actor = self._begin(process, thread)
        return actor

    def _begin(self, process: Process, run: Callable[[], None]) -> Actor:
        actor = Actor(process, run, self._hub)
        process.actors.append(actor)
        self._push(self.now_ns + next(self._latencies), actor, actor.token)
        return actor

    def die(self, process: Process, status: int) -> None:
        """A process is gone, with all that it had open."""
        if not process.alive:
            return
        process.status = status
        self.on_note(process.name, f"is gone, {os.waitstatus_to_exitcode(status)}")
        for actor in process.actors:
            actor.done = True
        for held in list(process.holdings.values()):
            held.release(process.pid)
        process.holdings.clear()
        for child in list(self.processes.values()):
            if child.ppid == process.pid:
                child.ppid = 1
                if child.orphaned is not None and child.alive:
                    self.send(child, child.orphaned)
        parent = self.processes.get(process.ppid)
        if parent is not None and parent.alive:
            self.send(parent, signal.SIGCHLD)
            self.happens(parent.signalled)
        self.happens(process.ended)
        self.on_death(process)

    def kill(self, pid: int, number: int) -> None:
        """Send a signal, as who runs does.

        Raises:
            ProcessLookupError: there is no such process.
        """
        process = self.processes.get(pid)
        if process is None or process.reaped:
            raise ProcessLookupError(errno.ESRCH, os.strerror(errno.ESRCH))
        if number and process.alive:
            self.send(process, number)
        me = self.current
        if me is not None:
            self._go_on(me)
            if process is me.process and (me.process.todo or me.process.stopped):
                self.wait(self.now_ns)

    def send(self, process: Process, number: int) -> None:
        """Send a signal."""
        if not process.alive:
            return
        if number == signal.SIGKILL:
            self.die(process, int(number))
        elif number == signal.SIGSTOP:
            process.stopped = True
        elif number == signal.SIGCONT:
            process.stopped = False
            process.continued_ns = self.now_ns
            for actor in process.actors:
                if actor.deferred:
                    actor.deferred = False
                    self._push(self.now_ns, actor, actor.token)
        elif number in process.blocked:
            process.pending.append(int(number))
            self.happens(process.signalled)
        else:
            self._deliver(process, int(number))

    def _deliver(self, process: Process, number: int) -> None:
        handler = process.handlers.get(number, signal.SIG_DFL)
        if callable(handler) and not isinstance(handler, int):
            process.todo.append((handler, number))
            main = process.actors[0]
            if main is not self.current:
                self._push(self.now_ns + next(self._latencies), main, main.token)
        elif handler == signal.SIG_DFL and number != signal.SIGCHLD:
            self.die(process, number)

    def unblock(self, process: Process, blocked: frozenset[int]) -> None:
        """Change which signals a process has blocked; what has waited comes."""
        process.blocked = blocked
        pending, process.pending = process.pending, []
        for number in pending:
            self.send(process, number)

    def children(self, pid: int) -> Iterator[Process]:
        """Those of a process that live."""
        yield from (one for one in self.processes.values() if one.ppid == pid and one.alive)

    def named(self, names: Iterable[str]) -> list[Process]:
        """Those that live, by their names."""
        wanted = set(names)
        return [one for one in self.processes.values() if one.alive and one.name in wanted]
