"""A configuration with everything that belongs to it: its text, the DBC, the codecs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from pydantic import ValidationError

from pneud import resources
from pneud.bus.codec import SOURCES, Codecs, DatabaseError, codecs_from, load_codecs
from pneud.bus.load import overload
from pneud.bus.shared import why_not_together
from pneud.config.axes import Part, axes_of, name_of, one_of, proof_file
from pneud.config.bus_tables import BusConfig
from pneud.config.models import Config, GasConfig
from pneud.config.nodes import GENERATED
from pneud.config.reading import explain, parse
from pneud.config.sections import ConfigError, check_channel
from pneud.config.toml import changed_text
from pneud.safety.unnoticed import Devices, Teller
from pneud.signals import ValveState

if TYPE_CHECKING:
    from pneud.canopen.plan import Plan

SYNC_COUNTERS = 240  # SYNC counts 1 … 240


class Loaded(NamedTuple):
    """An axis as it stands in files."""

    config: Config
    path: Path
    text: str
    dbc: Path
    codecs: Codecs

    @property
    def part(self) -> Part:
        """As it is among others."""
        return Part(self.config, self.text, self.path)

    @property
    def proof_file(self) -> Path:
        """The file beside which it is kept that the movement test was passed."""
        return proof_file(self.path, self.config.name)


def load(
    config_file: str | Path,
    rate_hz: float | None = None,
    change: dict[str, Any] | None = None,
    axis: str | None = None,
) -> Loaded:
    """Load a configuration and its DBC.

    Args:
        config_file: path, or bare name of one that comes with pneud; or a folder with a file for each axis.
        rate_hz: another rate than the configuration's.
        change: values to put in place of the file's, in tables like the file's; the text says so, too.
        axis: which one, where there are several.

    Raises:
        ConfigError: the configuration cannot be used.
        DatabaseError: the DBC cannot be used.
    """
    return _loaded(one_of(axes_of(config_file), axis, str(config_file)), rate_hz, change)


class Together(tuple[Loaded, ...]):
    """Axes that share a bus, in order.

    Attributes:
        name: of all together; of the only one where there is but one.
    """

    name: str


def load_axes(
    config_file: str | Path, rate_hz: float | None = None, change: dict[str, Any] | None = None
) -> Together:
    """Load all axes of a file, or of a folder, which share one bus; as `load`.

    Raises:
        ConfigError: they cannot be on one bus, too.
    """
    parts = axes_of(config_file)
    axes = Together(_loaded(part, rate_hz, change) for part in parts)
    axes.name = name_of(config_file, parts)
    why = why_not_together([(axis.config, axis.codecs) for axis in axes]) if len(axes) > 1 else ""
    if any(axis.config.reference.follow is not None for axis in axes):
        from pneud.config.following import why_not_led  # noqa: PLC0415 - for a few files only

        why = why or why_not_led([axis.config for axis in axes])
    if why:
        raise ConfigError(f"{config_file}: {why}")
    return axes


def _loaded(part: Part, rate_hz: float | None, change: dict[str, Any] | None) -> Loaded:
    config, text, path = part
    if change:
        text = changed_text(text, change)
        config = parse(text, f"{path} as changed")
    return complete(config, text, path, rate_hz)


def complete(config: Config, text: str, path: Path, rate_hz: float | None = None) -> Loaded:
    """A configuration with its DBC, which lies beside the file or comes with pneud; as `load`.

    Raises:
        ConfigError: the configuration cannot be used.
        DatabaseError: the DBC cannot be used.
    """
    if rate_hz is not None:
        config = at_rate(config, rate_hz)
    dbc = _dbc_of(config, path)
    return fitting(Loaded(config, path, text, dbc, load_codecs(config.bus, dbc, config.gas, keep=True)))


def fitting(loaded: Loaded) -> Loaded:
    """An axis whose frames can carry what it has to say, on a bus that can carry the frames.

    Raises:
        ConfigError: the bus cannot.
        DatabaseError: the frames cannot.
    """
    config, path, _, dbc, codecs = loaded
    _check_ranges(config, codecs, dbc)
    if why := overload(config, codecs):
        raise ConfigError(f"{path}: {why}")
    return loaded


def _dbc_of(config: Config, path: Path) -> Path:
    """The DBC that a configuration names, or that follows from its nodes."""
    if config.bus.dbc == GENERATED:
        from pneud.canopen.kept import kept_dbc  # noqa: PLC0415 - for rigs with nodes only

        return kept_dbc(config)
    try:
        return resources.find(config.bus.dbc, path.parent)
    except FileNotFoundError as e:
        raise ConfigError(f"{path}: bus.dbc: {e}") from None


def plans_of_nodes(loaded: Loaded) -> tuple[Plan, ...]:
    """What the nodes of an axis are configured to; nothing where it has none.

    Raises:
        EdsError: an EDS cannot be used.
    """
    if not loaded.config.bus.nodes:
        return ()
    from pneud.canopen.plan import plans_of  # noqa: PLC0415 - for rigs with nodes only

    return plans_of(loaded.config, loaded.path.parent)


def plans_of_plant(loaded: Loaded) -> tuple[Plan, ...]:
    """What has to be done to the nodes of its software rig before they answer; nothing where they just do."""
    return () if loaded.config.plant.devices == "frames" else plans_of_nodes(loaded)


def codecs_of(bus: BusConfig, name: str, dbc: bytes, gas: GasConfig | None = None) -> Codecs:
    """The codecs for a DBC that is not in a file of its own, such as a log's.

    Raises:
        DatabaseError: the DBC cannot be used.
    """
    return codecs_from(bus, Path(name or "log.dbc"), dbc, gas)


def _check_ranges(config: Config, codecs: Codecs, dbc: Path) -> None:
    """Make sure that the frames can carry whatever the axis may have to say and to hear."""
    u_max, limits = config.valve.u_max_v, config.limits
    try:
        codecs.sync.encode(counter=SYNC_COUNTERS)
        for voltage_v in (-u_max, u_max):
            codecs.valve_command.encode(voltage_v, 1, SYNC_COUNTERS, counter=0)
        swing_pa = limits.supply_max_pa - config.gas.atmosphere_pa
        values = {
            "status": 1, "age_s": 0.0, "state": 4, "second_position_m": 0.0,
            "p1_pa": limits.chamber_max_pa, "p2_pa": limits.chamber_max_pa, "supply_pa": limits.supply_max_pa,
        }  # fmt: skip
        for end, position_m in ((-1.0, limits.travel_min_m), (1.0, limits.travel_max_m)):
            values |= {"position_m": position_m, "applied_v": end * u_max, "difference_pa": end * swing_pa}
            for answer in codecs.answers:
                answer.codec.encode(*(values[key] for key in answer.keys), counter=0)
    except ValueError as e:
        raise DatabaseError(f"{dbc}: too narrow for this axis: {e}") from None
    finest = 0.01 * u_max
    if codecs.command_lsb_v > finest:
        raise DatabaseError(
            f"{dbc}: the command's steps of {codecs.command_lsb_v:g} V are too coarse; needs {finest:g} V"
        )


def devices_of(config: Config, codecs: Codecs) -> Devices:
    """What the devices of an axis tell, for `safety.unnoticed`."""
    told = {key for answer in codecs.answers for key in answer.filled}
    bus = config.bus
    states: frozenset[int] = frozenset(ValveState) if "state" in told else frozenset()
    state = None if bus.signals is None else bus.signals.state
    if state is not None and state.values:
        states = frozenset(state.values.values())
    encoder, pressure, valve = (_teller(codecs, keys) for keys in SOURCES.values())
    return Devices(
        sync=bool(bus.sync),
        follows=bus.follows,
        encoder=encoder,
        pressure=pressure,
        valve=valve,
        status="status" in told,
        second="second_position_m" in told,
        age="age_s" in told,
        homed=config.encoder.kind == "incremental",
        supply="supply_pa" in told,
        applied="applied_v" in told,
        states=states,
        nodes=any(device.node is not None for device in bus.devices),
        heartbeats=any(device.heartbeat_timeout_ms is not None for device in bus.devices),
        uncounted_inputs=tuple(
            message.name
            for message in (codecs.switching.inputs if codecs.switching is not None else ())
            if message.codec.counter_field is None
        ),
        brake_tells=config.brake is None or "brake_released" in bus.inputs,
    )


def _teller(codecs: Codecs, keys: tuple[str, ...]) -> Teller:
    theirs = {answer.name: answer.codec for answer in codecs.telling(*keys)}
    return Teller(
        tuple(theirs),
        tuple(name for name, codec in theirs.items() if codec.counter_field is None),
        tuple(name for name, codec in theirs.items() if codec.guard.crc is None),
    )


def listening_s(config: Config) -> float:
    """How long to listen on a bus to be sure that nobody sends in every tick [s]."""
    return max(0.1, 2.5 / config.loop.rate_hz)


def at_rate(config: Config, rate_hz: float) -> Config:
    """The configuration at another rate, checked like any other.

    Raises:
        ConfigError: the rate is out of bounds, or does not fit the rest.
    """
    if rate_hz == config.loop.rate_hz:
        return config
    data = config.model_dump(by_alias=True)
    data["loop"]["rate_hz"] = rate_hz
    try:
        return Config.model_validate(data)
    except ValidationError as e:
        raise ConfigError(f"--rate {rate_hz:g}: {explain(e)}") from None


def bus_name(option: str | None, config: Config) -> str:
    """The bus asked for with `--bus`, else the configuration's.

    Raises:
        ConfigError: not the form of a bus name.
    """
    if option is None:
        return config.bus.channel
    try:
        check_channel(option)
    except ValueError as e:
        raise ConfigError(f"--bus: {e}") from None
    return option
