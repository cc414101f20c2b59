"""One axis in the running loop: what is asked of it, what is recorded of it, when its run is over."""

from __future__ import annotations

import math
import time
from collections.abc import Collection
from typing import Protocol

from pneud.bus.link import Link
from pneud.log.live.ring import FrameTotals
from pneud.loop.conditions import Conditions
from pneud.loop.console_watch import ConsoleWatch
from pneud.loop.options import Options
from pneud.loop.recorder_watch import RecorderWatch
from pneud.loop.tally import Tally
from pneud.loop.turn import END_TICKS, Turn
from pneud.rig.truth import TruthReader
from pneud.safety.faults import BLOCKS_ARM, F
from pneud.safety.supervisor import is_engaged
from pneud.signals import Answer, Frame, Host, Request, RequestKind, State, Tick, Timing, Told

FAULT_S = 0.1  # how long a run that ends on a fault goes on telling the valve to centre
SNAPSHOT_PIECES = 128  # of a profile; the state with a longer one would take too long to hand over
ARM, DISARMED, FAULT = int(RequestKind.ARM), int(State.DISARMED), int(State.FAULT)
ARM_UNPROVEN, UNPROVEN = Request(ARM, (2.0,)), int(Host.UNPROVEN)
RESTART, TAKEN = int(RequestKind.RESTART), int(Answer.TAKEN)


class Operator(Protocol):
    """The way to those who ask something of an axis."""

    def take(self) -> Request | None:
        """The next request, if there is one; never waits."""

    def answer(self, tick: Tick) -> None:
        """Tell what became of the request taken last; never waits."""


