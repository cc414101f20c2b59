"""The state machine of an axis: a pure function of its state, the faults that hold now, and one request."""

from __future__ import annotations

from typing import NamedTuple

from pneud.safety.faults import BLOCKS_ARM, CENTRES, NO_SENSORS, STOPS
from pneud.signals import RequestKind, State

START_TICKS = 10  # ticks that the valve is told to centre before anything else
STARTING, WAITING, DISARMED = int(State.STARTING), int(State.WAITING), int(State.DISARMED)
TRACKING, STOPPING, FAULT = int(State.TRACKING), int(State.STOPPING), int(State.FAULT)
ARM, DISARM = int(RequestKind.ARM), int(RequestKind.DISARM)
CLEAR, SHUTDOWN = int(RequestKind.CLEAR), int(RequestKind.SHUTDOWN)


class Supervisor(NamedTuple):
    """State of the state machine."""

    state: int
    latched: int  # faults that hold the axis until they are cleared
    ticks: int  # in this state
    closing: bool  # shut down: never arms again


INITIAL = Supervisor(STARTING, 0, 0, False)


def is_engaged(state: int) -> bool:
    """Whether the valve may leave its centre in this state."""
    return TRACKING <= state <= STOPPING


def advance(s: Supervisor, present: int, request: int, at_rest: bool) -> Supervisor:
    """The state of this tick.

    Args:
        s: state of the last tick.
        present: bits of the faults that hold now.
        request: a `RequestKind`, 0 for none.
        at_rest: the reference has come to rest (ends a controlled stop).
    """
    closing = s.closing or request == SHUTDOWN
    if is_engaged(s.state):
        if present & CENTRES:
            return Supervisor(FAULT, s.latched | (present & (CENTRES | STOPS)), 0, closing)
        latched = s.latched | (present & STOPS)
        if s.state != STOPPING and (present & STOPS or request in (DISARM, SHUTDOWN)):
            return Supervisor(STOPPING, latched, 0, closing)
        if s.state == STOPPING and at_rest:
            return Supervisor(FAULT if latched else DISARMED, latched, 0, closing)
        return Supervisor(s.state, latched, s.ticks + 1, closing)
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
    if request == ARM and not present & BLOCKS_ARM and not closing:
        return Supervisor(TRACKING, 0, 0, closing)
    return Supervisor(DISARMED, 0, s.ticks + 1, closing)


def trip(s: Supervisor, faults: int, request: int = 0) -> Supervisor:
    """The state after a fault found behind the supervisor (output chain, exception): latched.

    Args:
        s: state of this tick, or of the last one where an exception kept this one from being reached.
        faults: bits to latch.
        request: what was asked in this tick, where `advance` has not seen it.
    """
    return Supervisor(FAULT, s.latched | faults, 0, s.closing or request == SHUTDOWN)
