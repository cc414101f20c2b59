"""The homogeneous feedback: exponents, one root, found to rounding, no limit cycle of its own."""

import math

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from pneud.control import homogeneous
from pneud.control.homogeneous import (
    Feedback,
    explicit_ustar,
    feedback,
    implicit_ustar,
    implicit_w3,
    sig,
)

PAPER = feedback(220.0, 450.0, 350.0, 0.8)


def magnitudes(low: float, high: float) -> st.SearchStrategy[float]:
    size = st.floats(low, high).map(lambda exponent: 10.0**exponent)
    return st.one_of(st.just(0.0), size, size.map(lambda x: -x))


gains = st.builds(
    feedback,
    st.floats(1, 6).map(lambda x: 10.0**x),
    st.floats(1, 5).map(lambda x: 10.0**x),
    st.floats(0, 3).map(lambda x: 10.0**x),
    st.floats(0.55, 1.0),
)
steps = st.floats(-4, -1.5).map(lambda x: 10.0**x)


def terms(y: float, w1: float, w2: float, w3: float, h: float, g: Feedback) -> tuple[float, float]:
    """Left side minus right side of the implicit equation, and the sum of the sizes of its terms."""
    parts = (
        y,
        h * g.k3 * sig(y, g.a3),
        h * g.k2 * sig(w2 + h * y, g.a2),
        h * g.k1 * sig(w1 + h * w2 + h * h * y, g.a1),
        -w3,
    )
    return math.fsum(parts), math.fsum(abs(part) for part in parts)


@pytest.mark.parametrize("alpha", [0.6, 0.8, 0.9, 1.0])
def test_exponents_follow_the_recursion_of_the_homogeneous_chain(alpha: float) -> None:
    g = feedback(1.0, 1.0, 1.0, alpha)
    # (20): α_{i−1} = α_i α_{i+1} / (2 α_{i+1} − α_i) with α4 = 1
    assert g.a3 == alpha
    assert g.a2 == pytest.approx(g.a3 * 1.0 / (2.0 * 1.0 - g.a3))
    assert g.a1 == pytest.approx(g.a2 * g.a3 / (2.0 * g.a3 - g.a2))


def test_sig_is_odd_and_keeps_the_sign() -> None:
    assert sig(-4.0, 0.5) == -2.0
    assert sig(4.0, 0.5) == 2.0
    assert sig(0.0, 0.5) == 0.0


@given(
    magnitudes(-9, 1), magnitudes(-9, 1), magnitudes(-9, 2), gains, st.floats(-3, 3).map(lambda x: 10.0**x)
)
def test_feedback_is_homogeneous(w1: float, w2: float, w3: float, g: Feedback, scale: float) -> None:
    # weights r1 : r2 : r3 with α_i = (r3 + degree)/r_i, here scaled so that r4 = 1
    once = explicit_ustar(w1, w2, w3, g)
    sizes = g.k1 * abs(sig(w1, g.a1)) + g.k2 * abs(sig(w2, g.a2)) + g.k3 * abs(sig(w3, g.a3))
    more = explicit_ustar(
        math.pow(scale, 1.0 / g.a1) * w1,
        math.pow(scale, 1.0 / g.a2) * w2,
        math.pow(scale, 1.0 / g.a3) * w3,
        g,
    )
    assert more == pytest.approx(scale * once, rel=1e-9, abs=1e-9 * scale * sizes)


@settings(max_examples=200)
@given(magnitudes(-12, 0), magnitudes(-12, 1), magnitudes(-12, 3), steps, gains)
@example(0.0, 0.0, 0.0, 1e-3, PAPER)
@example(-1e-3, 0.0, 2.0, 1e-2, PAPER)  # within reach of a kink
@example(0.4, 0.0, 0.0, 1e-3, PAPER)
@example(0.0, 0.0, 1e-9, 1e-2, feedback(1e4, 10.0, 1.0, 0.5625))  # a root of 2e-33
def test_root_is_found_to_rounding(w1: float, w2: float, w3: float, h: float, g: Feedback) -> None:
    y = implicit_w3(w1, w2, w3, h, g)
    rest, size = terms(y, w1, w2, w3, h, g)
    if abs(rest) > 8e-16 * size:
        # where a power is so steep that no float does better, the sign changes beside y, no further from it
        # than the rounding of u* = (y − w3)/h
        off = max(math.ulp(y), math.ulp(w3))
        below = terms(y - off, w1, w2, w3, h, g)[0]
        above = terms(y + off, w1, w2, w3, h, g)[0]
        assert below <= 0.0 <= above


