"""The controller as a whole: against the software rig, compiled and not."""

import math
from typing import Any

import numpy as np
import pytest

from pneud.axis.state import AxisParameters
from pneud.config.conversions import axis_of, lead_s, plant_of
from pneud.config.models import Config
from pneud.config.reading import load_config, parse
from pneud.config.sections import ConfigError
from pneud.control.prediction import Spool
from pneud.control.step import Controller, ControllerState, act, at_effect, join, observe, start
from pneud.physics.plant import PlantParameters
from pneud.physics.valve import SpoolTransition, Valve
from pneud.resources import configs
from pneud.rig.dynamics import initial_state
from pneud.signals import Estimate, Reference
from pneud.study.jit import jitted
from sine_loop import LoopOutcome, run_sine

COMMAND_LSB_V = 5e-4


def loaded(name: str = "virtual.toml") -> tuple[Config, AxisParameters, PlantParameters]:
    c = load_config(name)
    return c, axis_of(c, COMMAND_LSB_V), plant_of(c)


CONFIG, AXIS, PLANT = loaded()
P = AXIS.controller
REFERENCE = AXIS.reference
RUN = jitted(run_sine)


def begin(controller: Controller, position_m: float, plant: PlantParameters = PLANT) -> LoopOutcome:
    rig = initial_state(plant._replace(initial_x1=position_m + plant.cylinder.x_e1))
    state = start(position_m, rig.p1, rig.p2, plant.gas.supply_pa, controller)
    return LoopOutcome(state, rig, 0.0)


def track(
    controller: Controller,
    ticks: int,
    start_error_m: float = 0.0,
    push: tuple[int, int, float] = (0, 0, 0.0),
    plant: PlantParameters = PLANT,
    run: Any = RUN,
) -> tuple[LoopOutcome, np.ndarray]:
    trace, force = np.zeros((ticks, 8)), np.zeros(ticks)
    force[push[0] : push[1]] = push[2]
    noise = np.random.default_rng(3).normal(0.0, plant.pressure_noise_pa, (ticks, 3))
    first = begin(controller, REFERENCE.centre_m + start_error_m, plant)
    end = run(first, controller, plant, REFERENCE, 0.0, 10.0 / 4096, noise, force, trace)
    return end, trace


def rms_mm(trace: np.ndarray) -> float:
    return float(1e3 * np.sqrt(np.mean(trace[:, 0] ** 2)))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["virtual.toml", "paper-case1.toml"])
def test_compiled_and_interpreted_loop_agree_to_the_last_bit(name: str) -> None:
    _, axis, plant = loaded(name)
    results = [track(axis.controller, 250, 0.03, (100, 150, 200.0), plant, run) for run in (run_sine, RUN)]
    (end, trace), (end_compiled, trace_compiled) = results
    assert trace.tobytes() == trace_compiled.tobytes()
    assert tuple(end.controller) == tuple(end_compiled.controller)


def test_law_tracks_the_sine_closely_and_quietly() -> None:
    _, trace = track(P, 3000, run=run_sine)
    settled = trace[1000:]
    assert rms_mm(settled) < 0.05
    assert np.max(np.abs(settled[:, 0])) < 0.15e-3
    assert np.mean(np.abs(np.diff(settled[:, 1]))) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("error_m", [0.4, -0.4, 0.01])
def test_law_recovers_from_a_start_error(error_m: float) -> None:
    _, trace = track(P, 6000, start_error_m=error_m)
    assert rms_mm(trace[4000:]) < 0.05
    assert np.mean(np.abs(np.diff(trace[4000:, 1]))) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("push_n", [200.0, -200.0, 500.0, -500.0])
def test_law_recovers_from_a_push(push_n: float) -> None:
    _, trace = track(P, 6500, push=(2300, 3300, push_n))
    assert rms_mm(trace[4500:]) < 0.05
    assert np.mean(np.abs(np.diff(trace[4500:, 1]))) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("push_n", [50.0, -50.0])
def test_load_step_at_peak_speed(push_n: float) -> None:
    _, trace = track(P, 5000, push=(4000, 5000, push_n))
    error = np.abs(trace[:, 0])
    assert np.max(error[4000:]) < 0.65e-3
    assert np.max(error[4300:]) < 0.1e-3


@pytest.mark.slow
def test_without_prediction_the_dead_time_is_felt() -> None:
    blind = P._replace(lead_s=0.0, sliding=P.sliding._replace(horizon_s=0.0))
    assert rms_mm(track(blind, 4000)[1][2000:]) > 1.2 * rms_mm(track(P, 4000)[1][2000:])


@pytest.mark.slow
def test_without_the_friction_model_the_estimate_has_all_the_work() -> None:
    plain = P._replace(friction=P.friction._replace(coulomb_n=0.0, static_n=0.0, sigma0_n_m=0.0))
    with_model, without = track(P, 4000)[1][2000:], track(plain, 4000)[1][2000:]
    assert 2.0 * rms_mm(with_model) < rms_mm(without) < 0.2


def settled() -> tuple[ControllerState, Estimate]:
    rig = initial_state(PLANT)
    x = rig.x1 - PLANT.cylinder.x_e1
    state = start(x, rig.p1, rig.p2, PLANT.gas.supply_pa, P)
    return observe(state, x, True, rig.p1, rig.p2, PLANT.gas.supply_pa, 0.0, P.h, P)


