"""A brake, or a clamp, that holds the load: when it is let go, and when it has to hold again.

It is let go only of a load that the piston bears already, and the load is led only once it has let go; it
holds again before the valve is centred, and at once where a fault centres it. All of it follows from the
state, in one place, after the state machine of the axis has had its say.
"""

from typing import NamedTuple

from pneud.safety.faults import F
from pneud.signals import Hold

ENGAGED, BALANCING, RELEASING = int(Hold.ENGAGED), int(Hold.BALANCING), int(Hold.RELEASING)
RELEASED, ENGAGING = int(Hold.RELEASED), int(Hold.ENGAGING)
BRAKE_STUCK, BRAKE_UNBALANCED = 1 << F.BRAKE_STUCK, 1 << F.BRAKE_UNBALANCED


class BrakeRules(NamedTuple):
    """What is known of a brake."""

    used: bool = False  # there is one
    release_ns: int = 0  # from telling it to let go until it has
    engage_ns: int = 0  # from telling it to hold until it does
    balance_ns: int = 0  # longest time in which the piston's force comes to what the load takes
    feedback: int = 0  # mask of the input that says that it has let go; 0: none does
    feedback_ns: int = 0  # that this may be later than the brake
    frees: bool = True  # its output lets go of the load; else it holds the load
    at_rest: bool = False  # it holds the load wherever that is in position


class Brake(NamedTuple):
    """What a brake does."""

    hold: int = ENGAGED
    since_ns: int = 0
    wrong_ns: int = -1  # since when the feedback says otherwise; −1 where it does not
    fresh: int = 0  # 1 in the tick in which the load has to be taken over


def is_let_go(hold: int) -> bool:
    """Whether the brake is told to let go."""
    return hold in (RELEASING, RELEASED)


def is_holding(b: Brake, p: BrakeRules) -> bool:
    """Whether there is a brake, and the load may not be led for it.

    Args:
        b: the brake.
        p: what is known of it.
    """
    return p.used and b.hold != RELEASED


def judge(b: Brake, inputs: int, t_ns: int, p: BrakeRules) -> tuple[Brake, int]:
    """Whether the brake does what it is told, and the load can be borne: faults as bits of the table.

    Args:
        b: the brake, as of the last tick.
        inputs: bits.
        t_ns: this tick's SYNC.
        p: what is known of it.
    """
    faults, wrong_ns = 0, -1
    if p.feedback != 0 and (inputs & p.feedback != 0) != is_let_go(b.hold):
        wrong_ns = b.wrong_ns if b.wrong_ns >= 0 else t_ns
        allowed_ns = p.feedback_ns
        if b.hold == RELEASING:
            allowed_ns += p.release_ns
        elif b.hold != RELEASED:
            allowed_ns += p.engage_ns
        if t_ns - wrong_ns > allowed_ns:
            faults |= BRAKE_STUCK
    if b.hold == BALANCING and t_ns - b.since_ns > p.balance_ns:
        faults |= BRAKE_UNBALANCED
    return Brake(b.hold, b.since_ns, wrong_ns, b.fresh), faults


def proceed(
    b: Brake, engaged: bool, wanted: bool, balanced: bool, inputs: int, t_ns: int, p: BrakeRules
) -> Brake:
    """What the brake does from this tick on.

    Args:
        b: as `judge` left it.
        engaged: the axis is, in this tick.
        wanted: the load is to be led.
        balanced: the piston bears it.
        inputs: bits.
        t_ns: this tick's SYNC.
        p: what is known of it.
    """
    hold, passed_ns = b.hold, t_ns - b.since_ns
    if not engaged:
        hold = ENGAGED
    elif hold == ENGAGED:
        hold = BALANCING if wanted else ENGAGED
    elif hold == BALANCING:
        hold = ENGAGED if not wanted else RELEASING if balanced else BALANCING
    elif hold == RELEASING:
        there = passed_ns >= p.release_ns and (p.feedback == 0 or inputs & p.feedback != 0)
        hold = ENGAGING if not wanted else RELEASED if there else RELEASING
    elif hold == RELEASED:
        hold = RELEASED if wanted else ENGAGING
    else:
        late_ns = p.feedback_ns if inputs & p.feedback != 0 else 0
        hold = ENGAGED if passed_ns >= p.engage_ns + late_ns else ENGAGING
    if hold == b.hold:
        return Brake(hold, b.since_ns, b.wrong_ns, 0)
    turned = is_let_go(hold) != is_let_go(b.hold)
    return Brake(hold, t_ns, -1 if turned else b.wrong_ns, 1 if hold == RELEASED else 0)


def is_wanted(
    b: Brake, stopping: bool, holding: bool, at_rest: bool, in_position: int, p: BrakeRules
) -> bool:
    """Whether the load of an engaged axis is to be led, by which the brake has to let go.

    Args:
        b: the brake.
        stopping: the axis comes to rest.
        holding: it holds.
        at_rest: the reference has come to its end.
        in_position: 1 where the load has.
        p: what is known of the brake.
    """
    if stopping:
        return b.hold == RELEASED and not at_rest
    if holding and p.at_rest:
        return b.hold == RELEASED and in_position == 0
    return True
