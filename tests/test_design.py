"""Gains by rule, and predictions that come true."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from commands import object_of
from commands import pneud_here as pneud
from pneud import resources
from pneud.config.conversions import axis_of, plant_of
from pneud.config.models import Config
from pneud.config.reading import load_config
from pneud.control.homogeneous import explicit_ustar, feedback, implicit_ustar, sig
from pneud.control.tunables import bandwidth, delay_margin, linearised
from pneud.loading import at_rate
from pneud.study import gains
from pneud.study.noise import mean_step_v, passed
from pneud.study.push import Pushed, service

VIRTUAL = load_config("virtual.toml")
LSB_V = 5e-4
omegas, errors, alphas = st.floats(1.0, 500.0), st.floats(1e-5, 0.1), st.floats(0.6, 1.0)


def settings(c: Config, **control: object) -> Config:
    return c.model_copy(update={"control": c.control.model_copy(update=control)})


def by_rule(omega: float, rate_hz: float = 1000.0, alpha: float = 0.923, **control: object) -> Config:
    return settings(gains.designed(at_rate(VIRTUAL, rate_hz), omega, 1e-3, alpha), **control)


def tried(c: Config, start_error_m: float = 0.0) -> Pushed:
    return service(axis_of(c, LSB_V), plant_of(c), start_error_m)


@given(omegas, errors, alphas)
def test_each_term_equals_that_of_the_triple_pole_at_the_error(w: float, a: float, alpha: float) -> None:
    g = gains.scaled_gains(w, a, alpha)
    assert g.k1 * sig(a, g.a1) == pytest.approx(w**3 * a, rel=1e-9)
    assert g.k2 * sig(w * a, g.a2) == pytest.approx(3 * w**3 * a, rel=1e-9)
    assert g.k3 * sig(w * w * a, g.a3) == pytest.approx(3 * w**3 * a, rel=1e-9)
    assert bandwidth(g, a) == pytest.approx(w, rel=1e-9)
    assert linearised(g, a) == pytest.approx((w**3, 3 * w**2, 3 * w), rel=1e-9)


@given(omegas, errors, alphas, st.floats(0.1, 10.0))
def test_gains_scale_with_length_and_time(w: float, a: float, alpha: float, scale: float) -> None:
    one, other = gains.scaled_gains(w, a, alpha), gains.scaled_gains(w, scale * a, alpha)
    errors_of = (0.3 * a, -0.2 * w * a, 0.7 * w * w * a)
    expected = scale * explicit_ustar(*errors_of, one)
    w1, w2, w3 = (scale * e for e in errors_of)
    assert explicit_ustar(w1, w2, w3, other) == pytest.approx(expected, rel=1e-6, abs=1e-9 * scale * w**3 * a)


@given(omegas, errors, alphas)
def test_delay_margin_of_a_triple_pole_goes_with_one_over_bandwidth(w: float, a: float, alpha: float) -> None:
    g = gains.scaled_gains(w, a, alpha)
    assert w * delay_margin(g, a) == pytest.approx(0.40705, abs=1e-4)
    if alpha < 0.99:
        assert delay_margin(g, 0.1 * a) < delay_margin(g, a)


def test_delay_margin_is_where_a_linear_loop_with_dead_time_begins_to_grow() -> None:
    g, h = gains.scaled_gains(50.0, 1e-3, 1.0), 1e-5
    margin = delay_margin(g, 1e-3)

    def late_error(delay_s: float) -> float:
        w1, w2, w3, largest = 1e-3, 0.0, 0.0, 0.0
        waiting = [0.0] * round(delay_s / h)
        for k in range(200_000):
            waiting.append(explicit_ustar(w1, w2, w3, g))
            u = waiting.pop(0)
            w1, w2, w3 = w1 + h * w2, w2 + h * w3, w3 + h * u
            if k > 150_000:
                largest = max(largest, abs(w1))
            if abs(w1) > 1.0:
                return 1.0
        return largest

    assert late_error(0.9 * margin) < 1e-6
    assert late_error(1.1 * margin) > 1e-2


def test_a_loop_that_is_unstable_without_delay_has_no_margin() -> None:
    assert delay_margin(feedback(1000.0, 10.0, 10.0, 1.0), 1.0) == 0.0


@pytest.mark.parametrize("h", [0.01, 0.001])
def test_explicit_limit_cycle_is_found_on_the_chain_and_the_implicit_form_has_none(h: float) -> None:
    g = feedback(220.0, 450.0, 350.0, 0.8)
    predicted = gains.limit_cycle(g, h)
    assert predicted == pytest.approx({0.01: 16.413, 0.001: 1.6413e-4}[h], rel=1e-4)
    w3 = y3 = 0.5 * predicted
    for _ in range(400):
        w3 += h * explicit_ustar(0.0, 0.0, w3, g)
        y3 += h * implicit_ustar(0.0, 0.0, y3, h, g)
    assert abs(w3) == pytest.approx(predicted, rel=1e-3)
    assert abs(y3) < 1e-9 * predicted


def test_linear_feedback_has_no_limit_cycle_until_it_is_unstable() -> None:
    assert gains.limit_cycle(feedback(1.0, 2.0, 199.0, 1.0), 0.01) == 0.0
    assert gains.limit_cycle(feedback(1.0, 2.0, 201.0, 1.0), 0.01) == math.inf
    assert gains.limit_cycle(feedback(1.0, 2.0, 1e6, 0.9999), 0.01) == math.inf


@pytest.mark.parametrize(("h", "error_m"), [(0.0, 0.0513), (0.001, 0.0525), (0.01, 0.0587)])
def test_static_error_of_the_papers_gains_under_one_newton(h: float, error_m: float) -> None:
    assert gains.static_error(feedback(220.0, 450.0, 350.0, 0.8), 1.0, 15.0, h) == pytest.approx(
        error_m, rel=0.02
    )


def test_static_error_is_where_the_feedback_rests() -> None:
    g, a = feedback(220.0, 450.0, 350.0, 0.8), 0.1 / 15.0
    for T in (0.001, 0.01):
        w1 = gains.static_error(g, 0.1, 15.0, T) + T * T * a
        assert implicit_ustar(w1, 0.0, -a, T, g) == pytest.approx(0.0, abs=1e-6)


@given(st.floats(1.0, 1e4), st.floats(0.5, 1.0), st.floats(1e-6, 10.0))
def test_gain_for_noise_is_exact_for_a_line_and_of_the_powers_size(k: float, a: float, size: float) -> None:
    assert passed(k, 1.0, size) == pytest.approx(k, rel=1e-12)
    assert passed(k, a, size) * size == pytest.approx(k * size**a, rel=0.2)


def test_a_slower_reference_and_less_friction_ask_less_of_the_observer() -> None:
    slow = VIRTUAL.model_copy(
        update={"reference": VIRTUAL.reference.model_copy(update={"frequency_hz": 0.25})}
    )
    still = VIRTUAL.model_copy(
        update={"reference": VIRTUAL.reference.model_copy(update={"amplitude_m": 0.0})}
    )
    assert 0.0 == gains.disturbance_rate(still) < gains.disturbance_rate(slow)
    assert gains.disturbance_rate(slow) < 0.5 * gains.disturbance_rate(VIRTUAL)


def test_the_printed_tables_are_a_configuration_that_pneud_takes(tmp_path: Path) -> None:
    done = object_of(pneud("design", "--bandwidth", 70, "--error-mm", 1, "--json"))
    assert done["schema"] == 1
    assert done["ok"]
    assert done["warnings"] == []
    assert tomllib.loads(done["toml"])["control"] == done["control"]
    text = (resources.configs() / "virtual.toml").read_text()
    head, rest = text.split("[control]", 1)
    file = tmp_path / "axis.toml"
    file.write_text(head + done["toml"] + "\n[reference]" + rest.split("[reference]", 1)[1])
    (tmp_path / "pneud.dbc").write_text((resources.configs() / "pneud.dbc").read_text())
    assert load_config(file).control == by_rule(70.0).control
    checked = pneud("check", file)
    assert checked.returncode == 0
    assert "warning" not in checked.stdout
    words = pneud("design", "--bandwidth", 70, "--error-mm", 1)
    assert words.stdout.startswith(done["toml"])
    assert tomllib.loads(words.stdout)["control"] == done["control"]


@pytest.mark.parametrize(
    "options",
    [
        ("--bandwidth", 0, "--error-mm", 1),
        ("--bandwidth", "nan", "--error-mm", 1),
        ("--bandwidth", 50, "--error-mm", -1),
        ("--bandwidth", 50, "--error-mm", 1, "--alpha", 1.5),
        ("--bandwidth", 50, "--error-mm", 1, "--rate", 1e6),
    ],
)
def test_an_option_out_of_bounds_gets_one_line(options: tuple[object, ...]) -> None:
    done = pneud("design", *options)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1
    assert "must lie between" in done.stderr or "--rate" in done.stderr


def test_gains_that_pneud_would_refuse_are_printed_with_the_reason_and_status_1() -> None:
    done = pneud("design", "--bandwidth", 1, "--error-mm", 0.001, "--alpha", 0.6)
    assert done.returncode == 1
    assert "not Hurwitz" in done.stdout


@pytest.mark.parametrize(
    ("says", "make"),
    [
        ("not Hurwitz", partial(settings, VIRTUAL, k1=1e9)),
        ("explicit limit cycle", partial(by_rule, 110.0, 200.0, discretisation="explicit")),
        ("Hz are few", partial(by_rule, 60.0, 50.0)),
        ("oscillates", partial(by_rule, 140.0, predict=False)),
        ("unstable where it is linearised", partial(by_rule, 140.0, predict=False)),
        ("hangs on the prediction", partial(by_rule, 300.0)),
        ("alone takes", partial(settings, VIRTUAL, eta_m_s3=500.0)),
        ("may not come back from 400 mm", partial(by_rule, 280.0)),
        ("noise moves the command", partial(by_rule, 280.0)),
        ("1 N costs", partial(settings, VIRTUAL, estimate_force=False)),
    ],
)
def test_each_warning_comes_where_it_applies_and_not_with_what_is_shipped(
    says: str, make: Callable[[], Config]
) -> None:
    c = make()
    assert any(says in line for line in gains.warnings(c, gains.predict(c)))
    assert gains.warnings(VIRTUAL, gains.predict(VIRTUAL)) == []


def test_check_names_what_applies() -> None:
    done = pneud("check", "paper-case1.toml")
    assert done.returncode == 0
    assert "forces are not estimated" in done.stdout
    assert (
        "forces are not estimated" in object_of(pneud("check", "paper-case1.toml", "--json"))["warnings"][0]
    )


@pytest.mark.slow
@pytest.mark.parametrize("rate_hz", [500.0, 1000.0, 2000.0])
@pytest.mark.parametrize("omega", [30.0, 60.0, 90.0, 140.0])
def test_chatter_is_as_predicted_within_a_factor_of_two(omega: float, rate_hz: float) -> None:
    c = by_rule(omega, rate_hz)
    blind_less = settings(c, motion=c.control.motion.model_copy(update={"encoder_resolution_m": 0.0}))
    for each in (c, blind_less):
        assert 0.5 < mean_step_v(each) / tried(each).chatter_v < 2.0


@pytest.mark.slow
def test_chatter_of_the_gains_shipped_is_as_predicted() -> None:
    assert 0.5 < mean_step_v(VIRTUAL) / tried(VIRTUAL).chatter_v < 2.0


@pytest.mark.slow
@pytest.mark.parametrize("omega", [60.0, 90.0, 140.0])
def test_gains_by_rule_without_warning_of_recovery_come_back(omega: float) -> None:
    c = by_rule(omega)
    assert gains.predict(c).recovery_ratio < gains.MOST_RECOVERY_RATIO
    assert tried(c, 0.4).recovered(tried(c))


@pytest.mark.slow
def test_accurate_gains_that_do_not_come_back_are_found_out() -> None:
    done = pneud("design", "--bandwidth", 280, "--error-mm", 1, "--simulate", "--json")
    found = object_of(done)
    near, far = found["simulated"]
    assert done.returncode == 1
    assert near["rms_m"] < 1e-5
    assert far["rms_m"] > 1e-2
    assert any("does not come back" in line for line in found["warnings"])


@pytest.mark.slow
def test_slow_sampling_costs_the_explicit_form_its_calm_and_the_implicit_one_only_accuracy() -> None:
    rough = by_rule(110.0, 200.0, discretisation="explicit")
    assert gains.predict(rough).explicit_limit_cycle_m_s2 > 10 * gains.acceleration_noise(rough)
    assert tried(rough).chatter_v > 1.0
    assert tried(by_rule(110.0, 200.0)).chatter_v < 0.1
    slow, slower = tried(by_rule(110.0, 100.0), 0.4), tried(by_rule(110.0, 50.0), 0.4)
    assert slow.rms_m < slower.rms_m < 2e-3
    assert slower.saturated == 0.0


@pytest.mark.slow
def test_delay_without_prediction_is_felt_where_the_margin_ends() -> None:
    calm, late = by_rule(75.0, predict=False), by_rule(140.0, predict=False)
    assert tried(calm).chatter_v < 0.05
    assert tried(late).saturated > 0.1
    assert tried(by_rule(140.0)).saturated == 0.0
