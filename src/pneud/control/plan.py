"""What the reference is doing: a phase, since when, and the way it goes.

A plan is a plain record of numbers, so that freezing, logging and replaying an axis need nothing special.
"""

from typing import NamedTuple

from pneud.control.profile import Profile
from pneud.control.reference import Bounds, Sine, Way, along, at, sine, still, stop
from pneud.signals import Reference

SETTLE_NS = 50_000_000  # the load is given this long after a stop of the reference

# phases
NONE = 0
JOINING = 1  # on the way to what is to be followed
FOLLOWING = 2
COMING_TO_REST = 3
GOING = 4  # to rest at a position
RESTING = 5
LED = 6  # by another axis, from the end of its path on (`leading`)


class Plan(NamedTuple):
    """What the reference is doing."""

    phase: int
    since_ns: int  # when the phase began
    path: Way
    uploaded: bool = False  # follows the uploaded profile, not the configured reference
    piece: int = 0  # of the profile
    piece_ns: int = 0  # when that piece began
    jog_m_s: float = 0.0  # velocity of a jog, 0 where there is none
    lease: int = 0  # ticks that a jog may still go on


IDLE = Plan(NONE, 0, still(0.0))


def follow(plan: Plan, now_ns: int, configured: Sine, profile: Profile) -> tuple[Plan, Reference, bool]:
    """The plan and the reference at an instant, and whether the plan has come to its end.

    Args:
        plan: of an earlier instant.
        now_ns: the instant.
        configured: the configured reference.
        profile: the uploaded one, not empty where the plan follows it.
    """
    phase, path = plan.phase, plan.path
    t_ns = now_ns - plan.since_ns
    if phase == JOINING:
        T_ns = round(path.T * 1e9)
        if t_ns < T_ns:
            return plan, along(t_ns * 1e-9, path), False
        began_ns = plan.since_ns + T_ns
        plan = plan._replace(phase=FOLLOWING, since_ns=began_ns, piece=0, piece_ns=began_ns)
        t_ns -= T_ns
        phase = FOLLOWING
    if phase != FOLLOWING:
        settle_ns = SETTLE_NS if phase == COMING_TO_REST else 0
        return plan, along(t_ns * 1e-9, path), phase != RESTING and t_ns >= path.T * 1e9 + settle_ns
    if not plan.uploaded:
        return plan, sine(t_ns * 1e-9, configured), False
    piece, piece_ns = plan.piece, plan.piece_ns
    while piece < len(profile) - 1 and now_ns - piece_ns >= profile[piece].T * 1e9:
        piece_ns += round(profile[piece].T * 1e9)
        piece += 1
    if piece != plan.piece:
        plan = plan._replace(piece=piece, piece_ns=piece_ns)
    t = (now_ns - piece_ns) * 1e-9
    return plan, at(t, profile[piece]), piece == len(profile) - 1 and t >= profile[piece].T


def resting(position_m: float, now_ns: int) -> Plan:
    """Standing still."""
    return Plan(RESTING, now_ns, still(position_m))


def halting(plan: Plan, now: Reference, now_ns: int, bounds: Bounds, low_m: float, high_m: float) -> Plan:
    """Coming to rest between two positions; a way that brakes already goes on."""
    if plan.phase == COMING_TO_REST:
        return plan
    if plan.phase == GOING and now_ns - plan.since_ns >= (plan.path.T - plan.path.pieces[-1].T) * 1e9:
        return Plan(COMING_TO_REST, plan.since_ns, plan.path)
    return Plan(COMING_TO_REST, now_ns, stop(now, bounds, low_m, high_m))
