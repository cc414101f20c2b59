"""Rigs as they might really be: a hidden truth about a configuration, drawn from a seed.

A truth differs from what the controller believes in all that a commissioning has to find, and has what the
plain model leaves out. It is laid over a configuration as `pneud.loading.load` takes it for `change`.
"""

from __future__ import annotations

import math
import random
from collections.abc import Mapping
from typing import Any, NamedTuple

from pneud import resources
from pneud.config import library
from pneud.config.flow import L_S_BAR, RATINGS, conductance_of
from pneud.config.models import Config
from pneud.study.draft import Answers, drafted

Tables = dict[str, Any]

EDGE_V, CENTRE_V = 0.4, 0.1  # widest dead zone on a side, farthest centre; for commands up to
FULL_V = 5.0
CRITICAL = (0.2, 0.45)
LEAKAGE, HYSTERESIS = 0.004, 0.006  # largest, of the whole opening and of the greatest command
ENCODER_STEPS_M = (5e-6, 10e-6)
PRESSURE_BITS, PRESSURE_RANGE_PA, PRESSURE_NOISE_PA = 12, 1e6, 100.0
USUAL_COULOMB = 0.05  # of the piston's force, where the controller knows of no friction
USUAL_HZ, USUAL_STIFFNESS_N_M = 100.0, 1e5  # likewise
LOAD = 0.06  # of the piston's force at most, either way


class Truth(NamedTuple):
    """One of the twelve: a configuration of `rig_text`, and a seed."""

    rig: str
    seed: int


RIGS: Mapping[str, Mapping[str, str]] = {
    "small": {"cylinder": "dsnu-16", "valve": "mpye-5-m5", "stroke": "100", "mass": "0.8", "step": "10"},
    "upright": {
        "cylinder": "dsbc-32", "valve": "mpye-5-1-8-lf", "stroke": "300", "mass": "8", "inclination": "90",
    },
    "large": {"cylinder": "dsbc-63", "valve": "mpye-5-1-8-hf", "stroke": "600", "mass": "60", "step": "10"},
}  # fmt: skip
"""Rigs of other sizes than the packaged `virtual`, as somebody answers for them."""

TWELVE = tuple(
    Truth(rig, seed) for rig, first in zip(("virtual", *RIGS), (1, 4, 7, 10), strict=True)
    for seed in range(first, first + 3)
)  # fmt: skip
"""Truths that a commissioning has to find: four cylinders, one of them upright, three truths of each."""


def rig_text(rig: str) -> str:
    """A configuration's text: the packaged one of `virtual`, or what `pneud new` makes for one of `RIGS`."""
    if rig not in RIGS:
        return resources.find(f"{rig}.toml").read_text(encoding="utf-8")
    a = RIGS[rig]
    return drafted(
        Answers(
            name=rig,
            cylinder=library.cylinder(a["cylinder"]),
            valve=library.valve(a["valve"]),
            stroke_mm=float(a["stroke"]),
            mass_kg=float(a["mass"]),
            inclination_deg=float(a.get("inclination", "0")),
            supply_bar=5.0,
            hose_m=0.3,
            encoder_step_um=float(a.get("step", "5")),
            encoder="absolute",
            bus="auto",
        )
    ).text


def drawn(c: Config, seed: int) -> Tables:
    """A healthy truth about a configuration, as tables to lay over it; None takes a key out.

    Args:
        c: what the controller believes.
        seed: the same one draws the same truth about the same configuration.
    """
    chance = random.Random(f"truth {seed}")
    return {
        "plant": {
            **_heat(chance, c),
            "cylinder": _cylinder(chance, c),
            "valve": _valve(chance, c),
            "friction": _friction(chance, c),
            "sensors": _sensors(chance),
        }
    }


def _push_n(c: Config) -> float:
    """What the supply can push with [N]."""
    return (c.gas.supply_pa - c.gas.atmosphere_pa) * c.cylinder.piston_area_1_m2


