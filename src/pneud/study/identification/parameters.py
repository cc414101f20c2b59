"""What is sought, by keys of the configuration: where a search begins, what is known, what became of it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from pneud.config.conversions import command_delay_s, valve_of
from pneud.config.flow import L_S_BAR, area_of, conductance_of, gas_of
from pneud.config.models import Config
from pneud.config.sections import GRAVITY_M_S2
from pneud.physics.gas import Gas
from pneud.physics.ratings import DENSITY_ANR_KG_M3, TEMPERATURE_ANR_K, conductance_of_orifice
from pneud.study.identification.fitting import Found, Unknown

AREA, CONDUCTANCE = "valve.orifice_area_m2", "valve.sonic_conductance_l_s_bar"
CRITICAL, EXHAUST = "valve.critical_ratio", "valve.exhaust_ratio"
CRITICAL_OUT = "valve.exhaust_critical_ratio"
PLUS, MINUS = "valve.dead_zone_positive_v", "valve.dead_zone_negative_v"
CENTRE, HALF = "valve.centre_v", "valve.dead_zone_v"
BANDWIDTH, DELAY = "valve.bandwidth_hz", "bus.command_delay_us"
SEEP, SEEP_OUT = "plant.valve.leakage", "plant.valve.leakage_exhaust"
PLAY = "plant.valve.hysteresis_v"
DEAD1, DEAD2 = "cylinder.dead_length_1_m", "cylinder.dead_length_2_m"
EXPONENT, WALL = "plant.polytropic_exponent", "plant.wall_time_s"
MASS, LOAD = "cylinder.moving_mass_kg", "cylinder.load_n"
COULOMB, STATIC = "control.friction.coulomb_n", "control.friction.static_n"
STRIBECK, VISCOUS = "control.friction.stribeck_speed_m_s", "control.friction.viscous_n_s_m"
STIFFNESS = "control.friction.bristle_stiffness_n_m"
DAMPING, FORWARD = "control.friction.bristle_damping_n_s_m", "plant.friction.forward_share"

# What an interval has on either side at least, because steps of the simulation and smoothing count: a share
# of the value, and an amount.
FLOORS: Mapping[str, tuple[float, float]] = {
    AREA: (0.005, 0.0), CONDUCTANCE: (0.005, 0.0), CRITICAL: (0.0, 0.01),
    CRITICAL_OUT: (0.0, 0.01), EXHAUST: (0.005, 0.0),
    PLUS: (0.005, 0.001), MINUS: (0.005, 0.001), CENTRE: (0.0, 0.001), HALF: (0.005, 0.001),
    BANDWIDTH: (0.04, 0.0), DELAY: (0.0, 60.0), SEEP: (0.1, 5e-5), SEEP_OUT: (0.1, 5e-5),
    PLAY: (0.1, 0.001), DEAD1: (0.01, 1e-4), DEAD2: (0.01, 1e-4), EXPONENT: (0.0, 0.003), WALL: (0.05, 0.0),
    MASS: (0.005, 0.0), LOAD: (0.0, 0.1), COULOMB: (0.01, 0.02), STATIC: (0.05, 0.02),
    STRIBECK: (0.1, 0.0), VISCOUS: (0.01, 0.0), STIFFNESS: (0.05, 0.0),
    DAMPING: (0.1, 0.0), FORWARD: (0.0, 0.005),
}  # fmt: skip

# What a log lacks that does not tell a parameter.
LACKING: Mapping[str, str] = {
    AREA: "the valve hardly opens", CONDUCTANCE: "the valve hardly opens",
    CRITICAL: "no flow at several pressure ratios",
    CRITICAL_OUT: "no chamber that is emptied below half of the supply pressure",
    EXHAUST: "the valve hardly opens",
    PLUS: "the command does not pass that edge", MINUS: "the command does not pass that edge",
    CENTRE: "the command does not pass both edges", HALF: "the command does not pass both edges",
    BANDWIDTH: "the command does not change fast", DELAY: "the command does not change fast",
    SEEP: "no rest with the valve shut", SEEP_OUT: "no rest with the valve shut",
    PLAY: "the command does not go to and fro",
    DEAD1: "the load does not come near the rear end, or travels little",
    DEAD2: "the load does not come near the front end, or travels little",
    EXPONENT: "too little motion", WALL: "too little motion",
    MASS: "no acceleration", LOAD: "no motion both ways",
    COULOMB: "no motion", STATIC: "no motion slow enough to stick",
    STRIBECK: "no motion at speeds about it", VISCOUS: "no motion at several speeds",
    STIFFNESS: "no reversals", DAMPING: "no reversals", FORWARD: "no motion both ways at several speeds",
}  # fmt: skip


BY_WAY, MOST_BY_WAY = 0.15, 0.5  # share by which friction differs by direction, as a rule and at most
PINNED = 1e-6  # as good as known
OF_NO_USE = 0.5  # of a value: it is not told where it is less sure than that
ALWAYS = (CONDUCTANCE, AREA, BANDWIDTH, MASS)  # there is some; not told where it could be nothing as well


class Structure(NamedTuple):
    """What valve and chambers are like, apart from numbers."""

    iso: bool  # the flow is that of ISO 6358, not an orifice's
    heat: bool  # air takes the wall's temperature, rather than being compressed with an exponent
    apart: bool = False  # the edges to the atmosphere have a critical ratio of their own


class Estimate(NamedTuple):
    """A parameter with its interval of 95 %."""

    value: float
    low: float
    high: float
    configured: float | None
    told: bool  # the logs tell it; otherwise this is what was known before

    @property
    def agrees(self) -> bool:
        """The configured value lies within the interval."""
        return self.configured is not None and self.low <= self.configured <= self.high


def flow_of_area(area_m2: float, g: Gas) -> float:
    """Flow of a fully open edge [m³/s]: R T C ρ, choked, for each Pa upstream."""
    return flow_of_conductance(conductance_of_orifice(area_m2, g) / L_S_BAR, g)


def flow_of_conductance(c_l_s_bar: float, g: Gas) -> float:
    """The same for a sonic conductance [l/(s bar)]."""
    return c_l_s_bar * L_S_BAR * DENSITY_ANR_KG_M3 * g.R * math.sqrt(TEMPERATURE_ANR_K * g.temperature_k)


def chamber_unknowns(
    c: Config, delay_s: float, first: Mapping[str, float], structure: Structure
) -> list[Unknown]:
    """Those of valve and chambers, by the names of `chambers.Guess`; `first` has better guesses."""
    g, k, v = gas_of(c), c.cylinder, c.valve
    flow = flow_of_area(area_of(c), g)
    plus, minus = configured_edges_v(c)
    band = v.bandwidth_hz or 100.0
    h = 1.0 / c.loop.rate_hz
    reach = 0.5 * v.u_max_v
    least, most_m = 0.002 * k.stroke_m, 0.3 * k.stroke_m
    exponent = min(g.k, 1.3)
    exhaust = v.exhaust_ratio
    found = [
        Unknown("flow", flow, flow, flow, 0.02 * flow, 20.0 * flow),
        Unknown("plus_v", plus, plus, 0.3, -reach, reach),
        Unknown("minus_v", minus, minus, 0.3, -reach, reach),
        Unknown("bandwidth_hz", band, band, band, 5.0, 2000.0),
        Unknown("delay_s", delay_s, delay_s, 2e-4, 0.0, h),
        *(
            Unknown(name, dead, dead, dead + 0.01 * k.stroke_m, least, dead + most_m)
            for name, dead in (("dead1_m", k.dead_length_1_m), ("dead2_m", k.dead_length_2_m))
        ),
        Unknown("seep", 0.0, 0.0, 3e-3, 0.0, 0.05),
        Unknown("seep_out", 0.0, 0.0, 3e-3, 0.0, 0.05),
        Unknown("play_v", 0.0, 0.0, 0.02, 0.0, 0.5),
        Unknown("exhaust", exhaust, exhaust, 0.1, 0.2, 5.0),
    ]
    if structure.heat:
        found.append(Unknown("wall_1_s", 3.0, 3.0, 5.0, 0.1, 30.0))
    else:
        found.append(Unknown("exponent", exponent, exponent, 0.1, 1.0, 1.6))
    if structure.iso:
        found.append(Unknown("critical", 0.35, 0.35, 0.15, 0.0, 0.6))
    if structure.apart:
        ratio = first["critical"]
        found.append(Unknown("critical_out", ratio, ratio, 0.15, 0.0, 0.6))
    return [u._replace(start=first.get(u.key, u.start)) for u in found]


def configured_edges_v(c: Config) -> tuple[float, float]:
    """Commands at which the configured valve begins to open either way [V]."""
    v = valve_of(c)
    return v.centre_v + v.dead_zone_v, v.centre_v - v.dead_zone_v


def slide_unknowns(c: Config, first: tuple[float, float, float, float]) -> list[Unknown]:
    """Those of the moving load, in the order of `forces.Slide`; `first` is from `forces.at_once`.

    Friction is the same both ways, until `by_way` lets it differ.
    """
    mass, load, coulomb, viscous = first
    k, f = c.cylinder, c.control.friction
    known = k.moving_mass_kg
    usual = max(f.coulomb_n, 0.01 * c.gas.supply_pa * k.piston_area_1_m2)
    stiff = f.bristle_stiffness_n_m or 1e5
    speed = f.stribeck_speed_m_s
    static = f.static_n / f.coulomb_n - 1.0 if f.coulomb_n else 0.3
    damped = f.bristle_damping_n_s_m or math.sqrt(stiff * known)
    steady = max(f.viscous_n_s_m, usual)
    return [
        Unknown("mass", max(mass, 0.05 * known), known, known, 0.02 * known, 50.0 * known),
        Unknown("load", load, k.resistance_n, 5.0 * usual + 0.2 * k.resistance_n, -1e5, 1e5),
        Unknown("coulomb", max(coulomb, 0.02 * usual), usual, usual, 1e-3 * usual, 1e3 * usual),
        Unknown("static", static, static, 0.5, 0.0, 2.0),
        Unknown("stribeck", speed, speed, speed, 0.25 * speed, 5.0 * speed),
        Unknown("viscous", max(viscous, 0.0), f.viscous_n_s_m, steady, 0.0, 1e3 * steady),
        Unknown("stiffness", stiff, stiff, 3.0 * stiff, 0.01 * stiff, 100.0 * stiff),
        Unknown("damping", damped, damped, damped, 0.0, 30.0 * damped),
        Unknown("forward", 0.0, 0.0, BY_WAY, -PINNED, PINNED),
    ]


def by_way(unknowns: Sequence[Unknown]) -> list[Unknown]:
    """The same with friction that may differ by direction."""
    return [u._replace(low=-MOST_BY_WAY, high=MOST_BY_WAY) if u.key == "forward" else u for u in unknowns]


def weight_share(c: Config) -> float:
    """Weight against the way out for each kilogram [N/kg]."""
    return GRAVITY_M_S2 * math.sin(math.radians(c.cylinder.inclination_deg))


def configured(c: Config) -> dict[str, float]:
    """What the configuration says."""
    plus, minus = configured_edges_v(c)
    v, k, f = c.valve, c.cylinder, c.control.friction
    return {
        AREA: area_of(c), CONDUCTANCE: conductance_of(c) / L_S_BAR,
        PLUS: plus, MINUS: -minus, CENTRE: 0.5 * (plus + minus), HALF: 0.5 * (plus - minus),
        EXHAUST: v.exhaust_ratio, **_ratios(c),
        BANDWIDTH: v.bandwidth_hz, DELAY: 1e6 * command_delay_s(c.bus), SEEP: 0.0, SEEP_OUT: 0.0,
        PLAY: 0.0,
        DEAD1: k.dead_length_1_m, DEAD2: k.dead_length_2_m,
        EXPONENT: c.plant.polytropic_exponent or c.gas.heat_capacity_ratio,
        MASS: k.moving_mass_kg, LOAD: k.load_n,
        COULOMB: f.coulomb_n, STATIC: f.static_n, STRIBECK: f.stribeck_speed_m_s,
        VISCOUS: f.viscous_n_s_m, STIFFNESS: f.bristle_stiffness_n_m,
        DAMPING: f.bristle_damping_n_s_m, FORWARD: 0.0,
    }  # fmt: skip


def _ratios(c: Config) -> dict[str, float]:
    v = c.valve
    if v.flow == "orifice":
        return {}
    return {CRITICAL: v.critical_ratio, CRITICAL_OUT: v.exhaust_critical_ratio or v.critical_ratio}


def estimate(key: str, found: Found, config: Mapping[str, float], more: float = 0.0) -> Estimate:
    """A parameter as it is told, no surer than simulation and smoothing allow.

    Args:
        key: of the configuration.
        found: from the fit.
        config: what is configured.
        more: what it is less sure by, for other reasons.
    """
    share, amount = FLOORS[key]
    half = math.hypot(0.5 * (found.high - found.low), share * abs(found.value) + amount + more)
    low = found.value - half
    if found.value >= 0.0 and key not in (PLUS, MINUS, CENTRE, LOAD, FORWARD):
        low = max(low, 0.0)
    told = found.told and more <= OF_NO_USE * abs(found.value)  # nothing is a value, too
    told = told and (low > 0.0 or key not in ALWAYS)
    return Estimate(found.value, low, found.value + half, config.get(key), told)
