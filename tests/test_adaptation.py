"""What is learnt in motion: it finds what differs, stays in bounds, and waits where nothing is to be had."""

from __future__ import annotations

import itertools
import json
import math
import random
import shutil
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pneud.config import conversions
from pneud.control import step
from pneud.control.adaptation import (
    LAG_V,
    OPENING_V,
    Adaptation,
    Learnt,
    cylinder_learnt,
    friction_learnt,
    learn_force,
    learn_valve,
    valve_learnt,
)
from pneud.control.model import stiffest
from pneud.control.prediction import Spool
from pneud.control.reference import Sine, rest, septic, sine, way
from pneud.control.step import Controller, ControllerState, as_learnt, start
from pneud.loading import load
from pneud.log.format.snapshot import from_json, to_json
from pneud.physics.friction import stribeck
from pneud.physics.plant import PlantParameters
from pneud.physics.valve import dead_zone_inverse, opening
from pneud.rt.folders import cache_folder
from pneud.study import trial
from pure2c import compile_functions

LOADED = load("virtual.toml", None, {"control": {"adaptation": {"stiffness": True}}})
AXIS = conversions.axis_of(LOADED.config, LOADED.codecs.command_lsb_v)
PLANT = conversions.plant_of(LOADED.config)
P = AXIS.controller
A = P.adaptation
OPEN = Spool(1.0, 10.0)
FINITE = st.floats(-1e9, 1e9)
NOTHING = Learnt()
VALUES = 8  # of Learnt that are learnt; what follows is memory


@cache
def compiled_trial() -> Any:
    if shutil.which("cc") is None:
        pytest.skip("there is no C compiler")
    (run,) = compile_functions([trial.trial], cache=cache_folder("compiled")).functions
    return run


def moved(
    plant: PlantParameters,
    seconds: float,
    p: Controller = P,
    at_rest: bool = False,
    learnt: Learnt = NOTHING,
) -> Learnt:
    """What has been learnt in the lock-step trial: along the sine, or at rest."""
    reference = Sine(AXIS.reference.centre_m, 0.0, 0.0) if at_rest else AXIS.reference
    x = reference.centre_m
    course = trial.Errand(way(septic(1.0, rest(x), sine(0.0, reference))), reference, 0.0)
    bench = trial.begin(x, p, plant, 1)
    bench = bench._replace(state=bench.state._replace(learnt=learnt))
    ticks = round(seconds / p.h)
    bench, _ = compiled_trial()(bench, True, ticks, 0, 1e-5, course, p, plant, LOADED.codecs.command_lsb_v)
    found: Learnt = bench.state.learnt
    return found


def valve_says(so_far: Learnt, missing_v: float = 0.2, u_v: float = 1.0, p: Adaptation = A) -> Learnt:
    return learn_valve(so_far, True, missing_v, u_v, OPEN, 0.1, P.h, P.valve, p)


def force_says(
    so_far: Learnt, force_n: float = 60.0, v: float = 0.01, goal_v: float = 0.01, innovation_m: float = 0.0
) -> Learnt:
    return learn_force(
        so_far, force_n, 40.0, v, goal_v, 10.0, innovation_m, P.h, 15.0, P.friction, P.motion, A
    )


MOVING = Learnt(usable=True, moving=True)


def in_bounds(learnt: Learnt) -> bool:
    edges = (P.valve.dead_zone_v + learnt.edge_plus_v, P.valve.dead_zone_v + learnt.edge_minus_v)
    pairs = (
        *((edge, A.edges) for edge in edges),
        (learnt.flow, A.flow),
        (learnt.lag, A.lag),
        (learnt.friction, A.friction),
        (learnt.stiffness, A.stiffness),
        (learnt.load_n, A.load),
        (learnt.mass, A.mass),
    )
    return all(r.least - 1e-12 <= value <= r.most + 1e-12 for value, r in pairs)


# within bounds, whatever comes