def _heat(chance: random.Random, c: Config) -> Tables:
    """Air that keeps some of its heat: by an exponent, or by what the wall takes and gives."""
    exponent, wall_s = chance.uniform(1.15, 1.4), _between(chance, 0.1, 1.0)
    if chance.random() < 0.5:
        return {"polytropic_exponent": min(exponent, c.gas.heat_capacity_ratio), "wall_time_s": 0.0}
    return {"polytropic_exponent": None, "wall_time_s": wall_s}


def _cylinder(chance: random.Random, c: Config) -> Tables:
    k = c.cylinder
    return {
        "moving_mass_kg": k.moving_mass_kg * _beside(chance, 0.65, 1.5),
        "load_n": k.load_n + chance.uniform(-LOAD, LOAD) * _push_n(c),
        "dead_length_1_m": k.dead_length_1_m * _beside(chance, 0.75, 1.5),
        "dead_length_2_m": k.dead_length_2_m * _beside(chance, 0.75, 1.5),
    }


def _valve(chance: random.Random, c: Config) -> Tables:
    scale = c.valve.u_max_v / FULL_V
    found: Tables = dict.fromkeys(RATINGS)
    found |= {
        "sonic_conductance_l_s_bar": conductance_of(c) / L_S_BAR * _beside(chance, 0.85, 1.15, 0.03),
        "flow": "iso6358" if chance.random() < 0.75 else "orifice",
        "critical_ratio": chance.uniform(*CRITICAL),
        "bandwidth_hz": (c.valve.bandwidth_hz or USUAL_HZ) * _beside(chance, 0.6, 1.3),
        "damping": c.valve.damping,
        "dead_zone_positive_v": scale * chance.uniform(0.0, EDGE_V),
        "dead_zone_negative_v": scale * chance.uniform(0.0, EDGE_V),
        "centre_v": scale * chance.uniform(-CENTRE_V, CENTRE_V),
        "map": None,
        "hysteresis_v": chance.uniform(0.0, HYSTERESIS) * c.valve.u_max_v,
        "leakage": chance.uniform(0.0, LEAKAGE),
        "dac_bits": 12,
    }
    return found | {"leakage_exhaust": found["leakage"] * _between(chance, 0.7, 1.4)}


def _friction(chance: random.Random, c: Config) -> Tables:
    f = c.control.friction
    coulomb = (f.coulomb_n or USUAL_COULOMB * _push_n(c)) * _beside(chance, 0.6, 1.7)
    stiffness = (f.bristle_stiffness_n_m or USUAL_STIFFNESS_N_M) * _between(chance, 0.7, 5.0)
    mass = c.cylinder.moving_mass_kg
    return {
        "model": chance.choice(("lugre", "gms")),
        "coulomb_n": coulomb,
        "static_n": coulomb * chance.uniform(1.15, 1.6),
        "stribeck_speed_m_s": _between(chance, 0.01, 0.03),
        "viscous_n_s_m": (f.viscous_n_s_m or coulomb) * _beside(chance, 0.6, 1.7),
        "bristle_stiffness_n_m": stiffness,
        "bristle_damping_n_s_m": _between(chance, 0.1, 0.4) * math.sqrt(stiffness * mass),
    }


def _sensors(chance: random.Random) -> Tables:
    return {
        "encoder_resolution_m": chance.choice(ENCODER_STEPS_M),
        "pressure_bits": PRESSURE_BITS,
        "pressure_range_pa": PRESSURE_RANGE_PA,
        "pressure_resolution_pa": 0.0,
        "pressure_noise_pa": PRESSURE_NOISE_PA,
    }


def _between(chance: random.Random, low: float, high: float) -> float:
    """As likely to be twice as much as half as much."""
    return math.exp(chance.uniform(math.log(low), math.log(high)))


def _beside(chance: random.Random, low: float, high: float, apart: float = 0.08) -> float:
    """A factor between two numbers, but none that could pass for 1."""
    while True:
        factor = _between(chance, low, high)
        if abs(factor - 1.0) >= apart:
            return factor
