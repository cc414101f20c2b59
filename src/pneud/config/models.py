"""One axis as a TOML file: what may stand in it, and its bounds.

Unknown keys are errors; units are part of the names. Nothing here is read inside the loop.
"""

import math
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from pneud.config.bus_tables import BusConfig
from pneud.config.flow import RATINGS, given
from pneud.config.learnt import start_of
from pneud.config.measured import Places, check_map, edges_of
from pneud.config.plant import FrictionConfig, PlantConfig
from pneud.config.sections import (
    GRAVITY_M_S2,
    STOP_M,
    Area,
    Centre,
    Command,
    CriticalRatio,
    Damping,
    DeadZone,
    EncoderKind,
    ExhaustRatio,
    Exponent,
    Flow,
    Force,
    GasConstant,
    HeatRatio,
    Inclination,
    Mass,
    NonNegative,
    Orifice,
    Positive,
    Pressure,
    Resolution,
    Section,
    Stroke,
    Temperature,
)
from pneud.config.station import BrakeConfig, IoConfig, check_station
from pneud.control.laws import adrc, pid
from pneud.control.laws.open_loop import OpenLoop
from pneud.control.model import MOST_PUSH_RATIO
from pneud.physics.ratings import TYPICAL_CRITICAL_RATIO


class CylinderConfig(Section):
    """Geometry and load."""

    piston_area_1_m2: Area  # cap end
    piston_area_2_m2: Area  # rod end: without the rod
    stroke_m: Stroke
    dead_length_1_m: Positive  # volume before the piston at its end, with its hose, as a length
    dead_length_2_m: Positive  # likewise
    moving_mass_kg: Mass  # piston, rod and load
    inclination_deg: Inclination = 0.0  # of the way out against the horizontal; 90 lifts the mass
    load_n: Force = 0.0  # constant force against the way out, besides the weight

    @property
    def resistance_n(self) -> float:
        """Weight and constant load [N] against the way out."""
        return self.load_n + self.moving_mass_kg * GRAVITY_M_S2 * math.sin(math.radians(self.inclination_deg))


class GasConfig(Section):
    """The medium and its supply; pressures are absolute."""

    heat_capacity_ratio: HeatRatio = 1.4
    gas_constant_j_kg_k: GasConstant = 286.987
    temperature_k: Temperature = 293.0  # of the supply and of what flows
    atmosphere_pa: Pressure = 101_000.0
    supply_pa: Pressure  # absolute, as is everything here

    @model_validator(mode="after")
    def _supply_above_atmosphere(self) -> Self:
        if self.supply_pa <= self.atmosphere_pa:
            raise ValueError("supply_pa must lie above atmosphere_pa (both are absolute)")
        return self


MAP_EDGE_V = 1e-3  # by which map and dead_zone_v may differ


class ValveConfig(Section):
    """The proportional valve as the controller knows it; its size by one rating, open to the end."""

    orifice_area_m2: Orifice | None = None  # one of these five
    nominal_flow_l_min: Positive | None = None  # qnN, 6 → 5 bar above the atmosphere, ANR
    sonic_conductance_l_s_bar: Positive | None = None  # C of ISO 6358
    kv_m3_h: Positive | None = None  # of water at 1 bar
    cv: Positive | None = None  # in US gallons a minute at 1 psi
    flow: Flow = "orifice"  # how it falls with the pressure ratio: as in the paper, or by C and b
    critical_ratio: CriticalRatio = TYPICAL_CRITICAL_RATIO  # b; an orifice has its own, 0.53
    exponent: Exponent = 0.5  # m, the subsonic index
    exhaust_ratio: ExhaustRatio = 1.0  # flow to the atmosphere over that from the supply
    exhaust_critical_ratio: CriticalRatio | None = None  # b of the edges to the atmosphere; none: as above
    u_max_v: Command = 5.0  # signed about the centre; the DAC saturates here
    bandwidth_hz: NonNegative = 0.0  # natural frequency of the spool; 0: none
    damping: Damping = 0.7  # of the spool
    dead_zone_v: DeadZone = 0.0  # half width about the centre
    centre_v: Centre = 0.0  # command in the middle of the dead zone
    map: Places = ()  # [[command in V, relative opening], …] as measured, from end to end

    @model_validator(mode="after")
    def _one_rating(self) -> Self:
        if len(found := given(self)) != 1:
            raise ValueError(f"give one of {', '.join(RATINGS)}{f'; not {len(found)}' if found else ''}")
        return self

    @model_validator(mode="after")
    def _map_rises(self) -> Self:
        if self.map:
            check_map(self.map, self.u_max_v)
            dead_zone_v = edges_of(self.map).dead_zone_v
            if abs(self.dead_zone_v - dead_zone_v) > MAP_EDGE_V:
                raise ValueError(f"dead_zone_v must be that of map, {dead_zone_v:g}")
            if self.centre_v:
                raise ValueError("map has a centre of its own; leave out centre_v")
        return self


