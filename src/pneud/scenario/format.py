"""A scenario as a TOML file: what goes wrong, when, and what the axis is expected to do about it.

Unknown keys are errors; units are part of the names.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, model_validator

from pneud.bus.codec import ROLES
from pneud.config.sections import NonNegative, Positive, Section
from pneud.config.toml import tables_of

Probability = Annotated[float, Field(gt=0, le=1)]

Role = Literal["sync", "encoder", "pressure", "valve_status", "valve_command"]
Node = Literal["encoder", "pressure", "valve"]
Who = Literal["daemon", "recorder", "plant", "console"]
_OTHERWISE = {"status": "encoder_status", "state": "valve_state"}  # among the values of all frames
SIGNALS = {  # the frame that each is in, and its place among the frame's values
    _OTHERWISE.get(value, value): (role, place)
    for role in ("encoder", "pressure", "valve_status")
    for place, value in enumerate(ROLES[role])
}


def _known(signal: str) -> str:
    if signal not in SIGNALS:
        raise ValueError(f"must be one of {', '.join(SIGNALS)}")
    return signal


Signal = Annotated[str, AfterValidator(_known)]
TRAVEL_MM, IMPACT_M_S = 20.0, 0.05  # what an axis may use up after a fault, unless a reason is given


class When(Section):
    """Conditions on the true load that must hold together."""

    position_above_m: float | None = None
    position_below_m: float | None = None
    velocity_above_m_s: float | None = None
    velocity_below_m_s: float | None = None


class InjectedFault(Section):
    """What all faults have: when they begin, and for how long they last (without `for_s` to the end)."""

    since: Literal["armed", "start"] = "armed"  # first valve command with Enable 1, or first SYNC
    at_s: NonNegative = 0.0  # after that
    when: When = When()  # and then as soon as this holds
    for_s: Positive | None = None


class ChosenFault(InjectedFault):
    """What befalls some of the frames only, unless it is all of them."""

    probability: Probability = 1.0
    every: Annotated[int, Field(ge=1)] = 1  # of this many frames of a kind, one …
    phase: Annotated[int, Field(ge=0)] = 0  # … this one
    keep: bool = False  # all but that one


class FrameFault(ChosenFault):
    """Some of the frames of one kind or several."""

    frames: Annotated[tuple[Role, ...], Field(min_length=1)]


class Mishandled(FrameFault):
    """Frames get lost, come twice, come after the next one of their kind, have one wrong bit, or repeat.

    Those that freeze are as the last one before the fault, counter included.
    """

    kind: Literal["drop", "duplicate", "reorder", "corrupt", "freeze"]


class Delay(FrameFault):
    """Frames come late, by a time or so many of the controller's periods."""

    kind: Literal["delay"]
    delay_ms: NonNegative = 0.0
    delay_periods: NonNegative = 0.0
    after_sync: Annotated[float, Field(ge=0, lt=1)] | None = None  # all at once, so late as part of a period


class Babble(InjectedFault):
    """Somebody sends frames of its own, evenly in time, with a priority by its identifier."""

    kind: Literal["babble"]
    can_id: Annotated[int, Field(ge=0, le=0x7FF)]
    load: Annotated[float, Field(gt=0, le=1)] | None = None  # part of the bus's capacity
    per_period: Annotated[int, Field(ge=1, le=50)] | None = None  # or frames per period of the controller
    data: Annotated[str, Field(pattern=r"^([0-9a-fA-F]{2}){0,8}$")] = "0000000000000000"

    @model_validator(mode="after")
    def _one_way(self) -> Babble:
        if (self.load is None) == (self.per_period is None):
            raise ValueError("give either load or per_period")
        return self


class BusOff(InjectedFault):
    """A CAN controller leaves the bus: nothing goes in or out, then it is back."""

    kind: Literal["bus_off"]
    of: Literal["controller", "encoder", "pressure", "valve"]


class ErrorFrames(InjectedFault):
    """The CAN controller reports errors."""

    kind: Literal["error_frames"]
    error_class: Annotated[int, Field(ge=1, le=0x1FF)] = 0x88  # protocol violation, bus error
    controller_status: Annotated[int, Field(ge=0, le=0xFF)] = 0  # second byte, as in linux/can/error.h
    per_period: Annotated[int, Field(ge=1, le=20)] = 1


class Heartbeat(InjectedFault):
    """No fault: a node sends heartbeats, which it does not do otherwise; that they end is one."""

    kind: Literal["heartbeat"]
    node: Node
    every_ms: Positive


