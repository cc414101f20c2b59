"""One axis as a TOML file: what may stand in it, its bounds, and the plain parameters that come of it.

Unknown keys are errors; units are part of the names. Nothing here is read inside the loop.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from pneud import resources
from pneud.physics import cylinder as cyl
from pneud.physics import gas as gas_
from pneud.physics.friction import Friction
from pneud.physics.plant import PlantParameters
from pneud.physics.valve import Valve

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Fraction = Annotated[float, Field(gt=0, lt=1)]
Pressure = Annotated[float, Field(gt=0, le=2.0e6)]
MaybeInfinite = Annotated[float, Field(gt=0, allow_inf_nan=True)]


class ConfigError(Exception):
    """A configuration cannot be used; the text is one line for a person."""


class Section(BaseModel):
    """A table of the file: unknown keys, NaN and infinity are errors, and nothing changes afterwards."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=False)


def check_channel(text: str) -> None:
    """Check the form of a bus name: auto, socketcan:IF or unixcan:NAME.

    Raises:
        ValueError: any other form.
    """
    kind, _, name = text.partition(":")
    ok = text == "auto" or (
        kind in ("socketcan", "unixcan") and name != "" and "/" not in name and len(name) <= 64
    )
    if not ok:
        raise ValueError(f"bus {text!r} is none of auto, socketcan:IF, unixcan:NAME")


class CylinderConfig(Section):
    """Geometry and load."""

    piston_area_1_m2: Annotated[float, Field(gt=0, le=0.2)]
    piston_area_2_m2: Annotated[float, Field(gt=0, le=0.2)]
    stroke_m: Annotated[float, Field(gt=0, le=20)]
    dead_length_1_m: Positive
    dead_length_2_m: Positive
    moving_mass_kg: Annotated[float, Field(gt=0, le=10_000)]


class GasConfig(Section):
    """The medium and its supply; pressures are absolute."""

    heat_capacity_ratio: Annotated[float, Field(gt=1, lt=2)] = 1.4
    gas_constant_j_kg_k: Positive = 286.987
    temperature_k: Annotated[float, Field(ge=200, le=400)] = 293.0
    atmosphere_pa: Pressure = 101_000.0
    supply_pa: Pressure

    @model_validator(mode="after")
    def _supply_above_atmosphere(self) -> GasConfig:
        if self.supply_pa <= self.atmosphere_pa:
            raise ValueError("supply_pa must lie above atmosphere_pa (both are absolute)")
        return self


class ValveConfig(Section):
    """The proportional valve as the controller knows it."""

    orifice_area_m2: Positive
    u_max_v: Annotated[float, Field(gt=0, le=5)] = 5.0
    bandwidth_hz: NonNegative = 0.0
    damping: Annotated[float, Field(gt=0, le=5)] = 0.7
    dead_zone_v: Annotated[float, Field(ge=0, lt=2.5)] = 0.0


class LoopConfig(Section):
    """The tick."""

    rate_hz: Annotated[float, Field(ge=10, le=5_000)] = 1000.0
    set_deadline: Annotated[float, Field(ge=0.1, le=0.95)] = 0.8
    spin_us: Annotated[float, Field(ge=0, le=500)] = 0.0
    compiled: Literal["off", "auto", "required"] = "auto"


class RealtimeConfig(Section):
    """What is asked of the operating system.

    The loop has `cpu` to itself: recorder, console, screen and plant run on `other_cpus`, or on all but that
    one where none are given. "auto" is the last isolated CPU, else the last of several.
    """

    priority: Annotated[int, Field(ge=0, le=98)] = 80
    cpu: Annotated[int, Field(ge=0)] | Literal["auto"] | None = None
    other_cpus: tuple[Annotated[int, Field(ge=0)], ...] = ()
    plant_priority: Annotated[int, Field(ge=0, le=98)] | None = None
    recorder_nice: Annotated[int, Field(ge=0, le=19)] = 0
    lock_memory: bool = True
    required: bool = False


