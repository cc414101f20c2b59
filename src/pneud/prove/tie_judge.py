"""Oracles of two axes of which one is led by the other, or which are the halves of a gantry."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pneud.prove.axis_judge import CALM_TICKS, PATIENCE_TICKS, AxisJudge
from pneud.safety.supervisor import is_engaged
from pneud.signals import State

if TYPE_CHECKING:
    from pneud.loop.company import Tie
    from pneud.prove.judge import Judge

ASKEW_TICKS = 6  # until what is too far apart comes to rest: the loop has to hear of it, and to believe it
ASKEW_M = 1e-3  # that it may be more apart than is allowed, until the loop can know
APART_M = 1e-3  # of what leads an axis and what it is led to: a tick's age, and what was skipped
JOINS_S = 1.0  # beyond the way there, until an axis is where it is led
RESTS_S = 1.5  # until it rests, where nobody leads it any more
_TRACKING, _STOPPING = int(State.TRACKING), int(State.STOPPING)


class TieJudge:
    """Looks at one such pair, when both have decided a tick.

    Attributes:
        gantry: they carry one load.
    """

    def __init__(self, judge: Judge, tie: Tie) -> None:
        """Nothing has happened."""
        self.gantry = tie.gantry
        self._judge = judge
        self._follower, self._leader = judge.axes[tie.follower], judge.axes[tie.leader]
        follow = self._follower.config.reference.follow
        assert follow is not None
        self._scale, self._offset_m, self._skew_m = follow.scale, follow.offset_m, follow.skew_m or 0.0
        self._of_reference = follow.of == "reference"
        self._transfer_m_s = self._follower.config.limits.transfer.speed_m_s
        self.begins()

    def begins(self) -> None:
        """A loop is about to run."""
        self._alone = self._askew = 0  # ticks in a row
        self._joined_ns = 0  # when the one that is led has to be where it is led; 0: it is not led
        self._led_ns = 0  # when somebody led it last
        self._states = (0, 0)  # of follower and leader, in the last tick

    def joins(self, one: AxisJudge) -> AxisJudge | None:
        """The other half, where an axis is one of a gantry's."""
        if not self.gantry or one not in (self._follower, self._leader):
            return None
        return self._leader if one is self._follower else self._follower

    def may_centre(self, one: AxisJudge) -> bool:
        """Whether one half may be brought to rest because of the other, which has been no more engaged."""
        state = self._states[one is self._follower]
        return not is_engaged(state) or state == _STOPPING

    def decided(self) -> None:
        """Both have decided a tick."""
        follower, leader = self._follower.last, self._leader.last
        if follower is None or leader is None:
            return
        if self.gantry:
            self._together(is_engaged(follower.state), is_engaged(leader.state))
        elif self._of_reference:
            self._led(is_engaged(leader.state))
        self._states = follower.state, leader.state

    def _together(self, one: bool, other: bool) -> None:
        self._alone = self._alone + 1 if one != other else 0
        if self._alone > PATIENCE_TICKS:
            self._judge.says_no("gantry", f"one half is engaged alone for {self._alone} ticks")
        nodes = self._follower.node, self._leader.node
        assert self._follower.last is not None and self._leader.last is not None
        states = self._follower.last.state, self._leader.last.state
        if not (one and other) or _STOPPING in states or nodes[0] is None or nodes[1] is None:
            self._askew = 0
            return
        skew_m = nodes[1].truth().position_m - (nodes[0].truth().position_m - self._offset_m)
        self._askew = self._askew + 1 if abs(skew_m) > self._skew_m + ASKEW_M else 0
        if self._askew > ASKEW_TICKS:
            self._judge.says_no("gantry", f"{1e3 * skew_m:.1f} mm askew, and it goes on")

    def _led(self, leads: bool) -> None:
        """Who tracks is where he is led, once he has come there; and rests where nobody leads him."""
        follower, leader = self._follower.last, self._leader.last
        assert follower is not None and leader is not None
        now_ns = follower.t_ns
        if leads:
            self._led_ns = now_ns
        if follower.state != _TRACKING or (follower.request is not None and follower.answer):
            self._joined_ns = 0
            return
        if not leads:
            self._joined_ns = 0
            rests = now_ns - self._led_ns > RESTS_S * 1e9
            if rests and abs(follower.reference.velocity_m_s) > 1e-6:
                self._judge.says_no("led", f"{self._follower.name} moves, and nobody leads it")
            return
        goal_m = self._scale * leader.reference.position_m + self._offset_m
        apart_m = abs(follower.reference.position_m - goal_m)
        if not self._joined_ns:
            self._joined_ns = now_ns + round(1e9 * (apart_m / self._transfer_m_s + JOINS_S))
        calm = min(self._follower.calm, self._leader.calm) >= CALM_TICKS
        if calm and now_ns > self._joined_ns and apart_m > APART_M:
            name, mm = self._follower.name, 1e3 * apart_m
            self._judge.says_no("led", f"{name} is to be {mm:.2f} mm from where it is led")
