"""What estimates make of a configuration: which keys they stand for, and the rig as it has been found."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import ValidationError

from pneud.config.flow import RATINGS
from pneud.config.models import Config
from pneud.config.reading import explain
from pneud.config.sections import ConfigError
from pneud.study.identification import parameters as key
from pneud.study.identification.parameters import Estimate
from pneud.study.identification.table import Table

Values = dict[str, Any]
"""By dotted key of the configuration; a table is one whole, None takes a key out."""

DIGITS = 5
SAME = (
    *(key.EXHAUST, key.BANDWIDTH, key.DELAY, key.DEAD1, key.DEAD2, key.MASS, key.LOAD, key.COULOMB),
    *(key.STRIBECK, key.VISCOUS, key.STIFFNESS, key.DAMPING),
)  # keys that the controller has under the same name
STEP, START, MAP = "control.motion.encoder_resolution_m", "control.adaptation.start", "valve.map"
CRITICAL_RATIOS = (0.01, 0.59)  # that a configuration may have
LEVEL_M = 1e-9  # readings closer than that are the same
BRIDGED = 0.02  # of the distances: those beside readings that were missing, and lie anywhere


def encoder_step_m(t: Table) -> float:
    """The usual distance of neighbouring readings of the encoder [m]."""
    levels = np.unique(np.round(np.concatenate([p.position_m for p in t.pieces]) / LEVEL_M))
    apart = np.diff(levels)
    if not len(apart):
        return 0.0
    return LEVEL_M * float(np.median(apart[apart <= 1.5 * np.quantile(apart, BRIDGED)]))


def believed(found: Mapping[str, Estimate], step_m: float, c: Config) -> Values:
    """What the controller is to believe from now on: of all that is told, the values to be written.

    Args:
        found: estimates, those that the logs do not tell among them.
        step_m: of the encoder, 0 where it is not known.
        c: the configuration that they are to be written into.
    """
    told = {name: e.value for name, e in found.items() if e.told}
    values: Values = {name: told[name] for name in SAME if name in told}
    values |= _flow(told) | _edges(told)
    friction = c.control.friction
    coulomb_n = values.get(key.COULOMB, friction.coulomb_n)
    values[key.STATIC] = max(told.get(key.STATIC, friction.static_n), coulomb_n)
    if coulomb_n and not values.get(key.STIFFNESS, friction.bristle_stiffness_n_m):
        values[key.STIFFNESS] = found[key.STIFFNESS].value
    if step_m and c.control.motion.bandwidth_rad_s is not None:
        values[STEP] = step_m
    return {name: _rounded(value) for name, value in values.items()}


def _flow(told: Mapping[str, float]) -> Values:
    if key.CONDUCTANCE in told:
        sized: Values = {"valve.flow": "iso6358", key.CONDUCTANCE: told[key.CONDUCTANCE]}
        if key.CRITICAL in told:
            sized[key.CRITICAL] = _ratio(told[key.CRITICAL])
        sized[key.CRITICAL_OUT] = _ratio(told[key.CRITICAL_OUT]) if key.CRITICAL_OUT in told else None
    elif key.AREA in told:
        sized = {"valve.flow": "orifice", key.AREA: told[key.AREA]}
    else:
        return {}
    return {f"valve.{rating}": None for rating in RATINGS} | sized


def _ratio(found: float) -> float:
    return min(max(found, CRITICAL_RATIOS[0]), CRITICAL_RATIOS[1])


def _edges(told: Mapping[str, float]) -> Values:
    """Both edges, about the centre between them; where adaptation had got to before counts no more."""
    values: Values = {START: None}
    if key.PLUS in told and key.MINUS in told:
        plus, minus = told[key.PLUS], told[key.MINUS]
        values |= {key.CENTRE: 0.5 * (plus - minus), key.HALF: max(0.5 * (plus + minus), 0.0), MAP: None}
    return values


def rig(
    found: Mapping[str, Estimate], step_m: float, noise_pa: float, c: Config, slips: bool = False
) -> Values:
    """The rig as it has been found: `[plant]`, where it differs from what the controller believes.

    Args:
        found: estimates.
        step_m: of the encoder.
        noise_pa: of the pressures, their steps included.
        c: with what the controller believes of it.
        slips: Maxwell elements explain its friction better than bristles.
    """
    v = {name: e.value for name, e in found.items()}
    valve = {
        "bandwidth_hz": c.valve.bandwidth_hz,
        "damping": c.valve.damping,
        "dead_zone_v": c.valve.dead_zone_v,
        "centre_v": c.valve.centre_v,
        "hysteresis_v": v.get(key.PLAY, 0.0),
        "leakage": v.get(key.SEEP, 0.0),
        "leakage_exhaust": v.get(key.SEEP_OUT, 0.0),
        "dac_bits": c.plant.valve.dac_bits,
    }
    friction: Values = {"model": "gms" if slips else "lugre"}
    if key.FORWARD in found:
        friction["forward_share"] = _rounded(v[key.FORWARD])
    exponent = min(max(v.get(key.EXPONENT, 1.0), 1.0), c.gas.heat_capacity_ratio)
    values: Values = {
        "plant.polytropic_exponent": exponent if key.EXPONENT in v else None,
        "plant.wall_time_s": _rounded(max(v.get(key.WALL, 0.0), 0.0)),
        "plant.valve": {name: _rounded(value) for name, value in valve.items()},
        "plant.friction": friction | c.control.friction.model_dump(),
        "plant.sensors": {"encoder_resolution_m": step_m, "pressure_noise_pa": _rounded(noise_pa)},
    }
    return values | {f"plant.{table}": {} for table in ("cylinder", "gas", "supply", "hoses", "wiring")}


def changed(c: Config, values: Values) -> Config:
    """A configuration with values put in, as if they stood in its file.

    Raises:
        ConfigError: what would become of it cannot be used.
    """
    data = c.model_dump(by_alias=True)
    for name, value in values.items():
        *tables, last = name.split(".")
        table = data
        for step in tables:
            table = table[step]
        if value is None:
            table.pop(last, None)
        else:
            table[last] = value
    try:
        return Config.model_validate(data)
    except ValidationError as e:
        raise ConfigError(f"{c.name} as estimated: {explain(e)}") from None


def _rounded(value: Any) -> Any:
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value
