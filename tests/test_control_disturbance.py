"""The disturbance observer (10) in its three forms: fixed points, convergence, noise."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pneud.control.disturbance import EXPLICIT, IMPLICIT, MATCHED, Observer, ObserverState, observe

FORMS = [EXPLICIT, IMPLICIT, MATCHED]
values = st.floats(-1e4, 1e4)


def observer(form: int, L: float = 500.0, lambda0: float = 1.5, lambda1: float = 1.1) -> Observer:
    return Observer(lambda0, lambda1, L, form)


@pytest.mark.parametrize("form", FORMS)
@given(x3=values, d=values, f=values)
def test_the_truth_is_a_fixed_point(form: int, x3: float, d: float, f: float) -> None:
    h = 1e-3
    after = observe(ObserverState(x3, d, 0.0), x3 + h * (f + d), f, h, observer(form))
    assert after.d_hat == pytest.approx(d, abs=1e-9 * (1.0 + abs(x3) / h))
    assert after.e3 == pytest.approx(0.0, abs=1e-12 * (1.0 + abs(x3) + abs(f) + abs(d)))


def converged(form: int, d0: float, h: float, seconds: float, p: Observer) -> tuple[float, float]:
    """Greatest |d̂ − d| and |e3| in the last tenth for a disturbance that grows and falls."""
    state, x3, worst_d, worst_e = ObserverState(0.0, 0.0, 0.0), 0.0, 0.0, 0.0
    count = round(seconds / h)
    for i in range(count):
        d = d0 + 0.5 * p.L / math.pi * math.sin(math.pi * i * h)
        x3 += h * d
        state = observe(state, x3, 0.0, h, p)
        if i >= 0.9 * count:
            worst_d, worst_e = max(worst_d, abs(state.d_hat - d)), max(worst_e, abs(state.e3))
    return worst_d, worst_e


def test_implicit_form_ends_with_the_error_exactly_zero() -> None:
    worst_d, worst_e = converged(IMPLICIT, 200.0, 1e-3, 3.0, observer(IMPLICIT))
    assert worst_e == 0.0
    assert worst_d < 1e-8  # the mean of d over the last interval


@pytest.mark.parametrize("form", [EXPLICIT, MATCHED])
def test_other_forms_come_close(form: int) -> None:
    p = observer(form)
    worst_d, worst_e = converged(form, 200.0, 1e-3, 4.0, p)
    assert worst_d < 0.05 * p.L
    assert 0.0 < worst_e < 0.05


@pytest.mark.parametrize("form", [EXPLICIT, MATCHED])
def test_a_finer_sample_is_more_accurate(form: int) -> None:
    p = observer(form)
    assert converged(form, 200.0, 1e-4, 3.0, p)[0] < 0.5 * converged(form, 200.0, 1e-3, 3.0, p)[0]


def test_estimate_moves_no_faster_than_its_gain() -> None:
    h, p = 1e-3, observer(IMPLICIT)
    state = observe(ObserverState(0.0, 0.0, 0.0), 50.0, 0.0, h, p)
    assert state.d_hat == pytest.approx(h * p.lambda1 * p.L)
    assert state.x_hat < 50.0
    assert state.e3 == pytest.approx(state.x_hat - 50.0)


@given(noise=st.floats(-1.0, 1.0))
def test_implicit_form_solves_its_own_equations(noise: float) -> None:
    h, p = 1e-3, observer(IMPLICIT)
    before, x3, f = ObserverState(10.0, 30.0, 0.0), 10.0 + noise, -20.0
    after = observe(before, x3, f, h, p)
    e = after.e3
    pull = p.lambda0 * math.sqrt(p.L * abs(e)) * math.copysign(1.0, e)
    assert after.x_hat == pytest.approx(before.x_hat + h * (f + after.d_hat - pull), abs=1e-9)
    if e != 0.0:
        assert after.d_hat == before.d_hat - math.copysign(h * p.lambda1 * p.L, e)
    else:
        assert abs(after.d_hat - before.d_hat) <= h * p.lambda1 * p.L * (1 + 1e-9)


@pytest.mark.parametrize("lambda0", [1.5, 3.0])
def test_matched_form_has_the_eigenvalues_of_continuous_time(lambda0: float) -> None:
    # 1.5: complex poles; 3: real ones
    h, e, p = 1e-3, 0.04, observer(MATCHED, lambda0=lambda0)
    scale = h / math.sqrt(e)
    root = complex(0.25 * (lambda0**2 * p.L) - p.lambda1 * p.L) ** 0.5
    poles = [complex(math.e) ** (scale * (-0.5 * lambda0 * math.sqrt(p.L) + s * root)) for s in (1, -1)]
    # x̂ already off by e, d̂ right: one step gives the first column of the transition matrix
    after = observe(ObserverState(e, 0.0, e), 0.0, 0.0, h, p)
    trace, product = sum(poles).real, (poles[0] * poles[1]).real
    assert after.e3 == pytest.approx(e * (trace - 1.0))
    assert after.d_hat == pytest.approx(e * (trace - 1.0 - product) / h)