def test_joining_does_not_step() -> None:
    state, e = settled()
    r = Reference(e.position_m, 0.05, 0.5, 3.0)
    _, out = act(join(state, e, r, P), e, r, P)
    assert out.s == 0.0
    # and a law on its reference asks for next to nothing
    still = Reference(e.position_m, 0.0, 0.0, 0.0)
    _, out = act(join(state, e, still, P), e, still, P)
    assert abs(out.u_v) <= P.valve.dead_zone_v


def test_without_an_encoder_reading_the_filter_only_predicts() -> None:
    state, e = settled()
    _, guess = observe(state, 99.0, False, 3e5, 3.7e5, 6e5, 0.0, P.h, P)
    assert guess.position_m == pytest.approx(e.position_m, abs=1e-4)
    assert guess.innovation_m == 0.0
    _, told = observe(state, e.position_m + 1e-3, True, 3e5, 3.7e5, 6e5, 0.0, P.h, P)
    assert told.innovation_m == pytest.approx(1e-3, rel=0.05)


def test_friction_is_gained_once() -> None:
    state, e = settled()
    r = Reference(e.position_m, 0.1, 0.0, 0.0)
    state, _ = act(join(state, e, r, P), e, r, P)
    assert state.force_step_n > 0.0
    state, _ = observe(state, e.position_m, False, 3e5, 3.7e5, 6e5, 0.0, P.h, P)
    assert state.force_step_n == 0.0


@pytest.mark.parametrize(("command_v", "sign"), [(1.0, 1.0), (-1.0, -1.0)])
def test_observer_is_told_what_the_valve_lets_through(command_v: float, sign: float) -> None:
    state, _ = settled()
    quick = P._replace(
        valve=P.valve._replace(omega_rad_s=0.0), spool_before=SpoolTransition(0.0, 0.0, 0.0, 0.0)
    )
    for controller in (P, quick):
        s = state._replace(spool=Spool(command_v, 0.0), applied_v=command_v)
        _, e = observe(s, 0.45, False, 3e5, 3.7e5, 6e5, command_v, P.h, controller)
        assert e.opening_v == pytest.approx(sign * 0.9 * 5.0 / 4.9)


def test_a_valve_without_lag_jumps_when_the_command_arrives() -> None:
    state, _ = settled()
    valve = P.valve._replace(omega_rad_s=0.0, dead_zone_v=0.0)
    quick = P._replace(valve=valve, delay_s=0.25 * P.h, spool_before=SpoolTransition(0.0, 0.0, 0.0, 0.0))
    s = state._replace(spool=Spool(1.0, 0.0), applied_v=1.0)
    _, e = observe(s, 0.45, False, 3e5, 3.7e5, 6e5, 3.0, P.h, quick)
    assert e.opening_v == pytest.approx(0.25 * 1.0 + 0.75 * 3.0)


def test_prediction_can_be_left_out() -> None:
    state, e = settled()
    now = at_effect(state, e, 5.0, P._replace(lead_s=0.0))
    assert now[:2] == (e.position_m, e.velocity_m_s)
    moved = at_effect(state._replace(applied_v=2.0, spool=Spool(2.0, 0.0)), e, 0.0, P)
    assert moved.force_n - now.force_n > 5.0


def test_ismc_and_the_bare_law_leave_out_their_parts() -> None:
    """ISMC leaves d̂ out of prediction and law; without F̂ the unmatched force is not in w3."""
    state, e = settled()
    e = e._replace(d_hat_n_s=1e4, force_n=e.force_n + 10.0)
    ismc = P._replace(sliding=P.sliding._replace(compensate_d=False))
    assert at_effect(state, e, 0.0, P).force_n - at_effect(state, e, 0.0, ismc).force_n == pytest.approx(
        1e4 * P.lead_s, rel=1e-3
    )
    bare = P._replace(use_force=False)
    assert at_effect(state, e, 0.0, bare).force_n - at_effect(state, e, 0.0, P).force_n == pytest.approx(
        e.force_n, rel=1e-3
    )


def test_model_is_not_evaluated_beyond_the_ends() -> None:
    for position in (-0.5, 1.5):
        s = start(position, 3e5, 3e5, 6e5, P)
        assert all(math.isfinite(x) for x in (s.f0, s.f1_fill, s.f1_exhaust))
        _, e = observe(s, position, True, 3e5, 3e5, 6e5, 0.0, P.h, P)
        assert all(math.isfinite(x) for x in e)


def test_lead_is_delay_and_lag() -> None:
    assert lead_s(5e-4, Valve(5.0, 1000.0, 0.8, 0.0)) == pytest.approx(5e-4 + 1.6e-3)
    assert lead_s(5e-4, Valve(5.0, 0.0, 0.8, 0.0)) == 5e-4
    assert loaded("paper-case1.toml")[1].controller.lead_s == 0.0
    assert loaded("paper-case1.toml")[1].controller.sliding.horizon_s == 0.0


def test_options_of_the_force_need_the_force() -> None:
    text = (configs() / "virtual.toml").read_text()
    with pytest.raises(ConfigError, match="estimate_force"):
        parse(text.replace("[control]\n", "[control]\nestimate_force = false\n"), "x.toml")