class FrameConfig(Section):
    """One message of the DBC and its signals, by role.

    `node` is the CANopen identifier of the device that sends it: its EMCY stops the axis, and so does the
    loss of its heartbeat where `heartbeat_timeout_ms` is given.
    """

    message: str
    signals: dict[str, str] = Field(default_factory=dict)
    counter: str | None = "Counter"
    crc: str | None = "Crc"
    node: Annotated[int, Field(ge=1, le=127)] | None = None
    heartbeat_timeout_ms: Annotated[float, Field(ge=1, le=60_000)] | None = None

    @model_validator(mode="after")
    def _heartbeat_of_a_node(self) -> FrameConfig:
        if self.heartbeat_timeout_ms is not None and self.node is None:
            raise ValueError("heartbeat_timeout_ms needs node, the device's CANopen identifier")
        return self


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

    channel: str = "auto"
    dbc: str = "pneud.dbc"
    sync: bool = True
    bitrate_bit_s: MaybeInfinite = 1.0e6
    sensor_timeout_ms: Annotated[float, Field(ge=1, le=1000)] = 50.0
    valve_timeout_ms: Annotated[float, Field(ge=1, le=1000)] = 50.0
    deadline_timeout_ms: Annotated[float, Field(ge=1, le=1000)] = 50.0
    overload_timeout_ms: Annotated[float, Field(ge=1, le=10_000)] = 1000.0  # every tick after skipped ones
    command_delay_us: Annotated[float, Field(ge=0, le=10_000)] | None = None  # sampling → command acts
    frames: FramesConfig = FramesConfig()

    @model_validator(mode="after")
    def _channel_form(self) -> BusConfig:
        check_channel(self.channel)
        return self


class ObserverConfig(Section):
    """The disturbance observer (10)."""

    discretisation: Literal["explicit", "implicit", "matched"] = "implicit"
    lambda0: Positive = 1.5
    lambda1: Positive = 1.1
    gain_n_s2: Positive

    @model_validator(mode="after")
    def _convergent(self) -> ObserverConfig:
        if self.lambda1 <= 1.0:
            raise ValueError(
                "lambda1 must exceed 1, or d̂ cannot follow a disturbance that changes at gain_n_s2"
            )
        return self


MOST_PUSH_RATIO = 2.5  # two filters so far apart have a Lyapunov function in common


class MotionConfig(Section):
    """The [x, v, F] filter: a bandwidth, or the noise that its Kalman gains follow from."""

    bandwidth_rad_s: Annotated[float, Field(gt=0, le=5_000)] | None = None
    encoder_noise_m: Positive | None = None
    force_walk_n_rs: Positive | None = None  # what the unmatched force gains in a second [N/√s]
    encoder_resolution_m: NonNegative = 0.0  # readings within half a step of the prediction change nothing
    push_bandwidth_rad_s: Annotated[float, Field(gt=0, le=5_000)] | None = None  # for innovations
    push_beyond_m: NonNegative = 0.0  # that exceed half a step by more than this

    @model_validator(mode="after")
    def _one_way(self) -> MotionConfig:
        noise = (self.encoder_noise_m, self.force_walk_n_rs)
        if (self.bandwidth_rad_s is None) == (None in noise) or (noise.count(None) == 1):
            raise ValueError("give either bandwidth_rad_s, or encoder_noise_m and force_walk_n_rs")
        slow, fast = self.bandwidth_rad_s, self.push_bandwidth_rad_s
        if fast is not None and (slow is None or not slow <= fast <= MOST_PUSH_RATIO * slow):
            raise ValueError(
                "push_bandwidth_rad_s needs bandwidth_rad_s, and lies between it and "
                f"{MOST_PUSH_RATIO:g} times it"
            )
        return self


class FrictionConfig(Section):
    """LuGre friction; all zero for none."""

    coulomb_n: NonNegative = 0.0
    static_n: NonNegative = 0.0
    stribeck_speed_m_s: Positive = 0.02
    viscous_n_s_m: NonNegative = 0.0
    bristle_stiffness_n_m: NonNegative = 0.0
    bristle_damping_n_s_m: NonNegative = 0.0

    @model_validator(mode="after")
    def _complete(self) -> FrictionConfig:
        if self.static_n < self.coulomb_n:
            raise ValueError("static_n must not lie below coulomb_n")
        if self.coulomb_n > 0 and self.bristle_stiffness_n_m == 0:
            raise ValueError("bristle_stiffness_n_m must be positive where there is dry friction")
        return self


