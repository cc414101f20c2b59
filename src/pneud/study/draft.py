"""A configuration from what one knows of a rig before it has moved: data sheets, and what is typical."""

from __future__ import annotations

import math
from string import Template
from typing import NamedTuple

from pneud import resources
from pneud.config.library import CylinderSheet, ValveSheet
from pneud.config.models import Config
from pneud.config.reading import parse
from pneud.config.sections import GRAVITY_M_S2, ConfigError
from pneud.physics import ratings
from pneud.physics.gas import gas
from pneud.study import gains

ATMOSPHERE_PA, TEMPERATURE_K = 101_000.0, 293.0
GAS = gas(1.4, 286.987, TEMPERATURE_K, ATMOSPHERE_PA, 6e5)
CLEARANCE_M = 5e-3  # of a cylinder at its end
HOSES_M = ((25.0, 4e-3), (400.0, 6e-3))  # inner diameter up to a bore [mm]
RATED_PA = 5e5  # above the atmosphere: at which friction is told as part of the force
STATIC = 1.5  # times the sliding friction
ALPHA, ERROR_M = 0.923, 1e-3
BANDWIDTHS_RAD_S = (75.0, 65.0, 55.0, 47.0, 40.0, 34.0, 29.0, 25.0, 21.0, 18.0)
FAIR_RAD_S = 30.0  # where something speaks against each of them
MOST_PA = 1.3e6  # that the frames of pneud.dbc can carry
MOST_WEIGHT = 0.7  # with friction, of the piston's force
COLUMN = 31  # of the comments
LARGEST_M = 0.05  # amplitude of the reference


class Answers(NamedTuple):
    """What is asked of somebody who has a rig."""

    name: str
    cylinder: CylinderSheet
    valve: ValveSheet
    stroke_mm: float
    mass_kg: float
    inclination_deg: float
    supply_bar: float  # above the atmosphere
    hose_m: float  # from the valve to each port
    encoder_step_um: float
    encoder: str  # absolute or incremental
    bus: str


class Draft(NamedTuple):
    """A configuration, and what is to be said of it."""

    text: str
    config: Config
    bandwidth_rad_s: float
    warnings: list[str]  # of the gains


def drafted(a: Answers) -> Draft:
    """The configuration for some answers, with the fastest gains that nothing speaks against.

    Raises:
        ConfigError: the load is too heavy, or no configuration can have these values.
    """
    template = Template((resources.configs() / "library" / "new.toml.in").read_text(encoding="utf-8"))
    values = {**_words(a), **{key: _plain(value) for key, value in _rig(a).items()}}

    def filled(c: Config | None, omega_rad_s: float) -> str:
        return _aligned(template.substitute(values, omega=f"{omega_rad_s:g}", **_gains(c)))

    c = parse(filled(None, 1.0), a.name)
    for omega_rad_s in (*BANDWIDTHS_RAD_S, FAIR_RAD_S):
        made = gains.designed(c, omega_rad_s, ERROR_M, ALPHA)
        doubts = gains.warnings(made, gains.predict(made, ERROR_M))
        if not doubts:
            break
    text = filled(made, omega_rad_s)
    return Draft(text, parse(text, a.name), omega_rad_s, doubts)


def _aligned(text: str) -> str:
    """The comments behind values in one column."""
    lines = [line.partition(" # ") for line in text.splitlines()]
    return "".join(
        f"{code.rstrip() + ' ':<{COLUMN}}# {said}\n" if sign else f"{code}\n" for code, sign, said in lines
    )


def _words(a: Answers) -> dict[str, str]:
    return {
        "name": a.name,
        "cylinder": a.cylinder.title,
        "cylinder_source": a.cylinder.source,
        "valve": a.valve.title,
        "valve_source": a.valve.source,
        "encoder": a.encoder,
        "bus": a.bus,
        "rig": str(a.bus.startswith("socketcan")).lower(),
        "timeout": "5.0" if a.bus.startswith("socketcan") else "50.0",
        **_flow(a.valve),
    }


def _flow(v: ValveSheet) -> dict[str, str]:
    """The valve's rating as its sheet has it, and which of the rest comes from there."""
    if v.sonic_conductance_l_s_bar is not None:
        rating = f"sonic_conductance_l_s_bar = {v.sonic_conductance_l_s_bar!r} # {v.flow_l_min:.3g} l/min"
    else:
        rating = f"nominal_flow_l_min = {round(v.flow_l_min, 2)!r} # open to the end,"
    given = v.model_fields_set
    return {
        "rating": f"{rating} ANR at 6 -> 5 bar",
        "critical_ratio": f"{v.critical_ratio:g}",
        "critical_ratio_from": "b of its sheet" if "critical_ratio" in given else "typical",
        "valve_hz_from": "the limit frequency of its sheet"
        if "bandwidth_hz" in given
        else "typical: the limit frequency in the sheet of yours",
    }


