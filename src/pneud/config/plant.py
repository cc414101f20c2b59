"""The software rig as a section, where it differs from what the controller believes; friction of both."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from pneud.config.sections import (
    Area,
    Command,
    Damping,
    DeadZone,
    EncoderKind,
    Force,
    HeatRatio,
    Inclination,
    Mass,
    MaybeInfinite,
    NonNegative,
    Orifice,
    Positive,
    Pressure,
    Resolution,
    Section,
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
    def _complete(self) -> FrictionConfig:
        if self.static_n < self.coulomb_n:
            raise ValueError("static_n must not lie below coulomb_n")
        if self.coulomb_n > 0 and self.bristle_stiffness_n_m == 0:
            raise ValueError("bristle_stiffness_n_m must be positive where there is dry friction")
        return self


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
    gas_constant_j_kg_k: Positive | None = None
    temperature_k: Temperature | None = None
    atmosphere_pa: Pressure | None = None
    supply_pa: Pressure | None = None


class PlantValveConfig(Section):
    """The true valve; area, greatest command and time-out are those of `[valve]` and `[bus]` if not given."""

    orifice_area_m2: Orifice | None = None
    u_max_v: Command | None = None
    bandwidth_hz: NonNegative = 0.0  # 0: none
    damping: Damping = 0.7
    dead_zone_v: DeadZone = 0.0  # on either side
    dead_zone_positive_v: DeadZone | None = None  # edge for u > 0, where it is another
    dead_zone_negative_v: DeadZone | None = None  # likewise for u < 0, as a distance from the centre
    centre_v: Annotated[float, Field(gt=-2.5, lt=2.5)] = 0.0  # command from which both edges count
    dac_bits: Annotated[int, Field(ge=0, le=24)] = 0  # 0: any voltage
    timeout_ms: Timeout | None = None  # without a command, after which it centres itself


class PlantSensorsConfig(Section):
    """The true sensors; zero for exact ones."""

    encoder_kind: EncoderKind | None = None  # none: as in `[encoder]`
    encoder_resolution_m: Resolution = 0.0
    pressure_resolution_pa: NonNegative = 0.0
    pressure_noise_pa: NonNegative = 0.0


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
    disturbance: Literal["none", "case1", "case2"] = "none"  # force of the paper's cases
    bitrate_bit_s: MaybeInfinite = 1.0e6  # of the wire that the frames keep busy
    node_delay_us: Annotated[float, Field(ge=0, le=500)] = 20.0  # from SYNC to an answer
    cylinder: PlantCylinderConfig = PlantCylinderConfig()
    gas: PlantGasConfig = PlantGasConfig()
    valve: PlantValveConfig = PlantValveConfig()
    friction: FrictionConfig = FrictionConfig()
    sensors: PlantSensorsConfig = PlantSensorsConfig()
    wiring: PlantWiringConfig = PlantWiringConfig()