class ControlConfig(Section):
    """The law."""

    law: Literal["composite", "ismc"] = "composite"
    discretisation: Literal["explicit", "implicit"] = "implicit"
    k1: Positive
    k2: Positive
    k3: Positive
    alpha: Annotated[float, Field(gt=0.5, le=1)]
    eta_m_s3: NonNegative
    rod_force: bool = True  # the law knows of the atmosphere on the rod's side
    reverse_flow: bool = True  # the law's orifice lets air back into the supply
    smooth_x3: bool = False  # the observer's x̂3 in place of the measured x3
    estimate_force: bool = True
    force_rate_bandwidth_rad_s: Annotated[float, Field(ge=0, le=5_000)] = 0.0  # fed forward; 0: not
    predict: bool = True  # over transport delay and valve lag
    compensate_dead_zone: bool = False
    dead_zone_hold_v: Annotated[float, Field(ge=0, le=1)] = 0.02  # opening not worth crossing it
    observer: ObserverConfig
    motion: MotionConfig
    friction: FrictionConfig = FrictionConfig()  # as identified; fed forward along the reference

    @model_validator(mode="after")
    def _force_is_used(self) -> ControlConfig:
        if not self.estimate_force and (
            self.force_rate_bandwidth_rad_s > 0 or self.friction != FrictionConfig()
        ):
            raise ValueError("force_rate_bandwidth_rad_s and friction need estimate_force = true")
        return self

    @model_validator(mode="after")
    def _hurwitz(self) -> ControlConfig:
        if self.k2 * self.k3 <= self.k1:
            raise ValueError(
                f"gains are not Hurwitz: k2·k3 = {self.k2 * self.k3:g} must exceed k1 = {self.k1:g} (Lemma 2)"
            )
        return self


class HomingConfig(Section):
    """How the zero of an incremental encoder is found: against an end stop, slowly, with bounded force."""

    stop: Literal["rear", "front"] = "rear"
    speed_m_s: Annotated[float, Field(gt=0, le=0.1)] = 0.02
    force_n: Positive = 120.0  # above friction, below what harms
    back_off_m: Positive = 0.03


class EncoderConfig(Section):
    """What the encoder knows when it is switched on."""

    kind: Literal["absolute", "incremental"] = "absolute"
    homing: HomingConfig = HomingConfig()


class ReferenceConfig(Section):
    """The motion tracked after arming; positions in the paper's effective coordinate."""

    kind: Literal["sine"] = "sine"
    effective_centre_m: Positive
    amplitude_m: NonNegative
    frequency_hz: Annotated[float, Field(ge=0, le=20)]
    join: Literal["transfer", "at_once"] = "transfer"


class TransferConfig(Section):
    """Bounds of the motion that joins a reference."""

    speed_m_s: Positive = 0.3
    acceleration_m_s2: Positive = 2.0
    jerk_m_s3: Positive = 40.0


class WayConfig(Section):
    """Bounds of the motions to a position, at a speed, and to rest."""

    speed_m_s: Positive = 0.5  # never above limits.speed_m_s
    acceleration_m_s2: Positive = 5.0
    jerk_m_s3: Positive = 100.0
    margin_m: NonNegative = 1e-3  # positions this close to limits.travel cannot be asked for


class LimitsConfig(Section):
    """What the axis may never exceed; positions in the stroke coordinate, pressures absolute."""

    travel_min_m: float
    travel_max_m: float
    speed_m_s: Positive
    tracking_error_m: Positive
    chamber_min_pa: NonNegative
    chamber_max_pa: Pressure
    supply_min_pa: Pressure
    supply_max_pa: Pressure
    slew_v_s: Annotated[float, Field(gt=0, le=1e6)]
    innovation_m: Positive = 2e-3  # encoder against prediction; further is a jump of the encoder
    braking_m_s2: Positive = 10.0  # the deceleration that the axis can be relied on for
    disagreement_n: Positive = 800.0  # force that pressures and acceleration may leave unexplained
    saturation_s: Positive = 2.0
    stuck_force_n: Positive = 200.0  # change of force that a load cannot bear without moving at all
    stuck_travel_m: Positive = 0.03  # travel that changes every chamber pressure
    stop_then: Literal["hold", "centre"] = "hold"  # after a stop that was asked for
    transfer: TransferConfig = TransferConfig()
    motion: WayConfig = WayConfig()

    @model_validator(mode="after")
    def _ordered(self) -> LimitsConfig:
        for low, high in (
            ("travel_min_m", "travel_max_m"),
            ("chamber_min_pa", "chamber_max_pa"),
            ("supply_min_pa", "supply_max_pa"),
        ):
            if getattr(self, low) >= getattr(self, high):
                raise ValueError(
                    f"{low} = {getattr(self, low):g} must lie below {high} = {getattr(self, high):g}"
                )
        most = max(self.transfer.acceleration_m_s2, self.motion.acceleration_m_s2)
        if self.braking_m_s2 < most:
            raise ValueError(
                f"braking_m_s2 = {self.braking_m_s2:g} must not lie below the acceleration of transfer and"
                f" motion, {most:g}: they brake as hard"
            )
        return self


