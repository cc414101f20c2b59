"""What a row of the fault table says: which bit, what is done, when, and what a person can do; the bits."""

from __future__ import annotations

from enum import Enum, IntEnum
from typing import NamedTuple


class F(IntEnum):
    """Bit numbers of the fault table; they are part of the log format and never change their meaning."""

    ENCODER_MISSING = 0
    ENCODER_CORRUPT = 1
    ENCODER_FROZEN = 2
    ENCODER_LATE = 3
    ENCODER_ERROR = 4
    ENCODER_UNREFERENCED = 5
    PRESSURE_MISSING = 6
    PRESSURE_CORRUPT = 7
    PRESSURE_FROZEN = 8
    PRESSURE_LATE = 9
    CHAMBER_PRESSURE = 10
    SUPPLY_PRESSURE = 11
    VALVE_MISSING = 12
    VALVE_CORRUPT = 13
    VALVE_FROZEN = 14
    VALVE_LATE = 15
    VALVE_TIMED_OUT = 16
    VALVE_FAULT = 17
    VALVE_REBOOTED = 18
    TRAVEL = 19
    OVERSPEED = 20
    TRACKING_ERROR = 21
    NOT_FINITE = 22
    COMMAND_RANGE = 23
    DEADLINE = 24
    LINK_DOWN = 25
    NO_REALTIME = 26
    RECORDER_LOST = 27
    INTERNAL = 28
    MOVING = 29
    CLOCK_STEP = 30
    SEND_FAILED = 31
    ENCODER_JUMP = 32
    ENCODER_LOST_REFERENCE = 33
    UNSETTLED = 34
    UNREACHABLE = 35
    VALVE_ACTIVE = 36
    OTHER_CONTROLLER = 37
    SATURATED = 38
    SATURATED_LONG = 39
    BRAKING_DISTANCE = 40
    SUPPLY_FALLING = 41
    FORCE_DISAGREES = 42
    VALVE_DISAGREES = 43
    ENCODER_STUCK = 44
    PRESSURE_STUCK = 45
    PRESSURE_JUMP = 46
    SEND_BLOCKED = 47
    OVERLOADED = 48
    EMERGENCY = 49
    HEARTBEAT_LOST = 50
    BUS_PASSIVE = 51
    BUS_OFF = 52
    IDENTIFIER_CLASH = 53
    DISK_FULL = 54
    CONFIG_CHANGED = 55
    RECEIVE_OVERFLOW = 56
    OPERATOR_LOST = 57
    HOMING_FAILED = 58
    CONSOLE_LOST = 59
    ENCODER_DOUBTFUL = 60
    PRESSURE_DOUBTFUL = 61
    UNPROVEN = 62
    SKEW = 63
    LED_BEYOND = 64
    PROGRAM = 65
    PROGRAM_LATE = 66
    FORCE_WINDOW = 67
    FORCE_SPEED = 68
    FORCE_TIMEOUT = 69
    FORCE_DIRECTION = 70
    SYNC_LOST = 71
    INPUT_LOST = 72
    ENABLE_OFF = 73
    ENABLE_CUT = 74
    START_REFUSED = 75
    BRAKE_STUCK = 76
    BRAKE_UNBALANCED = 77


class Reaction(Enum):
    """What a fault does; each stronger one includes the weaker."""

    WARN = "shown and logged"
    LIMIT = "limit active"
    NO_ARM = "cannot arm"
    STOP = "controlled stop"
    CENTRE = "centre at once"


class Fault(NamedTuple):
    """One row of the table.

    `debounce` names the field of `checks.Limits` for how long it has to last before it counts; without, the
    first tick counts. `clears` says when it is no longer present, where that is not simply when what is
    named in `when` is over.
    """

    bit: IntEnum
    reaction: Reaction
    when: str
    cure: str
    debounce: str = ""
    clears: str = ""

    @property
    def name(self) -> str:
        """The name in logs, JSON and on the screen."""
        return self.bit.name.lower()

    @property
    def latches(self) -> bool:
        """Whether it holds the axis in FAULT until it is cleared."""
        return self.reaction in (Reaction.STOP, Reaction.CENTRE)
