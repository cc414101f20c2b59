"""What flows through one tick: measurement in, command out.

Every record is a NamedTuple of plain numbers, so that it can be logged, compared bit for bit and passed to
compiled code. SI units; positions are in the stroke coordinate (0 at the rear end stop) unless a name
says otherwise; times are CLOCK_MONOTONIC nanoseconds.
"""

from enum import IntEnum, IntFlag
from typing import Any, NamedTuple


class Source(IntFlag):
    """The three frames that make a complete set of measurements."""

    ENCODER = 1
    PRESSURE = 2
    VALVE = 4


ALL_SOURCES = int(Source.ENCODER | Source.PRESSURE | Source.VALVE)


class Defect(IntFlag):
    """Why frames of one source have not been used since its last valid one."""

    CORRUPT = 1  # wrong CRC or length
    FROZEN = 2  # the counter stands still
    LATE = 4  # answers an earlier SYNC than this tick's
    ODD = 16  # beyond what physics explains: held back until the next one confirms it
    CONFIRMED = 32  # says what the one before said, which was held back: both count


class Host(IntFlag):
    """What the machine, rather than the bus, has to say about this tick."""

    LINK_DOWN = 1
    NO_REALTIME = 2
    RECORDER_LOST = 4
    CLOCK_STEP = 8
    SEND_FAILED = 16
    OTHER_CONTROLLER = 32
    EMERGENCY = 64
    HEARTBEAT_LOST = 128
    BUS_PASSIVE = 256
    BUS_OFF = 512
    IDENTIFIER_CLASH = 1024
    DISK_FULL = 2048
    CONFIG_CHANGED = 4096
    RECEIVE_OVERFLOW = 8192
    CONSOLE_LOST = 16384
    UNPROVEN = 32768
    SYNC_LOST = 65536


class EncoderStatus(IntFlag):
    """Bits of ENCODER.Status."""

    REFERENCED = 1
    WARNING = 2
    ERROR = 4


class ValveState(IntEnum):
    """Values of VALVE_STATUS.State."""

    BOOT = 0
    CENTRED = 1
    ENABLED = 2
    TIMED_OUT = 3
    FAULT = 4


class State(IntEnum):
    """States of an axis; the names are lower-cased in everything a person or a script reads."""

    STARTING = 0
    WAITING = 1
    DISARMED = 2
    TRACKING = 3
    MOVING = 4
    HOLDING = 5
    HOMING = 6
    STOPPING = 7
    FAULT = 8
    PROBING = 9
    PRESSING = 10

    @property
    def label(self) -> str:
        """The state as written in logs, JSON and on the screen."""
        return self.name.lower()


def state_name(state: int) -> str:
    """A state as people and scripts read it; one that this version does not know by its number."""
    return State(state).label if 0 <= state < len(State) else f"state {state}"


ENGAGED = (
    *(State.TRACKING, State.MOVING, State.HOLDING, State.HOMING, State.STOPPING, State.PROBING),
    State.PRESSING,
)


class RequestKind(IntEnum):
    """What may be asked of an axis, and with which values; metres and seconds, stroke coordinate."""

    # (): engage and hold still; (1.0,): engage and track the configured reference; (2.0,): as (), and from
    # now on in this run it is no obstacle that no movement test was passed
    ARM = 1
    DISARM = 2  # controlled stop, then centre
    CLEAR = 3
    SHUTDOWN = 4  # controlled stop, then centre for good
    MARK = 5  # text for the log; the axis ignores it
    STOP = 6  # controlled stop, then what limits.stop_then says
    HOLD = 7  # come to rest and hold
    HOME = 8
    GOTO = 9  # (position, speed, acceleration, jerk); 0 for the configured one
    JOG = 10  # (velocity, lease in ticks)
    TRACK = 11  # (0.0,): the configured reference; (1.0,): the uploaded profile
    PIECE = 12  # (T, c0 … c7): one more piece of the profile; (): empty it
    # a law's code and its gains; behind them the configured reference, where it changes; behind that what is
    # believed of valve and friction, and the filters, where that does
    GAINS = 13
    PROBE = 14  # (voltage, rate, travel, speed, force, lease in ticks): a bounded opening without a loop
    RESTART = 15  # centre for good, and let the daemon begin anew with what its file says; not while engaged
    CENTRE = 16  # at once, and disarmed: of the loop, where a fault takes another axis
    # (force, ramp, low, high, speed, time): press with a force of the piston, within a window of the travel;
    # 0 for the configured ramp, speed and time, twice 0 for the whole travel
    FORCE = 17
    # the values of a `control.program.Step`: one more record of the program; (): empty it; (records, whose):
    # empty it for so many that come, whose 1: shared with other axes, 2: for a RUN, and no input
    RECORD = 20
    # (record, rounds, shared): go through the program from there, so often, 0 without end; record 0: go on
    # where it was stopped; shared 1: with a GO_ON behind each record
    RUN = 21
    GO_ON = 22  # of the loop, when all axes have done their record


