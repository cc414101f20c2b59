"""What several axes of one daemon are to each other: asked together, and touched by each other's faults."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

from pneud.config.models import Config
from pneud.console.handoff import SharedEnd
from pneud.loop.turn import Turn
from pneud.safety.faults import BLOCKS_ARM, CENTRES, F
from pneud.safety.supervisor import is_engaged
from pneud.signals import Answer, Defect, Request, RequestKind, Source, Stage, State, Tick, Told

ARM, GOTO, RESTART = int(RequestKind.ARM), int(RequestKind.GOTO), int(RequestKind.RESTART)
DISARM, CENTRE, STOPPING = int(RequestKind.DISARM), int(RequestKind.CENTRE), int(State.STOPPING)
ENCODER, ODD = int(Source.ENCODER), int(Defect.ODD)
_TOUCHES = {"stop": int(RequestKind.STOP), "centre": CENTRE, "go_on": 0}
RUN, RECORD, HOLD = int(RequestKind.RUN), int(RequestKind.RECORD), int(RequestKind.HOLD)
GO_ON, TAKEN = int(RequestKind.GO_ON), int(Answer.TAKEN)
DONE, UNDER_WAY = int(Stage.DONE), int(Stage.UNDER_WAY)
_UNDO = {
    ARM: Request(RequestKind.CENTRE),
    GOTO: Request(RequestKind.HOLD),
    RUN: Request(RequestKind.HOLD),
    RECORD: Request(RequestKind.RECORD),
}
"""What is asked of those that have done what others have refused: all do it, or none."""


class Companion(Protocol):
    """An axis, as the others see it."""

    touched: int
    told: Told | None

    @property
    def turn(self) -> Turn:
        """The exchange."""

    @property
    def waits(self) -> bool:
        """Whether the run itself is still to arm it, and cannot yet."""


class Company:
    """In every tick `look` before the lanes ask, `after` when all have decided."""

    def __init__(self, lanes: Sequence[Companion], configs: Sequence[Config], asking: Asking | None) -> None:
        """Axes that have not begun.

        Args:
            lanes: of the axes.
            configs: of the axes, in the same order.
            asking: by which operators reach them.
        """
        self._lanes = lanes
        self._others = [config.faults.others for config in configs]
        self._latched = [0] * len(lanes)
        self._asking = asking
        self._begun = False
        self._ties = ties_of(configs)
        self._sharing: set[int] = set()  # places of those that go through one program
        self._sampled = [(0, 0)] * len(lanes)  # instant that an axis's estimate holds for, and its tick's

    def look(self) -> bool:
        """Take what is asked of the axes; whether the run itself may arm them: they all do, or none.

        Not while an operator asks something of several: all of them are to do that from where they are.
        """
        asked = False
        if self._asking is not None:
            asked = self._asking.look([lane.turn.tick for lane in self._lanes] if self._begun else [])
        return not (asked or any(lane.waits for lane in self._lanes))

    def after(self) -> None:
        """See which axis a fault has taken in this tick, and have the others do what their tables say."""
        self._begun = True
        for number, lane in enumerate(self._lanes):
            latched, before = lane.turn.tick.latched, self._latched[number]
            self._latched[number] = latched
            if latched & ~before:
                self._touch(number, centred=latched & ~before & CENTRES != 0)
            request = lane.turn.tick.request
            if request is not None and request.kind == RUN and lane.turn.tick.answer == TAKEN:
                (self._sharing.add if request.values[2] == 1.0 else self._sharing.discard)(number)
        if self._sharing:
            self._share()
        if self._ties:
            self._tie()

    def _share(self) -> None:
        """Have those that go through one program do it record by record, or all hold where one is stopped."""
        lanes = [self._lanes[number] for number in sorted(self._sharing)]
        stages = [lane.turn.tick.progress.stage for lane in lanes]
        if any(stage < UNDER_WAY for stage in stages):
            for lane, stage in zip(lanes, stages, strict=True):
                if stage >= UNDER_WAY and not lane.touched:
                    lane.touched = HOLD
            self._sharing.clear()
        elif all(stage == DONE for stage in stages) and not any(lane.touched for lane in lanes):
            for lane in lanes:
                lane.touched = GO_ON

    def _tie(self) -> None:
        """Tell those who are led what the others have come to, and keep the halves of a gantry together."""
        lanes = self._lanes
        for number, lane in enumerate(lanes):
            self._sampled[number] = sampled_ns(lane.turn.tick, *self._sampled[number]), lane.turn.tick.t_ns
        for follower, leader, gantry in self._ties:
            lanes[follower].told = said(lanes[leader].turn.tick, self._sampled[leader][0])
            if gantry:
                lanes[leader].told = said(lanes[follower].turn.tick, self._sampled[follower][0])
                _keep_together(lanes[follower], lanes[leader])

    def _touch(self, number: int, *, centred: bool) -> None:
        for other, lane in enumerate(self._lanes):
            table = self._others[other]
            kind = _TOUCHES[table.centre if centred else table.stop]
            if _are_tied(self._ties, number, other):
                continue  # they do all together
            if other != number and kind and is_engaged(lane.turn.tick.state):
                lane.touched = max(kind, lane.touched)  # to centre is more than to stop


class Tie(NamedTuple):
    """Two axes of which one is led by the other, by their places."""

    follower: int
    leader: int
    gantry: bool


def ties_of(configs: Sequence[Config]) -> tuple[Tie, ...]:
    """Who is led by whom among the axes that are there."""
    names = [config.name for config in configs]
    found = ((n, config.reference.follow) for n, config in enumerate(configs))
    return tuple(
        Tie(n, names.index(follow.axis), follow.skew_m is not None)
        for n, follow in found
        if follow is not None and not follow.leads and follow.axis in names
    )


def _are_tied(ties: Sequence[Tie], one: int, other: int) -> bool:
    return any(tie.gantry and {tie.follower, tie.leader} == {one, other} for tie in ties)


def sampled_ns(tick: Tick, before_ns: int, last_ns: int) -> int:
    """The instant that an axis's estimate and reference hold for.

    Args:
        tick: its last one.
        before_ns: that of the tick before.
        last_ns: SYNC of the tick before.
    """
    m = tick.measurement
    if m.fresh & ENCODER and not m.encoder_defects & ODD:
        return tick.t_ns + m.encoder_offset_ns
    return before_ns + tick.t_ns - last_ns


def said(tick: Tick, at_ns: int) -> Told:
    """What others are told of an axis's tick."""
    return Told(at_ns, *tick.reference, tick.estimate.position_m, tick.estimate.velocity_m_s)


