"""Inputs and outputs by their roles: what inputs forbid and begin, and what outputs say.

Bits count as the configuration names inputs and outputs. What a message said last holds until it is lost.
"""

from typing import NamedTuple

from pneud.safety.brake import BrakeRules, is_let_go
from pneud.safety.faults import BLOCKS_ARM, F
from pneud.safety.supervisor import DISARMED, is_engaged
from pneud.signals import Heard, Hold, Station

SHOWN_NS = 1_000_000_000  # how long a start that was refused is shown
NEVER = -1
UNHEARD = 1  # a start input counts as on before it is heard: only what comes on later begins anything
INPUT_LOST, START_REFUSED = 1 << F.INPUT_LOST, 1 << F.START_REFUSED
NO_BRAKE = int(Hold.NONE)
ENABLE_OFF, ENABLE_CUT = 1 << F.ENABLE_OFF, 1 << F.ENABLE_CUT


class Roles(NamedTuple):
    """Which inputs and outputs do what: masks of their bits, 0 where there are none."""

    used: bool = False  # there are any
    lost_ns: int = 0  # a message that is silent for longer is lost; 0: there are no inputs
    enable: int = 0
    cuts: bool = False  # without enable the valve is centred at once
    start: int = 0  # 0 also where it is not to begin a program
    laps: int = 1  # rounds of that program
    in_position: int = 0
    ready: int = 0
    engaged: int = 0
    fault: int = 0
    brake: int = 0


class Inputs(NamedTuple):
    """What is remembered of inputs from tick to tick."""

    bits: int = 0
    start: int = UNHEARD  # 1 where it was on
    refused_ns: int = NEVER  # when a start was refused


class Judged(NamedTuple):
    """What the inputs of a tick come to."""

    inputs: Inputs
    starts: bool  # the input start has come on
    faults: int  # bits of the fault table


def judge(before: Inputs, heard: Heard | None, t_ns: int, p: Roles) -> Judged:
    """What the inputs forbid, and whether they begin something.

    Args:
        before: as of the last tick.
        heard: in this one; None where nothing is.
        t_ns: this tick's SYNC.
        p: which do what.
    """
    faults = 0
    if before.refused_ns >= 0 and t_ns - before.refused_ns < SHOWN_NS:
        faults |= START_REFUSED
    if p.lost_ns == 0:
        return Judged(before, False, faults)
    bits, age_ns = 0, p.lost_ns + 1
    if heard is not None:
        bits, age_ns = heard.inputs, heard.age_ns
    if age_ns > p.lost_ns:
        faults |= INPUT_LOST
        return Judged(before._replace(start=UNHEARD), False, faults)
    if p.enable != 0 and bits & p.enable == 0:
        if p.cuts:
            faults |= ENABLE_CUT
        else:
            faults |= ENABLE_OFF
    on = 1 if bits & p.start != 0 else 0
    starts = on > before.start
    return Judged(Inputs(bits, on, before.refused_ns), starts, faults)


def told(
    inputs: int,
    state: int,
    present: int,
    latched: int,
    in_position: int,
    program: int,
    hold: int,
    p: Roles,
    b: BrakeRules,
) -> Station:
    """What inputs say and what the outputs put out.

    Args:
        inputs: bits.
        state: of this tick.
        present: bits of the faults that hold now.
        latched: bits of those that hold the axis in fault.
        in_position: 1 where the load is.
        program: bits that the program puts out.
        hold: what the brake does.
        p: which outputs say what.
        b: of the brake.
    """
    outputs = program - (program & (p.in_position | p.ready | p.engaged | p.fault | p.brake))
    if in_position:
        outputs |= p.in_position
    if is_engaged(state):
        outputs |= p.ready | p.engaged
    elif state == DISARMED and present & BLOCKS_ARM == 0:
        outputs |= p.ready
    if latched != 0:
        outputs |= p.fault
    if is_let_go(hold) == b.frees:
        outputs |= p.brake
    return Station(inputs, outputs, hold if b.used else NO_BRAKE)
