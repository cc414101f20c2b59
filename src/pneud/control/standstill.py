"""Standstill: a load that is where it should be is left alone; one that is nearly there is nudged.

Friction holds a load at rest. Its bristles bend by micrometres under newtons, and a law that moves masses
makes the load hunt on what encoder and pressures cannot tell apart from noise. So, while the reference stands
still, the law keeps the valve shut while the load is within a band and it asks for little. A while after the
reference has come to rest the law gives way:

* to a closed valve, where the load would come to rest within a band, or has been hunting for long;
* to nudges, where it sticks beside the band: steps of force, each spread over one swing of the load on its
  bristles, so that it does not ring, if the valve can open so little; and as large as the stiffness that the
  step before has shown asks for;

and has the load back when it leaves a wider band, or moves.

A load that swings slowly on its bristles creeps off behind a closed valve. The law keeps that one, and
becomes quiet: its opening is smoothed, and given only from a size on. Where it rings all the same, it gives
way.
"""

import math
from typing import NamedTuple

from pneud.control.motion import MotionFilter
from pneud.physics.friction import Friction
from pneud.signals import Reference

# modes
LAW = 0
CLOSED = 1
NUDGED = 2

SHARE = 0.8  # of the error that a step of force is to take away
ROOM = 0.3  # of what static friction still holds that one step may take
MOST = 0.3  # of static friction that one step may be
LEAST = 0.01  # of static friction that any step may be
TELLING = 0.02  # of static friction, below which a step teaches nothing
FOLLOWED = 0.3  # of a step of force that has to have come before anything is learnt of it
STIFFEST, SOFTEST = 40.0, 0.3  # stiffness that may be found, in terms of that of the bristles
RISE, FALL = 2.0, 0.5  # by which what was found may change from step to step
FORCE_RAD_S = 40.0  # bandwidth of the force that is led along a step
LEAST_V = 0.01  # opening that is not worth a way across the dead zone
SMALL_V = 1.5 * LEAST_V  # opening that leads along a small step of force
SWINGS = 1.5  # that a step of force and what follows it take
TRIES = 1  # times that the law may make a load swing
LONGEST = 4.0  # swings that a load has to come to rest after a step of force
SLOW_RAD_S = 50.0  # swing on the bristles so slow that a load creeps off behind a closed valve
OPENS_V, SHUTS_V = 0.06, 0.01  # smoothed opening from which on a quiet law gives it, and down to which
RINGS_V = 0.04  # mean step of the command of a quiet law that rings
RINGING = 4  # times as long until that is known as until the law becomes quiet


class Standstill(NamedTuple):
    """When a load counts as standing still; all zero: never."""

    enter_m: float = 0.0  # error within which the load is left alone
    leave_m: float = 0.0  # error beyond which it no longer is
    near_m: float = 0.0  # error within which the law may give way to nudges
    far_m: float = 0.0  # error beyond which the law has the load back
    hunts_m: float = 0.0  # error within which the valve is closed on a load that hunts
    leave_m_s: float = 0.0  # and speed
    mass_kg: float = 1.0  # that swings on the bristles
    swing: int = 1  # ticks of one swing on the bristles
    smooth: float = 1.0  # share of a change of force and speed that is believed in a tick
    stuck: int = 1  # ticks without a reading that differs, until the load may be nudged
    patience: int = 1  # ticks of hunting, until the valve is closed
    grace: int = 1  # ticks that the load then has to come to rest
    restless: float = 0.0  # share of a step of the command that is remembered
    restless_v: float = 0.0  # mean step of the command that is hunting
    nudge_v: float = 0.0  # greatest opening of a nudge
    stick_m: float = 0.0  # readings that differ by no more are the same
    stick: int = 1  # ticks without a reading that differs, until the load counts as held by friction
    held: float = 0.0  # share of the force in balance that friction then takes over in a tick
    settle: int = 0  # ticks that the law has, before it gives way
    shut_v: float = 0.0  # opening up to which it keeps the valve shut within the band
    firm: float = 1.0  # times the law's bandwidth, with which it brings the load to rest
    again: int = 1  # times that giving way has to be of no use, until the law has neither
    wait_m: float = 0.0  # error within which a load is left to swing out the first time, too
    trusts: bool = False  # what has been learnt of friction, rather than what is configured
    calm: int = 0  # ticks after which the law hears of the load through a calmer filter; 0: never
    filter: MotionFilter = MotionFilter(0.0, 0.0, 0.0, 0.0)  # that one
    quiet: float = 0.0  # share of a change of its opening that a quiet law believes in a tick; 0: never quiet


