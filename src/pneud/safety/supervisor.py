"""The state machine of an axis: a pure function of its state, the faults that hold now, and one request."""

from typing import NamedTuple

from pneud.safety.faults import BLOCKS_ARM, CENTRES, NO_SENSORS, STOPS, F
from pneud.signals import RequestKind, State

START_TICKS = 10  # ticks that the valve is told to centre before anything else
STARTING, WAITING, DISARMED = int(State.STARTING), int(State.WAITING), int(State.DISARMED)
TRACKING, STOPPING, FAULT = int(State.TRACKING), int(State.STOPPING), int(State.FAULT)
ARM, DISARM = int(RequestKind.ARM), int(RequestKind.DISARM)
CLEAR, SHUTDOWN, STOP = int(RequestKind.CLEAR), int(RequestKind.SHUTDOWN), int(RequestKind.STOP)
HOLDING, MOVING, HOMING = int(State.HOLDING), int(State.MOVING), int(State.HOMING)
HOLD, GOTO, JOG = int(RequestKind.HOLD), int(RequestKind.GOTO), int(RequestKind.JOG)
TRACK, HOME = int(RequestKind.TRACK), int(RequestKind.HOME)
PROBE, PROBING = int(RequestKind.PROBE), int(State.PROBING)
FORCE, PRESSING = int(RequestKind.FORCE), int(State.PRESSING)
CENTRE = int(RequestKind.CENTRE)

# what a request makes of a disarmed axis, and of an engaged one
ENGAGES = {ARM: HOLDING, TRACK: TRACKING, HOME: HOMING, PROBE: PROBING}
STEERS = {HOLD: MOVING, GOTO: MOVING, JOG: MOVING, TRACK: TRACKING, HOME: HOMING, FORCE: PRESSING}
BLOCKS = {
    ARM: BLOCKS_ARM,
    TRACK: BLOCKS_ARM,
    HOME: BLOCKS_ARM & ~(1 << F.ENCODER_UNREFERENCED | 1 << F.UNPROVEN),
    PROBE: BLOCKS_ARM & ~(1 << F.UNPROVEN),
}


class Supervisor(NamedTuple):
    """State of the state machine."""

    state: int
    latched: int  # faults that hold the axis until they are cleared
    ticks: int  # in this state
    closing: bool  # shut down: never arms again
    centring: bool = False  # the stop under way ends with the valve centred, not with holding


INITIAL = Supervisor(STARTING, 0, 0, False)


def is_engaged(state: int) -> bool:
    """Whether the valve may leave its centre in this state."""
    return TRACKING <= state <= STOPPING or state >= PROBING


def advance(s: Supervisor, present: int, request: int, at_rest: bool) -> Supervisor:
    """The state of this tick.

    Args:
        s: state of the last tick.
        present: bits of the faults that hold now.
        request: a `RequestKind` that the axis can do, 0 for none. A disarmed axis asked to track arms for it.
        at_rest: the reference has come to the end of its way.
    """
    closing = s.closing or request == SHUTDOWN
    if is_engaged(s.state):
        if present & CENTRES:
            return Supervisor(FAULT, s.latched | (present & (CENTRES | STOPS)), 0, closing)
        latched = s.latched | (present & STOPS)
        if request == CENTRE:
            return Supervisor(FAULT if latched else DISARMED, latched, 0, closing)
        centring = s.centring or bool(present & STOPS) or request in (DISARM, SHUTDOWN)
        if s.state == STOPPING:
            if not at_rest:
                return Supervisor(STOPPING, latched, s.ticks + 1, closing, centring)
            return Supervisor(FAULT if latched else DISARMED if centring else HOLDING, latched, 0, closing)
        if present & STOPS or request in (DISARM, SHUTDOWN, STOP):
            if s.state in (HOMING, PROBING):  # slow, with little force, and no loop to stop by
                return Supervisor(FAULT if latched else DISARMED, latched, 0, closing)
            return Supervisor(STOPPING, latched, 0, closing, centring)
        goal = s.state
        if s.state == PROBING:
            goal = DISARMED if at_rest else PROBING
        elif s.state != HOMING and request in STEERS:
            goal = STEERS[request]
        elif at_rest:
            goal = HOLDING
        return Supervisor(goal, latched, s.ticks + 1 if goal == s.state else 0, closing)
    if s.state == FAULT:
        if request == CLEAR and not present & (CENTRES | STOPS):
            return Supervisor(DISARMED, 0, 0, closing)
        return Supervisor(FAULT, s.latched, s.ticks + 1, closing)
    if s.state == STARTING:
        if s.ticks < START_TICKS:
            return Supervisor(STARTING, 0, s.ticks + 1, closing)
        return Supervisor(WAITING, 0, 0, closing)
    if present & NO_SENSORS:
        return Supervisor(WAITING, 0, s.ticks + 1 if s.state == WAITING else 0, closing)
    if s.state == WAITING:
        return Supervisor(DISARMED, 0, 0, closing)
    if request in ENGAGES and not present & BLOCKS[request] and not closing:
        return Supervisor(ENGAGES[request], 0, 0, closing)
    return Supervisor(DISARMED, 0, s.ticks + 1, closing)


def trip(s: Supervisor, faults: int, request: int = 0) -> Supervisor:
    """The state after a fault found behind the supervisor (output chain, exception): latched.

    Args:
        s: state of this tick, or of the last one where an exception kept this one from being reached.
        faults: bits to latch.
        request: what was asked in this tick, where `advance` has not seen it.
    """
    return Supervisor(FAULT, s.latched | faults, 0, s.closing or request == SHUTDOWN)