class LoopConfig(Section):
    """The tick."""

    rate_hz: Annotated[float, Field(ge=10, le=5_000)] = 1000.0  # ticks per second
    set_deadline: Annotated[float, Field(ge=0.1, le=0.95)] = 0.8  # part of the period to wait for answers
    spin_us: Annotated[float, Field(ge=0, le=500)] = 0.0  # awake before each tick instead of asleep
    compiled: Literal["off", "auto", "required"] = "auto"  # the law in C: as can be had, or not without


class RealtimeConfig(Section):
    """What is asked of the operating system.

    The loop has `cpu` to itself: recorder, console, screen and plant run on `other_cpus`, or on all but that
    one where none are given. "auto" is the last isolated CPU, else the last of several.
    """

    priority: Annotated[int, Field(ge=0, le=98)] = 80  # SCHED_FIFO of the loop; 0: ordinary
    cpu: Annotated[int, Field(ge=0)] | Literal["auto"] | None = None
    other_cpus: tuple[Annotated[int, Field(ge=0)], ...] = ()
    plant_priority: Annotated[int, Field(ge=0, le=98)] | None = None  # 10 below the loop's if none
    recorder_nice: Annotated[int, Field(ge=0, le=19)] = 0  # niceness of the recorder
    lock_memory: bool = True  # mlockall
    required: bool = False  # refuse to arm without real-time scheduling


class ObserverConfig(Section):
    """The disturbance observer (10)."""

    discretisation: Literal["explicit", "implicit", "matched"] = "implicit"
    lambda0: Positive = 1.5
    lambda1: Positive = 1.1
    gain_n_s2: Positive

    @model_validator(mode="after")
    def _convergent(self) -> Self:
        if self.lambda1 <= 1.0:
            raise ValueError(
                "lambda1 must exceed 1, or d̂ cannot follow a disturbance that changes at gain_n_s2"
            )
        return self


class MotionConfig(Section):
    """The [x, v, F] filter: a bandwidth, or the noise that its Kalman gains follow from."""

    bandwidth_rad_s: Annotated[float, Field(gt=0, le=5_000)] | None = None
    encoder_noise_m: Positive | None = None
    force_walk_n_rs: Positive | None = None  # what the unmatched force gains in a second [N/√s]
    encoder_resolution_m: Resolution = 0.0  # readings within half a step of the prediction change nothing
    push_bandwidth_rad_s: Annotated[float, Field(gt=0, le=5_000)] | None = None  # for innovations
    push_beyond_m: NonNegative = 0.0  # that exceed half a step by more than this

    @model_validator(mode="after")
    def _one_way(self) -> Self:
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


class PidConfig(Section):
    """PID with feed-forward: a position loop around a force loop."""

    kp: Positive = 2540.0
    ki: NonNegative = 32000.0
    kd: Positive = 75.6
    kf: Positive = 202.0
    reach_m: Positive = 0.01  # error that feedback takes at most
    quiet_m: NonNegative = 20e-6  # the integral rests within this error
    force_max_n: NonNegative = 200.0  # greatest integral

    @model_validator(mode="after")
    def _hurwitz(self) -> Self:
        _check_hurwitz(pid.loop(pid.Pid(**self.model_dump())))
        return self


class AdrcConfig(Section):
    """Active disturbance rejection control."""

    k1: Positive = 373000.0
    k2: Positive = 15600.0
    k3: Positive = 216.0
    reach_m: Positive = 0.02  # error that feedback takes at most
    observer_rad_s: Annotated[float, Field(ge=0, le=5_000)] = 0.0  # of an observer without pressures; 0: none

    @model_validator(mode="after")
    def _hurwitz(self) -> Self:
        _check_hurwitz(adrc.loop(adrc.Adrc(**self.model_dump())))
        return self