class Stage(IntEnum):
    """How far the program of an axis is."""

    NONE = 0  # there is none, or it has not been begun
    STOPPED = 1  # by a stop, a fault, or another command: it can go on from its record
    ENDED = 2
    UNDER_WAY = 3
    DONE = 4  # this record is, and waits for those of the other axes
    DUE = 5  # the next record begins with the next tick
    LATE = 6  # the record has not come to its end in its time

    @property
    def label(self) -> str:
        """The stage as written in logs, JSON and on the screen."""
        return self.name.lower()


class Hunting(IntEnum):
    """What a load that swings at its target, or a command that does, most likely suffers from."""

    NONE = 0
    ENCODER = 1  # the command follows single readings
    VALVE = 2  # the loop is as fast as valve and transport
    FRICTION = 3  # the load sticks and breaks away

    @property
    def label(self) -> str:
        """The cause as written in logs, JSON and on the screen."""
        return self.name.lower()


HUNTING_CURES: dict[int, str] = {
    Hunting.ENCODER: "encoder noise; lower gains or control.motion.bandwidth_rad_s",
    Hunting.VALVE: "valve.bandwidth_hz, bus.command_delay_us, the mass; lower gains",
    Hunting.FRICTION: "control.friction, valve.dead_zone_v",
}
"""What to look at, by `Hunting`."""

REQUEST_VALUES = 27  # the most that a request carries


class Request(NamedTuple):
    """One request of the operator, taken by the axis in one tick."""

    kind: int
    values: tuple[float, ...] = ()


class Answer(IntEnum):
    """What became of a request."""

    NONE = 0  # there was none
    TAKEN = 1
    WRONG_STATE = 2
    BLOCKED = 3  # by faults that are present
    OUT_OF_TRAVEL = 4
    BEYOND_LIMITS = 5  # of speed, acceleration or jerk
    UNSTABLE = 6  # gains that the loop cannot have
    NOT_REFERENCED = 7
    NO_PROFILE = 8
    MALFORMED = 9
    CLOSING = 10


class Measurement(NamedTuple):
    """The newest valid values, and how good they are; in a tick, those that the axis believed.

    `fresh` has a bit of `Source` for each source whose valid frame belongs to this tick; `age_ns` counts from
    the instant a source's last valid value was sampled to this tick's SYNC (0 when fresh); `defects` tells
    why newer frames of a source were not used.
    """

    t_ns: int  # this tick's SYNC
    fresh: int
    position_m: float
    p1_pa: float
    p2_pa: float
    supply_pa: float
    applied_v: float  # what the valve's DAC put out when it was sampled
    encoder_status: int
    valve_state: int
    encoder_age_ns: int
    pressure_age_ns: int
    valve_age_ns: int
    encoder_defects: int
    pressure_defects: int
    valve_defects: int
    encoder_offset_ns: int  # sampling instant of position_m relative to t_ns
    skipped: int  # ticks skipped just before this one
    host: int  # bits of Host


class Estimate(NamedTuple):
    """What the axis believes at the instant at which this tick's position was sampled."""

    position_m: float
    velocity_m_s: float
    force_n: float  # F̂, unmatched force acting on the load
    x3_n: float  # P1 A1 − P2 A2
    x3_hat_n: float  # x̂3 of the observer (10)
    d_hat_n_s: float  # d̂ of the observer (10)
    innovation_m: float  # encoder minus prediction
    opening_v: float  # command that the valve spool is believed to follow


class Reference(NamedTuple):
    """Where the load should be at the instant of the estimate, with three derivatives."""

    position_m: float
    velocity_m_s: float
    acceleration_m_s2: float
    jerk_m_s3: float


def error_m(reference: Reference, position_m: Any) -> Any:
    """How far the load is from where it should be, at the instant at which its position was sampled [m].

    Args:
        reference: of that instant; its fields and the result may be arrays, as in `true_error_m`.
        position_m: as estimated for that instant; it is there where a reading is missing, too.
    """
    return reference.position_m - position_m


def true_error_m(reference: Reference, offset_ns: Any, truth_m: Any) -> Any:
    """The same for the true position, known at SYNC: the reference is taken back to that instant [m].

    Args:
        reference: of the instant at which the position was sampled.
        offset_ns: from SYNC to that instant, `Measurement.encoder_offset_ns`.
        truth_m: true position at SYNC; NaN where nobody tells.
    """
    position_m, velocity_m_s, acceleration_m_s2, jerk_m_s3 = reference
    t = offset_ns * -1e-9
    return position_m + t * (velocity_m_s + t * (acceleration_m_s2 / 2.0 + t * jerk_m_s3 / 6.0)) - truth_m


class Command(NamedTuple):
    """What leaves for the valve."""

    voltage_v: float
    enable: int
    saturated: int  # 1 where the law asked for more than the output chain let through
    law_v: float  # what the law asked for; NaN where it was not asked
    s: float  # sliding variable of (12); in PRESSING the wanted force less the piston's [N]
    ustar: float  # u* of (19); in PRESSING the wanted force, on its ramp [N]


