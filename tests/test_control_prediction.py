"""Prediction to the command's effect, and friction along the reference, against fine integration."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pneud.control.feedforward import (
    Creep,
    bristles_after,
    bristles_under,
    friction_ahead,
    friction_creeping,
    held_by_bristles,
)
from pneud.control.prediction import Motion, Rates, Spool, ahead, follow, later
from pneud.control.reference import Sine, sine
from pneud.physics.friction import Friction, friction_force, relaxation_rate
from pneud.physics.valve import Valve, opening, spool_transition
from pneud.signals import Reference

VALVE = Valve(5.0, 2.0 * math.pi * 100.0, 0.7, 0.1)
FRICTION = Friction(40.0, 55.0, 0.02, 60.0, 1e5, 300.0)
NONE = Friction(0.0, 0.0, 0.02, 0.0, 0.0, 0.0)
M, LEAD = 15.0, 2.8e-3


def fine(m: Motion, s: Spool, command_v: float, time_s: float, r: Rates) -> Motion:
    x, v, force, y, rate = m.x, m.v, m.force_n, s.position_v, s.rate_v_s
    h = time_s / 20000
    for _ in range(20000):
        u = opening(y, VALVE)
        rate += h * (VALVE.omega_rad_s**2 * (command_v - y) - 2.0 * VALVE.zeta * VALVE.omega_rad_s * rate)
        y += h * rate
        force += h * (r.f0 * v + (r.f1_fill if u >= 0.0 else r.f1_exhaust) * u + r.rest)
        v += h * force / M
        x += h * v
    return Motion(x, v, force)


@pytest.mark.parametrize(
    ("spool", "command_v"),
    [((0.2, 0.0), 0.25), ((0.3, -100.0), -0.4), ((-0.15, 20.0), 0.0), ((2.0, 0.0), -5.0)],
)
def test_prediction_agrees_with_fine_integration(spool: tuple[float, float], command_v: float) -> None:
    now, rates = Motion(0.4, 0.15, 7.0), Rates(-1900.0, 2800.0, 2600.0, 40.0)
    over_half = spool_transition(0.5 * LEAD, VALVE)
    p = ahead(now, Spool(*spool), command_v, 0.5 * LEAD, over_half, M, rates, VALVE)
    true = fine(now, Spool(*spool), command_v, LEAD, rates)
    # two straight lines stand for the spool's way: some per cent of the force its whole way is worth
    error = 0.05 * LEAD * 2800.0 * (abs(spool[0] - command_v) + 0.1)
    assert p.force_n == pytest.approx(true.force_n, abs=error)
    assert p.v == pytest.approx(true.v, abs=error * LEAD / M)
    assert p.x == pytest.approx(true.x, abs=error * LEAD**2 / M)


def test_a_settled_spool_stays() -> None:
    assert follow(Spool(0.7, 0.0), 0.7, spool_transition(1e-3, VALVE)) == (0.7, 0.0)


def test_a_command_not_yet_through_the_spool_is_reckoned_with() -> None:
    # the spool delays by 2ζ/ω: what it still lets through is the old opening for that long
    rates = Rates(0.0, 2800.0, 2800.0, 0.0)
    no_zone = VALVE._replace(dead_zone_v=0.0)
    T = 2.0 * VALVE.zeta / VALVE.omega_rad_s
    end = ahead(
        Motion(0.0, 0.0, 0.0),
        Spool(1.0, 0.0),
        0.0,
        0.5 * T,
        spool_transition(0.5 * T, no_zone),
        M,
        rates,
        no_zone,
    )
    assert end.force_n == pytest.approx(2800.0 * T, rel=0.25)


@given(st.floats(0.0, 20.0), st.floats(0.0, 5e-3))
def test_later_reference_is_that_of_the_sine(t: float, lead: float) -> None:
    p = Sine(0.4868, 0.05, math.pi)
    there, then = later(sine(t, p), lead), sine(t + lead, p)
    snap = p.amplitude_m * p.omega_rad_s**4
    # beside that, the angles of both, up to 63 rad, are rounded by 1.3e-14 together
    assert there.position_m == pytest.approx(then.position_m, abs=snap * lead**4 / 20.0 + 1e-15)
    assert there.velocity_m_s == pytest.approx(then.velocity_m_s, abs=snap * lead**3 / 5.0 + 3e-15)
    assert there.acceleration_m_s2 == pytest.approx(then.acceleration_m_s2, abs=snap * lead**2 / 1.9 + 1e-14)
    assert there.jerk_m_s3 == pytest.approx(then.jerk_m_s3, abs=snap * lead * 1.1 + 1e-13)


@pytest.mark.parametrize("v", [0.0, 1e-7, 1e-3, -0.02, 0.3])
def test_bristles_follow_their_equation(v: float) -> None:
    z = true = 1e-4
    for _ in range(20000):
        true += 1e-7 * (v - relaxation_rate(v, FRICTION) * true)
    assert bristles_after(z, v, relaxation_rate(v, FRICTION), 2e-3) == pytest.approx(true, rel=1e-3, abs=1e-9)


def test_bristles_in_long_sliding_carry_the_stribeck_force() -> None:
    z = bristles_after(0.0, 1.0, relaxation_rate(1.0, FRICTION), 10.0)
    assert z * FRICTION.sigma0_n_m == pytest.approx(FRICTION.coulomb_n)


def test_without_friction_there_is_none() -> None:
    r = Reference(0.1, 0.2, 0.3, 0.4)
    assert friction_ahead(0.0, r, later(r, LEAD), 1e-3, LEAD, NONE) == (0.0,) * 5
    assert bristles_after(1e-4, 0.1, relaxation_rate(0.1, NONE), 1e-3) == 0.0
    assert bristles_under(30.0, NONE) == held_by_bristles(30.0, NONE) == 0.0


def test_where_a_load_creeps_its_own_speed_counts_and_fades_with_speed_and_acceleration() -> None:
    creep = Creep(1.0, 0.06, 0.2)

    def of(v: float, speed: float, acceleration: float, p: Creep) -> tuple[float, ...]:
        now = Reference(0.1, speed, acceleration, 0.0)
        return friction_creeping(1e-4, now, later(now, LEAD), v, 1e-3, LEAD, FRICTION, p)

    def alone(speed: float, acceleration: float) -> tuple[float, ...]:
        now = Reference(0.1, speed, acceleration, 0.0)
        return friction_ahead(1e-4, now, later(now, LEAD), 1e-3, LEAD, FRICTION)

    assert of(0.05, 0.02, 0.0, Creep()) == alone(0.02, 0.0)
    assert of(0.02, 0.02, 0.0, creep) == alone(0.02, 0.0)
    share = 1.0 / (1.0 + (0.02 / 0.06) ** 4)
    assert of(0.03, 0.02, 0.0, creep) == pytest.approx(alone(0.02 + share * 0.01, 0.0))
    assert of(0.06, 0.06, 0.0, creep) == alone(0.06, 0.0)
    assert of(0.07, 0.06, 0.0, creep)[4] == pytest.approx(alone(0.065, 0.0)[4])
    assert of(0.03, 0.02, 0.2, creep)[4] == pytest.approx(alone(0.02 + 0.5 * share * 0.01, 0.2)[4])


def test_bristles_under_a_force_hold_it_up_to_coulomb() -> None:
    assert bristles_under(30.0, FRICTION) * FRICTION.sigma0_n_m == pytest.approx(30.0)
    assert bristles_under(-90.0, FRICTION) * FRICTION.sigma0_n_m == pytest.approx(-40.0)


def test_steps_of_the_friction_add_up_and_lead_the_way() -> None:
    """Along a reversal: the sum of the steps is the friction; what lies ahead comes, at the rate foretold."""
    h, p = 1e-3, Sine(0.0, 0.05, math.pi)
    z, total, forecasts, actual = 0.0, 0.0, [], []
    for i in range(1500):
        now = sine(i * h, p)
        f = friction_ahead(z, now, later(now, 3.0 * h), h, 3.0 * h, FRICTION)
        start = friction_force(now.velocity_m_s, z, FRICTION)
        if i == 0:
            total = start
        actual.append(start)
        forecasts.append((start + f.ahead_n, f.rate_n_s))
        total += f.step_n
        z = f.bristles_m
    end = sine(1500 * h, p)
    assert total == pytest.approx(friction_force(end.velocity_m_s, z, FRICTION), abs=1e-3)
    # before, at and after the reversal at 0.5 s
    for i in range(300, 1200):
        force, rate = forecasts[i]
        assert force == pytest.approx(actual[i + 3], abs=0.8)
        assert rate == pytest.approx((actual[i + 4] - actual[i + 2]) / (2.0 * h), abs=400.0)
    assert min(actual[300:]) < -40.0