def _check_hurwitz(loop: OpenLoop) -> None:
    if not loop.hurwitz:
        raise ValueError(f"gains are not Hurwitz: needs {loop.criterion}")


class StartConfig(Section):
    """Where adaptation starts, as `pneud learnt` writes it from a log; what is not given is as configured."""

    axis: str = ""  # that it was learnt on
    log: str = ""  # that it comes from
    dead_zone_positive_v: float | None = None  # edge for u > 0
    dead_zone_negative_v: float | None = None  # for u < 0, as a distance from zero
    orifice_area_m2: float | None = None  # as the flow tells
    bandwidth_hz: float | None = None  # of the spool
    coulomb_n: float | None = None  # the friction's level; all else of it goes along
    bristle_stiffness_n_m: float | None = None
    load_n: float | None = None  # force against the motion that is no friction
    moving_mass_kg: float | None = None


class AdaptationConfig(Section):
    """What is learnt in motion, slowly and within bounds, from its configured value on."""

    enabled: bool = True
    dead_zone: bool = True  # both edges: 0 to 8 % of valve.u_max_v, or to what is configured
    flow: bool = True  # gain of the valve: 0.5 to 2 times
    lag: bool = True  # of the spool: 1 to 4 times
    friction: bool = True  # level of what is fed forward: 0.3 to 3 times
    stiffness: bool = True  # of its bristles, after reversals before which all was explained: 1 to 20 times
    load: bool = True  # force that is no friction, up to what the supply can push
    mass: bool = True  # from a load that shakes: 0.4 to 2.5 times
    start: StartConfig = StartConfig()


class ControlConfig(Section):
    """The law, and the gains of all: of composite and ISMC here, of the others in their tables."""

    law: Literal["composite", "ismc", "pid", "adrc"] = "composite"
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
    dead_zone_hold_v: Annotated[float, Field(ge=0, le=1)] = 0.02  # opening not worth crossing it, at most
    creep: bool = True  # friction is fed forward at the load's own speed where the reference creeps
    standstill: bool = True  # a load at rest where it should be is left alone, the valve closed
    observer: ObserverConfig
    motion: MotionConfig
    friction: FrictionConfig = FrictionConfig()  # as identified; fed forward along the reference
    pid: PidConfig = PidConfig()
    adrc: AdrcConfig = AdrcConfig()
    adaptation: AdaptationConfig = AdaptationConfig()

    @model_validator(mode="after")
    def _force_is_used(self) -> Self:
        if not self.estimate_force and (
            self.force_rate_bandwidth_rad_s > 0 or self.friction != FrictionConfig()
        ):
            raise ValueError("force_rate_bandwidth_rad_s and friction need estimate_force = true")
        return self

    @model_validator(mode="after")
    def _hurwitz(self) -> Self:
        if self.k2 * self.k3 <= self.k1:
            raise ValueError(
                f"gains are not Hurwitz: k2·k3 = {self.k2 * self.k3:g} must exceed k1 = {self.k1:g} (Lemma 2)"
            )
        return self


class HomingConfig(Section):
    """How the zero of an incremental encoder is found: against an end stop, slowly, with bounded force."""

    stop: Literal["rear", "front"] = "rear"  # end stop that is the zero
    speed_m_s: Annotated[float, Field(gt=0, le=0.1)] = 0.02
    force_n: Positive = 120.0  # above friction, below what harms
    back_off_m: Positive = 0.03  # away from the stop, when it has been found


class EncoderConfig(Section):
    """What the encoder knows when it is switched on."""

    kind: EncoderKind = "absolute"  # an incremental one has to be homed
    homing: HomingConfig = HomingConfig()


class FollowConfig(Section):
    """A motion that another axis of the same daemon gives, in place of the one that is tracked.

    With `skew_m` both are a gantry, which carries one load: they do everything together.
    """

    axis: str  # the other one
    of: Literal["reference", "position"] = "reference"  # where it is to be, or where it is measured
    scale: Annotated[float, Field(ge=-100, le=100)] = 1.0  # of its position, in its stroke coordinate
    offset_m: float = 0.0  # behind the scale; of a gantry what makes it square
    bandwidth_hz: Annotated[float, Field(gt=0, le=50)] = 8.0  # of a measured position, and a gantry's shift
    skew_m: Positive | None = None  # of a gantry: further apart is a fault
    coupling: Annotated[float, Field(ge=0, le=2)] = 0.5  # part of the skew by which each reference gives way
    leads: bool = False  # the other follows; pneud says so itself

    @model_validator(mode="after")
    def _square(self) -> Self:
        if self.scale == 0.0:
            raise ValueError("scale must not be 0")
        if self.skew_m is not None and (self.scale != 1.0 or self.of != "reference"):
            raise ValueError('a gantry (skew_m) has scale = 1 and of = "reference"')
        return self