class Silence(InjectedFault):
    """Nodes send nothing, and go on hearing."""

    kind: Literal["silence"]
    nodes: Annotated[tuple[Node, ...], Field(min_length=1)]


class Skip(ChosenFault):
    """Nodes do not hear a SYNC: they do not answer it, and do not count it."""

    kind: Literal["skip"]
    nodes: Annotated[tuple[Node, ...], Field(min_length=1)]


class Reboot(InjectedFault):
    """A node starts anew; `for_s` is how long that takes."""

    kind: Literal["reboot"]
    node: Node
    for_s: Positive = 0.02


class Emcy(InjectedFault):
    """A node sends a CANopen emergency."""

    kind: Literal["emcy"]
    node: Node
    code: Annotated[int, Field(ge=0, le=0xFFFF)]


class ValveFailure(InjectedFault):
    """The valve's amplifier fails: its node centres for good and reports a fault."""

    kind: Literal["valve_failure"]


class Value(ChosenFault):
    """A node reports another value than it has: stuck at the last one, offset, drifting, scaled, or set."""

    kind: Literal["stuck", "offset", "drift", "scale", "set"]
    signal: Signal
    value: float = 0.0  # in the signal's unit; drift: per second; scale: factor
    alternate: bool = False  # of an offset: every other one has the other sign

    @model_validator(mode="after")
    def _of_offset(self) -> Value:
        if self.alternate and self.kind != "offset":
            raise ValueError("only an offset can alternate")
        return self


class Switched(InjectedFault):
    """An input is on, or off, for as long as that lasts; of an axis with inputs."""

    kind: Literal["input"]
    input: str
    on: bool


class InputsLost(InjectedFault):
    """The node of the inputs sends nothing."""

    kind: Literal["inputs_lost"]


class BrakeFault(InjectedFault):
    """The brake stays as it is named, whatever it is told."""

    kind: Literal["brake_stuck"]
    stuck: Literal["engaged", "released"]


class LoadCellFault(InjectedFault):
    """The load cell is off by `offset_n`; without that it sends nothing. Of an axis with one."""

    kind: Literal["load_cell"]
    offset_n: float | None = None


class Supply(InjectedFault):
    """The supply pressure changes [Pa, absolute]."""

    kind: Literal["supply"]
    supply_pa: Positive
    ramp_s: NonNegative = 0.0


class Leak(InjectedFault):
    """A hole from a chamber to the atmosphere, `size` times as wide as the open valve."""

    kind: Literal["leak"]
    chamber: Literal[1, 2]
    size: Annotated[float, Field(gt=0, le=20)]


class ValveStuck(InjectedFault):
    """The valve's spool stands still, whatever its amplifier puts out."""

    kind: Literal["valve_stuck"]
    opening_percent: Annotated[float, Field(ge=-100, le=100)]


class Seized(InjectedFault):
    """The piston does not move."""

    kind: Literal["seized"]


class Mass(InjectedFault):
    """The moving mass changes by a factor: the load falls off, or something falls on it."""

    kind: Literal["mass"]
    factor: Annotated[float, Field(gt=0, le=100)]


class FrictionFault(InjectedFault):
    """All friction grows by a factor."""

    kind: Literal["friction"]
    factor: Annotated[float, Field(gt=0, le=1000)]


class Force(InjectedFault):
    """A force pushes the load [N, in the direction of positive motion], steady or as a sine."""

    kind: Literal["force"]
    force_n: float
    frequency_hz: NonNegative = 0.0


class StopProcess(InjectedFault):
    """A process stands still (SIGSTOP) and goes on."""

    kind: Literal["stop"]
    who: Who
    for_s: Positive


class Overload(InjectedFault):
    """The daemon stands still for most of the time, again and again."""

    kind: Literal["overload"]
    stand_s: Positive
    run_s: Positive


class Kill(InjectedFault):
    """A process is killed (SIGKILL)."""

    kind: Literal["kill"]
    who: Literal["recorder", "plant", "console"]


class Operator(InjectedFault):
    """No fault: an operator asks for something, and from then on the axis needs its console."""

    kind: Literal["operator"]
    verb: Literal["arm", "disarm", "stop", "clear", "hold", "track", "force"]
    force_n: float | None = None  # of the verb `force`, by which the axis presses

    @model_validator(mode="after")
    def _of_force(self) -> Operator:
        if (self.verb == "force") != (self.force_n is not None):
            raise ValueError("force_n and the verb force belong together")
        return self