class LogConfig(Section):
    """The record."""

    detail: Literal["compact", "full"] = "compact"
    part_mb: Annotated[float, Field(ge=0, le=100_000)] = 256.0  # another file after so much; 0: never
    part_s: Annotated[float, Field(ge=0, le=1e7)] = 3600.0  # or after so long; 0: never
    quota_mb: Annotated[float, Field(ge=0, le=1e8)] = 20_000.0  # of all logs of the axis; 0: no bound
    keep_before_s: Annotated[float, Field(ge=0, le=1e6)] = 60.0  # what goes last around a fault
    keep_after_s: Annotated[float, Field(ge=0, le=1e6)] = 30.0

    @model_validator(mode="after")
    def _quota_of_several_parts(self) -> LogConfig:
        if self.quota_mb and not 0.0 < self.part_mb <= self.quota_mb / 4.0:
            raise ValueError(
                f"quota_mb = {self.quota_mb:g} needs part_mb above 0 and at most a quarter of it, since whole"
                f" parts are deleted; part_mb is {self.part_mb:g}"
            )
        return self


class PlantValveConfig(Section):
    """The true valve."""

    bandwidth_hz: NonNegative = 0.0
    damping: Annotated[float, Field(gt=0, le=5)] = 0.7
    dead_zone_v: Annotated[float, Field(ge=0, lt=2.5)] = 0.0
    dac_bits: Annotated[int, Field(ge=0, le=24)] = 0


class PlantSensorsConfig(Section):
    """The true sensors; zero for exact ones."""

    encoder_resolution_m: NonNegative = 0.0
    pressure_resolution_pa: NonNegative = 0.0
    pressure_noise_pa: NonNegative = 0.0


class PlantConfig(Section):
    """The software rig: what really happens, apart from what the controller's sections above believe."""

    step_us: Annotated[float, Field(gt=0, le=100)] = 100.0
    initial_x1_m: Positive = 0.45
    initial_p2_pa: Pressure = 300_000.0
    rod_force: bool = True
    reverse_flow: bool = True
    polytropic_exponent: Annotated[float, Field(ge=1, lt=2)] | None = None
    disturbance: Literal["none", "case1", "case2"] = "none"
    bitrate_bit_s: MaybeInfinite = 1.0e6
    node_delay_us: Annotated[float, Field(ge=0, le=500)] = 20.0
    valve: PlantValveConfig = PlantValveConfig()
    friction: FrictionConfig = FrictionConfig()
    sensors: PlantSensorsConfig = PlantSensorsConfig()