class ReferenceConfig(Section):
    """The motion tracked after arming; positions in the paper's effective coordinate."""

    kind: Literal["sine"] = "sine"
    effective_centre_m: Positive  # stroke coordinate and dead_length_1_m
    amplitude_m: NonNegative
    frequency_hz: Annotated[float, Field(ge=0, le=20)]
    join: Literal["transfer", "at_once"] = "transfer"  # by a jerk-limited way, or where it begins
    follow: FollowConfig | None = None  # another axis, in place of all this


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


class PressConfig(Section):
    """What pressing with a force keeps to, where nothing else is asked for."""

    most_n: Positive | None = None  # greatest force that may be asked for; none: 0.9 of the piston's
    rate_n_s: Positive | None = (
        None  # of the ramp; none: the piston's force in 0.05 s, or what the valve can do
    )
    speed_m_s: Positive = 0.2  # of the load, until it is pressed against something; faster is a fault
    time_s: Annotated[float, Field(gt=0, le=3600)] = 5.0  # until the force is reached; longer is a fault
    tolerance_n: Positive | None = None  # of the force; none: 2 N, or 1 % of it
    apart_n: Positive | None = None  # load cell from the piston's force; none: 0.1 of that and friction


class LimitsConfig(Section):
    """What the axis may never exceed; positions in the stroke coordinate, pressures absolute."""

    travel_min_m: float
    travel_max_m: float
    speed_m_s: Positive  # faster centres the valve
    tracking_error_m: Positive  # farther centres the valve
    chamber_min_pa: NonNegative
    chamber_max_pa: Pressure  # more centres the valve
    supply_min_pa: Pressure  # less is no air
    supply_max_pa: Pressure
    slew_v_s: Annotated[float, Field(gt=0, le=1e6)]  # of the command
    innovation_m: Positive = 2e-3  # encoder against prediction; further is a jump of the encoder
    braking_m_s2: Positive = 10.0  # the deceleration that the axis can be relied on for
    disagreement_n: Positive = 800.0  # force that pressures and acceleration may leave unexplained
    saturation_s: Positive = 2.0  # held back for so long stops the axis
    stuck_force_n: Positive = 200.0  # change of force that a load cannot bear without moving at all
    stuck_travel_m: Positive = 0.03  # travel that changes every chamber pressure
    stop_then: Literal["hold", "centre"] = "hold"  # after a stop that was asked for
    transfer: TransferConfig = TransferConfig()
    motion: WayConfig = WayConfig()
    force: PressConfig = PressConfig()

    @model_validator(mode="after")
    def _ordered(self) -> Self:
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


class InPositionConfig(Section):
    """When a load counts as having come to its target; it begins in a tick in which its encoder was read."""

    tolerance_m: Positive | None = None  # of the error; none: 0.02 mm, or two steps of the encoder
    velocity_m_s: Positive | None = None  # none: 2 mm/s, more with a coarse encoder
    time_s: Annotated[float, Field(ge=0, le=60)] = 0.05  # for so long, from reading to reading


class HuntingConfig(Section):
    """When a load at its target counts as hunting; it is shown and logged, and stops nothing."""

    swing_m: Positive | None = None  # the error goes to and fro by more; none: 1.5 in_position.tolerance_m
    longest_period_s: Annotated[float, Field(gt=0, le=120)] = 10.0  # of such a swing
    command_step_v: Positive = 0.05  # or the command's mean step from tick to tick is more


