"""The [x, v, F] filter: truth as a fixed point, poles, Kalman gains, what a reading within a step says."""

import math
import random

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
from hypothesis import given
from hypothesis import strategies as st

from pneud.control import motion
from pneud.control.motion import (
    MotionFilter,
    MotionState,
    at_rest,
    beyond,
    correct,
    kalman,
    predict,
    quickened,
    triple_pole,
)

M, ROD, H = 15.0, 20.2, 1e-3
forces = st.floats(-500.0, 500.0)


@given(x3=forces, slope=st.floats(-1e4, 1e4), F=forces, gain=st.floats(-5.0, 5.0), v=st.floats(-2.0, 2.0))
def test_prediction_is_exact_for_forces_in_straight_lines(
    x3: float, slope: float, F: float, gain: float, v: float
) -> None:
    after = predict(MotionState(0.1, v, F, x3, 0.0), x3 + slope * H, gain, ROD, M, H)
    a0, jerk = (x3 - ROD - F) / M, (slope - gain / H) / M
    assert after.v == pytest.approx(v + H * a0 + H * H * jerk / 2.0, abs=1e-12)
    assert after.x == pytest.approx(0.1 + H * v + H * H * a0 / 2.0 + H**3 * jerk / 6.0, abs=1e-12)
    assert (after.F, after.x3) == (F + gain, x3 + slope * H)


def test_load_at_rest_stays_where_it_is() -> None:
    state = at_rest(0.3, 45.0, ROD)
    for _ in range(100):
        state = correct(predict(state, 45.0, 0.0, ROD, M, H), 0.3, M, H, triple_pole(400.0, H))
    assert (state.x, state.v, state.F) == pytest.approx((0.3, 0.0, 45.0 - ROD), abs=1e-12)