class Hog(InjectedFault):
    """Processes that do nothing but take the CPU."""

    kind: Literal["hog"]
    processes: Annotated[int, Field(ge=1, le=64)] = 4


class ClockStep(InjectedFault):
    """The machine's wall clock is set, and set back when the fault is over."""

    kind: Literal["clock_step"]
    step_s: float
    for_s: Positive = 1.0


class LogFull(InjectedFault):
    """The log may not grow any further (RLIMIT_FSIZE of the recorder), as on a full disk."""

    kind: Literal["log_full"]


class Descriptors(InjectedFault):
    """A process can open no further files (RLIMIT_NOFILE)."""

    kind: Literal["descriptors"]
    who: Who


class InterfaceFault(InjectedFault):
    """The CAN interface goes down, is deleted, or takes no more frames; all is well again when it is over."""

    kind: Literal["link_down", "link_deleted", "queue_full"]


BUS = Mishandled | Delay | Babble | BusOff | ErrorFrames
NODES = Silence | Skip | Reboot | Emcy | Heartbeat | ValveFailure | Value
STATION = Switched | InputsLost | BrakeFault | LoadCellFault
PLANT = Supply | Leak | ValveStuck | Seized | Mass | FrictionFault | Force
MACHINE = StopProcess | Overload | Kill | Operator | Hog | ClockStep | LogFull | Descriptors | InterfaceFault
AnyFault = Annotated[BUS | NODES | STATION | PLANT | MACHINE, Field(discriminator="kind")]


class Evidence(Section):
    """From when on the fault can be seen on the bus: a value beyond a bound in a frame."""

    signal: Signal
    above: float | None = None
    below: float | None = None


class Expect(Section):
    """What the axis does about it."""

    reaction: Literal["centre", "stop", "no_arm", "warn", "none"]
    faults: tuple[str, ...] = ()  # names of the fault table; all of them …
    also: tuple[str, ...] = ()  # … and of these some may come along
    after: Literal["evidence", "sensor_timeout", "valve_timeout", "onset"] = "evidence"
    evidence: Evidence | None = None  # without one: the first frame that the fault has touched
    within_ticks: Annotated[int, Field(ge=1)] = 2  # from there to 0 V on the bus
    within_ms: Positive | None = None  # in place of it: from the fault's onset, where no frame shows it
    travel_mm: Positive = TRAVEL_MM
    impact_m_s: NonNegative = IMPACT_M_S
    reason: str = ""  # why more travel or a harder impact than usual cannot be avoided

    @model_validator(mode="after")
    def _told(self) -> Expect:
        if (self.travel_mm > TRAVEL_MM or self.impact_m_s > IMPACT_M_S) and not self.reason:
            raise ValueError(
                f"more than {TRAVEL_MM:g} mm of travel or an impact above {IMPACT_M_S:g} m/s needs a reason"
            )
        if self.reaction not in ("none",) and not self.faults:
            raise ValueError("names no fault of the table")
        return self


class Scenario(Section):
    """One scenario."""

    schema_: Annotated[Literal[1], Field(alias="schema")]
    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]{0,63}$")]
    description: str
    config: str = "virtual.toml"  # the axis, where none is named with --config
    axis: str | None = None  # that it happens to, where there are several; else the first one
    change: dict[str, Any] = Field(default_factory=dict)  # what the axis's configuration says differently
    duration_s: Positive = 3.0
    interface: bool = (
        False  # True where it takes an interface of the kernel for another reason than its faults
    )
    simulated: bool = True  # False where it takes a machine for another reason than its faults
    fault: Annotated[tuple[AnyFault, ...], Field(min_length=1)]
    expect: Expect

    @property
    def needs_machine(self) -> bool:
        """Whether it takes a real machine: the simulation has neither processes nor clock nor files."""
        real = (Kill, Operator, Hog, ClockStep, LogFull, Descriptors)
        return self.interface or not self.simulated or any(isinstance(fault, real) for fault in self.fault)

    @property
    def orders(self) -> bool:
        """Whether it does anything to the machine."""
        return any(isinstance(fault, MACHINE) for fault in self.fault)

    @property
    def needs_interface(self) -> bool:
        """Whether it takes an interface of the kernel, and the right to change it."""
        return self.interface or any(isinstance(f, InterfaceFault) for f in self.fault)


def parse_scenario(text: str) -> Scenario:
    """A scenario from the text of its file.

    Raises:
        TomlError: not TOML.
        pydantic.ValidationError: not a scenario.
    """
    return Scenario.model_validate(tables_of(text))
