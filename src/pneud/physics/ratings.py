"""A valve as data sheets rate it: ISO 6358, nominal flow, Kv and Cv; and the orifice that flows as much.

Volumes are those of the reference atmosphere (ANR, ISO 8778): 100 kPa, 293.15 K, 65 % humidity.
"""

from __future__ import annotations

import math

from pneud.physics.gas import Gas, flow_factor, subsonic_share

DENSITY_ANR_KG_M3 = 1.185
TEMPERATURE_ANR_K = 293.15
DENSITY_NORMAL_KG_M3 = 1.293  # of dry air at 273.15 K and 1.01325 bar, to which Kv refers
NOMINAL_UPSTREAM_PA, NOMINAL_DOWNSTREAM_PA = 7e5, 6e5  # 6 → 5 bar above the atmosphere, absolute
TYPICAL_CRITICAL_RATIO = 0.3  # of spool valves whose sheet has none
KV_OF_CV = 0.865  # m³/h at 1 bar for each US gallon a minute at 1 psi


def volume_flow(
    C: float, b: float, upstream_pa: float, downstream_pa: float, temperature_k: float, m: float = 0.5
) -> float:
    """Volume flow [m³/s ANR] by ISO 6358.

    Args:
        C: sonic conductance [m³/(s Pa) ANR]; 1 dm³/(s bar) is 1e-8.
        b: critical pressure ratio.
        upstream_pa: absolute.
        downstream_pa: absolute.
        temperature_k: of the air upstream.
        m: subsonic index.
    """
    share = subsonic_share(downstream_pa / upstream_pa, b, m)
    return C * upstream_pa * math.sqrt(TEMPERATURE_ANR_K / temperature_k) * share


def nominal_flow(C: float, b: float, m: float = 0.5) -> float:
    """Nominal flow qnN [m³/s ANR]: 6 → 5 bar above the atmosphere at 293.15 K (VDI 3290)."""
    return volume_flow(C, b, NOMINAL_UPSTREAM_PA, NOMINAL_DOWNSTREAM_PA, TEMPERATURE_ANR_K, m)


def conductance_of_flow(nominal_m3_s: float, b: float = TYPICAL_CRITICAL_RATIO, m: float = 0.5) -> float:
    """Sonic conductance [m³/(s Pa)] of a nominal flow [m³/s ANR] at a critical ratio."""
    return nominal_m3_s / nominal_flow(1.0, b, m)


def flow_of_kv(kv_m3_h: float) -> float:
    """Nominal flow [m³/s ANR] of a Kv [m³/h of water at 1 bar].

    QN = 514 Kv √(Δp p2/(ρN T1)) m³/h at 0 °C and 1.01325 bar, with bar, kg/m³ and K (VDI/VDE 2173): 1078
    l/min for each Kv; as volume ANR the same mass is more.
    """
    drop_bar = (NOMINAL_UPSTREAM_PA - NOMINAL_DOWNSTREAM_PA) / 1e5
    root = math.sqrt(drop_bar * NOMINAL_DOWNSTREAM_PA / 1e5 / (DENSITY_NORMAL_KG_M3 * TEMPERATURE_ANR_K))
    return 514.0 * kv_m3_h * root / 3600.0 * DENSITY_NORMAL_KG_M3 / DENSITY_ANR_KG_M3


def orifice_of(C: float, g: Gas) -> float:
    """Area [m²] of the model's orifice that lets through as much as a sonic conductance, both choked.

    Below its own critical ratio, of 0.53, the orifice is choked where a real valve of a smaller one no longer
    is: at 6 → 5 bar it flows more than the sheet says.
    """
    root = math.sqrt(g.R * TEMPERATURE_ANR_K / g.k)
    return C * DENSITY_ANR_KG_M3 * root / g.gamma_choked


def conductance_of_orifice(area_m2: float, g: Gas) -> float:
    """The reverse of `orifice_of` [m³/(s Pa)]."""
    return area_m2 / orifice_of(1.0, g)


def nominal_flow_of(C: float, g: Gas) -> float:
    """Nominal flow [m³/s ANR] that a model with this sonic conductance has, whichever its flow factor is."""
    share = flow_factor(NOMINAL_DOWNSTREAM_PA / NOMINAL_UPSTREAM_PA, g) / g.gamma_choked
    return C * NOMINAL_UPSTREAM_PA * share