class Told(NamedTuple):
    """What another axis of the same daemon came to in its last tick; in its own stroke coordinate."""

    t_ns: int  # the instant that all of it belongs to
    position_m: float  # of its reference, NaN where it has none
    velocity_m_s: float
    acceleration_m_s2: float
    jerk_m_s3: float
    measured_m: float  # its estimates
    measured_m_s: float


class Progress(NamedTuple):
    """How far a program is, and what it puts out."""

    step: int  # record of the program, from 1; the last one, where it is stopped or has ended
    lap: int  # rounds that are done
    stage: int  # a `Stage`
    outputs: int  # bits


NO_PROGRESS = Progress(0, 0, 0, 0)


class Heard(NamedTuple):
    """What inputs and a load cell say in a tick."""

    inputs: int  # bits, in the order in which the configuration names them
    age_ns: int  # of the message that was heard longest ago
    force_n: float = float("nan")  # of the load cell; NaN where there is none
    force_age_ns: int = 1 << 62  # how old that is


NOTHING_HEARD = Heard(0, 1 << 62)


class Weighed(NamedTuple):
    """What a load cell says in a tick."""

    force_n: float  # with which the load presses, outwards positive; NaN before it has said anything
    age_ns: int  # from when that came to this tick's SYNC


class Hold(IntEnum):
    """What a brake, or a clamp, does with the load."""

    NONE = 0  # there is none
    ENGAGED = 1  # it holds the load
    BALANCING = 2  # it does, while the piston's force comes to what the load takes
    RELEASING = 3  # it is told to let go
    RELEASED = 4
    ENGAGING = 5  # it is told to hold

    @property
    def label(self) -> str:
        """As written in logs, JSON and on the screen."""
        return self.name.lower()


class Station(NamedTuple):
    """What an axis hears and says beside encoder, pressures and valve; bits as the configuration has them."""

    inputs: int
    outputs: int
    brake: int  # a `Hold`


class Tick(NamedTuple):
    """Everything one cycle read and decided."""

    t_ns: int
    measurement: Measurement
    request: Request | None
    estimate: Estimate
    reference: Reference
    command: Command
    state: int
    present: int  # bits of the fault table that hold now
    latched: int  # bits of the fault table that hold the axis in FAULT
    answer: int = 0  # an `Answer`: what became of the request
    in_position: int = 0  # 1 where the load has come to rest at the end of the reference
    hunting: int = 0  # a `Hunting`: why it does not
    told: Told | None = None  # by another axis, to one that is led by it
    program: Progress | None = None  # where there is one
    station: Station | None = None  # where there are inputs or outputs
    weighed: Weighed | None = None  # where there is a load cell

    @property
    def error_m(self) -> float:
        """Reference − estimated position [m]; NaN without a reference."""
        return float(error_m(self.reference, self.estimate.position_m))

    @property
    def state_name(self) -> str:
        """The state as people and scripts read it."""
        return state_name(self.state)

    @property
    def progress(self) -> Progress:
        """How far its program is, also where there is none."""
        return self.program or NO_PROGRESS


class Mileage(NamedTuple):
    """What an axis has done: what wears counts in it, and it only ever grows."""

    strokes: int = 0  # times that the load has turned
    travel_m: float = 0.0  # to and fro
    air_m3: float = 0.0  # from the supply, by the model; as volume of the reference atmosphere (ANR)
    engaged_s: float = 0.0
    hardest_stop_m_s2: float = 0.0  # the greatest deceleration


class Frame(NamedTuple):
    """A classic CAN frame on its way: kernel receive stamp, or the time of send() for a sent one."""

    stamp_ns: int
    can_id: int  # as in struct can_frame, with its flag bits
    data: bytes


class Timing(NamedTuple):
    """Where the time of one tick went [ns]; a negative value means that there was none."""

    lateness_ns: int  # wake-up after the ideal grid
    set_ns: int  # SYNC sent → set complete or given up
    cycle_ns: int  # axis.cycle
    send_ns: int  # encoding and send() of the command
    latency_ns: int  # newest sensor frame's stamp → send() of the command returned
    record_ns: int  # hand-over of the previous tick's record


class Record(NamedTuple):
    """One tick as it goes to the recorder.

    `frames[:before]` were drained before SYNC left, the rest after it: replay feeds them in that order.
    `sent` holds SYNC
    and VALVE_COMMAND. `truth_m` is the true position at SYNC where a software plant tells it, else NaN.
    """

    tick: Tick
    timing: Timing
    frames: tuple[Frame, ...]
    before: int
    sent: tuple[Frame, ...]
    truth_m: float

    @property
    def true_error_m(self) -> float:
        """Reference − true position, both at SYNC [m]; NaN where nobody tells."""
        tick = self.tick
        return float(true_error_m(tick.reference, tick.measurement.encoder_offset_ns, self.truth_m))