class Lane:
    """All that the loop has to do for one axis alone.

    Attributes:
        turn: the exchange.
        conditions: of the host.
        recorder: takes the records.
        tally: of the run.
        request: of this tick.
        early: bits of `signals.Host` of this tick that its answers have no part in.
        operated: an operator has asked something of the axis, or a fault of another has.
        again: an operator has asked the daemon to begin anew.
        identifiers: of frames that are this axis's alone; none where it shares the bus with no other.
        touched: a `RequestKind` that a fault of another axis makes of the next tick, 0 for none.
        told: what an axis has said that leads this one, or is beside it; None where there is none.
        decided_ns: when the axis had decided; like the next one, for the loop to set.
        done_ns: when its command had been sent.
    """

    def __init__(
        self,
        turn: Turn,
        link: Link,
        recorder: RecorderWatch,
        options: Options,
        truth: TruthReader | None = None,
        console: Operator | None = None,
        identifiers: Collection[int] = (),
    ) -> None:
        self.turn = turn
        self.identifiers = identifiers
        self.touched = 0
        self.told: Told | None = None
        self._link = link
        self.conditions = Conditions(turn.inbox, link)
        self.recorder = recorder
        self.tally = Tally(truth=truth is not None, timed=True, sync=turn.inbox.sync)
        self.request: Request | None = None
        self.early = 0
        self.operated = self.again = False
        self.decided_ns = self.done_ns = 0
        self._truth = truth
        self._at_sync = turn.inbox.makes_sync  # the plant tells of the SYNC that was sent
        self._truth_m = math.nan
        self._console = console
        self._watch = ConsoleWatch(recorder.ring)
        self._asked = False  # the request is an operator's
        self._unproven = UNPROVEN if options.unproven else 0
        self._trusted = False  # by an operator: no movement test is asked for
        self._armed = not options.auto_arm
        self._shut = False  # shutdown has been requested of the axis
        self._end_on_fault = options.end_on_fault
        self._fault_ticks = options.ticks(FAULT_S, END_TICKS)
        self._idle = 0  # ticks since it was engaged
        self._record_ns = -1  # that the last record took to hand over

    @property
    def waits(self) -> bool:
        """Whether the run itself is still to arm the axis, and cannot yet."""
        return not self._armed and not self._can_arm()

    def prepare(self, host: int, ending: bool, may_arm: bool = True) -> None:
        """Find what there is to know before the answers come: what is asked of the axis, what its host lacks.

        Args:
            host: bits of `signals.Host` from elsewhere.
            ending: the run is to end.
            may_arm: the run itself may arm the axis, as far as others are concerned.
        """
        self._ask(ending, may_arm)
        t_ns = self.turn.t_ns
        lost = 0 if self._shut else self._watch.host(t_ns)
        unproven = 0 if self._trusted else self._unproven
        self.early = self.conditions.early(t_ns, host | lost | unproven | self.recorder.host)

    def _ask(self, ending: bool, may_arm: bool) -> None:
        """Find what is asked of the axis in this tick, by the run itself or else by an operator."""
        request, self._asked = self._own_request(ending, may_arm), False
        if request is None and self._console is not None:
            request = self._console.take()
            if request is not None:
                self._asked = self.operated = True
                self._trusted |= request == ARM_UNPROVEN
        self.request = request

    def _own_request(self, ending: bool, may_arm: bool) -> Request | None:
        if ending and not self._shut:
            self._shut = True
            return Request(RequestKind.SHUTDOWN)
        if self.touched:
            kind, self.touched, self.operated = self.touched, 0, True
            return Request(kind)
        if self._armed or not may_arm or not self._can_arm():
            return None
        return Request(RequestKind.ARM, (1.0,))

    def _can_arm(self) -> bool:
        if not self.tally.ticks:
            return False
        last = self.turn.tick
        return last.state == DISARMED and not last.present & BLOCKS_ARM and self.recorder.begun

    def see_truth(self, sync_ns: int) -> None:
        """Look for the true position at this tick's SYNC."""
        if self._truth is not None:
            t_ns = self.turn.t_ns
            self._truth_m = self._truth.get(t_ns, sync_ns) if self._at_sync else self._truth.near(t_ns)

    def record(
        self, sync: Frame, lateness_ns: int, set_ns: int, called_ns: int, *, freeze: bool, report: bool
    ) -> None:
        """Hand the tick over, after its command was sent.

        Args:
            sync: as it was sent.
            lateness_ns: of the wake-up, after the first of the grid points that it missed.
            set_ns: when the set was complete or given up.
            called_ns: when it was the axis's turn: then, or when the command of the one before had been sent.
            freeze: hand the state over, too.
            report: say what the run has come to so far.
        """
        turn, ring = self.turn, self.recorder.ring
        newest_ns, sent_ns, begun_ns = turn.newest_ns, turn.sent_ns, time.monotonic_ns()
        if self._truth is not None and math.isnan(self._truth_m):  # the plant had not seen SYNC before
            self.see_truth(sync.stamp_ns)
        timing = Timing(
            lateness_ns,
            set_ns - turn.t_ns,
            self.decided_ns - called_ns,
            self.done_ns - self.decided_ns,
            sent_ns - newest_ns if newest_ns and sent_ns > 0 else -1,
            self._record_ns,
        )
        record = turn.record(timing, sync, self._truth_m)
        ring.put(record)
        if freeze or (self._shut and self._idle == 1):  # the last state tells what the run has come to
            short = len(turn.axis.state.profile) <= SNAPSHOT_PIECES
            ring.put_state(turn.t_ns, turn.freeze() if short else None)
        if report:
            self._report()
        self._record_ns = time.monotonic_ns() - begun_ns
        if self._asked and self._console is not None:
            self._console.answer(turn.tick)
        self.tally.add(record, ending=self._shut)

    def _report(self) -> None:
        """Say what the run has come to so far; to those who look on, so now and then will do."""
        ring, link, c = self.recorder.ring, self._link, self.turn.inbox.counts()
        ring.set_mileage(self.turn.axis.mileage)
        ring.set_frames(FrameTotals(c.rx, link.tx, c.lost + link.rx_dropped, c.crc, c.stale, c.late))

    def over(self) -> bool:
        """Whether nothing is left to do for the axis after this tick; to be asked once in each."""
        tick, request = self.turn.tick, self.request
        self._watch.after(tick, asked=self._asked)
        if request is not None and not self._asked and request.kind == ARM:
            # unless it says that it cannot be reached, what is in the way may pass, and arming is tried again
            self.tally.asked_to_arm(tick)
            self._armed = is_engaged(tick.state) or bool(tick.present & 1 << F.UNREACHABLE)
        elif self._asked and request is not None and request.kind == RESTART and tick.answer == TAKEN:
            self._shut = self.again = True
        if is_engaged(tick.state):
            self._armed = True  # whoever has armed it: the run itself does so once, and not after a disarm
            self._idle = 0
            return False
        self._idle += 1
        if self._shut:
            return self._idle >= END_TICKS
        # an operator is there to clear a fault
        ends = self._end_on_fault and not self.operated and tick.state == FAULT
        return ends and self._idle >= self._fault_ticks