class Config(Section):
    """A whole axis."""

    schema_: Annotated[Literal[1], Field(alias="schema")]
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")]
    cylinder: CylinderConfig
    gas: GasConfig
    valve: ValveConfig
    loop: LoopConfig = LoopConfig()
    realtime: RealtimeConfig = RealtimeConfig()
    bus: BusConfig = BusConfig()
    encoder: EncoderConfig = EncoderConfig()
    control: ControlConfig
    reference: ReferenceConfig
    limits: LimitsConfig
    log: LogConfig = LogConfig()
    plant: PlantConfig = PlantConfig()

    @model_validator(mode="after")
    def _fits_together(self) -> Config:
        stroke = self.cylinder.stroke_m
        if self.limits.travel_min_m < 0 or self.limits.travel_max_m > stroke:
            raise ValueError(
                f"limits.travel {self.limits.travel_min_m:g} … {self.limits.travel_max_m:g} m"
                f" must lie within the stroke 0 … {stroke:g} m"
            )
        if self.limits.tracking_error_m > 0.5 * stroke:
            raise ValueError(
                f"limits.tracking_error_m = {self.limits.tracking_error_m:g} is more than half the stroke"
            )
        centre = self.reference.effective_centre_m - self.cylinder.dead_length_1_m
        low, high = centre - self.reference.amplitude_m, centre + self.reference.amplitude_m
        if low < self.limits.travel_min_m or high > self.limits.travel_max_m:
            raise ValueError(
                f"reference reaches {low:g} … {high:g} m of the stroke,"
                f" beyond limits.travel {self.limits.travel_min_m:g} … {self.limits.travel_max_m:g} m"
            )
        peak = 2.0 * math.pi * self.reference.frequency_hz * self.reference.amplitude_m
        if peak > self.limits.speed_m_s:
            raise ValueError(
                f"reference reaches {peak:g} m/s, above limits.speed_m_s = {self.limits.speed_m_s:g}"
            )
        if not self.limits.supply_min_pa <= self.gas.supply_pa <= self.limits.supply_max_pa:
            raise ValueError(
                f"gas.supply_pa = {self.gas.supply_pa:g} lies outside limits.supply"
                f" {self.limits.supply_min_pa:g} … {self.limits.supply_max_pa:g}"
            )
        limits = self.limits
        back_off_m = self.encoder.homing.back_off_m
        rear = self.encoder.homing.stop == "rear"
        homed_m = back_off_m if rear else stroke - back_off_m
        if self.encoder.kind == "incremental" and not (limits.travel_min_m < homed_m < limits.travel_max_m):
            raise ValueError(
                f"encoder.homing.back_off_m = {back_off_m:g} ends at {homed_m:g} m, outside limits.travel"
                f" {limits.travel_min_m:g} … {limits.travel_max_m:g} m"
            )
        if 2.0 * limits.motion.margin_m >= limits.travel_max_m - limits.travel_min_m:
            raise ValueError(f"limits.motion.margin_m = {limits.motion.margin_m:g} leaves no travel")
        x1 = self.plant.initial_x1_m - self.cylinder.dead_length_1_m
        if not 0.0 <= x1 <= stroke:
            raise ValueError(f"plant.initial_x1_m = {self.plant.initial_x1_m:g} lies outside the stroke")
        period_ms = 1000.0 / self.loop.rate_hz
        for key in ("sensor_timeout_ms", "valve_timeout_ms", "deadline_timeout_ms", "overload_timeout_ms"):
            if getattr(self.bus, key) < 2.0 * period_ms:
                raise ValueError(
                    f"bus.{key} = {getattr(self.bus, key):g} is shorter than two ticks ({2 * period_ms:g} ms)"
                )
        return self


def gas_of(c: Config) -> gas_.Gas:
    """The gas as plain numbers."""
    g = c.gas
    return gas_.gas(
        g.heat_capacity_ratio, g.gas_constant_j_kg_k, g.temperature_k, g.atmosphere_pa, g.supply_pa
    )


def cylinder_of(c: Config) -> cyl.Cylinder:
    """The cylinder as plain numbers."""
    k = c.cylinder
    return cyl.cylinder(
        k.piston_area_1_m2,
        k.piston_area_2_m2,
        k.moving_mass_kg,
        k.stroke_m,
        k.dead_length_1_m,
        k.dead_length_2_m,
        c.valve.orifice_area_m2,
        c.valve.u_max_v,
        gas_of(c),
    )


def valve_of(c: Config) -> Valve:
    """The valve the controller believes in, as plain numbers."""
    v = c.valve
    return Valve(v.u_max_v, 2.0 * math.pi * v.bandwidth_hz, v.damping, v.dead_zone_v)


def friction_of(f: FrictionConfig) -> Friction:
    """A friction as plain numbers."""
    return Friction(
        f.coulomb_n,
        f.static_n,
        f.stribeck_speed_m_s,
        f.viscous_n_s_m,
        f.bristle_stiffness_n_m,
        f.bristle_damping_n_s_m,
    )