class StandstillState(NamedTuple):
    """What is remembered of it."""

    mode: int = LAW
    ticks: int = 0  # ticks in that mode; of a step of force where it nudges
    speed_m_s: float = 0.0  # smoothed
    net_n: float = 0.0  # force out of balance, smoothed
    restless_v: float = 0.0  # mean step of the command
    from_n: float = 0.0  # force of the pressures when the step of force began
    step_n: float = 0.0  # of force
    error_m: float = 0.0  # when it began
    stiffness_n_m: float = 0.0  # found; 0: none yet
    anchor_m: float = 0.0  # reading since which none has differed
    same: int = 0  # readings since then
    tries: int = 0  # times that giving way, or a quiet law, was of no use, since the reference stands still
    wanted_v: float = 0.0  # opening of the law, smoothed, while it is quiet
    given_v: float = 0.0  # of that


def is_still(now: Reference, goal: Reference) -> bool:
    """Whether a reference stands still from now until the command has its effect."""
    return (
        now.velocity_m_s == 0.0
        and now.acceleration_m_s2 == 0.0
        and goal.velocity_m_s == 0.0
        and goal.acceleration_m_s2 == 0.0
    )


def read(s: StandstillState, position_m: float, p: Standstill) -> StandstillState:
    """The state after an encoder reading."""
    if abs(position_m - s.anchor_m) > p.stick_m:
        return _read(s, position_m, 0)
    return _read(s, s.anchor_m, s.same + 1)


def is_calm(s: StandstillState, p: Standstill) -> bool:
    """Whether a load has stood for long enough to be heard of through the calmer filter."""
    return p.calm > 0 and (s.mode != LAW or s.ticks >= p.calm)


def is_firm(s: StandstillState, p: Standstill) -> bool:
    """Whether the law is to bring the load to rest: giving way has not been of no use too often."""
    return s.tries < p.again


def is_quiet(s: StandstillState, f: Friction, p: Standstill) -> bool:
    """Whether the law has the load, which swings slowly on its bristles as far as is known, and is quiet."""
    if p.quiet <= 0.0 or s.mode != LAW or s.tries > 0 or s.ticks < p.calm:
        return False
    return f.sigma0_n_m < SLOW_RAD_S * SLOW_RAD_S * p.mass_kg


def rings(s: StandstillState, error_m: float, p: Standstill) -> bool:
    """Whether a quiet law does not keep the load calm."""
    loud = s.restless_v > RINGS_V and s.ticks > RINGING * p.calm
    return loud or abs(error_m) > p.near_m


def quieted(s: StandstillState, opening_v: float, p: Standstill) -> StandstillState:
    """The state with what a quiet law gives of its opening: none until it is worth crossing the dead zone.

    Args:
        s: of this tick.
        opening_v: that the law asks for.
        p: parameters.
    """
    wanted_v = s.wanted_v + p.quiet * (opening_v - s.wanted_v)
    least_v = SHUTS_V if wanted_v * s.given_v > 0.0 else OPENS_V
    return _giving(s, wanted_v, 0.0 if abs(wanted_v) <= least_v else wanted_v)


def has_a_while(s: StandstillState, p: Standstill) -> bool:
    """Whether the law has time yet before it gives way: a while at first, half of it after each failure."""
    return is_firm(s, p) and (s.ticks if s.tries == 0 else 2 * s.ticks) < p.settle


def is_held(s: StandstillState, p: Standstill) -> bool:
    """Whether friction holds a load left alone: no reading differed for longer than any force would need."""
    return s.mode != LAW and p.held > 0.0 and s.same >= p.stick


def keeps_shut(error_m: float, opening_v: float, shut: bool, p: Standstill) -> bool:
    """Whether the law keeps the valve shut for a load at rest.

    Args:
        error_m: reference minus estimate.
        opening_v: that it asks for.
        shut: it is shut.
        p: parameters.
    """
    return abs(opening_v) <= p.shut_v and abs(error_m) <= (p.leave_m if shut else p.enter_m)


