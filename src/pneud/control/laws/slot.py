"""The slot for laws beside the sliding one: which of them runs, their gains, and the table of them all.

Another law is a module like `pid` and a few lines here: its kind, its gains, its state, its turn in each
function and its line in the table.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

from pneud.control.laws import adrc as adrc_
from pneud.control.laws import pid as pid_
from pneud.control.laws.adrc import Adrc, AdrcState, at_rest, extend, in_motion
from pneud.control.laws.adrc import after as adrc_after
from pneud.control.laws.adrc import demand as adrc_demand
from pneud.control.laws.open_loop import OpenLoop
from pneud.control.laws.pid import Pid, PidState
from pneud.control.laws.pid import after as pid_after
from pneud.control.laws.pid import begin as pid_begin
from pneud.control.laws.pid import demand as pid_demand
from pneud.control.laws.situation import Situation

SLIDING, PID, ADRC = 0, 1, 2


class Slot(NamedTuple):
    """Which law runs, and the gains of all but the sliding one, whose parameters are `Sliding`."""

    kind: int = SLIDING
    pid: Pid = Pid(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    adrc: Adrc = Adrc(0.0, 0.0, 0.0, 0.0, 0.0)


class SlotState(NamedTuple):
    """What the laws of the slot carry from tick to tick."""

    pid: PidState = PidState()
    adrc: AdrcState = AdrcState()


class Entry(NamedTuple):
    """A law of the slot as it is named, made, tuned and judged."""

    name: str  # in configurations, of its table there, and of its gains in `Slot`
    kind: int
    gains: type[Any]
    tunable: tuple[str, ...]  # its first gains: those that are not computed
    made: Callable[[tuple[float, ...], float], Any]  # gains from the tunable ones and the sample time [s]
    is_sound: Callable[[Any], bool]  # whether each of finite gains is one of its kind
    loop: Callable[[Any], OpenLoop]
    rule: Callable[[float], dict[str, float]]  # gains for a bandwidth [rad/s]


IN_SLOT = (
    Entry("pid", PID, Pid, Pid._fields, pid_.made, pid_.is_sound, pid_.loop, pid_.rule),
    Entry("adrc", ADRC, Adrc, Adrc._fields[:5], adrc_.made, adrc_.is_sound, adrc_.loop, adrc_.rule),
)


def joined(s: Situation, unmodelled_n: float, slot: Slot) -> SlotState:
    """The state of laws that take over a load at rest, under a force [N] that is not fed forward."""
    return SlotState(pid_begin(unmodelled_n, slot.pid), at_rest(s.e))


def taken_over(own: SlotState, s: Situation, before: Slot, after: Slot) -> SlotState:
    """The state of a law that takes over in motion; with other gains of its own it goes on as it was."""
    if after.kind == PID and before.kind != PID:
        return SlotState(pid_begin(s.e.force_n - s.friction.now_n, after.pid), own.adrc)
    if after.kind == ADRC and (before.kind != ADRC or before.adrc.observer_rad_s == 0.0):
        return SlotState(own.pid, in_motion(s))
    return own


def demand(own: SlotState, s: Situation, slot: Slot) -> tuple[SlotState, float]:
    """Rate of the force [N/s] that the law in the slot asks for, and what it has taken in for that."""
    if slot.kind == PID:
        return own, pid_demand(own.pid, s, slot.pid)
    if slot.adrc.observer_rad_s > 0.0:
        own = SlotState(own.pid, extend(own.adrc, s, slot.adrc))
    return own, adrc_demand(own.adrc, s, slot.adrc)


def afterwards(own: SlotState, s: Situation, Z: float, possible: bool, slot: Slot) -> SlotState:
    """What is carried to the next tick.

    Args:
        own: as `demand` left it.
        s: the situation.
        Z: the rate of the force in the end [N/s].
        possible: whether the valve can give it.
        slot: which law.
    """
    if slot.kind == PID:
        return SlotState(pid_after(own.pid, s, Z, possible, slot.pid), own.adrc)
    return SlotState(own.pid, adrc_after(own.adrc, s))
