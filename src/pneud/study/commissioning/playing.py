"""Steps played one after another, tick by tick: an operator of the axis, in simulation as on the daemon."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from pneud.safety.faults import names
from pneud.safety.supervisor import BLOCKS
from pneud.signals import Answer, Measurement, Record, Request, RequestKind, State, Tick
from pneud.study.commissioning.steps import Act, Step

QUIET_S, PATIENCE_S = 0.2, 5.0  # without anything that keeps an axis from it; for what does
DRIFT_M, DRIFT_PA = 1e-4, 2e3  # load and air that move by more meanwhile are not at rest
DRIFT_S = 10.0  # that they are waited for at most
FROM_REST = (RequestKind.ARM, RequestKind.PROBE)
NEVER_OURS = (RequestKind.STOP, RequestKind.SHUTDOWN, RequestKind.HOLD, RequestKind.JOG, RequestKind.HOME)

Announce = Callable[[Step], None]


class Played(NamedTuple):
    """What became of steps."""

    failure: str = ""  # why they have not come to their end
    faults: tuple[str, ...] = ()
    left: int = 0  # steps that have not come to theirs

    @property
    def whole(self) -> bool:
        """They have come to their end."""
        return not self.failure


class Player:
    """Asks for one act after another.

    Attributes:
        taken: all requests of the act have been.
        verdict: what became of the steps, once it is over.
    """

    def __init__(self, steps: Sequence[Step], h: float, announce: Announce) -> None:
        """Nothing has been asked for yet.

        Args:
            steps: in their order.
            h: sample time [s].
            announce: is told of each step before anything in it moves.
        """
        self._steps, self._h, self._announce = list(steps), h, announce
        self._acts: list[Act] = []
        self._act: Act | None = None
        self._queue: list[Request] = []
        self._asked = 0  # kind of the last request
        self.taken = False
        self._waited = self._quiet = self._stood = self._age = 0
        self._from: Measurement | None = None  # when it began to be quiet
        self._drifted = 0  # ticks that load and air were waited for
        self.verdict: Played | None = None

    def ask(self, state: int, present: int) -> Request | None:
        """What is asked of the axis in this tick; at the end that it shuts down."""
        if self.verdict is not None:
            return Request(RequestKind.SHUTDOWN)
        act = self._act
        if act is None or (self._stood and self._stood * self._h >= act.dwell_s):
            act = self._next(state)
            if act is None:
                return None
        if self._queue:
            return self._request(state, present)
        self._age += 1
        if act.lease and state == State.PROBING and self._age % (act.lease // 3 + 1) == 0:
            return act.requests[-1]
        return None

    def _next(self, state: int) -> Act | None:
        """The next act that is not done already."""
        while True:
            while not self._acts:
                if not self._steps:
                    self.verdict = Played()
                    return None
                step = self._steps.pop(0)
                self._announce(step)
                self._acts = list(step.acts)
            act = self._acts.pop(0)
            if act.requests[0].kind != RequestKind.ARM or state != State.HOLDING:
                break
        self._act, self._queue = act, list(act.requests)
        self.taken = False
        self._waited = self._quiet = self._stood = self._age = self._drifted = 0
        return act

    def _request(self, state: int, present: int) -> Request | None:
        kind = self._queue[0].kind
        if kind in FROM_REST:
            if state != State.DISARMED or present & BLOCKS[kind]:
                self._quiet = 0
                self._wait(state, present & BLOCKS[kind])
                return None
            self._quiet += 1
            if self._quiet * self._h < QUIET_S:
                return None
        self._asked = kind
        return self._queue.pop(0)

    def _wait(self, state: int, hindering: int) -> None:
        self._waited += 1
        if self._waited * self._h > PATIENCE_S:
            self.verdict = Played(f"the axis is {State(state).label}", tuple(names(hindering)))

    def see(self, record: Record) -> None:
        """What became of it."""
        tick, act = record.tick, self._act
        if self.verdict is not None or act is None:
            return
        kind = tick.request.kind if tick.request is not None else 0
        if act.settled and self._queue:
            self._let_drift(tick.measurement)
        if tick.latched:
            self.verdict = Played("a fault", tuple(names(tick.latched)))
        elif kind in NEVER_OURS or (kind == RequestKind.DISARM and kind != self._asked):
            self.verdict = Played("stopped")
        elif kind and kind == self._asked:
            self._answered(act, kind, tick)
        elif self.taken:
            self._stood = self._stood + 1 if tick.state == act.until else 0

    def _let_drift(self, m: Measurement) -> None:
        """Let a load that moves by itself go where it will: a probe would be over before it tells."""
        if self._from is None or (_has_moved(self._from, m) and self._drifted * self._h < DRIFT_S):
            self._from = m
            self._drifted += self._quiet
            self._quiet = 0

    def _answered(self, act: Act, kind: int, tick: Tick) -> None:
        if tick.answer == Answer.TAKEN:
            self.taken = not self._queue
        elif tick.answer == Answer.BLOCKED and kind in FROM_REST and not self.taken:
            self._queue.insert(0, act.requests[-1])
            self._quiet = 0
        elif not self.taken:  # a probe may have ended while it was renewed
            words = f"{RequestKind(kind).name.lower()}: {Answer(tick.answer).name.lower()}"
            blocked = tick.present if tick.answer == Answer.BLOCKED else 0
            self.verdict = Played(words, tuple(names(blocked)))


def _has_moved(before: Measurement, now: Measurement) -> bool:
    pressed_pa = max(abs(now.p1_pa - before.p1_pa), abs(now.p2_pa - before.p2_pa))
    return abs(now.position_m - before.position_m) > DRIFT_M or pressed_pa > DRIFT_PA
