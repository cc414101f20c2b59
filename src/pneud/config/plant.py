"""The software rig as a section, where it differs from what the controller believes; friction of both."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from pneud.config.flow import RATINGS, given
from pneud.config.measured import Places, check_map
from pneud.config.sections import (
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
    Leakage,
    Mass,
    MaybeInfinite,
    NonNegative,
    Offset,
    Orifice,
    Positive,
    Pressure,
    Resolution,
    Section,
    Share,
    Stroke,
    Temperature,
    Timeout,
)


class FrictionConfig(Section):
    """LuGre friction; all zero for none."""

    coulomb_n: NonNegative = 0.0
    static_n: NonNegative = 0.0
    stribeck_speed_m_s: Positive = 0.02
    viscous_n_s_m: NonNegative = 0.0
    bristle_stiffness_n_m: NonNegative = 0.0
    bristle_damping_n_s_m: NonNegative = 0.0

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if self.static_n < self.coulomb_n:
            raise ValueError("static_n must not lie below coulomb_n")
        if self.coulomb_n > 0 and self.bristle_stiffness_n_m == 0:
            raise ValueError("bristle_stiffness_n_m must be positive where there is dry friction")
        return self


class PlantFrictionConfig(FrictionConfig):
    """The true friction; all zero for none."""

    model: Literal["lugre", "gms"] = "lugre"  # bristles of one kind, or four Maxwell elements that slip
    pressure_share_bar: Share = 0.0  # more of it for each bar of mean chamber pressure above 3 bar, absolute
    forward_share: Share = 0.0  # more of it on the way out, and less on the way back


class PlantCylinderConfig(Section):
    """The true geometry and load; what is not given is as in `[cylinder]`."""

    piston_area_1_m2: Area | None = None
    piston_area_2_m2: Area | None = None
    stroke_m: Stroke | None = None
    dead_length_1_m: Positive | None = None
    dead_length_2_m: Positive | None = None
    moving_mass_kg: Mass | None = None
    inclination_deg: Inclination | None = None
    load_n: Force | None = None


class PlantGasConfig(Section):
    """The true medium and supply; what is not given is as in `[gas]`."""

    heat_capacity_ratio: HeatRatio | None = None
    gas_constant_j_kg_k: GasConstant | None = None
    temperature_k: Temperature | None = None
    atmosphere_pa: Pressure | None = None
    supply_pa: Pressure | None = None


class PlantSupplyConfig(Section):
    """A supply that gives way where much is drawn."""

    receiver_m3: NonNegative = 0.0  # volume before the valve; 0: the supply is constant
    regulator_l_min_bar: Positive = 1000.0  # ANR, what flows after for each bar below `gas.supply_pa`


FreePeriod = Annotated[float, Field(ge=100, le=100_000)]


class PlantHosesConfig(Section):
    """Hoses that the controller does not know of, besides the dead lengths and the lag."""

    volume_1_m3: NonNegative = 0.0
    volume_2_m3: NonNegative = 0.0
    delay_s: Annotated[float, Field(ge=0, le=0.05)] = 0.0  # about 3 ms for each metre


class PlantValveConfig(Section):
    """The true valve; size, flow, range and time-out are as in `[valve]` and `[bus]` if not given."""

    orifice_area_m2: Orifice | None = None  # one of these five at most
    nominal_flow_l_min: Positive | None = None
    sonic_conductance_l_s_bar: Positive | None = None
    kv_m3_h: Positive | None = None
    cv: Positive | None = None
    flow: Flow | None = None
    critical_ratio: CriticalRatio | None = None
    exponent: Exponent | None = None
    exhaust_ratio: ExhaustRatio | None = None
    exhaust_critical_ratio: CriticalRatio | None = None
    u_max_v: Command | None = None
    bandwidth_hz: NonNegative = 0.0  # 0: none
    damping: Damping = 0.7
    dead_zone_v: DeadZone = 0.0  # on either side
    dead_zone_positive_v: DeadZone | None = None  # edge for u > 0, where it is another
    dead_zone_negative_v: DeadZone | None = None  # likewise for u < 0, as a distance from the centre
    centre_v: Centre = 0.0  # command from which both edges count
    map: Places = ()  # as in `[valve]`; edges and centre are its own
    hysteresis_v: Annotated[float, Field(ge=0, le=1)] = 0.0  # play of the spool, from one side to the other
    leakage: Leakage = 0.0  # opening of closed edges from the supply, as a part of the whole one
    leakage_exhaust: Leakage | None = None  # of those to the atmosphere; none: as much
    dac_bits: Annotated[int, Field(ge=0, le=24)] = 0  # 0: any voltage
    timeout_ms: Timeout | None = None  # without a command, after which it centres itself

    @model_validator(mode="after")
    def _one_rating(self) -> Self:
        if len(given(self)) > 1:
            raise ValueError(f"give one of {', '.join(RATINGS)} at most")
        return self

    @model_validator(mode="after")
    def _map_has_edges(self) -> Self:
        own = (self.dead_zone_positive_v, self.dead_zone_negative_v, self.dead_zone_v or None)
        if self.map and (self.centre_v or any(edge is not None for edge in own)):
            raise ValueError("map has edges and centre of its own; give neither dead_zone_v nor centre_v")
        if self.map:
            check_map(self.map, self.map[-1][0])
        return self


class PlantSensorsConfig(Section):
    """The true sensors; zero for exact ones."""

    encoder_kind: EncoderKind | None = None  # none: as in `[encoder]`
    encoder_resolution_m: Resolution = 0.0
    pressure_resolution_pa: NonNegative = 0.0
    encoder_noise_m: Resolution = 0.0  # standard deviation
    encoder_offset_m: Annotated[float, Field(ge=-0.01, le=0.01)] = 0.0
    encoder_lag_s: Annotated[float, Field(ge=0, le=0.01)] = 0.0  # it shows where the load was
    pressure_noise_pa: NonNegative = 0.0
    pressure_bits: Annotated[int, Field(ge=0, le=24)] = 0  # of pressure_range_pa, in place of a resolution
    pressure_range_pa: Pressure = 1.0e6
    pressure_lag_s: Annotated[float, Field(ge=0, le=0.1)] = 0.0
    p1_offset_pa: Offset = 0.0
    p2_offset_pa: Offset = 0.0
    supply_offset_pa: Offset = 0.0

    @property
    def pressure_step_pa(self) -> float:
        """Step of what the pressure sensors show [Pa]."""
        bits = self.pressure_bits
        return self.pressure_range_pa / 2**bits if bits else self.pressure_resolution_pa

    @model_validator(mode="after")
    def _one_step(self) -> Self:
        if self.pressure_bits and self.pressure_resolution_pa:
            raise ValueError("give either pressure_resolution_pa or pressure_bits")
        return self


class PlantContactConfig(Section):
    """Something to press against: a spring with a damper that the load runs into, and out of again."""

    position_m: NonNegative = 0.0  # where it begins, stroke coordinate
    stiffness_n_m: Annotated[float, Field(ge=0, le=1e7)] = 0.0  # 0: nothing is there
    damping_n_s_m: Annotated[float, Field(ge=0, le=1e5)] = 0.0
    side: Literal["front", "rear"] = "front"  # in front of the load, or behind it


class PlantWiringConfig(Section):
    """Mistakes in putting the rig together, each by itself or with others."""

    swapped_hoses: bool = False  # as is a valve whose command is inverted
    encoder_inverted: bool = False
    encoder_scale: Annotated[float, Field(ge=0.01, le=100)] = 1.0  # shown over true, from the start on
    exchanged_pressures: bool = False
    dead_pressure: Literal["none", "a", "b"] = "none"  # its sensor shows the atmosphere
    supply_shut: bool = False
    valve_unplugged: bool = False  # the spool stays in its centre
    blocked: bool = False  # the load cannot move


class PlantBeamConfig(Section):
    """A beam to the piston of another axis, with a load on it; square where both are at first."""

    axis: str  # the other one; said of one of the two
    stiffness_n_m: Positive
    damping_n_s_m: NonNegative = 0.0
    load_kg: NonNegative = 0.0
    load_share: Annotated[float, Field(ge=0, le=1)] = 0.5  # of it that this axis bears; the other the rest
    mirrored: bool = False  # as the other one says; pneud writes that itself


class PlantConfig(Section):
    """The software rig: what really happens, apart from what the controller's sections above believe.

    Whatever the rig has in common with the controller's sections can differ from them, in the tables below.
    """

    step_us: Annotated[float, Field(gt=0, le=100)] = 100.0  # of the integration
    initial_x1_m: Positive = 0.45  # stroke coordinate and `[cylinder]` dead_length_1_m
    initial_p2_pa: Pressure = 300_000.0
    rod_force: bool = True
    reverse_flow: bool = True
    polytropic_exponent: Annotated[float, Field(ge=1, lt=2)] | None = None  # none: adiabatic
    wall_time_s: Annotated[float, Field(ge=0, le=100)] = (
        0.0  # in which air gets as warm as the wall; 0: never
    )
    disturbance: Literal["none", "case1", "case2"] = "none"  # force of the paper's cases
    bitrate_bit_s: MaybeInfinite = 1.0e6  # of the wire that the frames keep busy
    node_delay_us: Annotated[float, Field(ge=0, le=500)] = 20.0  # from SYNC to an answer
    free_period_us: FreePeriod | None = None  # of nodes that run free (bus.sync); none: as loop.rate_hz
    free_jitter_us: Annotated[float, Field(ge=0, le=10_000)] = 0.0  # about as late as their frames leave
    devices: Literal["frames", "canopen"] | None = None  # what its nodes are; none: as bus.nodes
    odd_nodes: Annotated[int, Field(ge=0)] | None = None  # seed of one that misbehaves while it is configured
    inputs: dict[str, bool] = Field(default_factory=dict)  # that are on at first; enable is by itself
    input_period_ms: Annotated[float, Field(ge=1, le=10_000)] = 10.0  # they are sent so often
    output_timeout_ms: Annotated[float, Field(ge=1, le=10_000)] = 100.0  # without a message outputs are off
    cylinder: PlantCylinderConfig = PlantCylinderConfig()
    gas: PlantGasConfig = PlantGasConfig()
    valve: PlantValveConfig = PlantValveConfig()
    friction: PlantFrictionConfig = PlantFrictionConfig()
    supply: PlantSupplyConfig = PlantSupplyConfig()
    hoses: PlantHosesConfig = PlantHosesConfig()
    sensors: PlantSensorsConfig = PlantSensorsConfig()
    wiring: PlantWiringConfig = PlantWiringConfig()
    beam: PlantBeamConfig | None = None
    contact: PlantContactConfig = PlantContactConfig()
