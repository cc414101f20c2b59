"""Ratings of valves against the standards' formulas and figures that are printed in sheets."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pneud.config.flow import gas_of
from pneud.config.reading import load_config
from pneud.physics import ratings as r
from pneud.physics.gas import iso6358, signed_flow, subsonic_share

AIR = gas_of(load_config("virtual.toml"))
L_S_BAR, L_MIN = 1e-8, 1e-3 / 60.0


@pytest.mark.parametrize("b", [0.15, 0.3, 0.45])
@pytest.mark.parametrize(("p1_mpa", "p2_mpa"), [(0.6, 0.5), (0.6, 0.1), (0.4, 0.39)])
def test_flow_is_that_of_the_formula_in_catalogues(b: float, p1_mpa: float, p2_mpa: float) -> None:
    """Q = 600 C (P1 + 0.1) √(1 − ((ratio − b)/(1 − b))²) √(293/(273 + t)) l/min ANR, P in MPa above 0.1."""
    C, t = 1.7, 35.0
    ratio = (p2_mpa + 0.1) / (p1_mpa + 0.1)
    root = math.sqrt(1.0 - ((ratio - b) / (1.0 - b)) ** 2) if ratio > b else 1.0
    catalogue = 600.0 * C * (p1_mpa + 0.1) * root * math.sqrt(293.0 / (273.0 + t))
    found = r.volume_flow(C * L_S_BAR, b, (p1_mpa + 0.1) * 1e6, (p2_mpa + 0.1) * 1e6, 273.15 + t)
    assert found / L_MIN == pytest.approx(catalogue, rel=1e-3)


def test_the_standard_says_what_flows_when_choked() -> None:
    """qm = C ρ0 p1 √(T0/T1), ISO 6358-1 (2)."""
    C, p1 = 2.0 * L_S_BAR, 5e5
    mass = r.DENSITY_ANR_KG_M3 * r.volume_flow(C, 0.3, p1, 1e5, 320.0)
    assert mass == pytest.approx(C * 1.185 * p1 * math.sqrt(293.15 / 320.0))


@given(st.floats(1.0, 5000.0), st.floats(0.1, 0.52))
def test_conductance_and_nominal_flow_are_each_others_reverse(l_min: float, b: float) -> None:
    C = r.conductance_of_flow(l_min * L_MIN, b)
    assert r.nominal_flow(C, b) / L_MIN == pytest.approx(l_min)


@given(st.floats(0.0, 1.2), st.floats(0.05, 0.6))
def test_the_share_falls_from_one_to_nothing(ratio: float, b: float) -> None:
    assert 0.0 <= subsonic_share(ratio, b) <= 1.0
    assert subsonic_share(ratio, b) >= subsonic_share(ratio + 0.01, b)
    assert subsonic_share(b, b) == 1.0
    assert subsonic_share(1.0, b) == 0.0


def test_a_kv_of_one_is_1078_normal_litres_a_minute() -> None:
    normal = r.flow_of_kv(1.0) * r.DENSITY_ANR_KG_M3 / r.DENSITY_NORMAL_KG_M3
    assert normal / L_MIN == pytest.approx(1078.0, rel=1e-3)


def test_a_cv_is_about_what_makers_print() -> None:
    """984 l/min for a Cv of 1 (VDI 3290), and an effective area of 18 mm² (JIS B 8390): all within 7 %."""
    flow = r.flow_of_kv(r.KV_OF_CV)
    assert flow / L_MIN == pytest.approx(984.0, rel=0.07)
    assert 5.02 * r.conductance_of_flow(flow) / L_S_BAR == pytest.approx(18.0, rel=0.13)


def test_an_effective_area_is_five_times_the_conductance() -> None:
    """S [mm²] = 5.02 C [dm³/(s bar)] in catalogues: for a C of 1, an orifice of 5.02 mm²."""
    assert 1e6 * r.orifice_of(L_S_BAR, AIR) == pytest.approx(5.02, rel=2e-3)


@given(st.floats(1e-7, 1e-3), st.floats(2e5, 1e6))
def test_the_orifice_flows_as_much_when_choked(area_m2: float, p1_pa: float) -> None:
    C = r.conductance_of_orifice(area_m2, AIR)
    assert r.orifice_of(C, AIR) == pytest.approx(area_m2)
    model = area_m2 * math.sqrt(AIR.k / (AIR.R * 293.15)) * signed_flow(p1_pa, 0.1 * p1_pa, AIR)
    rated = r.DENSITY_ANR_KG_M3 * r.volume_flow(C, 0.3, p1_pa, 0.1 * p1_pa, 293.15)
    assert model == pytest.approx(rated)


@given(
    st.floats(0.1, 20.0),
    st.floats(0.15, 0.5),
    st.floats(0.4, 0.6),
    st.floats(2e5, 1e6),
    st.floats(0.05, 0.99),
)
def test_the_model_by_iso_6358_flows_as_the_standard_says(
    l_s_bar: float, b: float, m: float, p1_pa: float, ratio: float
) -> None:
    C, g = l_s_bar * L_S_BAR, iso6358(AIR, b, m)
    model = r.orifice_of(C, AIR) * math.sqrt(g.k / (g.R * 310.0)) * signed_flow(p1_pa, ratio * p1_pa, g)
    rated = r.DENSITY_ANR_KG_M3 * r.volume_flow(C, b, p1_pa, ratio * p1_pa, 310.0, m)
    assert model == pytest.approx(rated)
    assert r.nominal_flow_of(C, g) == pytest.approx(r.nominal_flow(C, b, m))


def test_an_orifice_flows_more_at_the_nominal_pressures() -> None:
    C = r.conductance_of_flow(350.0 * L_MIN)
    assert r.nominal_flow_of(C, AIR) / L_MIN == pytest.approx(1.21 * 350.0, rel=0.02)