@given(FINITE, FINITE, FINITE, FINITE, FINITE, FINITE, FINITE, st.booleans())
def test_one_sample_of_anything_stays_within_bounds(
    missing: float, u: float, y: float, v: float, force: float, goal_v: float, innovation: float, fresh: bool
) -> None:
    learnt = learn_valve(MOVING, fresh, missing, u, Spool(y, v), v, P.h, P.valve, A)
    learnt = learn_force(learnt, force, missing, v, goal_v, y, innovation, P.h, 15.0, P.friction, P.motion, A)
    assert in_bounds(learnt)
    assert all(math.isfinite(float(x)) for x in (*learnt[:VALUES], *learnt.shake))  # type: ignore[arg-type]


def wandered(ticks: int) -> None:
    """Ticks of noise, pushes, saturation and sticking in turn, each of them for a while."""
    chance = random.Random(1)
    learnt, scale, goal_v = Learnt(), 1.0, 0.0
    for i in range(ticks):
        if i % 97 == 0:
            scale, goal_v = 10.0 ** chance.uniform(-3.0, 3.0), chance.choice((0.0, 0.05, -0.05, 0.5, -0.5))
        v = goal_v * chance.choice((0.0, 1.0, 1.2)) + chance.gauss(0.0, 1e-3)
        y = chance.gauss(0.0, scale)
        p = as_learnt(P, learnt)
        learnt = learn_valve(
            learnt,
            chance.random() > 0.01,
            chance.gauss(0.0, scale),
            opening(y, p.valve),
            Spool(y, chance.gauss(0.0, 100.0)),
            v,
            P.h,
            P.valve,
            A,
        )
        learnt = learn_force(
            learnt,
            chance.gauss(0.0, 100.0 * scale),
            chance.gauss(0.0, 40.0),
            v,
            goal_v,
            chance.gauss(0.0, 100.0 * scale),
            chance.gauss(0.0, 1e-6 * scale),
            P.h,
            p.cylinder.M,
            P.friction,
            P.motion,
            A,
        )
        assert in_bounds(learnt)
    assert all(math.isfinite(float(x)) for x in (*learnt[:VALUES], *learnt.shake))  # type: ignore[arg-type]


def test_ten_thousand_random_ticks_stay_within_bounds() -> None:
    wandered(10_000)


@pytest.mark.slow
def test_a_million_random_ticks_stay_within_bounds() -> None:
    wandered(1_000_000)


