"""What flows through a valve, by any one rating of its data sheet."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from pneud.physics import ratings
from pneud.physics.gas import Gas, gas, iso6358

if TYPE_CHECKING:
    from pneud.config.models import Config

L_MIN, L_S_BAR = 1e-3 / 60.0, 1e-8
RATINGS = ("orifice_area_m2", "nominal_flow_l_min", "sonic_conductance_l_s_bar", "kv_m3_h", "cv")


class Rated(Protocol):
    """A table with ratings, of which some may be given."""

    orifice_area_m2: float | None
    nominal_flow_l_min: float | None
    sonic_conductance_l_s_bar: float | None
    kv_m3_h: float | None
    cv: float | None


def given(v: Rated) -> list[str]:
    """The ratings that a table has."""
    return [key for key in RATINGS if getattr(v, key) is not None]


def medium_of(c: Config) -> Gas:
    """The gas, flowing as through an orifice."""
    g = c.gas
    return gas(
        k=g.heat_capacity_ratio,
        R=g.gas_constant_j_kg_k,
        temperature_k=g.temperature_k,
        atmosphere_pa=g.atmosphere_pa,
        supply_pa=g.supply_pa,
    )


def gas_of(c: Config) -> Gas:
    """The gas, flowing as the valve has it."""
    v, g = c.valve, medium_of(c)
    return g if v.flow == "orifice" else iso6358(g, v.critical_ratio, v.exponent)


def vent_of(c: Config) -> Gas:
    """The same, as the edges to the atmosphere have it."""
    v, g = c.valve, gas_of(c)
    if v.flow == "orifice" or v.exhaust_critical_ratio is None:
        return g
    return iso6358(g, v.exhaust_critical_ratio, v.exponent)


def area_of(c: Config) -> float:
    """Area [m²] of an orifice that flows as much as the valve, open to the end, where both are choked."""
    v, b, m = c.valve, c.valve.critical_ratio, c.valve.exponent
    if v.orifice_area_m2 is not None:
        return v.orifice_area_m2
    if v.sonic_conductance_l_s_bar is not None:
        return ratings.orifice_of(v.sonic_conductance_l_s_bar * L_S_BAR, medium_of(c))
    if v.nominal_flow_l_min is not None:
        flow = v.nominal_flow_l_min * L_MIN
    else:
        flow = ratings.flow_of_kv(v.kv_m3_h if v.kv_m3_h is not None else ratings.KV_OF_CV * (v.cv or 0.0))
    return ratings.orifice_of(ratings.conductance_of_flow(flow, b, m), medium_of(c))


def conductance_of(c: Config) -> float:
    """Sonic conductance [m³/(s Pa)] of the edges from the supply."""
    return ratings.conductance_of_orifice(area_of(c), medium_of(c))