def stand(
    s: StandstillState,
    error_m: float,
    velocity_m_s: float,
    net_n: float,
    force_n: float,
    friction_n: float,
    still: bool,
    f: Friction,
    p: Standstill,
) -> StandstillState:
    """The state after a tick.

    Args:
        s: before it.
        error_m: reference minus estimate.
        velocity_m_s: estimated.
        net_n: force that is out of balance.
        force_n: of the pressures.
        friction_n: that holds against it.
        still: the reference stands still.
        f: the friction of a load at rest.
        p: parameters.
    """
    speed_m_s = s.speed_m_s + p.smooth * (velocity_m_s - s.speed_m_s)
    s = _in_mode(s, s.mode, s.ticks + 1, speed_m_s, s.net_n + p.smooth * (net_n - s.net_n), s.restless_v)
    if not still or p.enter_m <= 0.0:
        # what nudges have found, and how the law fared, holds until the reference moves
        s = _giving(_tried(s, 0), 0.0, 0.0)
        return _entered(_stepping(s, s.from_n, s.step_n, s.error_m, 0.0), LAW, 0, 0.0)
    size = abs(error_m)
    if is_quiet(s, f, p):
        if not rings(s, error_m, p):
            return s
        s = _tried(s, 1)
    if s.mode == LAW and has_a_while(s, p):
        return s
    if s.mode == LAW:
        if would_rest(s, error_m, f, p):
            return _entered(s, CLOSED, p.grace, s.restless_v)
        if size <= p.near_m and s.same >= p.stuck:
            return planned(s, error_m, force_n, friction_n, f, p)
        hunts = size <= p.hunts_m and s.restless_v > p.restless_v and s.ticks > p.patience
        if hunts and not runs_away(error_m, velocity_m_s, p):
            return _entered(_tried(s, s.tries + 1), CLOSED, 0, s.restless_v)
        return s
    coming = s.mode == CLOSED and s.ticks < p.grace and swing_m(error_m, velocity_m_s, f, p) <= p.far_m
    if size > p.far_m or (abs(velocity_m_s) > p.leave_m_s and not coming):
        return given_back(s, p)
    if s.mode == CLOSED:
        if size <= p.leave_m or coming:
            return s
        if s.same >= p.stuck:
            return planned(s, error_m, force_n, friction_n, f, p)
        # a load that the law has made swing again and again is left to swing out, and one that is hardly off
        within_m = p.near_m if s.tries > TRIES else p.wait_m
        swings = size <= within_m and s.ticks < p.grace + LONGEST * p.swing
        return s if swings else given_back(s, p)
    if s.step_n * error_m < 0.0:
        return _entered(s, CLOSED, p.grace, s.restless_v)  # past the target
    if s.ticks < SWINGS * p.swing or (s.same < p.stick and s.ticks < LONGEST * p.swing):
        return s
    return planned(learnt(s, error_m, force_n, f), error_m, force_n, friction_n, f, p)


def given_back(s: StandstillState, p: Standstill) -> StandstillState:
    """The law has the load again, and after some times no longer a while before it gives way."""
    return _entered(_tried(s, max(s.tries, min(s.tries + 1, p.again))), LAW, 0, 0.0)


def runs_away(error_m: float, velocity_m_s: float, p: Standstill) -> bool:
    """Whether a load leaves its target fast: one that is pushed makes the command step as hunting does."""
    return error_m * velocity_m_s < 0.0 and abs(velocity_m_s) > p.leave_m_s


def swing_m(error_m: float, velocity_m_s: float, f: Friction, p: Standstill) -> float:
    """How far off [m] a load gets that swings about the target on its bristles."""
    return math.sqrt(error_m * error_m + velocity_m_s * velocity_m_s * p.mass_kg / f.sigma0_n_m)


def would_rest(s: StandstillState, error_m: float, f: Friction, p: Standstill) -> bool:
    """Whether load and bristles would come to rest within the band, were the valve closed, and not ring."""
    sag_m, swing_m = s.net_n / f.sigma0_n_m, s.speed_m_s * math.sqrt(p.mass_kg / f.sigma0_n_m)
    return abs(error_m - sag_m) <= p.enter_m and sag_m * sag_m + swing_m * swing_m <= p.enter_m * p.enter_m


def learnt(s: StandstillState, error_m: float, force_n: float, f: Friction) -> StandstillState:
    """The stiffness that a step of force has shown, where the force has come."""
    given_n = abs(force_n - s.from_n)
    if given_n < max(FOLLOWED * abs(s.step_n), TELLING * f.static_n):
        return s
    moved_m = s.error_m - error_m if s.step_n > 0.0 else error_m - s.error_m
    before = stiffness(s, f)
    found = given_n / max(moved_m, given_n / (STIFFEST * f.sigma0_n_m), 1e-12)
    found = max(FALL * before, min(RISE * before, found))
    found = max(SOFTEST * f.sigma0_n_m, min(STIFFEST * f.sigma0_n_m, found))
    return _stepping(s, s.from_n, s.step_n, s.error_m, found)


def stiffness(s: StandstillState, f: Friction) -> float:
    """Of what holds the load [N/m]: as nudges have found it, or else of the bristles."""
    return s.stiffness_n_m if s.stiffness_n_m > 0.0 else f.sigma0_n_m


