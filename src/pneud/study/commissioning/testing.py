"""The movement test's way: which probe is asked for when, tick by tick; an operator of the axis."""

from __future__ import annotations

from pneud.axis.state import AxisParameters
from pneud.control.probe import Probe
from pneud.safety.faults import F, names
from pneud.safety.supervisor import BLOCKS
from pneud.signals import Answer, Request, RequestKind, State, Tick
from pneud.study.commissioning.movement import (
    Finding,
    Seen,
    Verdict,
    expected_of,
    is_driven,
    judge,
    judge_rest,
    moves,
    seen,
    touches,
)

QUIET_S, PATIENCE_S = 0.3, 3.0  # at rest before a probe; before what hinders is told
TRIES, QUICKER = 3, 3.0  # at what has contradicted itself, and how much
LEASE_S = 0.3
_STOPS = (RequestKind.STOP, RequestKind.DISARM, RequestKind.SHUTDOWN)


class MovementTest:
    """Asks for one probe after another, and judges what they show.

    Attributes:
        verdict: what came of it, once it is over.
        asked: the probe that is under way or was the last.
    """

    def __init__(self, p: AxisParameters) -> None:
        """Nothing has been asked for yet."""
        self._p = p
        self._lease = max(1, round(LEASE_S / p.controller.h))
        self._loose, self._tries = False, 0
        self._rest: list[Tick] = []  # disarmed since the last probe
        self._driven = False  # something has moved the load then
        self._todo = touches(p, self._lease)
        self._begin_loose()
        self._seen: list[Seen] = []
        self._ticks: list[Tick] = []
        self._quiet = self._hindered = self._age = 0
        self._awaited = False  # what was asked for has not come to the axis yet
        self.asked: Probe | None = None
        self.verdict: Verdict | None = None

    def _begin_loose(self) -> None:
        if not self._todo and not self._loose:
            self._loose, self._todo = True, moves(self._p, self._lease)

    def ask(self, state: int, present: int) -> Request | None:
        """What is asked of the axis in this tick; at the end that it shuts down."""
        if self.verdict is not None:
            return Request(RequestKind.SHUTDOWN)
        if state == State.PROBING and self.asked is not None:
            self._age, self._hindered = self._age + 1, 0
            return request_of(self.asked) if self._age % (self._lease // 3 + 1) == 0 else None
        if self._awaited or state != State.DISARMED or present & BLOCKS[RequestKind.PROBE]:
            self._quiet, self._hindered = 0, self._hindered + 1
            if self._hindered * self._p.controller.h > PATIENCE_S:
                self.verdict = self._told(judge_rest(present) or Verdict((Finding.BY_FAULT,)))
            return None
        self._quiet += 1
        if self._quiet * self._p.controller.h < QUIET_S:
            return None
        self._quiet = self._age = 0
        self._driven |= self._moved_at_rest()
        self._rest = []
        self.asked, self._awaited = self._todo.pop(0), True
        return request_of(self.asked)

    def see(self, tick: Tick) -> None:
        """What became of it."""
        asked = tick.request is not None and tick.request.kind == RequestKind.PROBE
        self._awaited &= not asked
        if asked and tick.answer == Answer.BLOCKED and self.asked is not None:
            self._todo.insert(0, self.asked)  # by what came up meanwhile, and may go again
            self._hindered += round(QUIET_S / self._p.controller.h)
        elif asked and tick.answer != Answer.TAKEN:
            self.verdict = judge_rest(tick.present) or Verdict((Finding.BY_FAULT,))
        if tick.state == State.DISARMED:
            self._rest.append(tick)
        if tick.state == State.PROBING:
            self._ticks.append(tick)
        elif self._ticks:
            self._seen.append(seen([*self._ticks, tick], self._p))
            self._ticks = []
            stopped = tick.request is not None and tick.request.kind in _STOPS
            if stopped or tick.present & 1 << F.OPERATOR_LOST:
                self.verdict = Verdict((Finding.STOPPED,), tuple(names(tick.latched)))
            elif not self._todo or tick.latched:
                self._conclude()

    def _conclude(self) -> None:
        verdict = self._told(judge(self._seen, expected_of(self._p), self._loose))
        if verdict.findings == (Finding.UNDECIDED,) and self._tries + 1 < TRIES:
            self._tries, self._seen, self._todo = self._tries + 1, [], moves(self._p, self._lease, QUICKER)
            return
        if self._loose or not verdict.passed:
            self.verdict = verdict
        self._seen = []
        self._begin_loose()

    def _told(self, verdict: Verdict) -> Verdict:
        """What a valve that is open at rest makes of it: nothing else can be told then."""
        if not verdict.passed and (self._driven or self._moved_at_rest()):
            return Verdict((Finding.OPEN_AT_REST,), verdict.faults)
        return verdict

    def _moved_at_rest(self) -> bool:
        """Whether the load is moved by air, when the last probe has died away."""
        return is_driven(self._rest[len(self._rest) // 2 :], self._p)


def request_of(p: Probe) -> Request:
    """That asks for a probe, or renews it."""
    return Request(RequestKind.PROBE, tuple(map(float, p[:6])))