@given(
    magnitudes(-6, 0),
    magnitudes(-6, 1),
    magnitudes(-6, 3),
    steps,
    gains,
    st.floats(-1e3, 1e3),
    st.floats(1e-3, 1e3),
)
def test_equation_has_one_root(
    w1: float, w2: float, w3: float, h: float, g: Feedback, y: float, more: float
) -> None:
    assert terms(y + more, w1, w2, w3, h, g)[0] > terms(y, w1, w2, w3, h, g)[0]


@settings(max_examples=200)
@given(magnitudes(-12, 0), magnitudes(-12, 1), magnitudes(-12, 3), steps, gains)
def test_iterations_are_far_from_their_bound(w1: float, w2: float, w3: float, h: float, g: Feedback) -> None:
    found = homogeneous.implicit_w3(w1, w2, w3, h, g)
    patch = pytest.MonkeyPatch()
    with patch.context() as m:
        m.setattr(homogeneous, "MAX_ITERATIONS", homogeneous.MAX_ITERATIONS - 20)
        # a root next to nothing is still being halved where its digits no longer matter
        assert abs(homogeneous.implicit_w3(w1, w2, w3, h, g) - found) <= 1e-12 * abs(w3)


def test_iterations_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(homogeneous, "MAX_ITERATIONS", 1)
    # a rough answer between the bracket's ends instead of an endless search
    y = implicit_w3(0.3, -1.0, 20.0, 0.01, PAPER)
    assert -1e3 < y < 1e3


def test_answer_is_odd_in_the_errors() -> None:
    assert implicit_ustar(-1e-3, 0.02, -0.3, 1e-3, PAPER) == -implicit_ustar(1e-3, -0.02, 0.3, 1e-3, PAPER)


def test_root_on_a_kink_is_returned_as_it_is() -> None:
    # w1 and w2 vanish: with w3 below h k3 |·|^α3 nothing stays
    assert implicit_w3(0.0, 0.0, 0.0, 1e-3, PAPER) == 0.0
    h = 2.0**-7
    linear = Feedback(1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
    # y = 0 solves h k2 w2 + h k1 (w1 + h w2) = w3 exactly in binary fractions
    assert implicit_w3(1.0, 0.5, h * 0.5 + h * (1.0 + h * 0.5), h, linear) == 0.0


def test_linear_chain_is_backward_euler() -> None:
    g = feedback(1000.0, 300.0, 30.0, 1.0)
    w1, w2, w3, h = 0.01, -0.2, 3.0, 0.01
    expected = (w3 - h * (g.k2 * w2 + g.k1 * (w1 + h * w2))) / (1.0 + h * g.k3 + h * h * g.k2 + h**3 * g.k1)
    assert implicit_w3(w1, w2, w3, h, g) == pytest.approx(expected, rel=1e-14)


def _amplitude(implicit: bool, h: float) -> float:
    """Greatest |w3| of the chain (13) under a zero-order hold, after a second."""
    w1, w2, w3, greatest = 1e-3, 0.0, 0.0, 0.0
    count = round(4.0 / h)
    for i in range(count):
        u = implicit_ustar(w1, w2, w3, h, PAPER) if implicit else explicit_ustar(w1, w2, w3, PAPER)
        w1 += h * (w2 + h * (0.5 * w3 + h * u / 6.0))
        w2 += h * (w3 + 0.5 * h * u)
        w3 += h * u
        if i > count / 2:
            greatest = max(greatest, abs(w3))
    return greatest


def test_explicit_form_has_the_predicted_limit_cycle_and_the_implicit_none() -> None:
    h = 0.01
    predicted = (h * PAPER.k3 / 2.0) ** (1.0 / (1.0 - PAPER.a3))
    assert predicted == pytest.approx(16.4, abs=0.1)
    assert _amplitude(False, h) == pytest.approx(predicted, rel=0.2)
    assert _amplitude(True, h) < 0.02 * predicted
