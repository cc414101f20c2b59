"""Flow of an ideal gas through a valve: an orifice (St Venant and Wantzel), or by ISO 6358.

The orifice is equation (6) of the paper, corrected. Both let through as much where they are choked.
"""

import math
from typing import NamedTuple

LINEAR_FROM = (
    0.999  # pressure ratio above which the flow factor is a straight line to zero (as in ISO 6358 models)
)


class Gas(NamedTuple):
    """An ideal gas and the constants of its flow factor, made by `gas` and `iso6358`."""

    k: float  # ratio of specific heats
    R: float  # gas constant [J/(kg K)]
    temperature_k: float
    atmosphere_pa: float
    supply_pa: float  # nominal
    critical_ratio: float  # downstream/upstream pressure at which the flow chokes
    gamma_choked: float  # flow factor at and below it
    gamma_linear: float  # flow factor at LINEAR_FROM
    exponent: float = 0.0  # m of ISO 6358; 0: an orifice


def gas(k: float, R: float, temperature_k: float, atmosphere_pa: float, supply_pa: float) -> Gas:
    """Constants of a gas; pressures absolute."""
    critical = (2.0 / (k + 1.0)) ** (k / (k - 1.0))
    return Gas(
        k=k,
        R=R,
        temperature_k=temperature_k,
        atmosphere_pa=atmosphere_pa,
        supply_pa=supply_pa,
        critical_ratio=critical,
        gamma_choked=subsonic_factor(critical, k),
        gamma_linear=subsonic_factor(LINEAR_FROM, k),
    )


def iso6358(g: Gas, critical_ratio: float, exponent: float) -> Gas:
    """The gas with the flow factor of ISO 6358, as much of it as through the orifice where both are choked.

    Args:
        g: the gas.
        critical_ratio: b.
        exponent: m, 0.5 for most valves.
    """
    return g._replace(
        critical_ratio=critical_ratio,
        gamma_linear=g.gamma_choked * subsonic_share(LINEAR_FROM, critical_ratio, exponent),
        exponent=exponent,
    )


def subsonic_share(r: float, b: float, m: float = 0.5) -> float:
    """Share of the choked flow at a pressure ratio r by ISO 6358: 1 up to b, 0 from 1 on."""
    if r <= b:
        return 1.0
    x = (r - b) / (1.0 - b)
    return math.pow(1.0 - x * x, m) if x < 1.0 else 0.0


def subsonic_factor(r: float, k: float) -> float:
    """γ(r) of (6) between the critical ratio and 1: √(2/(k−1) · (r^(2/k) − r^((k+1)/k))).

    Args:
        r: downstream over upstream absolute pressure.
        k: ratio of specific heats.
    """
    q = r ** (1.0 / k)
    return math.sqrt(2.0 / (k - 1.0) * q * (q - r))


def flow_factor(r: float, g: Gas) -> float:
    """Flow factor γ for any pressure ratio r ≥ 0: choked, subsonic, or linear close to 1; 0 from 1 on."""
    if r <= g.critical_ratio:
        return g.gamma_choked
    if r < LINEAR_FROM:
        if g.exponent == 0.0:
            return subsonic_factor(r, g.k)
        return g.gamma_choked * subsonic_share(r, g.critical_ratio, g.exponent)
    if r < 1.0:
        return g.gamma_linear * (1.0 - r) / (1.0 - LINEAR_FROM)
    return 0.0


def signed_flow(upstream_pa: float, downstream_pa: float, g: Gas) -> float:
    """γ·P of the side that really is upstream [Pa]; negative when the flow runs backwards.

    The mass flow through an area A is `A √(k/(R T)) · signed_flow`.
    """
    if downstream_pa < upstream_pa:
        return upstream_pa * flow_factor(downstream_pa / upstream_pa, g)
    if upstream_pa < downstream_pa:
        return -downstream_pa * flow_factor(upstream_pa / downstream_pa, g)
    return 0.0