def plant_of(c: Config) -> PlantParameters:
    """The true plant as plain numbers."""
    p = c.plant
    cylinder = cylinder_of(c)
    if not p.rod_force:
        cylinder = cylinder._replace(rod_force_n=0.0)
    return PlantParameters(
        gas=gas_of(c),
        cylinder=cylinder,
        valve=Valve(
            c.valve.u_max_v, 2.0 * math.pi * p.valve.bandwidth_hz, p.valve.damping, p.valve.dead_zone_v
        ),
        friction=friction_of(p.friction),
        polytropic_exponent=p.polytropic_exponent or c.gas.heat_capacity_ratio,
        reverse_flow=p.reverse_flow,
        step_s=p.step_us * 1e-6,
        initial_x1=p.initial_x1_m,
        initial_p2_pa=p.initial_p2_pa,
        disturbance=("none", "case1", "case2").index(p.disturbance),
        dac_bits=p.valve.dac_bits,
        valve_timeout_s=c.bus.valve_timeout_ms * 1e-3,
        encoder_resolution_m=p.sensors.encoder_resolution_m,
        pressure_resolution_pa=p.sensors.pressure_resolution_pa,
        pressure_noise_pa=p.sensors.pressure_noise_pa,
        encoder_zero_m=p.initial_x1_m - cylinder.x_e1 if c.encoder.kind == "incremental" else 0.0,
        encoder_referenced=c.encoder.kind == "absolute",
        bitrate_bit_s=p.bitrate_bit_s,
        node_delay_s=p.node_delay_us * 1e-6,
    )


def parse(text: str, name: str) -> Config:
    """A configuration from the text of its file.

    Args:
        text: TOML.
        name: what to call it in messages.

    Raises:
        ConfigError: names the file, the key, the value and the bound.
    """
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as e:
        raise ConfigError(f"{name}: not valid TOML: {e}") from None
    try:
        return Config.model_validate(data)
    except ValidationError as e:
        raise ConfigError(f"{name}: {explain(e)}") from None


def with_settings(text: str, name: str, settings: Sequence[str]) -> Config:
    """A configuration with some of its values replaced.

    Args:
        text: TOML.
        name: what to call it in messages.
        settings: such as "control.k1=2500", the value as in TOML; a string needs no quotes.

    Raises:
        ConfigError: as `parse`, or a setting has not this form.
    """
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as e:
        raise ConfigError(f"{name}: not valid TOML: {e}") from None
    for setting in settings:
        key, equals, value = setting.partition("=")
        *tables, last = key.strip().split(".")
        if not equals or not last:
            raise ConfigError(f"--set {setting}: give key=value, such as control.k1=2500")
        table = data
        for part in tables:
            table = table.setdefault(part, {})
            if not isinstance(table, dict):
                raise ConfigError(f"--set {setting}: {part} is no table")
        try:
            table[last] = tomllib.loads(f"x = {value}")["x"]
        except tomllib.TOMLDecodeError:
            table[last] = value.strip()
    try:
        return Config.model_validate(data)
    except ValidationError as e:
        raise ConfigError(f"{name} with --set: {explain(e)}") from None


def load_config(file: str | Path) -> Config:
    """The configuration in a file, or one of those that come with pneud by its bare name.

    Raises:
        ConfigError: the file is missing, unreadable or wrong.
    """
    return load_with_text(file)[0]


def load_with_text(file: str | Path) -> tuple[Config, str, Path]:
    """As `load_config`, with the file's text and where it was found."""
    try:
        path = resources.find(file)
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError as e:
        raise ConfigError(str(e)) from None
    except (OSError, UnicodeDecodeError) as e:
        raise ConfigError(f"{file}: cannot be read: {e}") from None
    return parse(text, str(path)), text, path


def explain(e: ValidationError) -> str:
    """What is wrong, in one line: key, value and bound of each error."""
    return "; ".join(_sentence(error) for error in e.errors())


def _sentence(error: Any) -> str:
    where = ".".join(str(part) for part in error["loc"])
    if error["type"] == "extra_forbidden":
        return f"{where}: unknown key"
    if error["type"] == "missing":
        return f"{where}: missing"
    message = error["msg"].removeprefix("Value error, ")
    value = error["input"]
    shown = f" = {value!r}" if isinstance(value, (int, float, str, bool)) else ""
    return f"{where}{shown}: {message}" if where else str(message)