def _rig(a: Answers) -> dict[str, float]:
    """Geometry, friction and limits [SI] by the template's names."""
    area_1, area_2 = a.cylinder.areas_m2
    stroke, supply = 1e-3 * a.stroke_mm, ATMOSPHERE_PA + 1e5 * a.supply_bar
    hose = next(d for bore_mm, d in HOSES_M if a.cylinder.bore_mm <= bore_mm)
    hose_m3 = 0.25 * math.pi * hose**2 * a.hose_m
    dead_1, dead_2 = CLEARANCE_M + hose_m3 / area_1, CLEARANCE_M + hose_m3 / area_2
    coulomb = a.cylinder.friction * RATED_PA * area_1
    static = STATIC * coulomb
    weight = a.mass_kg * GRAVITY_M_S2 * abs(math.sin(math.radians(a.inclination_deg)))
    push = 1e5 * a.supply_bar * area_2
    if weight + static > MOST_WEIGHT * push:
        raise ConfigError(
            f"{a.mass_kg:g} kg are too heavy: {weight:.3g} N of weight and {static:.3g} N of friction against"
            f" {push:.3g} N of the piston"
        )
    return {
        "area_1": area_1,
        "area_2": area_2,
        "stroke": stroke,
        "dead_1": dead_1,
        "dead_2": dead_2,
        "hose": a.hose_m,
        "hose_mm": 1e3 * hose,
        "mass": a.mass_kg,
        "other_mass": 1.2 * a.mass_kg,
        "inclination": a.inclination_deg,
        "supply": supply,
        "valve_hz": a.valve.bandwidth_hz,
        "damping": a.valve.damping,
        "dead_zone": a.valve.dead_zone_v,
        "encoder_step": 1e-6 * a.encoder_step_um,
        "coulomb": coulomb,
        "static": static,
        "viscous": coulomb,  # typical: at 1 m/s as much again
        "homing_speed": min(0.02, 0.1 * stroke),
        "homing_force": 2.2 * static + weight,
        "back_off": 0.05 * stroke,
        "centre": 0.5 * stroke + dead_1,
        "initial": 0.45 * stroke + dead_1,
        "initial_p2": 0.5 * supply,
        "travel_min": 0.02 * stroke,
        "travel_max": 0.98 * stroke,
        "margin": min(1e-3, 0.005 * stroke),
        "tracking_error": min(0.02, 0.1 * stroke),
        "chamber_max": min(max(1e6, 1.6 * supply), MOST_PA),
        "supply_min": ATMOSPHERE_PA + 0.7 * (supply - ATMOSPHERE_PA),
        "supply_max": min(1.33 * supply, MOST_PA),
        "disagreement": 1.25 * push + weight,
        "stuck": 0.35 * push,
        **_motions(a, stroke, push - weight - static),
    }


def _motions(a: Answers, stroke: float, spare_n: float) -> dict[str, float]:
    """Speeds that the valve can fill, accelerations for a quarter of the force that is left."""
    filled = ratings.DENSITY_ANR_KG_M3 * a.valve.conductance * GAS.R * TEMPERATURE_K
    fastest = 2.0 * filled / a.cylinder.areas_m2[0]  # chambers at half the supply pressure
    speed, acceleration = min(0.5, 0.3 * fastest), min(5.0, 0.25 * max(spare_n, 0.0) / a.mass_kg)
    return {
        "speed": min(2.0, max(0.8 * fastest, 1.5 * speed)),
        "motion_speed": speed,
        "motion_acceleration": acceleration,
        "motion_jerk": 20.0 * acceleration,
        "transfer_speed": 0.6 * speed,
        "transfer_acceleration": 0.4 * acceleration,
        "transfer_jerk": 20.0 * 0.4 * acceleration,
        "braking": min(10.0, 2.0 * acceleration),
        "amplitude": min(0.1 * stroke, LARGEST_M, 0.6 * speed / math.pi, acceleration / math.pi**2),
    }


def _gains(c: Config | None) -> dict[str, str]:
    """Of a configuration, by the template's names; any that can be, without one."""
    if c is None:
        return dict.fromkeys(("k1", "eta", "force_rate", "gain", "filter", "push"), "1.0") | {
            "k2": "3.0",
            "k3": "3.0",
            "alpha": str(ALPHA),
        }
    law = c.control
    found = {
        "k1": law.k1,
        "k2": law.k2,
        "k3": law.k3,
        "alpha": law.alpha,
        "eta": law.eta_m_s3,
        "force_rate": law.force_rate_bandwidth_rad_s,
        "gain": law.observer.gain_n_s2,
        "filter": law.motion.bandwidth_rad_s,
        "push": law.motion.push_bandwidth_rad_s,
    }
    return {key: _plain(value) for key, value in found.items() if value is not None}


def _plain(value: float) -> str:
    """A number to four digits, as TOML."""
    return repr(gains.rounded(value))