class LogConfig(Section):
    """The record."""

    detail: Literal["compact", "full"] = "compact"  # reals with 32 bits, or as they are
    part_mb: Annotated[float, Field(ge=0, le=100_000)] = 256.0  # another file after so much; 0: never
    part_s: Annotated[float, Field(ge=0, le=1e7)] = 3600.0  # or after so long; 0: never
    quota_mb: Annotated[float, Field(ge=0, le=1e8)] = 20_000.0  # of all logs of the axis; 0: no bound
    keep_before_s: Annotated[float, Field(ge=0, le=1e6)] = 60.0  # what goes last around a fault
    keep_after_s: Annotated[float, Field(ge=0, le=1e6)] = 30.0  # and behind it

    @model_validator(mode="after")
    def _quota_of_several_parts(self) -> Self:
        if self.quota_mb and not 0.0 < self.part_mb <= self.quota_mb / 4.0:
            raise ValueError(
                f"quota_mb = {self.quota_mb:g} needs part_mb above 0 and at most a quarter of it, since whole"
                f" parts are deleted; part_mb is {self.part_mb:g}"
            )
        return self


Touch = Literal["stop", "centre", "go_on"]


class OthersConfig(Section):
    """What this axis does, engaged, where a fault takes another one of the same daemon.

    A stop is a controlled one, then what `limits.stop_then` says; `centre` lets go of the load at once.
    """

    centre: Touch = "stop"  # one that is centred at once
    stop: Touch = "stop"  # one that comes to a controlled stop


class FaultsConfig(Section):
    """What a fault does beyond its own axis."""

    others: OthersConfig = OthersConfig()


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
    io: IoConfig = IoConfig()
    brake: BrakeConfig | None = None
    encoder: EncoderConfig = EncoderConfig()
    control: ControlConfig
    reference: ReferenceConfig
    limits: LimitsConfig
    in_position: InPositionConfig = InPositionConfig()
    hunting: HuntingConfig = HuntingConfig()
    faults: FaultsConfig = FaultsConfig()
    log: LogConfig = LogConfig()
    plant: PlantConfig = PlantConfig()

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        stroke = self.cylinder.stroke_m
        if self.limits.travel_min_m < -STOP_M or self.limits.travel_max_m > stroke + STOP_M:
            raise ValueError(
                f"limits.travel {self.limits.travel_min_m:g} … {self.limits.travel_max_m:g} m"
                f" must lie within {STOP_M:g} m of the stroke 0 … {stroke:g} m"
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
        self._plant_can_be()
        period_ms = 1000.0 / self.loop.rate_hz
        for key in (
            "sensor_timeout_ms",
            "valve_timeout_ms",
            "deadline_timeout_ms",
            "overload_timeout_ms",
            "input_timeout_ms",
        ):
            if getattr(self.bus, key) < 2.0 * period_ms:
                raise ValueError(
                    f"bus.{key} = {getattr(self.bus, key):g} is shorter than two ticks ({2 * period_ms:g} ms)"
                )
        start_of(self)
        check_station(self)
        both = self.control.compensate_dead_zone and any(n.dead_band == "valve" for n in self.bus.nodes)
        if both:
            raise ValueError(
                'the dead band is made up for twice: dead_band = "off" of the valve\'s node,'
                " or control.compensate_dead_zone = false"
            )
        return self

    def _plant_can_be(self) -> None:
        p = self.plant
        if p.valve.map and p.valve.map[-1][0] != (p.valve.u_max_v or self.valve.u_max_v):
            raise ValueError("plant.valve.map must lead from end to end of u_max_v")
        k = p.gas.heat_capacity_ratio or self.gas.heat_capacity_ratio
        if p.wall_time_s and p.polytropic_exponent not in (None, k):
            raise ValueError(
                f"plant.polytropic_exponent = {p.polytropic_exponent:g} stands for heat: not with wall_time_s"
            )
        if p.devices == "canopen" and not self.bus.nodes:
            raise ValueError('plant.devices = "canopen" needs [[bus.nodes]]')
        true_stroke_m = p.cylinder.stroke_m or self.cylinder.stroke_m
        if not 0.0 <= p.initial_x1_m - self.cylinder.dead_length_1_m <= true_stroke_m:
            raise ValueError(f"plant.initial_x1_m = {p.initial_x1_m:g} lies outside the stroke")
        supply_pa = p.gas.supply_pa or self.gas.supply_pa
        atmosphere_pa = p.gas.atmosphere_pa or self.gas.atmosphere_pa
        if supply_pa <= atmosphere_pa:
            raise ValueError(
                f"plant.gas: supply_pa = {supply_pa:g} must lie above atmosphere_pa = {atmosphere_pa:g}"
            )