def planned(
    s: StandstillState, error_m: float, force_n: float, friction_n: float, f: Friction, p: Standstill
) -> StandstillState:
    """The next step of force; none within the band.

    A step towards breaking away takes a part of what static friction has left, since a load that breaks away
    goes far; where the one before has not moved the load, more was left, and twice as much is taken.
    """
    if abs(error_m) <= p.enter_m:
        return _entered(s, CLOSED, p.grace, s.restless_v)
    left_n = f.static_n - friction_n if error_m > 0.0 else f.static_n + friction_n
    most_n = min(MOST * f.static_n, max(LEAST * f.static_n, ROOM * left_n))
    if s.mode == NUDGED and s.step_n * error_m > 0.0 and abs(error_m - s.error_m) <= p.stick_m:
        most_n = max(most_n, min(MOST * f.static_n, 2.0 * abs(s.step_n)))
    step_n = max(-most_n, min(most_n, SHARE * stiffness(s, f) * error_m))
    s = _stepping(s, force_n, step_n, error_m, s.stiffness_n_m)
    return _entered(s, NUDGED, 0, s.restless_v)


def nudge(
    s: StandstillState, force_n: float, h: float, f1_fill: float, f1_exhaust: float, p: Standstill
) -> float:
    """Opening [V] that the standing load needs: none, or what leads the force along its step.

    Args:
        s: of this tick.
        force_n: of the pressures.
        h: sample time [s].
        f1_fill: F1 for u ≥ 0 [N/(s V)].
        f1_exhaust: F1 for u < 0.
        p: parameters.
    """
    if s.mode == CLOSED:
        return 0.0
    # a small step takes less time: the valve has a least opening
    quickest = abs(s.step_n) / (h * SMALL_V * (f1_fill if s.step_n > 0.0 else f1_exhaust))
    ticks = max(1.0, min(float(p.swing), quickest))
    share = min(1.0, (s.ticks + 1.0) / ticks)
    rate = FORCE_RAD_S * (s.from_n + share * s.step_n - force_n)
    if s.ticks < ticks:
        rate += s.step_n / (ticks * h)
    u = rate / (f1_fill if rate > 0.0 else f1_exhaust)
    if abs(u) < LEAST_V:
        return 0.0
    return max(-p.nudge_v, min(p.nudge_v, u))


def stirred(s: StandstillState, step_v: float, p: Standstill) -> StandstillState:
    """The state with the size of a step of the law's command in it."""
    return _entered(s, s.mode, s.ticks, s.restless_v + p.restless * (step_v - s.restless_v))


def _read(s: StandstillState, anchor_m: float, same: int) -> StandstillState:
    # written out, since numba knows no _replace
    return StandstillState(
        s.mode,
        s.ticks,
        s.speed_m_s,
        s.net_n,
        s.restless_v,
        s.from_n,
        s.step_n,
        s.error_m,
        s.stiffness_n_m,
        anchor_m,
        same,
        s.tries,
        s.wanted_v,
        s.given_v,
    )


def _tried(s: StandstillState, tries: int) -> StandstillState:
    return StandstillState(
        s.mode,
        s.ticks,
        s.speed_m_s,
        s.net_n,
        s.restless_v,
        s.from_n,
        s.step_n,
        s.error_m,
        s.stiffness_n_m,
        s.anchor_m,
        s.same,
        tries,
        s.wanted_v,
        s.given_v,
    )


def _entered(s: StandstillState, mode: int, ticks: int, restless_v: float) -> StandstillState:
    return _in_mode(s, mode, ticks, s.speed_m_s, s.net_n, restless_v)


def _in_mode(
    s: StandstillState, mode: int, ticks: int, speed_m_s: float, net_n: float, restless_v: float
) -> StandstillState:
    return StandstillState(
        mode,
        ticks,
        speed_m_s,
        net_n,
        restless_v,
        s.from_n,
        s.step_n,
        s.error_m,
        s.stiffness_n_m,
        s.anchor_m,
        s.same,
        s.tries,
        s.wanted_v,
        s.given_v,
    )


def _stepping(
    s: StandstillState, from_n: float, step_n: float, error_m: float, stiffness_n_m: float
) -> StandstillState:
    return StandstillState(
        s.mode,
        s.ticks,
        s.speed_m_s,
        s.net_n,
        s.restless_v,
        from_n,
        step_n,
        error_m,
        stiffness_n_m,
        s.anchor_m,
        s.same,
        s.tries,
        s.wanted_v,
        s.given_v,
    )


def _giving(s: StandstillState, wanted_v: float, given_v: float) -> StandstillState:
    return StandstillState(
        s.mode,
        s.ticks,
        s.speed_m_s,
        s.net_n,
        s.restless_v,
        s.from_n,
        s.step_n,
        s.error_m,
        s.stiffness_n_m,
        s.anchor_m,
        s.same,
        s.tries,
        wanted_v,
        given_v,
    )
