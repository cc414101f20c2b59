"""The composite law: s starts and stays at zero on the model, nothing winds up, the dead zone is spared."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pneud.control.homogeneous import feedback
from pneud.control.laws.situation import LawOutput
from pneud.control.laws.sliding import Sliding, SlidingState, engage, firmer, law, reaching
from pneud.control.tunables import bandwidth
from pneud.physics.valve import Valve, opening

VALVE = Valve(5.0, 0.0, 0.7, 0.1)
LAW = Sliding(feedback(6e4, 5e3, 110.0, 0.92), 1.5, True, 3e-3, True, 15.0, True, 0.05)
H, FILL, EXHAUST = 1e-3, 2800.0, 2600.0


def answer(
    p: Sliding = LAW,
    state: SlidingState | None = None,
    w: tuple[float, float, float] = (0.0, 0.0, 0.0),
    jerk_d: float = 0.0,
    drift: float = 0.0,
    d_hat: float = 0.0,
    force_rate: float = 0.0,
    last_v: float = 0.0,
) -> tuple[SlidingState, LawOutput]:
    return law(
        engage(w[2]) if state is None else state,
        *w, jerk_d, drift, d_hat, force_rate, FILL, EXHAUST, H, p, VALVE, last_v,
    )  # fmt: skip


@given(st.floats(1e-6, 1e-2), st.floats(1.0, 2.0))
def test_a_firmer_law_is_faster_by_as_much_at_every_error(error_m: float, more: float) -> None:
    firm = firmer(LAW, more)
    assert bandwidth(firm.gains, error_m) == pytest.approx(more * bandwidth(LAW.gains, error_m))
    assert firm._replace(gains=LAW.gains) == LAW
    assert firmer(LAW, 1.0) == LAW


@pytest.mark.parametrize("implicit", [True, False])
def test_engaging_does_not_step(implicit: bool) -> None:
    _, out = answer(LAW._replace(implicit=implicit), w=(1e-4, 1e-3, 0.7))
    assert out.s == 0.0


@pytest.mark.parametrize(("Z", "f1"), [(700.0, FILL), (-700.0, EXHAUST)])
def test_each_direction_has_its_own_authority(Z: float, f1: float) -> None:
    _, out = answer(jerk_d=Z / LAW.M)
    assert opening(out.u_v, VALVE) == pytest.approx(Z / f1)


def test_what_is_known_is_fed_forward_with_the_sign_of_the_equations() -> None:
    _, out = answer(jerk_d=10.0, drift=-300.0, d_hat=50.0, force_rate=400.0)
    assert opening(out.u_v, VALVE) == pytest.approx((150.0 + 300.0 - 50.0 + 400.0) / FILL)
    _, without = answer(
        LAW._replace(compensate_d=False), jerk_d=10.0, drift=-300.0, d_hat=50.0, force_rate=400.0
    )
    assert opening(without.u_v, VALVE) == pytest.approx(850.0 / FILL)


@pytest.mark.parametrize("implicit", [True, False])
def test_feedback_pushes_towards_the_reference(implicit: bool) -> None:
    p = LAW._replace(implicit=implicit)
    for w in ((1e-3, 0.0, 0.0), (0.0, 0.05, 0.0), (0.0, 0.0, 3.0)):
        ahead, behind = answer(p, w=w)[1], answer(p, w=(-w[0], -w[1], -w[2]))[1]
        assert ahead.u_v > VALVE.dead_zone_v
        assert behind.u_v < -VALVE.dead_zone_v
        assert ahead.ustar == -behind.ustar < 0.0


@given(
    st.floats(-1e-3, 1e-3), st.floats(-1e-2, 1e-2), st.floats(-1.0, 1.0), st.floats(-2e3, 2e3), st.booleans()
)
def test_s_stays_zero_where_the_model_is_right(
    w1: float, w2: float, w3: float, drift: float, implicit: bool
) -> None:
    p = LAW._replace(implicit=implicit, hold_v=0.0)
    state, out = answer(p, w=(w1, w2, w3), drift=drift)
    u = opening(max(-VALVE.u_max_v, min(VALVE.u_max_v, out.u_v)), VALVE)
    rate = drift + (FILL if u >= 0.0 else EXHAUST) * u
    _, following = answer(p, state, w=(w1, w2, w3 - H * rate / p.M))
    assert following.s == pytest.approx(0.0, abs=1e-9 * (1.0 + abs(rate) / p.M))


@pytest.mark.parametrize("size", [0.4, -0.4])
def test_saturation_does_not_wind_up(size: float) -> None:
    p = LAW._replace(gains=feedback(6e6, 5e4, 400.0, 0.92))
    w3 = 0.0
    state = engage(w3)
    for _ in range(500):
        state, out = answer(p, state, w=(size, 0.0, w3))
        assert abs(out.u_v) > VALVE.u_max_v
        w3 -= H * math.copysign(VALVE.u_max_v, out.u_v) * (FILL if out.u_v > 0.0 else EXHAUST) / p.M
        w3 = max(-40.0, min(40.0, w3)) if abs(w3) < 30.0 else w3
        assert out.s == pytest.approx(0.0, abs=1e-6)


def test_opening_not_worth_it_leaves_the_command_in_the_dead_zone() -> None:
    small = 0.9 * LAW.hold_v * FILL / LAW.M
    for last, expected in ((0.07, 0.07), (-0.07, -0.07), (0.3, 0.1), (-0.3, -0.1)):
        assert answer(jerk_d=small, last_v=last)[1].u_v == expected
    assert answer(jerk_d=1.2 * small, last_v=-0.1)[1].u_v > VALVE.dead_zone_v


def test_holding_does_not_wind_up() -> None:
    w, state = (1e-6, 0.0, 0.0), engage(0.0)
    for _ in range(2000):
        state, out = answer(state=state, w=w, last_v=0.05)
        assert out.u_v == 0.05
        assert abs(out.s) < 1e-9


def test_feedback_looks_no_less_far_ahead_than_a_sample() -> None:
    w = (1e-4, 0.0, 0.0)
    near, sample, far = (answer(LAW._replace(horizon_s=T), w=w)[1].ustar for T in (0.0, H, 5.0 * H))
    assert near == sample
    assert abs(far) < abs(sample)


def test_dead_zone_can_be_left_in() -> None:
    _, out = answer(LAW._replace(invert_dead_zone=False), jerk_d=1.0)
    assert out.u_v == pytest.approx(LAW.M / FILL)


def test_reaching_is_bounded_and_reaches_zero_without_passing_it() -> None:
    T, eta = 3e-3, 2.0
    assert reaching(1.0, T, eta, True) == eta
    assert reaching(-1.0, T, eta, True) == -eta
    assert T * reaching(1e-3, T, eta, True) == pytest.approx(1e-3)
    assert reaching(1e-9, T, eta, False) == eta
    assert reaching(-1e-9, T, eta, False) == -eta
    assert reaching(0.0, T, eta, False) == 0.0
