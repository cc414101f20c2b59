"""The table `[bus]`: time-outs, and what messages, signals and nodes there are."""

from typing import Annotated, Any, Literal, Self

from pydantic import Field, ValidationError, model_validator

from pneud.config.mapping import Mapped, MessageConfig, SignalsConfig, check_cell
from pneud.config.nodes import GENERATED, NodeConfig, check_nodes, messages_of, signals_of
from pneud.config.sections import MaybeInfinite, Positive, Section, Timeout, check_channel


class FrameConfig(MessageConfig):
    """One message of the DBC and its signals, by role.

    `node` is the CANopen identifier of the device that sends it: its EMCY stops the axis, and so does the
    loss of its heartbeat where `heartbeat_timeout_ms` is given.
    """

    message: str  # name in the DBC
    signals: dict[str, str] = Field(default_factory=dict)  # role = "name in the DBC"
    counter: str | None = "Counter"  # signal that counts the frames; "none": the device has none
    crc: str | None = "Crc"  # signal with the checksum; "none": the device has none


class FramesConfig(Section):
    """Which message of the DBC plays which role; the defaults are those of pneud.dbc."""

    sync: FrameConfig = FrameConfig(message="SYNC", crc=None)
    encoder: FrameConfig = FrameConfig(
        message="ENCODER", signals={"position_m": "Position", "status": "Status", "age_s": "Age"}, node=1
    )
    pressure: FrameConfig = FrameConfig(
        message="PRESSURE", signals={"p1_pa": "P1", "p2_pa": "P2", "supply_pa": "Supply"}, node=2
    )
    valve_status: FrameConfig = FrameConfig(
        message="VALVE_STATUS", signals={"applied_v": "Applied", "state": "State"}, node=3
    )
    valve_command: FrameConfig = FrameConfig(
        message="VALVE_COMMAND", signals={"voltage_v": "Voltage", "enable": "Enable", "sequence": "Sequence"}
    )


class BusConfig(Section):
    """The CAN bus and its time-outs."""

    channel: str = "auto"  # `auto`, `socketcan:IF` or `unixcan:NAME`
    dbc: str = "pneud.dbc"  # beside this file, or one of pneud's; of nodes it is made
    sync: bool | Literal["follow"] = True  # sensors answer SYNC, "follow": another's; else they run free
    bitrate_bit_s: MaybeInfinite = 1.0e6  # `inf` where frames go over no wire
    fd: bool = False  # the bus carries CAN FD; messages may then have up to 64 bytes
    data_bitrate_bit_s: MaybeInfinite | None = None  # of their data; none: the same
    sensor_timeout_ms: Annotated[float, Field(ge=1, le=1000)] = 50.0  # without a valid frame
    valve_timeout_ms: Timeout = 50.0  # likewise
    deadline_timeout_ms: Annotated[float, Field(ge=1, le=1000)] = 50.0  # without a complete set in time
    input_timeout_ms: Annotated[float, Field(ge=2, le=60_000)] = 200.0  # of inputs, without a valid frame
    output_period_ms: Annotated[float, Field(ge=1, le=10_000)] = 20.0  # of outputs, and on every change
    overload_timeout_ms: Annotated[float, Field(ge=1, le=10_000)] = 1000.0  # every tick after skipped ones
    command_delay_us: Annotated[float, Field(ge=0, le=10_000)] | None = None  # sampling → command acts
    encoders_apart_m: Positive = 1e-3  # more between two encoders is an error of theirs
    frames: FramesConfig = FramesConfig()
    signals: SignalsConfig | None = None
    messages: dict[str, MessageConfig] = Field(default_factory=dict)
    inputs: dict[str, Mapped] = Field(default_factory=dict)  # by name, which may be a role
    outputs: dict[str, Mapped] = Field(default_factory=dict)  # likewise
    load_cell: Mapped | None = None  # force with which the load presses, outwards positive; none: from x3
    nodes: tuple[NodeConfig, ...] = ()  # CANopen nodes, which have to be configured

    @model_validator(mode="before")
    @classmethod
    def _signals_of_nodes(cls, data: Any) -> Any:
        """With nodes and without a DBC the signals follow from the nodes."""
        if not isinstance(data, dict) or not data.get("nodes") or data.get("dbc", GENERATED) != GENERATED:
            return data
        try:
            nodes = tuple(NodeConfig.model_validate(node) for node in data["nodes"])
        except ValidationError:
            return data  # which is said of the node itself
        check_nodes(nodes)
        signals = SignalsConfig.model_validate(signals_of(nodes))
        if SignalsConfig.model_validate(data.get("signals", signals)) != signals:
            raise ValueError("signals follow from nodes; leave them out, or name dbc")
        own = {"nodes": nodes, "dbc": GENERATED, "signals": signals, "messages": messages_of(nodes)}
        return {**data, **own}

    @model_validator(mode="after")
    def _nodes_answer_sync(self) -> Self:
        if self.nodes and self.sync is not True:
            raise ValueError("nodes are configured to answer SYNC, on a bus without it; sync has to be true")
        return self

    @model_validator(mode="after")
    def _period_of_free(self) -> Self:
        if self.sync and any(device.period_us is not None for device in self.devices):
            raise ValueError(
                "period_us is of devices that sample by themselves, and sync has these answer it"
            )
        return self

    @model_validator(mode="after")
    def _data_of_fd(self) -> Self:
        rate = self.data_bitrate_bit_s
        if rate is not None and not self.fd:
            raise ValueError("data_bitrate_bit_s is of CAN FD; give fd = true, or leave it out")
        if rate is not None and rate < self.bitrate_bit_s:
            raise ValueError(f"data_bitrate_bit_s = {rate:g}: data are never slower than the rest of a frame")
        return self

    @model_validator(mode="after")
    def _channel_form(self) -> Self:
        check_channel(self.channel)
        return self

    @model_validator(mode="after")
    def _one_mapping(self) -> Self:
        if self.signals is not None and self.frames != FramesConfig():
            raise ValueError("give either frames or signals")
        others = [name for name in self.messages if name not in self.io_messages]
        if self.signals is None and others:
            raise ValueError("messages goes with signals; with frames, these keys stand in each frame")
        if self.load_cell is not None:
            check_cell(self.load_cell)
        if self.inputs or self.outputs:
            from pneud.config.station import check_io  # noqa: PLC0415 - for a few axes only

            check_io(self.inputs, self.outputs)
        return self

    @property
    def switches(self) -> dict[str, tuple[str, ...]]:
        """Names of inputs and outputs, by their bits."""
        return {"inputs": tuple(self.inputs), "outputs": tuple(self.outputs)}

    @property
    def io_messages(self) -> tuple[str, ...]:
        """The messages with inputs and outputs."""
        cell = () if self.load_cell is None else (self.load_cell,)
        told = (*self.inputs.values(), *self.outputs.values(), *cell)
        return tuple(dict.fromkeys(str(value.signal).partition(".")[0] for value in told))

    @property
    def follows(self) -> bool:
        """Whether another controller sends SYNC."""
        return self.sync == "follow"

    @property
    def devices(self) -> tuple[MessageConfig, ...]:
        """What is said of the messages that the nodes send."""
        frames = self.frames
        if self.signals is None:
            return (frames.encoder, frames.pressure, frames.valve_status, *self.messages.values())
        return tuple(self.messages.values())
