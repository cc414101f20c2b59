"""Values of the axis by signals of the DBC, in place of frames: `[bus.signals]` and `[bus.messages]`."""

from typing import Annotated, Any, Self

from pydantic import BeforeValidator, Field, field_validator, model_validator

from pneud.config.protection import ProtectionConfig
from pneud.config.sections import Section

NONE = ("", "none", False)  # in place of a signal that the device does not have


class MessageConfig(ProtectionConfig):
    """What a message has besides its values.

    `node` is the CANopen identifier of the device that sends it: its EMCY stops the axis, and so does the
    loss of its heartbeat where `heartbeat_timeout_ms` is given.
    """

    counter: str | None = None  # signal that counts the frames; "none": the device has none
    crc: str | None = None  # signal with the checksum; "none": the device has none
    node: Annotated[int, Field(ge=1, le=127)] | None = None
    heartbeat_timeout_ms: Annotated[float, Field(ge=1, le=60_000)] | None = None
    period_us: Annotated[float, Field(ge=100, le=100_000)] | None = None  # at which it samples, running free

    @field_validator("counter", "crc", mode="before")
    @classmethod
    def _none(cls, name: Any) -> Any:
        return None if name in NONE else name

    @model_validator(mode="after")
    def _heartbeat_of_a_node(self) -> Self:
        if self.heartbeat_timeout_ms is not None and self.node is None:
            raise ValueError("heartbeat_timeout_ms needs node, the device's CANopen identifier")
        return self


class SignalConfig(Section):
    """Where a value comes from: a signal, and what makes it the axis's; or a constant.

    `"MESSAGE.SIGNAL"` alone stands for a table with nothing but `signal`, and a number for a constant.
    """

    signal: Annotated[str, Field(pattern=r"^[^.]+(\.[^.]+)?$")] | None = None  # "MESSAGE.SIGNAL"
    constant: float | None = None  # SI; in place of a signal
    unit: str | None = None  # of the signal, where the DBC has none or a wrong one
    counts_per_m: float | None = None  # of a position; negative where it counts the other way
    m_per_count: float | None = None  # likewise
    offset: float = 0.0  # SI; added to what the signal says
    gauge: bool = False  # a pressure above gas.atmosphere_pa
    mask: Annotated[int, Field(ge=1)] | None = None  # bits of the signal that say it
    values: dict[int, int] = Field(default_factory=dict)  # number on the wire = number of the axis

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if (self.signal is None) == (self.constant is None):
            raise ValueError('give a signal, "MESSAGE.SIGNAL", or a constant')
        scales = [key for key in ("unit", "counts_per_m", "m_per_count") if getattr(self, key) is not None]
        if len(scales) > 1:
            raise ValueError(f"give one of {', '.join(scales)}")
        if 0.0 in (self.counts_per_m, self.m_per_count):
            raise ValueError("counts_per_m and m_per_count cannot be 0")
        return self


def _spelt(value: Any) -> Any:
    if isinstance(value, str):
        return {"signal": value}
    if isinstance(value, int | float) and not isinstance(value, bool):
        return {"constant": value}
    return value


Mapped = Annotated[SignalConfig, BeforeValidator(_spelt)]
CONSTANTS = ("status", "age_s", "supply_pa", "enable")


class SignalsConfig(Section):
    """Which signal fills which value; what is absent the devices do not have.

    Each is `"MESSAGE.SIGNAL"`, a table as [below](#bussignalsvalue), or, of a few, a constant.
    """

    position_m: Mapped
    status: Mapped | None = None  # bits 1 referenced, 2 warning, 4 error; none: always referenced
    age_s: Mapped | None = None  # from sampling to sending, in the position's message; none: 0
    second_position_m: Mapped | None = None  # of another encoder; they may not differ
    p1_pa: Mapped | None = None  # one of the chambers may come from the other and difference_pa
    p2_pa: Mapped | None = None
    difference_pa: Mapped | None = None  # p1 - p2
    supply_pa: Mapped | None = None  # none: gas.supply_pa
    applied_v: Mapped | None = None  # none: the last command
    state: Mapped | None = None  # of the valve; none: as enabled by the last command
    voltage_v: Mapped  # of the command, as all that follows
    enable: Mapped | None = None  # none: 0 V has to do
    sequence: Mapped | None = None  # the counter of the SYNC that it answers
    sync: Mapped | None = None  # "MESSAGE.COUNTER" or "MESSAGE"; none: 0x080 without data

    @model_validator(mode="after")
    def _enough(self) -> Self:
        if sum(v is not None for v in (self.p1_pa, self.p2_pa, self.difference_pa)) != 2:
            raise ValueError("give two of p1_pa, p2_pa and difference_pa")
        for name, value in self:
            if value is None:
                continue
            if value.constant is not None and name not in CONSTANTS:
                raise ValueError(f"{name}: a signal has to tell it; constants are {', '.join(CONSTANTS)}")
            if value.gauge and name not in ("p1_pa", "p2_pa", "supply_pa"):
                raise ValueError(f"{name}: gauge is of p1_pa, p2_pa and supply_pa")
            if (value.counts_per_m or value.m_per_count) and not name.endswith("position_m"):
                raise ValueError(f"{name}: counts are of position_m; give unit")
            if (value.values or value.mask) and name not in ("status", "state", "enable"):
                raise ValueError(f"{name}: mask and values are of status, state and enable")
            if value.signal is not None and name != "sync" and "." not in value.signal:
                raise ValueError(f'{name} = "{value.signal}": give "MESSAGE.SIGNAL"')
        return self

    @property
    def messages(self) -> tuple[str, ...]:
        """The messages that the nodes send, in order of the values."""
        theirs = [
            value.signal.partition(".")[0]
            for name, value in self
            if value is not None and value.signal is not None and name not in OWN
        ]
        return tuple(dict.fromkeys(theirs))


OWN = ("voltage_v", "enable", "sequence", "sync")  # what the controller sends


def check_cell(told: SignalConfig) -> None:
    """Refuse what is no signal with a force.

    Raises:
        ValueError: says what, and the cure.
    """
    if told.signal is None or "." not in told.signal:
        raise ValueError('load_cell: give "MESSAGE.SIGNAL"')
    if told != SignalConfig(signal=told.signal, unit=told.unit, offset=told.offset):
        raise ValueError("load_cell: is a force; it takes signal, unit and offset")