STUCK = PLANT.friction._replace(coulomb_n=900.0, static_n=1200.0)
TROUBLES: dict[str, tuple[PlantParameters, Sine, float]] = {  # rig, what it is asked, push [N]
    "none": (PLANT, AXIS.reference, 0.0),
    "noise": (PLANT._replace(pressure_noise_pa=3e4), AXIS.reference, 0.0),
    "coarse sensors": (
        PLANT._replace(encoder_resolution_m=1e-4, pressure_resolution_pa=2e4),
        AXIS.reference,
        0.0,
    ),
    "stuck": (PLANT._replace(friction=STUCK), AXIS.reference, 0.0),
    "saturated": (PLANT, AXIS.reference._replace(omega_rad_s=25.0), 0.0),
    "throttled": (
        PLANT._replace(cylinder=PLANT.cylinder._replace(c1=0.1 * PLANT.cylinder.c1)),
        AXIS.reference,
        0.0,
    ),
    "pushed": (PLANT, AXIS.reference, 400.0),
    "slow valve": (
        PLANT._replace(valve=PLANT.valve._replace(omega_rad_s=0.1 * PLANT.valve.omega_rad_s)),
        AXIS.reference,
        0.0,
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("trouble", TROUBLES)
def test_nothing_winds_up_in_a_million_ticks_of_trouble(trouble: str) -> None:
    run, lsb_v = compiled_trial(), LOADED.codecs.command_lsb_v
    bench, joins, begin = (
        trial.begin(AXIS.reference.centre_m, P, PLANT, 1),
        True,
        rest(AXIS.reference.centre_m),
    )

    def go(seconds: float, plant: PlantParameters, reference: Sine, push_n: float) -> trial.Verdict:
        nonlocal bench, joins, begin
        there = way(septic(1.0, begin, sine(0.0, reference)))
        course, ticks = trial.Errand(there, reference, push_n), round(seconds / P.h)
        bench, verdict = run(bench, joins, ticks, 0, 1e-5, course, P, plant, lsb_v)
        joins, begin = False, sine(seconds - there.T, reference)
        return verdict  # type: ignore[no-any-return]

    for _ in range(5):
        go(25.0, *TROUBLES[trouble])
        learnt = bench.state.learnt
        assert in_bounds(learnt)
        assert all(math.isfinite(float(x)) for x in (*learnt[:VALUES], *learnt.shake))  # type: ignore[arg-type]
    go(30.0, *TROUBLES["none"])
    after = go(10.0, *TROUBLES["none"])
    assert after.rms_m < 2e-5
    assert after.max_m < 1.5e-4


@pytest.mark.slow
@pytest.mark.parametrize(
    "wrong",
    [
        Learnt(0.1, -0.05, 1.3, 1.8, 0.7, 1.0, 20.0),
        Learnt(-0.1, 0.1, 0.7, 1.0, 1.5, 1.0, -50.0),
        Learnt(0.3, 0.3, 2.0, 4.0, 3.0, 20.0, 600.0),
    ],
)
def test_all_values_together_are_drawn_to_the_truth(wrong: Learnt) -> None:
    learnt = moved(PLANT, 300.0, learnt=wrong)
    assert max(abs(learnt.edge_plus_v), abs(learnt.edge_minus_v)) < 0.02
    factors = (learnt.flow, learnt.lag, learnt.friction)
    assert factors == pytest.approx((1.0,) * 3, abs=0.2)
    assert abs(learnt.load_n) < 2.0


@pytest.mark.slow
def test_from_every_corner_of_the_bounds_the_load_is_followed_soon() -> None:
    x = AXIS.reference.centre_m
    course = trial.Errand(way(septic(1.0, rest(x), sine(0.0, AXIS.reference))), AXIS.reference, 0.0)
    start = trial.begin(x, P, PLANT, 1)
    edges = (A.edges.least - P.valve.dead_zone_v, A.edges.most - P.valve.dead_zone_v)
    ends = [(r.least, r.most) for r in (A.flow, A.lag, A.friction, A.load, A.mass)]
    worst_m = 0.0
    for edge, flow, lag, friction, load_n, mass in itertools.product(edges, *ends):
        learnt = Learnt(edge, edge, flow, lag, friction, 1.0, load_n, mass)
        bench = start._replace(state=start.state._replace(learnt=learnt))
        _, verdict = compiled_trial()(
            bench, True, 31_000, 21_000, 1e-5, course, P, PLANT, LOADED.codecs.command_lsb_v
        )
        worst_m = max(worst_m, verdict.rms_m)
    assert worst_m < 1.5e-4


def test_the_averaged_gradients_contract(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[tuple[float, float]] = []  # opening, and what the spool lags behind [V]
    valve = P.valve

    def learn(so_far: Learnt, fresh: bool, missing_v: float, u_v: float, spool: Spool, *more: Any) -> Learnt:
        found = learn_valve(so_far, fresh, missing_v, u_v, spool, *more)
        if found.usable and so_far.moving and u_v != 0.0:
            seen.append((u_v, 2.0 * valve.zeta / valve.omega_rad_s * spool.rate_v_s))
        return found

    monkeypatch.setattr(step, "learn_valve", learn)
    bench, x = trial.begin(AXIS.reference.centre_m, P, PLANT, 1), AXIS.reference.centre_m
    course = trial.Errand(way(septic(1.0, rest(x), sine(0.0, AXIS.reference))), AXIS.reference, 0.0)
    for i in range(3000):  # the way there, and a period
        bench = trial.tick(bench, i * P.h, i == 0, course, P, PLANT, 0.0)
    u, behind = np.array(seen[-1900:]).T
    regressors = np.stack((-1.0 * (u > 0.0), 1.0 * (u < 0.0), u, -behind))
    one = np.ones_like(u)
    weights = np.stack((one, one, 1.0 / (OPENING_V**2 + u * u), 20.0 / (LAG_V**2 + behind * behind)))
    rates_per_s = np.linalg.eigvals((weights * regressors) @ regressors.T / len(u))
    assert (rates_per_s.real > 1.0 / 200.0).all()
    assert (weights * regressors * regressors * P.h).max() < 0.1  # of an error, taken away by one sample


# frozen where nothing is to be had


@pytest.mark.parametrize(
    ("so_far", "fresh", "u_v", "spool", "v"),
    [
        (MOVING, False, 1.0, OPEN, 0.1),  # no set, or a tick skipped
        (MOVING, True, 4.9, Spool(4.95, 0.0), 0.1),  # saturated
        (MOVING, True, 1.0, OPEN, 0.0),  # the load sticks
        (MOVING, True, 0.0, Spool(0.05, 0.0), 0.1),  # within the dead zone
        (Learnt(), True, 1.0, OPEN, 0.1),  # the reference is at rest
    ],
)
def test_the_valve_is_not_learnt(so_far: Learnt, fresh: bool, u_v: float, spool: Spool, v: float) -> None:
    learnt = learn_valve(so_far, fresh, 0.2, u_v, spool, v, P.h, P.valve, A)
    assert learnt[:VALUES] == so_far[:VALUES]
    assert not learnt.moving


@pytest.mark.parametrize(
    ("so_far", "v", "goal_v"),
    [
        (Learnt(), 0.1, 0.1),  # not usable
        (MOVING, 0.0, 0.1),  # the load sticks
        (MOVING, -0.1, 0.1),  # or goes elsewhere
        (MOVING, 0.1, 1e-3),  # the reference is at rest
    ],
)
def test_the_force_is_not_learnt(so_far: Learnt, v: float, goal_v: float) -> None:
    learnt = force_says(so_far, v=v, goal_v=goal_v, innovation_m=1e-4)
    assert learnt[:VALUES] == so_far[:VALUES]
    assert learnt.moving == (abs(goal_v) > 2e-3)


def test_a_saturated_valve_freezes_the_force_too() -> None:
    saturated = learn_valve(MOVING, True, 0.2, 4.9, Spool(5.0, 0.0), 0.1, P.h, P.valve, A)
    assert force_says(saturated)[:VALUES] == MOVING[:VALUES]


@pytest.mark.slow
def test_noise_at_rest_changes_nothing() -> None:
    assert moved(PLANT._replace(pressure_noise_pa=1000.0), 10.0, at_rest=True)[:VALUES] == Learnt()[:VALUES]


# what one sample does


def test_more_flow_than_believed_draws_the_edge_in_and_the_gain_up() -> None:
    plus, minus = valve_says(MOVING), valve_says(MOVING, -0.2, -1.0)
    assert plus.edge_plus_v < 0.0 == plus.edge_minus_v
    assert minus.edge_minus_v < 0.0 == minus.edge_plus_v
    assert plus.flow > 1.0 < minus.flow


def test_one_odd_reading_is_no_valve() -> None:
    assert abs(valve_says(MOVING, 1e6).edge_plus_v) <= 1.01 * P.h * P.valve.u_max_v


def test_a_valve_without_lag_has_none_to_learn() -> None:
    quick = P.valve._replace(omega_rad_s=0.0)
    assert learn_valve(MOVING, True, -0.2, 1.0, OPEN, 0.1, P.h, quick, A).lag == 1.0
    assert valve_says(MOVING, -0.2).lag > 1.0


def test_without_friction_force_is_load() -> None:
    none = P.friction._replace(coulomb_n=0.0, static_n=0.0)
    learnt = learn_force(MOVING, 60.0, 0.0, 0.1, 0.1, 0.0, 0.0, P.h, 15.0, none, P.motion, A)
    assert (learnt.friction, learnt.stiffness) == (1.0, 1.0)
    assert learnt.load_n > 0.0


def bent_too_soon(sign: float, plain: bool) -> Learnt:
    """After a sample just behind a reversal, with more friction than bristles have that are as configured."""
    return learn_force(
        MOVING._replace(plain=plain),
        sign * 60.0,
        sign * 5.0,
        sign * 0.01,
        sign * 0.01,
        0.0,
        0.0,
        P.h,
        15.0,
        P.friction,
        P.motion,
        A,
    )


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_friction_that_comes_too_soon_is_of_stiffer_bristles(sign: float) -> None:
    learnt = bent_too_soon(sign, plain=True)
    assert 1.0 < learnt.stiffness <= 1.01
    assert learnt.plain


def test_bristles_are_stiff_enough_where_the_reference_meets_more_friction_than_the_load() -> None:
    lags = learn_force(
        MOVING._replace(plain=True), 60.0, 65.0, 0.01, 0.01, 0.0, 0.0, P.h, 15.0, P.friction, P.motion, A
    )
    assert lags.stiffness == 1.0


@pytest.mark.parametrize(
    ("coulomb_n", "step_m", "most"),
    [(36.0, 1e-6, 20.0), (36.0, 0.0, 20.0), (0.0, 0.0, 20.0), (36.0, 40e-6, 36.0 / 10.8), (5.0, 40e-6, 1.0)],
)
def test_bristles_are_no_stiffer_than_the_encoder_can_tell(
    coulomb_n: float, step_m: float, most: float
) -> None:
    assert stiffest(coulomb_n, 9e4, step_m) == pytest.approx(most)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_force_that_was_there_before_the_reversal_says_nothing_of_bristles(sign: float) -> None:
    learnt = bent_too_soon(sign, plain=False)
    assert learnt.stiffness == 1.0
    assert not learnt.plain


@pytest.mark.parametrize(("beyond_n", "plain"), [(0.0, True), (6.0, True), (9.0, False), (-9.0, False)])
def test_bristles_bent_for_good_tell_whether_all_is_explained(beyond_n: float, plain: bool) -> None:
    f = P.friction
    v = 0.05
    steady_n = stribeck(v, f) + f.viscous_n_s_m * v
    for before in (True, False):
        learnt = learn_force(
            MOVING._replace(plain=before, bent_m=stribeck(v, f) / f.sigma0_n_m),
            steady_n + beyond_n,
            steady_n,
            v,
            v,
            0.0,
            0.0,
            P.h,
            15.0,
            f,
            P.motion,
            A,
        )
        assert learnt.plain is plain


# what comes of it


def test_nothing_learnt_is_the_configuration() -> None:
    assert as_learnt(P, Learnt()) == P
    off = P._replace(adaptation=Adaptation())
    assert as_learnt(off, Learnt(edge_plus_v=0.1)) is off


@given(st.floats(-0.09, 0.3), st.floats(-0.09, 0.3), st.floats(-4.0, 4.0))
def test_edges_apart_are_crossed_as_one(plus: float, minus: float, u: float) -> None:
    valve = valve_learnt(P.valve, Learnt(edge_plus_v=plus, edge_minus_v=minus))
    assert opening(dead_zone_inverse(u, valve, 0.0), valve) == pytest.approx(u, abs=1e-12)
    edge = 1e-9
    assert opening(P.valve.dead_zone_v + plus + edge, valve) > 0.0
    assert opening(P.valve.dead_zone_v + plus - edge, valve) == 0.0
    assert opening(-P.valve.dead_zone_v - minus - edge, valve) < 0.0
    assert opening(-P.valve.dead_zone_v - minus + edge, valve) == 0.0


def test_factors_go_where_they_belong() -> None:
    learnt = Learnt(flow=1.2, lag=2.0, friction=1.5, stiffness=3.0, mass=0.5)
    assert cylinder_learnt(P.cylinder, learnt).c1 == 1.2 * P.cylinder.c1
    assert friction_learnt(P.friction, learnt).coulomb_n == 1.5 * P.friction.coulomb_n
    p = as_learnt(P, learnt)
    assert p.sliding.M == p.cylinder.M == 0.5 * P.cylinder.M
    assert p.lead_s - P.lead_s == pytest.approx(2.0 * P.valve.zeta / P.valve.omega_rad_s)
    assert as_learnt(P._replace(lead_s=0.0), learnt).lead_s == 0.0


def test_a_snapshot_from_before_there_was_adaptation_is_read() -> None:
    state = start(0.5, 3e5, 3e5, 6e5, P)
    old = json.loads(to_json(state))
    del old["learnt"]
    assert from_json(ControllerState, json.dumps(old)) == state


@pytest.mark.parametrize("dead_zone_v", [0.0, 0.13, 0.2])
def test_the_edges_are_found(dead_zone_v: float) -> None:
    learnt = moved(PLANT._replace(valve=PLANT.valve._replace(dead_zone_v=dead_zone_v)), 21.0)
    assert P.valve.dead_zone_v + learnt.edge_plus_v == pytest.approx(dead_zone_v, abs=0.015)
    assert P.valve.dead_zone_v + learnt.edge_minus_v == pytest.approx(dead_zone_v, abs=0.015)


def test_edges_that_differ_are_found() -> None:
    valve = PLANT.valve._replace(dead_zone_v=0.12, centre_v=0.04)
    learnt = moved(PLANT._replace(valve=valve), 21.0)
    assert P.valve.dead_zone_v + learnt.edge_plus_v == pytest.approx(0.16, abs=0.015)
    assert P.valve.dead_zone_v + learnt.edge_minus_v == pytest.approx(0.08, abs=0.015)


def test_flow_lag_friction_stiffness_and_mass_are_drawn_to_the_truth() -> None:
    cylinder, friction, valve = PLANT.cylinder, PLANT.friction, PLANT.valve
    assert moved(PLANT._replace(cylinder=cylinder._replace(c1=0.7 * cylinder.c1)), 21.0).flow < 0.85
    assert moved(PLANT._replace(valve=valve._replace(omega_rad_s=0.3 * valve.omega_rad_s)), 21.0).lag > 2.5
    less = friction._replace(coulomb_n=0.7 * friction.coulomb_n, static_n=0.7 * friction.static_n)
    assert 0.6 < moved(PLANT._replace(friction=less), 21.0).friction < 0.8
    assert moved(PLANT._replace(friction=friction._replace(sigma0_n_m=1e6)), 21.0).stiffness > 3.0
    assert moved(PLANT._replace(cylinder=cylinder._replace(M=0.5 * cylinder.M)), 21.0).mass < 0.8


def test_a_rig_that_is_as_configured_leaves_the_values_there() -> None:
    learnt = moved(PLANT, 31.0)
    assert max(abs(learnt.edge_plus_v), abs(learnt.edge_minus_v)) < 5e-3
    factors = (learnt.flow, learnt.lag, learnt.friction, learnt.stiffness, learnt.mass)
    assert factors == pytest.approx((1.0,) * 5, abs=0.05)
    assert abs(learnt.load_n) < 2.0


def test_what_is_switched_off_stays_as_it_is() -> None:
    c = LOADED.config
    off = dict.fromkeys(("dead_zone", "flow", "lag", "friction", "load", "mass"), False)
    adaptation = c.control.adaptation.model_copy(update=off)
    c = c.model_copy(update={"control": c.control.model_copy(update={"adaptation": adaptation})})
    p = conversions.controller_of(c)
    odd = PLANT._replace(valve=PLANT.valve._replace(dead_zone_v=0.2))
    assert moved(odd, 3.0, p)[:VALUES] == Learnt()[:VALUES]
