"""The fault table: what can go wrong, what the axis does about it, and what a person can do.

The table is data. `docs/safety.md` shows it, the supervisor acts on its masks, the log and the screen use
its names.
"""

from __future__ import annotations

from enum import IntEnum

from pneud.safety.fault_row import Fault, Reaction, unheard


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
    LOAD_MISSING = 78
    LOAD_DISAGREES = 79


TABLE: tuple[Fault, ...] = (
    *unheard(
        (F.ENCODER_MISSING, F.ENCODER_CORRUPT, F.ENCODER_FROZEN, F.ENCODER_LATE),
        "no encoder frame, or none that could be believed",
        "encoder",
        "encoder",
    ),
    Fault(
        F.ENCODER_ERROR,
        Reaction.CENTRE,
        "the encoder reports an error",
        "check the scale, the head and its gap",
    ),
    Fault(F.ENCODER_UNREFERENCED, Reaction.NO_ARM, "the encoder has no reference", "home the axis"),
    *unheard(
        (F.PRESSURE_MISSING, F.PRESSURE_CORRUPT, F.PRESSURE_FROZEN, F.PRESSURE_LATE),
        "no pressure frame, or none that could be believed",
        "pressure",
        "pressure node",
    ),
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
    *unheard(
        (F.VALVE_MISSING, F.VALVE_CORRUPT, F.VALVE_FROZEN, F.VALVE_LATE),
        "no valve status",
        "valve status",
        "valve node",
    ),
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
        "the valve node is not enabled although the axis is engaged, and has been in the same state for"
        " longer than bus.valve_timeout_ms",
        "check the valve node's supply voltage",
        clears="as soon as the axis is not engaged",
    ),
    Fault(
        F.TRAVEL,
        Reaction.CENTRE,
        "the position of an engaged axis has left limits.travel, or lies outside the cylinder",
        "clear, arm, and lead it back",
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
        "no tick ran while the axis was engaged",
        "see pneud doctor for what delays this machine",
        "deadline_timeout_ns",
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
        "the recorder process is gone, or its disk takes nothing for another reason than want of room",
        "check the disk; restart to log again where the process is gone",
        clears="within 2 s after the disk takes data again",
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
        clears="with the next tick",
    ),
    Fault(
        F.SEND_FAILED,
        Reaction.WARN,
        "a frame could not be sent",
        "check txqueuelen and the bus load",
        clears="with the next tick",
    ),
    Fault(
        F.ENCODER_JUMP,
        Reaction.CENTRE,
        "the encoder is further than limits.innovation_m from where the load can have gone",
        "check the scale, the head and its mounting; home the axis again",
        clears="as soon as the estimate has followed",
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
        clears="1 s after its last frame",
    ),
    Fault(
        F.SATURATED,
        Reaction.LIMIT,
        "the law asks for more than the slew limit or valve.u_max_v allow",
        "none needed; where it lasts, ask for less speed or acceleration",
    ),
    Fault(
        F.SATURATED_LONG,
        Reaction.STOP,
        "the command is limited all the time",
        "check supply, load and friction; ask for less speed or acceleration",
        "saturation_ns",
    ),
    Fault(
        F.BRAKING_DISTANCE,
        Reaction.STOP,
        "the load could no longer be brought to rest within limits.travel by limits.braking_m_s2",
        "keep the motion away from the ends of travel, or slower near them",
    ),
    Fault(
        F.SUPPLY_FALLING,
        Reaction.STOP,
        "the supply pressure falls so fast that it leaves limits.supply within 0.2 s",
        "open the supply; look for a burst hose; check the compressor",
        "supply_ns",
    ),
    Fault(
        F.FORCE_DISAGREES,
        Reaction.CENTRE,
        "the encoder's acceleration and the pressures' force differ by more than limits.disagreement_n while"
        " the axis is engaged",
        "check what the load runs against, the pressure sensors' scale, and cylinder.moving_mass_kg",
        "disagreement_ns",
    ),
    Fault(
        F.VALVE_DISAGREES,
        Reaction.CENTRE,
        "the valve node, enabled, puts out none of the last three commands (within 0.05 V)",
        "check the valve node and its DAC; check that nothing else commands it",
        "valve_timeout_ns",
    ),
    Fault(
        F.ENCODER_STUCK,
        Reaction.CENTRE,
        "engaged, the position stands still to the last digit: although the load was faster than any force"
        " could have stopped it (at once), or while the pressures' force changes by more than"
        " limits.stuck_force_n (except while homing)",
        "check the encoder's coupling and head; see whether the load is jammed",
        "sensor_timeout_ns",
    ),
    Fault(
        F.PRESSURE_STUCK,
        Reaction.CENTRE,
        "a chamber pressure stands still to the last digit while the engaged load moves by more than"
        " limits.stuck_travel_m",
        "check the sensor, its hose and the pressure node",
    ),
    Fault(
        F.PRESSURE_JUMP,
        Reaction.CENTRE,
        "a chamber pressure has changed by more than valve and piston can change it",
        "check the sensor's wiring and hose",
        clears="with the next pressure frame",
    ),
    Fault(
        F.SEND_BLOCKED,
        Reaction.CENTRE,
        "frames cannot be sent in any tick, though the interface is up: the transmit queue stays full",
        "check that another device acknowledges, the termination, the bit rate and txqueuelen",
        "valve_timeout_ns",
    ),
    Fault(
        F.OVERLOADED,
        Reaction.STOP,
        "every tick comes after skipped ones",
        "lower loop.rate_hz, or see pneud doctor for what takes this machine's time",
        "overload_ns",
    ),
    Fault(
        F.EMERGENCY,
        Reaction.STOP,
        "a node of the axis reports an emergency (CANopen EMCY)",
        "look the error code up in the node's manual",
        clears="when the node reports error code 0 or boots",
    ),
    Fault(
        F.HEARTBEAT_LOST,
        Reaction.STOP,
        "a node with heartbeat_timeout_ms sends no heartbeat for as long, or is not operational, or nodes of"
        " the axis that pneud configures are not ready, or the process that does it has died",
        "check the node's power and wiring; set it operational (NMT start); what keeps pneud's nodes from it"
        " stands in the journal; where pneud-nodes is no longer among the processes, pneud restart",
        clears="with the next heartbeat of an operational node, and when all nodes are ready",
    ),
    Fault(
        F.BUS_PASSIVE,
        Reaction.STOP,
        "the CAN controller is error-passive",
        "check wiring, termination, bit rate, and that another device acknowledges",
        clears="when the controller reports that it is active again, or the interface went down and up",
    ),
    Fault(
        F.BUS_OFF,
        Reaction.CENTRE,
        "the CAN controller has left the bus (bus-off)",
        "check the wiring for a short; without restart-ms: ip link set IF type can restart",
        clears="when the controller was restarted, or the interface went down and up",
    ),
    Fault(
        F.IDENTIFIER_CLASH,
        Reaction.CENTRE,
        "more frames of a source than SYNC asked for: another device uses its identifier",
        "find the device with the same identifier and give it another",
        clears="when the surplus is forgotten, one frame in 16 ticks",
    ),
    Fault(
        F.DISK_FULL,
        Reaction.WARN,
        "the log's disk or its quota is full; records are lost meanwhile",
        "make room on the disk; it is logged again from then on",
        clears="within 2 s after the disk takes data again",
    ),
    Fault(
        F.CONFIG_CHANGED,
        Reaction.WARN,
        "the configuration file or the DBC has changed since the start",
        "restart to use it, or put the file back; the running one is in the log",
        clears="when the file is as it was",
    ),
    Fault(
        F.RECEIVE_OVERFLOW,
        Reaction.WARN,
        "the kernel has dropped received frames, because they were not read in time",
        "see pneud doctor for what delays this machine; check what floods the bus",
        clears="with the next tick",
    ),
    Fault(
        F.OPERATOR_LOST,
        Reaction.WARN,
        "nobody has renewed a jog in time; the load is brought to rest and held",
        "check the operator's connection; jog again",
        clears="with the next tick",
    ),
    Fault(
        F.HOMING_FAILED,
        Reaction.CENTRE,
        "homing found the load stuck, or no stop in the time that a stroke takes",
        "check that the load is free, encoder.homing.force_n against friction, and the supply; home again",
    ),
    Fault(
        F.CONSOLE_LOST,
        Reaction.STOP,
        "the console, at whose operator's request the axis is engaged, has been silent for 0.5 s, or is gone",
        "none but to clear and arm: the console is started again by itself; where nobody answers, restart the"
        " daemon; where it repeats itself, see pneud doctor for what takes this machine's time",
        clears="when the axis is no longer engaged, or the console is back",
    ),
    Fault(
        F.ENCODER_DOUBTFUL,
        Reaction.STOP,
        "three in ten of the encoder's readings are further from where the load can be than noise and forces"
        " explain, and the next one does not confirm them",
        "check the encoder's shielding, head and scale; check that its node answers SYNC with what it has"
        " sampled then",
        clears="when fewer have been odd for some 40 ms",
    ),
    Fault(
        F.PRESSURE_DOUBTFUL,
        Reaction.STOP,
        "three in ten of the pressure readings have changed by more than valve and piston can change them, or"
        " crossed a limit, and the next one does not confirm them",
        "check the sensors' shielding, wiring and supply",
        clears="when fewer have been odd for some 40 ms",
    ),
    Fault(
        F.UNPROVEN,
        Reaction.NO_ARM,
        "the movement test has not been passed with this wiring, cylinder and valve (only the test itself and"
        " homing are allowed)",
        "pneud commission makes it; pneud arm --unproven does without for one run",
    ),
    Fault(
        F.SKEW,
        Reaction.STOP,
        "the loads of a gantry are further apart than reference.follow.skew_m; both come to rest together",
        "check that neither is held, the beam, and the supply; bring it square by hand, or by"
        " reference.follow.offset_m",
    ),
    Fault(
        F.LED_BEYOND,
        Reaction.STOP,
        "what reference.follow leads to lies outside the axis's own travel, or is faster than limits.motion",
        "lead the other axis less far or more slowly; check reference.follow.scale and offset_m",
        clears="as soon as the axis is not engaged",
    ),
    Fault(
        F.PROGRAM,
        Reaction.STOP,
        "a record of the program cannot be done from where the axis is",
        "pneud status tells the record: a relative way, or what it follows, leads out of the travel; clear,"
        " arm, and go on with pneud run --resume, or elsewhere with --from",
        clears="with the next tick",
    ),
    Fault(
        F.PROGRAM_LATE,
        Reaction.STOP,
        "a record of the program has not come to its end within its timeout_s",
        "pneud status tells the record: the load does not come into its tolerance, or what is waited for does"
        " not happen; clear, arm, and go on with pneud run --resume",
        clears="with the next tick",
    ),
    Fault(
        F.FORCE_WINDOW,
        Reaction.STOP,
        "a load that is to press has left the window of travel that was asked for",
        "check what it was to press against: it may be missing, have given way, or stand elsewhere; then"
        " clear, arm, and lead it back",
    ),
    Fault(
        F.FORCE_SPEED,
        Reaction.STOP,
        "a load that is to press has been faster than was asked for, for 20 ms, or twice as fast",
        "check what it was to press against: it may have broken; ask for more speed, or a slower ramp, where"
        " the load has to go far",
    ),
    Fault(
        F.FORCE_TIMEOUT,
        Reaction.STOP,
        "the force that was asked for has not been reached in the time that was asked for",
        "check supply, leaks, and what it presses against; ask for less force, a faster ramp or more time",
    ),
    Fault(
        F.FORCE_DIRECTION,
        Reaction.STOP,
        "force or load have gone the other way than was asked for, for 50 ms",
        "check the sign of the force that was asked for, the hoses, and what else pushes the load (weight)",
    ),
    Fault(
        F.SYNC_LOST,
        Reaction.CENTRE,
        'no SYNC has come for bus.sensor_timeout_ms from the controller that bus.sync = "follow" waits for',
        "start the daemon that makes SYNC on this bus, and see why it has ended",
    ),
    Fault(
        F.INPUT_LOST,
        Reaction.STOP,
        "a message with inputs has not come for bus.input_timeout_ms, or never",
        "check the power of the node that sends the inputs, its wiring, and how often it sends",
    ),
    Fault(
        F.ENABLE_OFF,
        Reaction.STOP,
        'the input enable is off (with io.enable_off = "stop")',
        "switch it on; then clear, where the axis was engaged, and arm",
    ),
    Fault(
        F.ENABLE_CUT,
        Reaction.CENTRE,
        'the input enable is off (with io.enable_off = "centre")',
        "switch it on; then clear, where the axis was engaged, and arm",
    ),
    Fault(
        F.START_REFUSED,
        Reaction.WARN,
        "the input start has come on where no program can begin: not armed, none that is loaded whole and for"
        " this axis alone, or one that was stopped half way",
        "arm; pneud run FILE --load loads a program, pneud run --resume goes on with one that was stopped",
        clears="after 1 s",
    ),
    Fault(
        F.BRAKE_STUCK,
        Reaction.STOP,
        "the input brake_released does not say what the brake is told, after its time and brake.feedback_s",
        "check the brake's air or power, its valve, and the switch that tells of it",
    ),
    Fault(
        F.BRAKE_UNBALANCED,
        Reaction.STOP,
        "the piston's force has not come to what the load takes within brake.balance_s; the brake stays"
        " engaged",
        "check the supply, cylinder.load_n and inclination_deg, and the mass that is carried",
    ),
    Fault(
        F.LOAD_MISSING,
        Reaction.STOP,
        "the load cell of bus.load_cell has not been heard for bus.sensor_timeout_ms, or never",
        "check the cell's amplifier, its power and wiring; without a cell take bus.load_cell out",
    ),
    Fault(
        F.LOAD_DISAGREES,
        Reaction.STOP,
        "while it presses, the piston's force and the load cell differ by more than limits.force.apart_n",
        "check the cell's zero, sign and unit (bus.load_cell), the pressures, and what else bears the load",
    ),
)


FAULT_CURES = tuple(fault.cure for fault in sorted(TABLE, key=lambda fault: fault.bit))  # by bit number
FAULT_NAMES = tuple(bit.name.lower() for bit in sorted(F))  # by bit number


def mask(*reactions: Reaction) -> int:
    """Bits of all faults with one of these reactions."""
    return sum(1 << fault.bit for fault in TABLE if fault.reaction in reactions)


CENTRES = mask(Reaction.CENTRE)
STOPS = mask(Reaction.STOP)
BLOCKS_ARM = mask(Reaction.CENTRE, Reaction.STOP, Reaction.NO_ARM)
LOG_LOST = 1 << F.RECORDER_LOST | 1 << F.DISK_FULL

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
