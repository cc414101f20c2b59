"""What the server and the desk say to each other: what to ask of the loop, and what there is to tell."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

from pneud.console import handoff, protocol
from pneud.console.programs import AxisFacts, Compiled
from pneud.console.protocol import ProtocolError
from pneud.control.reference import Bounds
from pneud.signals import Request, RequestKind

MOTION = (
    *(RequestKind.ARM, RequestKind.DISARM, RequestKind.STOP, RequestKind.HOLD),
    *(RequestKind.HOME, RequestKind.GOTO, RequestKind.TRACK, RequestKind.RUN),
    RequestKind.FORCE,
)
RENEWED = (RequestKind.JOG, RequestKind.PROBE)  # by the same again, which is no other command


class Orders(NamedTuple):
    """What a request comes to."""

    words: str  # for the log
    requests: tuple[Request, ...]  # one after the other; the first refusal ends it
    urgent: bool = False  # needs no lease, goes first and takes the lease
    free: bool = False  # needs no lease
    done: Callable[[], dict[str, Any]] | None = None  # called when all are taken; fields for the reply
    undo: Request | None = None  # asked for where not all are taken
    unfinished: bool = False  # another message of the same client is to follow
    follows: bool = False  # such an unfinished one, without which it is not done
    attended: bool = False  # the axis is to hold where its client goes
    axes: tuple[int, ...] = (0,)  # places of those that are asked, all in one tick
    each: Mapping[int, Request] | None = None  # what, where it is not the same of all
    steps: tuple[Mapping[int, Request], ...] = ()  # one after the other, where each is not the same of all
    then: protocol.GotoAll | None = None  # is to be planned when these axes stand, and replied to then

    def step(self, number: int) -> Mapping[int, Request]:
        """What to ask next of which axes."""
        if self.steps:
            return self.steps[number]
        return self.each if self.each is not None else dict.fromkeys(self.axes, self.requests[number])


class Desk(Protocol):
    """What the server asks about the axis."""

    name: str
    """Of the axis; every reply has it."""
    carried_by: str
    """The axis that leads it in a gantry; empty where it is led by itself."""

    def read(self) -> None:
        """Read what `status` and the plan of a reload depend on; called in another thread."""

    def status(self) -> dict[str, Any]:
        """The fields of the reply to `status`."""

    def attach(self) -> tuple[dict[str, Any], int]:
        """The fields of the reply to `attach`, and the descriptor that goes with it."""

    def gains(self) -> dict[str, Any]:
        """The fields of the reply to `tune_get`."""

    def engaged_in(self) -> str:
        """The axis's state, where it is engaged; empty where it is not."""

    def moves(self) -> bool:
        """Whether the axis is in a motion that a hold would bring to rest."""

    def stands_m(self) -> float:
        """Where the axis holds.

        Raises:
            ProtocolError: it does not hold.
        """

    def bounds(self, distance_m: float) -> Bounds:
        """What a move of so much from rest would keep to, if it went alone."""

    def plan(self, message: protocol.Request) -> Orders:
        """What to ask of the loop.

        Raises:
            ProtocolError: what is asked for cannot be done.
        """

    def facts(self) -> AxisFacts:
        """What a program has to know of the axis."""

    def taken(self, found: Compiled) -> dict[str, Any]:
        """The axis has a program; fields for the reply."""

    def shares(self) -> tuple[str, ...]:
        """Names of the axes that go through its program."""

    def refused(self, answer: int, words: str, outcome: handoff.RequestOutcome) -> ProtocolError:
        """What to tell a client about the axis's refusal."""

    def half_done(self, undo: Request | None) -> None:
        """What must be undone where all ends here has begun; None: it is whole, or undone."""

    def left_half_done(self) -> Orders | None:
        """What undoes what the console before this one has left half done."""