def error_step(p: MotionFilter) -> np.ndarray:
    step = np.array([[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])
    gain = np.array([[p.alpha], [p.beta], [p.gamma]])
    found: np.ndarray = (np.eye(3) - gain @ np.array([[1.0, 0.0, 0.0]])) @ step
    return found


def poles(p: MotionFilter) -> np.ndarray:
    return np.linalg.eigvals(error_step(p))


@pytest.mark.parametrize("omega", [50.0, 400.0, 2000.0])
def test_triple_pole_lies_where_asked(omega: float) -> None:
    # a triple root shows only to the cube root of the rounding
    assert poles(triple_pole(omega, H)) == pytest.approx(math.exp(-omega * H), abs=1e-4)


@given(noise=st.floats(-7, -4), walk=st.floats(0, 5))
def test_kalman_filter_is_stable(noise: float, walk: float) -> None:
    assert max(abs(poles(kalman(10.0**noise, 10.0**walk, M, H)))) < 1.0


@pytest.mark.parametrize("walk", [30.0, 1e3, 1e5])
def test_kalman_gains_solve_the_riccati_equation(walk: float) -> None:
    noise = 3e-7
    p = kalman(noise, walk, M, H)
    q = (walk * math.sqrt(H) * H * H / (M * noise)) ** 2
    A = np.array([[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])
    Q = q * np.array([[1 / 20, 1 / 8, 1 / 6], [1 / 8, 1 / 3, 1 / 2], [1 / 6, 1 / 2, 1.0]])
    C = np.array([[1.0, 0.0, 0.0]])
    P = scipy.linalg.solve_discrete_are(A.T, C.T, Q, np.eye(1))
    K = (P @ C.T / (C @ P @ C.T + 1.0)).ravel()
    assert (p.alpha, p.beta, p.gamma) == pytest.approx(tuple(K), rel=1e-5)


def test_kalman_iteration_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    exact = kalman(3e-7, 1e3, M, H)
    monkeypatch.setattr(motion, "MAX_ITERATIONS", 3)
    rough = kalman(3e-7, 1e3, M, H)
    assert rough != exact
    assert max(abs(poles(rough))) < 1.0


def test_force_is_found_without_an_error_that_stays() -> None:
    x, v, state, p = 0.2, 0.0, at_rest(0.2, ROD, ROD), triple_pole(400.0, H)
    for i in range(200):
        F = 30.0 if i >= 50 else 0.0
        a = -F / M
        x, v = x + H * v + 0.5 * H * H * a, v + H * a
        state = correct(predict(state, ROD, 0.0, ROD, M, H), x, M, H, p)
    assert (state.F, state.v) == pytest.approx((30.0, v), abs=1e-6)
    assert state.x == pytest.approx(x, abs=1e-12)


def test_a_known_gain_of_the_force_needs_no_innovation() -> None:
    x, v, state, p, F = 0.2, 0.0, at_rest(0.2, ROD, ROD), triple_pole(400.0, H), 0.0
    for i in range(60):
        gain = 1.5 if i >= 20 else 0.0
        x += H * v + H * H * (-F / M) / 2.0 - H * H * gain / M / 6.0
        v += H * (-F - 0.5 * gain) / M
        F += gain
        state = correct(predict(state, ROD, gain, ROD, M, H), x, M, H, p)
        assert abs(state.innovation) < 1e-15
    assert pytest.approx(F, abs=1e-6) == state.F


def test_a_reading_within_a_step_of_the_encoder_changes_nothing() -> None:
    state = MotionState(0.2, 0.1, 5.0, 30.0, 0.0)
    after = correct(state, 0.2 + 0.4e-6, M, H, triple_pole(400.0, H, 0.5e-6))
    assert after[:4] == state[:4]
    assert after.innovation == pytest.approx(0.4e-6, rel=1e-6)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_reading_outside_draws_to_the_edge_of_its_step(side: float) -> None:
    state = MotionState(0.2, 0.1, 5.0, 30.0, 0.0)
    p = triple_pole(400.0, H, 0.5e-6)
    after = correct(state, 0.2 + side * 2e-6, M, H, p)
    edge = correct(state, 0.2 + side * 1.5e-6, M, H, p._replace(blind_m=0.0))
    assert after[:4] == pytest.approx(edge[:4], rel=1e-9)
    assert after.innovation == pytest.approx(side * 2e-6, rel=1e-6)


def _force_blows(blind_m: float) -> float:
    """Mean change of F from tick to tick of a load that creeps over the encoder's steps."""
    x, v, p, sum_ = 0.2, 2e-4, triple_pole(400.0, H, blind_m), 0.0
    draw = random.Random(4).gauss
    state = at_rest(x, ROD, ROD)._replace(v=v)
    for _ in range(3000):
        x += H * v
        before = state.F
        x3 = ROD + draw(0.0, 0.2)
        state = correct(predict(state, x3, 0.0, ROD, M, H), round(x / 1e-6) * 1e-6, M, H, p)
        sum_ += abs(state.F - before)
    return sum_ / 3000


def test_knowing_the_resolution_quietens_the_force() -> None:
    assert _force_blows(0.5e-6) < 0.5 * _force_blows(0.0)


def test_filter_stays_stable_over_longer_intervals() -> None:
    state, p = at_rest(0.2, ROD, ROD), triple_pole(400.0, H)
    for i in range(400):
        h = H * (1 + i % 4)
        state = correct(predict(state, ROD, 0.0, ROD, M, h), 0.201, M, h, p)
    assert state.x == pytest.approx(0.201, abs=1e-9)
    assert pytest.approx(0.0, abs=1e-3) == state.F


def test_a_reading_after_a_gap_counts_for_the_whole_gap() -> None:
    p, h = triple_pole(300.0, H), H
    state = at_rest(0.4, 20.0, 20.0)
    for _ in range(8):
        state = predict(state, 20.0, 0.0, 20.0, M, h)
    after = correct(state, 0.4 + 80e-6, M, h, p)
    assert after.v == pytest.approx(p.beta * 80e-6 / 8e-3)
    assert pytest.approx(-M * p.gamma * 80e-6 / 8e-3**2) == after.F
    assert after.unread_s == 0.0


def test_a_reading_soon_after_the_last_one_counts_as_one_of_a_whole_sample() -> None:
    p, h = triple_pole(300.0, H), H
    state = predict(at_rest(0.4, 20.0, 20.0), 20.0, 0.0, 20.0, M, 0.1e-3)
    after = correct(state, 0.4 + 1e-6, M, h, p)
    assert after.v == pytest.approx(p.beta * 1e-6 / h)
    assert pytest.approx(-M * p.gamma * 1e-6 / h**2) == after.F


SLOW, FAST = triple_pole(316.0, H, 0.5e-6), triple_pole(600.0, H)


@given(st.floats(-1e-4, 1e-4))
def test_what_noise_explains_is_taken_slowly_and_the_rest_fast(innovation_m: float) -> None:
    p = quickened(SLOW, FAST, 1.5e-6)
    state = MotionState(0.0, 0.1, 5.0, 30.0, 0.0)
    r, more = beyond(innovation_m, p)
    assert r - more == pytest.approx(max(-1.5e-6, min(1.5e-6, r)), abs=1e-18)
    slow = correct(state, math.copysign(abs(r - more) + (0.5e-6 if r else 0.0), r), M, H, SLOW)
    fast = correct(MotionState(0.0, 0.0, 0.0, 30.0, 0.0), more, M, H, FAST)
    both = correct(state, innovation_m, M, H, p)
    assert both[:3] == pytest.approx([a + b for a, b in zip(slow[:3], fast[:3], strict=True)], abs=1e-9)


@given(st.floats(-5e-5, 5e-5), st.floats(0.0, 1e-9))
def test_the_correction_is_continuous(innovation_m: float, step_m: float) -> None:
    p, state = quickened(SLOW, FAST, 1.5e-6), MotionState(0.0, 0.1, 5.0, 30.0, 0.0)
    low, high = (correct(state, innovation_m + d, M, H, p) for d in (0.0, step_m))
    assert abs(high.x - low.x) <= 2.0 * step_m
    assert abs(high.F - low.F) <= 2.0 * M * FAST.gamma * step_m / H**2 + 1e-9


@pytest.mark.parametrize("ratio", [1.9, 2.5])
@pytest.mark.parametrize("omega_h", [0.05, 0.2, 0.5])
def test_two_filters_have_a_lyapunov_function_in_common(ratio: float, omega_h: float) -> None:
    steps = [error_step(triple_pole(w, 1.0)) for w in (omega_h, ratio * omega_h)]

    def growth(factor: np.ndarray) -> float:
        root = np.zeros((3, 3))
        root[np.tril_indices(3)] = factor
        P = root @ root.T
        return max(float(scipy.linalg.eigvalsh(A.T @ P @ A, P)[-1]) for A in steps)

    middle = 0.5 * (steps[0] + steps[1])
    weights = np.diag([1.0, omega_h**-2, omega_h**-4])
    P = scipy.linalg.solve_discrete_lyapunov(middle.T, weights)
    begin = np.linalg.cholesky(P)[np.tril_indices(3)]
    found = scipy.optimize.minimize(growth, begin, method="Nelder-Mead", options={"maxfev": 3000})
    # x' P x falls in every step, whatever mixture of the two is applied: it is convex in the gains
    assert found.fun < 1.0


def test_without_a_second_filter_nothing_is_added() -> None:
    state = MotionState(0.2, 0.1, 5.0, 30.0, 0.0)
    same = quickened(SLOW, triple_pole(316.0, H), 1.5e-6)
    assert correct(state, 0.21, M, H, same)[:3] == correct(state, 0.21, M, H, SLOW)[:3]
