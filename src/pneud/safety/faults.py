"""The fault table: what can go wrong, what the axis does about it, and what a person can do.

The table is data. `docs/safety.md` shows it, the supervisor acts on its masks, the log and the screen use
its names.
"""

from __future__ import annotations

from enum import Enum, IntEnum
from typing import NamedTuple


class Reaction(Enum):
    """What a fault does; each stronger one includes the weaker."""

    WARN = "shown and logged"
    NO_ARM = "cannot arm"
    STOP = "controlled stop"
    CENTRE = "centre at once"


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


class Fault(NamedTuple):
    """One row of the table."""

    bit: F
    reaction: Reaction
    when: str
    cure: str

    @property
    def name(self) -> str:
        """The name in logs, JSON and on the screen."""
        return self.bit.name.lower()


_WIRING = "check the node's power, its wiring and the bus termination"
_NOISE = "check shielding and termination; check that no other device uses this identifier"
_NODE = "power-cycle the node; it repeats itself"
_TIMING = "check the node's configuration (it has to answer SYNC) and the bus load"

TABLE: tuple[Fault, ...] = (
    Fault(
        F.ENCODER_MISSING, Reaction.CENTRE, "no encoder frame for longer than bus.sensor_timeout_ms", _WIRING
    ),
    Fault(F.ENCODER_CORRUPT, Reaction.CENTRE, "only encoder frames with a wrong CRC for as long", _NOISE),
    Fault(F.ENCODER_FROZEN, Reaction.CENTRE, "the encoder's counter stands still for as long", _NODE),
    Fault(F.ENCODER_LATE, Reaction.CENTRE, "only encoder frames sampled before SYNC for as long", _TIMING),
    Fault(
        F.ENCODER_ERROR,
        Reaction.CENTRE,
        "the encoder reports an error",
        "check the scale, the head and its gap",
    ),
    Fault(F.ENCODER_UNREFERENCED, Reaction.NO_ARM, "the encoder has no reference", "home the axis"),
    Fault(
        F.PRESSURE_MISSING,
        Reaction.CENTRE,
        "no pressure frame for longer than bus.sensor_timeout_ms",
        _WIRING,
    ),
    Fault(F.PRESSURE_CORRUPT, Reaction.CENTRE, "only pressure frames with a wrong CRC for as long", _NOISE),
    Fault(F.PRESSURE_FROZEN, Reaction.CENTRE, "the pressure node's counter stands still for as long", _NODE),
    Fault(F.PRESSURE_LATE, Reaction.CENTRE, "only pressure frames sampled before SYNC for as long", _TIMING),
    Fault(
        F.CHAMBER_PRESSURE,
        Reaction.CENTRE,
        "a chamber pressure lies outside limits.chamber",
        "check the sensors' scale and the hoses; far above the supply the load is driving the piston",
    ),
    Fault(
        F.SUPPLY_PRESSURE,
        Reaction.CENTRE,
        "the supply pressure lies outside limits.supply",
        "open the supply; check the regulator and the compressor",
    ),
    Fault(F.VALVE_MISSING, Reaction.CENTRE, "no valve status for longer than bus.sensor_timeout_ms", _WIRING),
    Fault(F.VALVE_CORRUPT, Reaction.CENTRE, "only valve status frames with a wrong CRC for as long", _NOISE),
    Fault(F.VALVE_FROZEN, Reaction.CENTRE, "the valve node's counter stands still for as long", _NODE),
    Fault(F.VALVE_LATE, Reaction.CENTRE, "only valve status frames sampled before SYNC for as long", _TIMING),
    Fault(
        F.VALVE_TIMED_OUT,
        Reaction.CENTRE,
        "the valve node has centred itself for want of commands",
        "check the bus load and the machine's timing (pneud doctor)",
    ),
    Fault(
        F.VALVE_FAULT,
        Reaction.CENTRE,
        "the valve node reports a fault, or a state that is not known",
        "check the valve and its amplifier",
    ),
    Fault(
        F.VALVE_REBOOTED,
        Reaction.CENTRE,
        "the valve node is not enabled although the axis is engaged",
        "check the valve node's supply voltage",
    ),
    Fault(
        F.TRAVEL,
        Reaction.CENTRE,
        "the position lies outside limits.travel",
        "move the load back by hand with the supply shut, then clear",
    ),
    Fault(F.OVERSPEED, Reaction.CENTRE, "faster than limits.speed_m_s", "check the gains and the load"),
    Fault(
        F.TRACKING_ERROR,
        Reaction.CENTRE,
        "further from the reference than limits.tracking_error_m",
        "check load, friction and supply; a slower reference needs less",
    ),
    Fault(
        F.NOT_FINITE,
        Reaction.CENTRE,
        "a measurement, an estimate or the command is not a finite number",
        "keep the log and report it; it replays to the same tick",
    ),
    Fault(
        F.COMMAND_RANGE,
        Reaction.CENTRE,
        "the output chain produced a command beyond ±u_max",
        "keep the log and report it; it replays to the same tick",
    ),
    Fault(
        F.DEADLINE,
        Reaction.CENTRE,
        "no tick ran for longer than bus.deadline_timeout_ms",
        "see pneud doctor for what delays this machine",
    ),
    Fault(
        F.LINK_DOWN,
        Reaction.CENTRE,
        "the CAN interface is down or gone",
        "ip link set IF up; check the adapter",
    ),
    Fault(
        F.NO_REALTIME,
        Reaction.NO_ARM,
        "real-time scheduling is required and was refused",
        "run as the service, or grant CAP_SYS_NICE or RLIMIT_RTPRIO; see pneud doctor",
    ),
    Fault(
        F.RECORDER_LOST,
        Reaction.WARN,
        "the recorder process is gone",
        "check disk space; restart to log again",
    ),
    Fault(
        F.INTERNAL,
        Reaction.CENTRE,
        "an exception in the cycle",
        "keep the log and report it; it replays to the same tick",
    ),
    Fault(F.MOVING, Reaction.NO_ARM, "the load moves", "wait until it stands still"),
    Fault(
        F.CLOCK_STEP,
        Reaction.WARN,
        "the machine's wall clock was set",
        "none needed; log times follow the old clock",
    ),
    Fault(F.SEND_FAILED, Reaction.WARN, "a frame could not be sent", "check txqueuelen and the bus load"),
    Fault(
        F.ENCODER_JUMP,
        Reaction.CENTRE,
        "the encoder is further than limits.innovation_m from where the load can have gone",
        "check the scale, the head and its mounting; home the axis again",
    ),
    Fault(
        F.ENCODER_LOST_REFERENCE,
        Reaction.CENTRE,
        "the encoder loses its reference while the axis is engaged (except while homing)",
        "check the encoder's supply voltage, then home the axis",
    ),
    Fault(
        F.UNSETTLED,
        Reaction.NO_ARM,
        "the estimates have not yet run for 50 ms and 10 ticks on end",
        "wait; if it stays, the three nodes do not answer in the same tick",
    ),
    Fault(
        F.UNREACHABLE,
        Reaction.NO_ARM,
        "asked to arm where the way to the reference leaves limits.travel, or with join at_once further from"
        " it than limits.tracking_error_m",
        "move the load closer to the middle of the reference, or allow limits.transfer more acceleration",
    ),
    Fault(
        F.VALVE_ACTIVE,
        Reaction.NO_ARM,
        "the valve node is enabled, or off its centre, although the axis is not engaged",
        "check that nothing else commands this valve; check the valve's amplifier",
    ),
    Fault(
        F.OTHER_CONTROLLER,
        Reaction.CENTRE,
        "someone else sends SYNC or valve commands on this bus",
        "stop the other program; one axis has one controller",
    ),
)


FAULT_NAMES = tuple(bit.name.lower() for bit in sorted(F))  # by bit number


def mask(*reactions: Reaction) -> int:
    """Bits of all faults with one of these reactions."""
    return sum(1 << fault.bit for fault in TABLE if fault.reaction in reactions)


CENTRES = mask(Reaction.CENTRE)
STOPS = mask(Reaction.STOP)
BLOCKS_ARM = mask(Reaction.CENTRE, Reaction.STOP, Reaction.NO_ARM)

_SOURCES = ("ENCODER", "PRESSURE", "VALVE")
NO_SENSORS = sum(
    1 << fault.bit
    for fault in TABLE
    for source in _SOURCES
    for lack in ("MISSING", "CORRUPT", "FROZEN", "LATE")
    if fault.bit.name == f"{source}_{lack}"
)


def names(bits: int) -> list[str]:
    """Names of the faults in a bit mask, in the table's order."""
    return [fault.name for fault in TABLE if bits >> fault.bit & 1]
