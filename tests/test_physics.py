"""Laws of the gas, the orifice, the cylinder, the valve and friction."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from pneud.config.conversions import cylinder_of
from pneud.config.flow import gas_of
from pneud.config.reading import load_config
from pneud.physics.cylinder import F0, F1_FLOOR, F1_exhaust, F1_fill
from pneud.physics.friction import Friction, friction_force, relaxation_rate, slide, stribeck
from pneud.physics.gas import LINEAR_FROM, Gas, flow_factor, iso6358, signed_flow, subsonic_factor
from pneud.physics.series import NEAR, SHORT, decay, power, raised
from pneud.physics.valve import Valve, dead_zone_inverse, opening, spool_transition
from pneud.rig.chamber import exchange, inflow

CONFIG = load_config("virtual.toml")
GAS = gas_of(CONFIG)
CYLINDER = cylinder_of(CONFIG)
SEALS = Friction(40.0, 55.0, 0.02, 60.0, 1e5, 300.0)
pressures = st.floats(2e4, 1.2e6)
ratios = st.floats(0.01, 1.0)
gases = st.just(GAS) | st.builds(iso6358, st.just(GAS), st.floats(0.1, 0.55), st.floats(0.4, 0.6))


def test_the_flow_factor_is_choked_at_low_ratios_and_nothing_at_one() -> None:
    assert GAS.critical_ratio == pytest.approx(0.52828, abs=1e-5)
    assert flow_factor(0.0, GAS) == flow_factor(GAS.critical_ratio, GAS) == pytest.approx(0.57870, abs=1e-5)
    assert flow_factor(1.0, GAS) == 0.0
    assert flow_factor(0.8, GAS) == pytest.approx(
        math.sqrt(5.0) * 0.8 ** (2.4 / 2.8) * math.sqrt(0.8 ** (-0.4 / 1.4) - 1.0)
    )


@given(ratios, ratios, gases)
def test_the_flow_factor_never_grows_with_the_ratio(a: float, b: float, g: Gas) -> None:
    low, high = sorted((a, b))
    assert flow_factor(low, g) >= flow_factor(high, g) - 1e-12


@given(gases)
def test_the_flow_factor_has_no_steps(g: Gas) -> None:
    for r in (g.critical_ratio, LINEAR_FROM, 1.0):
        assert flow_factor(r - 1e-12, g) == pytest.approx(flow_factor(r, g), abs=1e-6)


@given(pressures, pressures, gases)
def test_flow_reverses_with_the_pressures(a: float, b: float, g: Gas) -> None:
    assert signed_flow(a, b, g) == -signed_flow(b, a, g)
    assert (signed_flow(a, b, g) > 0) == (a > b)


@given(pressures, pressures, gases)
def test_flow_into_a_chamber_is_the_signed_flow_with_its_derivative(
    chamber: float, other: float, g: Gas
) -> None:
    flow, slope = inflow(chamber, other, g)
    assert flow == pytest.approx(signed_flow(other, chamber, g), rel=1e-9, abs=1e-6)
    assert slope <= 1e-9
    e = 0.01
    r = min(chamber, other) / max(chamber, other)
    if all(abs(r - kink) > 1e-6 for kink in (g.critical_ratio, LINEAR_FROM, 1.0)):
        high, low = inflow(chamber + e, other, g)[0], inflow(chamber - e, other, g)[0]
        assert slope == pytest.approx((high - low) / (2 * e), rel=1e-3, abs=1e-5)


@given(pressures, pressures, st.floats(0.0, 1e6), st.floats(1e-6, 1e-4), gases)
def test_flow_brings_a_chamber_towards_the_other_side_and_never_across(
    chamber: float, other: float, rate: float, h: float, g: Gas
) -> None:
    after = exchange(chamber, other, rate, 0.0, h, g)
    assert min(chamber, other) <= after <= max(chamber, other)


@given(st.floats(0.02, 1.0), pressures, pressures)
def test_the_cylinder_stiffens_and_keeps_authority(x1: float, p1: float, p2: float) -> None:
    assert F0(x1, p1, p2, CYLINDER, GAS) < 0
    floor = F1_FLOOR * CYLINDER.F1_nominal
    assert F1_fill(x1, p1, p2, 6e5, CYLINDER, GAS) >= floor
    assert F1_exhaust(x1, p1, p2, 6e5, CYLINDER, GAS) >= floor


def test_stribeck_falls_from_static_to_coulomb() -> None:
    assert stribeck(0.0, SEALS) == 55.0
    assert stribeck(1.0, SEALS) == pytest.approx(40.0)
    assert stribeck(-0.01, SEALS) == stribeck(0.01, SEALS)


def test_sliding_settles_at_the_steady_friction() -> None:
    for v in (0.005, -0.05, 1.0):
        rate = relaxation_rate(v, SEALS)
        assert friction_force(v, v / rate, SEALS) == pytest.approx(
            math.copysign(stribeck(v, SEALS), v) + 60.0 * v
        )


@given(st.floats(0.0, 3.0))
def test_a_decay_is_that_of_libm_to_the_last_digits(x: float) -> None:
    mean, away = decay(x)
    if x < 1e-3:
        assert mean == pytest.approx(1.0 - x / 2 + x * x / 6, rel=1e-10)
        assert away == pytest.approx(0.5 - x / 6, rel=1e-6)
    else:
        assert mean == pytest.approx(-math.expm1(-x) / x, rel=4e-16)
        assert away == pytest.approx((1.0 - mean) / x, rel=1e-12)


def test_a_series_is_as_good_at_its_end_as_what_follows() -> None:
    below, above = math.nextafter(SHORT, 0.0), SHORT
    assert decay(below) == pytest.approx(decay(above), rel=1e-15)
    for n in (1.0, 1.2, 1.4):
        for d in (NEAR, -NEAR):
            assert raised(math.nextafter(d, 0.0), power(n)) == pytest.approx(math.pow(1.0 + d, n), rel=4e-16)


@given(st.floats(-0.1, 0.1), st.floats(1.0, 1.67))
def test_a_power_is_that_of_libm_to_the_last_digits(d: float, n: float) -> None:
    assert raised(d, power(n)) == pytest.approx(math.pow(1.0 + d, n), rel=6e-16)


def test_slow_and_fast_relaxation_of_the_bristles_meet() -> None:
    guess = SHORT * 40.0 / (1e-4 * 1e5)  # where the series of the decay ends
    below, above = (
        slide(0.01, 2e-4, guess * factor, 500.0, 15.0, 1e-4, SEALS) for factor in (1.0 - 1e-12, 1.0 + 1e-12)
    )
    assert below == pytest.approx(above, rel=1e-9)
    stiff = SEALS._replace(sigma0_n_m=1e9)  # the trapezium rule where nothing slips
    mean, z = slide(0.01, 0.0, 0.0, 0.0, 15.0, 1e-4, stiff)
    assert 15.0 * 2 * (0.01 - mean) / 1e-4 == pytest.approx(1e9 * z / 2 + 300.0 * z / 1e-4 + 60.0 * mean)


def test_a_load_below_static_friction_is_held() -> None:
    v = z = a = 0.0
    for i in range(60_000):
        force = min(50.0, i * 0.005)  # a sudden load would break away by its swing
        mean, z = slide(v, z, v + 5e-5 * a, force, 15.0, 1e-4, SEALS)
        a, v = (2 * mean - 2 * v) / 1e-4, 2 * mean - v
    assert abs(v) < 1e-8
    assert z == pytest.approx(50.0 / 1e5, rel=1e-3)


@given(st.floats(-5.0, 5.0), st.floats(0, 1e9), st.floats(0, 1e6), st.floats(0.05, 100))
def test_friction_alone_never_speeds_a_load_up_whatever_the_stiffness(
    v: float, sigma0: float, sigma1: float, mass: float
) -> None:
    f = SEALS._replace(sigma0_n_m=sigma0, sigma1_n_s_m=sigma1)
    start, z = abs(v), 0.0
    for _ in range(100):
        mean, z = slide(v, z, v, 0.0, mass, 1e-4, f)
        v = 2 * mean - v
        assert abs(v) <= start * (1.0 + 1e-9)
        assert abs(z) <= 1e-4 * start + (55.0 / sigma0 if sigma0 > 0 else 1e-2 * start)


@given(st.floats(1.0, 1e5), st.floats(0.05, 5.0), st.floats(1e-6, 1e-2))
def test_two_half_transitions_of_the_spool_are_one_whole(omega: float, zeta: float, t: float) -> None:
    valve = Valve(5.0, omega, zeta, 0.0)
    half, whole = spool_transition(t / 2, valve), spool_transition(t, valve)
    ee = half.ee * half.ee + half.er * half.re
    rr = half.re * half.er + half.rr * half.rr
    assert ee == pytest.approx(whole.ee, abs=1e-6)
    assert rr == pytest.approx(whole.rr, abs=1e-6)


@pytest.mark.parametrize("zeta", [0.3, 0.7, 0.9999999, 1.0, 1.0000001, 2.0])
def test_the_spool_follows_its_differential_equation(zeta: float) -> None:
    omega, t = 628.0, 2e-3
    m = spool_transition(t, Valve(5.0, omega, zeta, 0.0))
    truth = solve_ivp(
        lambda _, s: [s[1], -omega * omega * s[0] - 2 * zeta * omega * s[1]],
        (0, t), [-2.0, 100.0], rtol=1e-11, atol=1e-11,
    ).y[:, -1]  # fmt: skip
    assert m.ee * -2.0 + m.er * 100.0 == pytest.approx(truth[0], rel=1e-5)
    assert m.re * -2.0 + m.rr * 100.0 == pytest.approx(truth[1], rel=1e-5)


def test_a_spool_without_lag_is_where_it_is_told() -> None:
    assert spool_transition(1e-6, Valve(5.0, 0.0, 0.7, 0.0)) == (0.0, 0.0, 0.0, 0.0)


@given(st.floats(-7.0, 7.0))
def test_the_opening_is_dead_about_the_centre_and_never_more_than_full(y: float) -> None:
    valve = Valve(5.0, 628.0, 0.7, 0.1)
    u = opening(y, valve)
    assert abs(u) <= 5.0
    assert (u == 0.0) == (abs(y) <= 0.1)
    if 0.1 < abs(y) <= 5.0:
        assert dead_zone_inverse(u, valve, 0.0) == pytest.approx(y)


def test_the_opening_of_a_spool_that_is_nowhere_is_unknown() -> None:
    assert math.isnan(opening(math.nan, Valve(5.0, 628.0, 0.7, 0.1)))


def test_subsonic_factor_meets_the_choked_one() -> None:
    assert subsonic_factor(GAS.critical_ratio, GAS.k) == GAS.gamma_choked


def test_without_reverse_flow_a_chamber_above_supply_takes_nothing_back() -> None:
    one_way = CYLINDER._replace(reverse_flow=False)
    over = 1.2 * GAS.supply_pa
    for f1 in (F1_fill, F1_exhaust):
        usual = f1(0.5, 3e5, 3e5, GAS.supply_pa, CYLINDER, GAS)
        assert f1(0.5, 3e5, 3e5, GAS.supply_pa, one_way, GAS) == usual
    assert F1_fill(0.5, over, 3e5, GAS.supply_pa, one_way, GAS) > F1_fill(
        0.5, over, 3e5, GAS.supply_pa, CYLINDER, GAS
    )
