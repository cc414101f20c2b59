"""PID with feed-forward and ADRC: what each part of them does, and that they hold a load."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pneud.config.conversions import plant_of
from pneud.control.laws.adrc import AdrcState, extend, made, quadruple_pole, reading
from pneud.control.laws.pid import Pid, PidState
from pneud.control.laws.sliding import command
from pneud.control.laws.slot import PID, SLIDING, Slot
from pneud.control.motion import correct, predict
from pneud.control.reference import rest
from pneud.control.step import Controller, ControllerState, act, join, observe, situation, start
from pneud.loading import load
from pneud.physics.valve import opening
from pneud.signals import Estimate
from pneud.study.cases import Bench, bench_of, case, figures, move_of, trace_of
from pneud.study.tuned import (
    ADRC3,
    ADRC4,
    COMPOSITE,
    COMPOSITE_PAPER,
    EXTENDED,
    ISMC,
    ISMC_PAPER,
    PID_FF,
    setting,
)

LOADED = load("virtual.toml")
BENCH = bench_of(LOADED, compiled=False)
P = BENCH.controller
AT = 0.4
GAINS = Pid(1600.0, 20000.0, 80.0, 150.0, 0.02, 20e-6, 200.0)


def pid(p: Controller = P, **gains: float) -> Controller:
    return p._replace(slot=Slot(PID, pid=GAINS._replace(**gains)))


def asked(p: Controller, off_m: float, integral_n: float = 0.0) -> tuple[ControllerState, float]:
    """State and command for a load at rest that is to be somewhere else."""
    state, e = joined(p)
    state = state._replace(own=state.own._replace(pid=PidState(integral_n)))
    state, out = act(state, e, rest(AT + off_m), p)
    return state, out.u_v


def joined(p: Controller = P) -> tuple[ControllerState, Estimate]:
    plant = plant_of(LOADED.config)
    p2 = 3e5
    p1 = (p2 * plant.cylinder.A2 + plant.cylinder.rod_force_n) / plant.cylinder.A1
    state = start(AT, p1, p2, 6e5, p)
    state, e = observe(state, AT, True, p1, p2, 6e5, 0.0, p.h, p)
    return join(state, e, rest(AT), p), e


@pytest.mark.parametrize("name", [PID_FF, ADRC4, ADRC3])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_each_drives_the_load_towards_the_reference(name: str, side: float) -> None:
    assert asked(setting(name, P), side * 5e-3)[1] * side > 0.1


@pytest.mark.parametrize("name", [PID_FF, ADRC4, ADRC3])
def test_an_error_counts_no_more_than_the_reach(name: str) -> None:
    p = setting(name, P)
    reach = p.slot.pid.reach_m if p.slot.kind == PID else p.slot.adrc.reach_m
    near, far = (asked(p, d * reach)[1] for d in (1.0, 5.0))
    assert near == pytest.approx(far, rel=1e-9)


@pytest.mark.parametrize("name", [PID_FF, ADRC4, ADRC3])
def test_a_law_without_sliding_variable_says_so(name: str) -> None:
    p = setting(name, P)
    state, e = joined(p)
    after, out = act(state, e, rest(AT + 1e-3), p)
    assert math.isnan(out.s)
    assert math.isnan(out.ustar)
    assert after.sliding == state.sliding


def test_the_sliding_law_leaves_the_others_alone() -> None:
    state, e = joined()
    after, _ = act(state, e, rest(AT + 1e-3), P)
    assert P.slot.kind == SLIDING
    assert after.own == state.own


def test_the_integral_gains_in_the_direction_of_the_error() -> None:
    state, _ = asked(pid(), 1e-4)
    assert state.own.pid.integral_n == pytest.approx(P.h * P.cylinder.M * 20000.0 * 1e-4, rel=1e-3)


def test_the_integral_rests_within_the_quiet_band() -> None:
    assert asked(pid(), 1e-5)[0].own.pid.integral_n == 0.0


def test_the_integral_does_not_wind_up_where_the_valve_saturates() -> None:
    state, u = asked(pid(kp=1e5), 0.02)
    assert abs(u) > P.valve.u_max_v
    assert state.own.pid.integral_n == 0.0
    # but it does unwind
    state, u = asked(pid(kp=1e5, force_max_n=1e9), -1e-3, integral_n=1e4)
    assert u > P.valve.u_max_v
    assert state.own.pid.integral_n < 1e4


def test_the_integral_has_a_bound() -> None:
    assert asked(pid(), 2e-3, integral_n=1e3)[0].own.pid.integral_n == 200.0


def test_pid_without_the_estimated_force_sees_the_force_of_the_pressures() -> None:
    u = [asked(pid(p), 2e-3)[1] for p in (P, P._replace(use_force=False))]
    assert u[0] == pytest.approx(u[1], rel=0.05)  # the load stands still and no force acts on it


@pytest.mark.parametrize(("force_n", "integral_n"), [(20.0, 0.0), (-80.0, -44.0), (900.0, 200.0)])
def test_pid_takes_over_what_friction_cannot_hold(force_n: float, integral_n: float) -> None:
    state, e = joined(pid())
    state = join(state, e._replace(force_n=force_n), rest(AT), pid())
    assert state.own.pid.integral_n == integral_n


@given(st.floats(-1e4, 1e4).filter(lambda z: z != 0.0))
def test_a_command_gives_the_rate_wanted_where_that_is_worth_crossing_the_dead_zone(Z: float) -> None:
    state, _ = joined()
    wanted = Z / (state.f1_fill if Z >= 0.0 else state.f1_exhaust)
    u = command(wanted, 3.0, P.sliding, P.valve)
    if abs(wanted) <= P.sliding.hold_v:
        assert u == P.valve.dead_zone_v
        assert opening(u, P.valve) == 0.0
    elif abs(wanted) <= P.valve.u_max_v:
        assert opening(u, P.valve) == pytest.approx(wanted, rel=1e-9)
    else:
        assert abs(u) > P.valve.u_max_v


def test_without_the_inverse_the_command_is_the_opening() -> None:
    assert command(1.0, 3.0, P.sliding._replace(invert_dead_zone=False), P.valve) == 1.0


@pytest.mark.parametrize("omega", [100.0, 400.0, 1500.0])
def test_the_observer_of_fourth_order_has_four_equal_poles(omega: float) -> None:
    h = 1e-3
    a = np.array([[1, 1, 1 / 2, 1 / 6], [0, 1, 1, 1 / 2], [0, 0, 1, 1], [0, 0, 0, 1]])
    g = np.array(quadruple_pole(omega, h))
    error = a - np.outer(g, a[0])
    q = math.exp(-omega * h)
    assert np.poly(error) == pytest.approx(np.poly([q] * 4), abs=1e-9)


@given(st.floats(-1e-4, 1e-4))
def test_the_reading_is_found_again_in_the_estimate(off: float) -> None:
    state, _ = joined()
    motion = predict(state.motion, state.motion.x3, 0.0, P.cylinder.rod_force_n, P.cylinder.M, P.h)
    after = correct(motion, AT + off, P.cylinder.M, P.h, P.motion)
    e = Estimate(after.x, after.v, after.F, after.x3, after.x3, 0.0, after.innovation, 0.0)
    assert reading(e, P.motion) == pytest.approx(AT + off, abs=1e-12)


@pytest.mark.parametrize("u", [1.0, -1.0])
def test_the_observer_of_fourth_order_finds_what_the_model_leaves_out(u: float) -> None:
    state, e = joined()
    s = situation(state, e, rest(AT), P)
    g = made((0.0, 0.0, 0.0, 1.0, 300.0), P.h)
    f1 = state.f1_fill if u >= 0.0 else state.f1_exhaust
    M, missing = P.cylinder.M, 50.0 * u
    own, x, v, a = AdrcState(AT, 0.0, 0.0, 0.0), AT, 0.0, 0.0
    for _ in range(100):
        jerk = (state.f0 * v + f1 * u) / M + missing
        x += P.h * (v + P.h * (0.5 * a + P.h * jerk / 6.0))
        v += P.h * (a + 0.5 * P.h * jerk)
        a += P.h * jerk
        seen = e._replace(position_m=x, innovation_m=0.0, opening_v=u)
        own = extend(own, s._replace(e=seen), g)
    assert own.f == pytest.approx(missing, rel=0.05)
    assert own.v == pytest.approx(v, rel=0.01)


def test_adrc_without_prediction_takes_the_state_as_it_is() -> None:
    now = P._replace(lead_s=0.0)
    state, u = asked(setting(ADRC4, now), 1e-3)
    assert u > 0.0
    assert state.own.adrc.x == pytest.approx(AT)


@pytest.mark.parametrize("name", [PID_FF, ADRC4, ADRC3, EXTENDED])
def test_a_short_move_ends_within_a_millimetre(name: str) -> None:
    f = _moved(BENCH, name)
    assert f[0] < 1e-3
    assert f[1] < 0.5


def _moved(bench: Bench, name: str) -> tuple[float, float]:
    c = case(bench, move_of(bench, 0.01, 0.3, 0.2), (0.2, 0.7))
    found = figures(bench, setting(name, bench.controller), c)
    return found.max_m, found.chatter_v


@pytest.mark.parametrize("name", [ISMC, COMPOSITE, ISMC_PAPER, COMPOSITE_PAPER])
def test_the_papers_laws_have_neither_force_nor_friction(name: str) -> None:
    p = setting(name, P)
    assert not p.use_force
    assert p.friction.coulomb_n == 0.0
    assert p.sliding.compensate_d == ("omposite" in name)
    assert p.slot.kind == SLIDING


@pytest.mark.slow
def test_compiled_and_interpreted_runs_are_the_same() -> None:
    fast = bench_of(LOADED, compiled=True)
    c = case(BENCH, move_of(BENCH, 0.01, 0.1, 0.02), (0.2, 0.3))
    for name in (PID_FF, ADRC4):
        a, b = (trace_of(bench, setting(name, P), c) for bench in (BENCH, fast))
        assert np.array_equal(a[0], b[0])
        assert np.array_equal(a[1], b[1])