def _keep_together(follower: Companion, leader: Companion) -> None:
    """What becomes of one half of a gantry is done by the other, which carries the same load."""
    one, other = follower.turn.tick.state, leader.turn.tick.state
    if is_engaged(one) and not is_engaged(other):
        follower.touched = CENTRE
    elif is_engaged(other) and not is_engaged(one):
        leader.touched = CENTRE
    elif one == STOPPING != other and is_engaged(other):
        leader.touched = max(leader.touched, DISARM)


class Asking:
    """Requests of operators for several axes, dealt to all of them in one tick.

    To arm and to go somewhere, all do it or none. Of all else some may have nothing to do.
    """

    def __init__(self, end: SharedEnd, axes: int) -> None:
        self._end = end
        self.ends = tuple(_LaneEnd(self, number) for number in range(axes))
        """Of each axis, for its lane."""
        self._dealt: dict[int, Request] = {}  # and not answered
        self._ticks: dict[int, Tick] = {}  # that have answered
        self._kind = 0

    def look(self, last: Sequence[Tick]) -> bool:
        """Take the next request that came, if there is none under way.

        Args:
            last: the last tick of each axis; none in the first one.

        Returns:
            Whether axes have been asked something, and have not answered yet.
        """
        if self._dealt or any(end.request for end in self.ends):
            return True
        if not (asked := self._end.take_all()):
            return False
        self._dealt, self._ticks = asked, {}
        self._kind = next(iter(asked.values())).kind
        hindered = [lane for lane in asked if not last or _refuses(asked[lane], last[lane])]
        if hindered and (lane := hindered[0]) < len(last):
            refusing = last[lane]
            wrong = refusing.state != State.DISARMED
            answer = Answer.WRONG_STATE if wrong else Answer.BLOCKED
            self._dealt = {}
            self._end.answer_of(lane, refusing._replace(answer=int(answer)))
            return False
        for lane, request in asked.items():
            self.ends[lane].request = request
        return True

    def answered(self, lane: int, tick: Tick) -> None:
        """An axis has decided."""
        if self._dealt.pop(lane, None) is None:
            return
        self._ticks[lane] = tick
        if self._dealt:
            return
        taken = [n for n, found in self._ticks.items() if found.answer == Answer.TAKEN]
        refused = [n for n in self._ticks if n not in taken]
        undo = _UNDO.get(self._kind)
        if refused and undo is not None:
            for n in taken:
                self.ends[n].request = undo
        tells = (refused if undo is not None else taken) or taken or refused
        self._end.answer_of(tells[0], self._ticks[tells[0]])


def _refuses(request: Request, last: Tick) -> bool:
    """Whether an axis will certainly not do what all have to do, or none."""
    if request.kind == ARM:
        blocks = BLOCKS_ARM & ~(1 << F.UNPROVEN) if request.values == (2.0,) else BLOCKS_ARM
        return last.state != State.DISARMED or last.present & blocks != 0
    if request.kind == RECORD and last.progress.stage >= UNDER_WAY:
        return True  # who has none under way would lose the one that it has
    return request.kind == RESTART and is_engaged(last.state)


class _LaneEnd:
    """One axis's share of what is asked of several."""

    def __init__(self, asking: Asking, number: int) -> None:
        self._asking = asking
        self._number = number
        self.request: Request | None = None

    def take(self) -> Request | None:
        """The next request, if there is one; never waits."""
        request, self.request = self.request, None
        return request

    def answer(self, tick: Tick) -> None:
        """Tell what became of the request taken last."""
        self._asking.answered(self._number, tick)
