"""A load at rest: left alone within a band, nudged beside it, given back to the law beyond."""

from __future__ import annotations

import math
import random
from functools import cache
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pneud.config.conversions import axis_of, plant_of
from pneud.control import standstill
from pneud.control.adaptation import Adaptation
from pneud.control.feedforward import recalled
from pneud.control.model import calmer
from pneud.control.motion import at_rest, correct, triple_pole
from pneud.control.reference import Sine, rest, septic, sine, way
from pneud.control.standstill import CLOSED, LAW, NUDGED, Standstill, StandstillState
from pneud.control.step import Controller
from pneud.loading import load
from pneud.physics.friction import Friction
from pneud.physics.plant import PlantParameters
from pneud.rt.folders import cache_folder
from pneud.signals import Reference
from pneud.study import trial
from pneud.study.trial import Errand, Pair, Verdict
from pure2c import BuildError, compile_functions

P = Standstill(
    enter_m=6e-6,
    leave_m=11e-6,
    near_m=1e-4,
    far_m=3e-4,
    hunts_m=1e-4,
    leave_m_s=4e-3,
    mass_kg=1e5 / 80.0**2,
    swing=80,
    smooth=1.0,
    stuck=20,
    patience=100,
    grace=80,
    restless=0.02,
    restless_v=0.03,
    nudge_v=0.5,
    stick_m=1e-6,
    stick=10,
    held=0.1,
)
F = Friction(40.0, 60.0, 0.02, 50.0, 1e5, 300.0)
STILL = rest(0.4)
NOSINE = Sine(0.4, 0.0, 0.0)
SWING = Sine(0.4, 0.1, math.pi)
RESTLESS = {(1e-6, 5e5): 0.1}  # here the law has the load back again and again
numbers = st.floats(-1e3, 1e3)


def stand(s: StandstillState, **changes: Any) -> StandstillState:
    seen: dict[str, Any] = {
        "error_m": 5e-5,
        "velocity_m_s": 0.0,
        "net_n": 0.0,
        "force_n": 100.0,
        "friction_n": 0.0,
        "still": True,
    }
    return standstill.stand(s, **(seen | {"f": F} | changes), p=P)


def test_a_reference_stands_still_when_nothing_of_it_moves_now_or_later() -> None:
    assert standstill.is_still(STILL, STILL)
    for moving in (STILL._replace(velocity_m_s=1e-9), STILL._replace(acceleration_m_s2=1e-9)):
        assert not standstill.is_still(moving, STILL)
        assert not standstill.is_still(STILL, moving)


def test_readings_are_the_same_within_a_step_of_the_first() -> None:
    s = StandstillState()
    for position, same in (
        (0.4, 0),
        (0.4 + 0.9e-6, 1),
        (0.4 - 0.9e-6, 2),
        (0.4 + 1.1e-6, 0),
        (0.4 + 1.2e-6, 1),
    ):
        s = standstill.read(s, position, P)
        assert s.same == same
    alone = s._replace(mode=CLOSED, same=P.stick)
    assert standstill.is_held(alone, P)
    assert not standstill.is_held(alone._replace(mode=LAW), P)
    assert not standstill.is_held(alone._replace(same=P.stick - 1), P)
    assert not standstill.is_held(alone, P._replace(held=0.0))


def test_the_law_has_a_while_before_it_gives_way() -> None:
    p = P._replace(settle=1000)
    assert standstill.stand(StandstillState(ticks=998), 0.0, 0.0, 0.0, 0.0, 0.0, True, F, p).mode == LAW
    assert standstill.stand(StandstillState(ticks=999), 0.0, 0.0, 0.0, 0.0, 0.0, True, F, p).mode == CLOSED


def test_the_law_has_half_its_while_again_until_giving_way_was_of_no_use_too_often() -> None:
    p = P._replace(settle=1000, again=3)
    s = StandstillState(mode=CLOSED, ticks=P.grace)
    for tries, after in ((1, 500), (2, 500), (3, 1), (3, 1)):
        s = standstill.stand(s, 4e-4, 0.0, 0.0, 0.0, 0.0, True, F, p)
        assert (s.mode, s.ticks, s.tries) == (LAW, 0, tries)
        assert standstill.is_firm(s, p) == (tries < 3)
        if after > 1:
            s = standstill.stand(s._replace(ticks=after - 2), 0.0, 0.0, 0.0, 0.0, 0.0, True, F, p)
            assert s.mode == LAW
        s = standstill.stand(s, 0.0, 0.0, 0.0, 0.0, 0.0, True, F, p)
        assert s.mode == CLOSED
        s = s._replace(mode=CLOSED, ticks=P.grace)
    assert standstill.given_back(s._replace(tries=5), p).tries == 5


def test_a_load_hardly_off_the_band_is_left_to_swing_out_the_first_time() -> None:
    p, s = P._replace(wait_m=16e-6), StandstillState(mode=CLOSED, ticks=P.grace)
    assert standstill.stand(s, 15e-6, 0.0, 0.0, 0.0, 0.0, True, F, p).mode == CLOSED
    assert standstill.stand(s, 17e-6, 0.0, 0.0, 0.0, 0.0, True, F, p).mode == LAW
    late = s._replace(ticks=P.grace + 4 * P.swing)
    assert standstill.stand(late, 15e-6, 0.0, 0.0, 0.0, 0.0, True, F, p).mode == LAW


def test_a_load_is_heard_of_calmly_once_it_has_stood_for_a_while() -> None:
    p, s = P._replace(calm=100), StandstillState(ticks=99)
    assert not standstill.is_calm(s, p)
    assert standstill.is_calm(s._replace(ticks=100), p)
    assert standstill.is_calm(s._replace(mode=CLOSED, ticks=0), p)
    assert not standstill.is_calm(s._replace(mode=CLOSED), P)


def test_coarse_encoders_are_heard_of_calmly_where_the_law_can_damp_a_swing() -> None:
    coarse, fine = rig(5e-6, 1e5)[0], rig(3.9e-6, 1e5)[0]
    assert rig(4.999e-6, 1e5)[0].standstill.trusts  # as it is found of one of 5 µm
    s = coarse.standstill
    assert (s.calm, s.again, s.trusts) == (100, 3, True)
    assert s.leave_m < s.wait_m < s.near_m
    assert s.filter[:3] == pytest.approx(triple_pole(316.0 / 2.5, coarse.h)[:3])
    assert s.filter.more_gamma + s.filter.gamma == pytest.approx(coarse.motion.gamma)
    for other in (fine, rig(5e-6, 1e5, moving_mass_kg=3.0)[0], rig(5e-6, 1e5, law_bristles_n_m=4e5)[0]):
        s = other.standstill
        assert (s.calm, s.again, s.trusts, s.wait_m, s.filter) == (0, 1, False, 0.0, other.motion)


@given(st.floats(-1e-3, 1e-3), st.floats(0.0, 5e-5))
def test_a_calmer_filter_takes_no_more_of_a_reading_than_the_usual_one(off_m: float, blind_m: float) -> None:
    usual = triple_pole(316.0, 1e-3, blind_m)
    calm = calmer(usual._replace(noise_m=1e-5), 1e-3)
    before = at_rest(0.4, 100.0, 0.0)
    a, b = (correct(before, 0.4 + off_m, 15.0, 1e-3, p) for p in (calm, usual))
    for x, y, at in ((a.x, b.x, 0.4), (a.v, b.v, 0.0), (a.F, b.F, before.F)):
        assert abs(x - at) <= abs(y - at) + 1e-9
        assert (x - at) * (y - at) >= 0.0


def test_the_law_keeps_the_valve_shut_within_the_band_where_it_asks_for_little() -> None:
    p = P._replace(shut_v=0.1)
    assert standstill.keeps_shut(6e-6, -0.1, False, p)
    assert not standstill.keeps_shut(6.1e-6, 0.0, False, p)
    assert standstill.keeps_shut(-11e-6, 0.1, True, p)
    assert not standstill.keeps_shut(11.1e-6, 0.0, True, p)
    assert not standstill.keeps_shut(0.0, 0.11, True, p)


QUIET = P._replace(calm=100, settle=1000, again=3, quiet=0.2)
SOFT = F._replace(sigma0_n_m=0.9 * standstill.SLOW_RAD_S**2 * P.mass_kg)


def test_a_quiet_law_keeps_the_load_for_as_long_as_it_does_not_ring() -> None:
    s = StandstillState(ticks=5_000)
    assert standstill.is_quiet(s, SOFT, QUIET)
    for other in (s._replace(ticks=99), s._replace(mode=CLOSED), s._replace(tries=1)):
        assert not standstill.is_quiet(other, SOFT, QUIET)
    assert not standstill.is_quiet(s, SOFT, QUIET._replace(quiet=0.0))
    assert not standstill.is_quiet(s, F, QUIET)  # stiffer, as has been learnt
    assert standstill.stand(s, 0.0, 0.0, 0.0, 0.0, 0.0, True, SOFT, QUIET).mode == LAW
    for ringing, error_m in ((s._replace(restless_v=0.041), 0.0), (s, -1.1 * P.near_m)):
        after = standstill.stand(ringing, error_m, 0.0, 0.0, 0.0, 0.0, True, SOFT, QUIET)
        assert after.tries >= 1
        assert not standstill.is_quiet(after, SOFT, QUIET)
    arriving = s._replace(restless_v=0.041, ticks=398)  # as restless as the law has been before it
    assert standstill.stand(arriving, 0.0, 0.0, 0.0, 0.0, 0.0, True, SOFT, QUIET).tries == 0


def test_a_quiet_law_gives_what_it_wants_for_a_while_and_until_that_is_next_to_nothing() -> None:
    s, given = StandstillState(), []
    for opening_v in [0.05] * 50 + [0.1] * 5 + [0.0] * 15 + [-0.2] * 3:
        s = standstill.quieted(s, opening_v, QUIET)
        assert s.given_v in (0.0, s.wanted_v)
        given.append(s.given_v)
    assert given[:50] == [0.0] * 50
    assert [x > 0.0 for x in given[50:70]] == [False] + [True] * 13 + [False] * 6
    assert [x < 0.0 for x in given[70:]] == [False, True, True]
    assert math.isnan(standstill.quieted(s, math.nan, QUIET).given_v)
    moving = standstill.stand(s, 0.0, 0.0, 0.0, 0.0, 0.0, False, SOFT, QUIET)
    assert (moving.wanted_v, moving.given_v) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("seen", "mode"),
    [
        ({"error_m": 5.9e-6}, CLOSED),
        ({"error_m": -5.9e-6}, CLOSED),
        ({"error_m": 6.1e-6}, LAW),
        ({"error_m": 0.0, "velocity_m_s": 0.9 * 6e-6 * 80.0}, CLOSED),
        ({"error_m": 0.0, "velocity_m_s": 1.1 * 6e-6 * 80.0}, LAW),  # it would ring
        ({"error_m": 5e-6, "net_n": 0.59}, CLOSED),  # would sag towards the target
        ({"error_m": -5e-6, "net_n": 0.59}, LAW),  # and here away from it
        ({"error_m": 0.0, "still": False}, LAW),
    ],
)
def test_the_valve_closes_where_the_load_would_come_to_rest_in_the_band(
    seen: dict[str, Any], mode: int
) -> None:
    assert stand(StandstillState(), **seen).mode == mode


def test_a_closed_valve_stays_so_until_the_wider_band_is_left() -> None:
    closed = StandstillState(mode=CLOSED, ticks=P.grace)
    assert stand(closed, error_m=10.9e-6).mode == CLOSED
    assert stand(closed, error_m=11.1e-6).mode == LAW
    assert stand(closed, error_m=11.1e-6).ticks == 0
    assert stand(closed, error_m=0.0, velocity_m_s=4.1e-3).mode == LAW
    assert stand(closed._replace(same=P.stuck), error_m=11.1e-6).mode == NUDGED


def test_a_load_that_has_hunted_is_given_time_to_come_to_rest() -> None:
    hunting = StandstillState(restless_v=0.031, ticks=P.patience)
    closed = stand(hunting)
    assert (closed.mode, closed.ticks) == (CLOSED, 0)
    assert stand(hunting._replace(ticks=P.patience - 1)).mode == LAW
    assert stand(hunting._replace(restless_v=0.029)).mode == LAW
    assert stand(hunting, error_m=1.1e-4).mode == LAW
    assert stand(closed, velocity_m_s=0.02).mode == CLOSED  # for a moment it swings by 0.25 mm
    assert stand(closed, velocity_m_s=0.03).mode == LAW  # and here by 0.38 mm
    assert stand(closed, error_m=3.1e-4).mode == LAW
    farther = standstill.stand(hunting, 2.9e-4, 0.0, 0.0, 0.0, 0.0, True, F, P._replace(hunts_m=3e-4))
    assert (farther.mode, farther.ticks) == (CLOSED, 0)


@pytest.mark.parametrize("towards", [1.0, -1.0])
def test_a_load_that_runs_away_from_its_target_is_pushed_and_does_not_hunt(towards: float) -> None:
    hunting = StandstillState(restless_v=0.1, ticks=P.patience)
    away = stand(hunting, error_m=2e-5 * towards, velocity_m_s=-4.1e-3 * towards)
    assert (away.mode, away.tries) == (LAW, 0)
    assert stand(hunting, error_m=2e-5 * towards, velocity_m_s=4.1e-3 * towards).mode == CLOSED
    assert stand(hunting, error_m=2e-5 * towards, velocity_m_s=-3.9e-3 * towards).mode == CLOSED


def test_what_sticks_beside_the_band_is_nudged_towards_it_as_far_as_friction_allows() -> None:
    stuck = StandstillState(same=P.stuck)
    assert stand(stuck, error_m=5e-5).step_n == pytest.approx(0.8 * 1e5 * 5e-5)
    assert stand(stuck, error_m=-5e-5).step_n == pytest.approx(-0.8 * 1e5 * 5e-5)
    assert stand(stuck, error_m=1e-4).step_n == pytest.approx(8.0)
    found = stuck._replace(stiffness_n_m=1e6)
    assert stand(found, error_m=9e-5).step_n == pytest.approx(0.3 * 60.0)
    assert stand(found, error_m=9e-5, friction_n=50.0).step_n == pytest.approx(0.3 * 10.0)
    assert stand(found, error_m=9e-5, friction_n=70.0).step_n == pytest.approx(0.01 * 60.0)
    assert stand(found, error_m=-9e-5, friction_n=50.0).step_n == pytest.approx(-0.3 * 60.0)
    assert stand(stuck, error_m=1.1e-4).mode == LAW


def test_a_step_of_force_takes_a_swing_and_a_half_and_teaches_the_stiffness() -> None:
    nudged = stand(StandstillState(same=P.stuck), error_m=5e-5)
    assert stand(nudged._replace(ticks=118), error_m=5e-5).ticks == 119
    over = nudged._replace(ticks=120, same=P.stick)
    learnt = stand(over, error_m=3e-5, force_n=104.0)  # 4 N for 20 µm
    assert learnt.stiffness_n_m == pytest.approx(2e5)
    assert learnt.step_n == pytest.approx(0.8 * 2e5 * 3e-5)
    assert stand(over, error_m=5e-5, force_n=104.0).stiffness_n_m == pytest.approx(2e5)  # at most twice
    assert stand(over, error_m=1e-5, force_n=101.3).stiffness_n_m == pytest.approx(0.5e5)  # at least half
    assert stand(over, error_m=3e-5, force_n=101.0).stiffness_n_m == 0.0  # the force has not come
    assert stand(over, error_m=0.0, force_n=104.0).mode == CLOSED
    assert stand(nudged, error_m=-1e-6).mode == CLOSED  # past the target
    moving = over._replace(same=P.stick - 1)
    assert stand(moving, error_m=3e-5, force_n=104.0).ticks == 121  # it has to come to rest
    assert stand(moving._replace(ticks=320), error_m=3e-5, force_n=104.0).ticks == 0
    back = stand(StandstillState(same=P.stuck), error_m=-5e-5)._replace(ticks=120)
    assert stand(back, error_m=-3e-5, force_n=96.0).stiffness_n_m == pytest.approx(2e5)


def test_a_step_that_has_not_moved_the_load_is_followed_by_one_of_twice_its_size() -> None:
    found = StandstillState(same=P.stuck, stiffness_n_m=1e6)
    nudged = stand(found, error_m=9e-5, friction_n=59.0)  # friction seems to have nothing left
    sizes = [nudged.step_n]
    for _ in range(6):
        nudged = stand(nudged._replace(ticks=120, same=P.stick), error_m=9e-5, friction_n=59.0)
        sizes.append(nudged.step_n)
    assert sizes == pytest.approx([0.6, 1.2, 2.4, 4.8, 9.6, 18.0, 18.0])
    moved = stand(nudged._replace(ticks=120, same=P.stick), error_m=8e-5, friction_n=59.0)
    assert moved.step_n == pytest.approx(0.6)


def test_a_load_that_swings_again_and_again_beside_a_closed_valve_is_left_to_swing_out() -> None:
    beside = StandstillState(mode=CLOSED, ticks=P.grace)
    assert stand(beside, error_m=5e-5).mode == LAW
    assert stand(beside._replace(tries=1), error_m=5e-5).mode == LAW
    swinging = beside._replace(tries=2)
    assert stand(swinging, error_m=5e-5).mode == CLOSED
    assert stand(swinging, error_m=1.1e-4).mode == LAW
    assert stand(swinging._replace(ticks=P.grace + 4 * P.swing), error_m=5e-5).mode == LAW
    hunting = StandstillState(ticks=P.patience, restless_v=0.1)
    assert stand(hunting, error_m=5e-5, velocity_m_s=3e-3)[:2] == (CLOSED, 0)
    assert stand(hunting, error_m=5e-5, velocity_m_s=3e-3).tries == 1
    assert stand(swinging, error_m=5e-5, still=False).tries == 0


def test_a_small_step_of_force_takes_less_than_a_swing() -> None:
    s = StandstillState(mode=NUDGED, ticks=0, from_n=100.0, step_n=0.15)
    u = standstill.nudge(s, 100.0, 1e-3, 500.0, 400.0, P)  # 20 ticks at 0.015 V
    assert u == pytest.approx(0.015 + 40.0 * 0.15 / 20 / 500.0)
    assert standstill.nudge(s._replace(ticks=20), 100.15, 1e-3, 500.0, 400.0, P) == 0.0
    tiny = s._replace(step_n=1e-4)
    assert standstill.nudge(tiny._replace(ticks=1), 100.0, 1e-3, 500.0, 400.0, P) == 0.0


def test_a_nudge_leads_the_force_along_its_step() -> None:
    s = StandstillState(mode=NUDGED, ticks=39, from_n=100.0, step_n=8.0)
    on_time = standstill.nudge(s, 104.0, 1e-3, 500.0, 400.0, P)
    assert on_time == pytest.approx(8.0 / 0.08 / 500.0)
    assert standstill.nudge(s, 108.0, 1e-3, 500.0, 400.0, P) == pytest.approx(-60.0 / 400.0)
    assert standstill.nudge(s, 0.0, 1e-3, 500.0, 400.0, P) == P.nudge_v
    assert standstill.nudge(s._replace(ticks=80), 108.05, 1e-3, 500.0, 400.0, P) == 0.0
    assert standstill.nudge(s._replace(mode=CLOSED), 0.0, 1e-3, 500.0, 400.0, P) == 0.0


@given(st.lists(st.tuples(numbers, numbers, numbers, numbers, numbers, st.booleans()), max_size=60))
def test_whatever_comes_the_state_is_sound(
    ticks: list[tuple[float, float, float, float, float, bool]],
) -> None:
    s = StandstillState()
    for error, velocity, net, force, friction, still in ticks:
        s = standstill.read(s, error * 1e-6, P)
        s = standstill.stand(s, error * 1e-6, velocity * 1e-5, net, force, friction, still, F, P)
        assert s.mode in (LAW, CLOSED, NUDGED)
        assert all(math.isfinite(x) for x in s)
        assert abs(s.step_n) <= 0.3 * F.static_n + 1e-9
        assert s.stiffness_n_m == 0.0 or 0.3e5 <= s.stiffness_n_m <= 40e5
        assert abs(standstill.nudge(s, force, 1e-3, 500.0, 400.0, P)) <= P.nudge_v
        if not still or abs(error) > 300.0:
            assert s.mode == LAW


# a load on a rig


@cache
def ticks_of() -> tuple[Any, Any]:
    """The trial and one tick of it, compiled where that can be had."""
    try:
        return tuple(compile_functions([trial.trial, trial.tick], cache=cache_folder("compiled")).functions)  # type: ignore[return-value]
    except (BuildError, OSError):
        return trial.trial, trial.tick


def rig(
    step_m: float,
    bristles_n_m: float,
    standstill: bool = True,
    creep: bool = True,
    law_bristles_n_m: float = 9e4,
    **cylinder: float,
) -> tuple[Controller, PlantParameters]:
    """virtual.toml with another encoder, and truly other bristles."""
    here = load(
        "virtual.toml",
        None,
        {
            "cylinder": cylinder,
            "control": {
                "standstill": standstill,
                "creep": creep,
                "motion": {"encoder_resolution_m": step_m},
                "friction": {"bristle_stiffness_n_m": law_bristles_n_m},
            },
            "plant": {
                "sensors": {"encoder_resolution_m": step_m},
                "friction": {"bristle_stiffness_n_m": bristles_n_m},
            },
        },
    )
    return axis_of(here.config, here.codecs.command_lsb_v).controller, plant_of(here.config)


def move(
    pair: Pair,
    joins: bool,
    to_m: float,
    c: Controller,
    plant: PlantParameters,
    ticks: int,
    judged: int,
    tol: float,
) -> tuple[Pair, Verdict]:
    T = max(0.05, (52.5 * abs(to_m - pair.reference_m) / 100.0) ** (1.0 / 3.0))
    errand = Errand(way(septic(T, rest(pair.reference_m), rest(to_m))), NOSINE)
    before = round(T / c.h)
    done: tuple[Pair, Verdict] = ticks_of()[0](
        pair, joins, before + ticks, before + judged, tol, errand, c, plant, 10.0 / 4096
    )
    return done[0], done[1]._replace(outside=max(0, done[1].outside - before))


@pytest.mark.parametrize("bristles_n_m", [0.5e5, 1e5, 5e5, 20e5])
@pytest.mark.parametrize("step_m", [1e-6, 5e-6, 10e-6])
def test_a_load_at_rest_neither_hunts_nor_stands_beside_its_target(
    step_m: float, bristles_n_m: float
) -> None:
    c, plant = rig(step_m, bristles_n_m)
    pair = trial.begin(0.44, c, plant)
    _, v = move(pair, True, 0.48, c, plant, 20_000, 5_000, 1e-3)
    assert v.rms_m <= 15e-6
    assert v.max_m <= 50e-6
    assert v.step_v <= RESTLESS.get((step_m, bristles_n_m), 0.005)


@pytest.mark.parametrize(
    ("step_m", "bristles_n_m", "late"), [(5e-6, 3e5, 0), (10e-6, 3e5, 0), (5e-6, 5e5, 12)]
)
def test_a_load_whose_swing_dies_at_once_is_left_alone_at_once(
    step_m: float, bristles_n_m: float, late: int
) -> None:
    """On bristles five times as stiff half of the moves may end late: with the law alone nearly all do."""
    c, plant = rig(step_m, bristles_n_m, moving_mass_kg=3.0)
    outside, steps_v = [], []
    for seed in (1, 2):
        pair, _ = move(trial.begin(0.44, c, plant, seed), True, 0.45, c, plant, 1_000, 0, 1e-3)
        for to_m in (0.46, 0.45) * 6:
            pair, v = move(pair, False, to_m, c, plant, 600, 300, 20e-6)
            outside.append(v.outside)
            steps_v.append(v.step_v)
    assert sum(x >= 500 for x in outside) <= late
    assert sum(x > 0.03 for x in steps_v) <= late / 3  # the law alone: 0.1 to 0.2


HEAVY: dict[str, Any] = {
    "cylinder": {
        "piston_area_1_m2": 0.0031172,
        "piston_area_2_m2": 0.0028031,
        "moving_mass_kg": 60.0,
    },
    "valve": {"orifice_area_m2": 1.381e-5},
    "control": {
        "k1": 16060.0,
        "k2": 3029.0,
        "k3": 124.4,
        "force_rate_bandwidth_rad_s": 320.0,
        "observer": {"gain_n_s2": 11030.0},
        "motion": {
            "bandwidth_rad_s": 180.0,
            "push_bandwidth_rad_s": 342.0,
            "encoder_resolution_m": 1e-5,
        },
        "friction": {"coulomb_n": 93.5, "static_n": 140.0, "viscous_n_s_m": 93.5},
    },
    "plant": {
        "friction": {"coulomb_n": 93.5, "static_n": 140.0, "viscous_n_s_m": 93.5},
        "sensors": {"encoder_resolution_m": 1e-5},
    },
}


@cache
def heavy() -> tuple[Controller, PlantParameters]:
    """60 kg on soft bristles, seen by an encoder of 10 µm: a cylinder of 63 mm bore."""
    here = load("virtual.toml", None, HEAVY)
    return axis_of(here.config, here.codecs.command_lsb_v).controller, plant_of(here.config)


def test_a_heavy_load_on_soft_bristles_stays_where_it_has_come_to_rest() -> None:
    c, plant = heavy()
    pair, _ = move(trial.begin(0.44, c, plant), True, 0.45, c, plant, 2_000, 0, 1e-3)
    for to_m in (0.451, 0.46, 0.45):
        pair, v = move(pair, False, to_m, c, plant, 4_000, 500, 25e-6)
        assert v.outside < 500
        assert v.step_v < 0.03
    assert standstill.is_quiet(pair.state.standstill, c.friction, c.standstill)


def test_a_law_is_quiet_where_swing_and_law_are_slow_and_the_encoder_is_coarse() -> None:
    assert heavy()[0].standstill.quiet > 0.0
    for other in (rig(10e-6, 9e4), rig(10e-6, 9e4, moving_mass_kg=60.0), rig(1e-6, 9e4, moving_mass_kg=60.0)):
        assert other[0].standstill.quiet == 0.0


def test_the_command_of_a_quiet_law_is_none_or_beyond_the_dead_zone() -> None:
    c, plant = heavy()
    pair, _ = move(trial.begin(0.44, c, plant), True, 0.45, c, plant, 600, 0, 1e-3)
    assert standstill.is_quiet(pair.state.standstill, c.friction, c.standstill)
    errand, commands = Errand(way(septic(0.05, rest(0.45), rest(0.45))), NOSINE, 20.0), []
    for i in range(60):
        pair = trial.tick(pair, 1e-3 * i, False, errand, c, plant, 10.0 / 4096)
        commands.append(abs(pair.last_v))
    assert 0.0 in commands
    assert max(commands) > c.valve.dead_zone_v
    assert not any(0.0 < x < 0.9 * c.valve.dead_zone_v for x in commands)


def test_bristles_beyond_the_law_have_less_of_its_patience() -> None:
    """A swing that dies by itself, and one that the motion filter sees too late to damp."""
    soft = rig(5e-6, 1e5)[0].standstill
    for beyond in (rig(5e-6, 1e5, moving_mass_kg=3.0), rig(5e-6, 1e5, law_bristles_n_m=4e5)):
        s = beyond[0].standstill
        assert (s.settle, s.patience, s.hunts_m) == (80, 50, s.far_m)
    assert (soft.settle, soft.patience, soft.hunts_m) == (1000, 100, soft.near_m)


def test_without_it_the_load_hunts() -> None:
    c, plant = rig(10e-6, 5e5, standstill=False)
    _, v = move(trial.begin(0.44, c, plant), True, 0.48, c, plant, 5_000, 1_000, 1e-3)
    assert v.step_v > 0.2


def test_short_ways_end_in_position() -> None:
    c, plant = rig(1e-6, 1e5)
    pair, _ = move(trial.begin(0.44, c, plant), True, 0.45, c, plant, 1_000, 0, 1e-3)
    at_m = 0.45
    for by_m in (1e-3, 1e-3, -1e-3, 10e-3, -10e-3, -10e-3, 1e-3, -1e-3):
        at_m += by_m
        pair, v = move(pair, False, at_m, c, plant, 1_000, 0, 30e-6)
        assert v.outside <= 400
        assert (v.high_m - at_m if by_m > 0.0 else at_m - v.low_m) <= 50e-6


def test_a_push_gives_the_load_back_to_the_law_which_brings_it_home() -> None:
    c, plant = rig(1e-6, 1e5)
    pair, _ = move(trial.begin(0.44, c, plant), True, 0.45, c, plant, 4_000, 0, 1e-3)
    assert pair.state.standstill.mode == CLOSED
    errand = Errand(way(septic(0.05, rest(0.45), rest(0.45))), NOSINE, 50.0)
    pair, v = ticks_of()[0](pair, False, 5_000, 0, 20e-6, errand, c, plant, 10.0 / 4096)
    assert v.max_m < 0.6e-3
    assert v.outside < 1_000
    assert pair.state.standstill.mode != LAW


def test_a_push_that_begins_like_hunting_finds_the_valve_open() -> None:
    c, plant = rig(1e-6, 1e5)
    pair, _ = move(trial.begin(0.44, c, plant), True, 0.45, c, plant, 4_000, 0, 1e-3)
    c = c._replace(standstill=c.standstill._replace(enter_m=1e-9, near_m=0.0))  # calm, it would be left alone
    for restless_v in (0.02, 0.029):
        restless = StandstillState(ticks=c.standstill.patience, restless_v=restless_v, tries=1)
        hunting = pair._replace(state=pair.state._replace(standstill=restless))
        errand = Errand(way(septic(0.05, rest(0.45), rest(0.45))), NOSINE, 50.0)
        _, v = ticks_of()[0](hunting, False, 100, 0, 20e-6, errand, c, plant, 10.0 / 4096)
        assert v.max_m < 0.5e-3


def test_bristles_of_a_standing_load_are_drawn_to_what_the_force_says() -> None:
    friction = rig(1e-6, 1e5)[0].friction
    assert recalled(0.0, 1e9, 0.5, friction) == pytest.approx(0.5 * friction.static_n / friction.sigma0_n_m)
    assert recalled(1e-4, 1e9, 0.5, friction._replace(sigma0_n_m=0.0)) == 1e-4


@pytest.mark.parametrize("inverse", [True, False])
@pytest.mark.parametrize("plain", [True, False])
def test_laws_without_what_is_learnt_or_left_alone_come_to_rest_too(plain: bool, inverse: bool) -> None:
    c, plant = rig(1e-6, 1e5, standstill=not plain)
    c = c._replace(sliding=c.sliding._replace(invert_dead_zone=inverse))
    c = c._replace(standstill=c.standstill._replace(settle=0))
    if plain:
        c = c._replace(adaptation=Adaptation())
    errand = Errand(way(septic(0.1, rest(0.45), rest(0.4501))), NOSINE)
    pair, v = trial.trial(trial.begin(0.45, c, plant), True, 300, 250, 1e-3, errand, c, plant, 10.0 / 4096)
    assert v.max_m < 1e-4
    assert (pair.state.standstill.mode == LAW) >= plain


def test_loads_that_come_and_go_are_no_stiffer_bristles() -> None:
    """Steps of a load as large as the friction, at any instant of a sine, look like them for a moment."""
    c, plant = rig(1e-6, 1e5)
    tick, errand = ticks_of()[1], Errand(way(septic(1.0, rest(0.4), sine(0.0, SWING))), SWING)
    chance, most, force_n, until = random.Random(3), 1.0, 0.0, 3000
    pair = trial.begin(0.4, c, plant)
    for i in range(20_000):
        if i == until:
            force_n = chance.uniform(-1.0, 1.0) * plant.friction.coulomb_n
            until += chance.randrange(150, 2500)
        pair = tick(pair, i * c.h, i == 0, errand._replace(force_n=force_n), c, plant, 10.0 / 4096)
        most = max(most, pair.state.learnt.stiffness)
    assert most < 3.0


@pytest.mark.parametrize("creep", [True, False])
def test_a_load_on_stiff_bristles_creeps_evenly_where_its_own_speed_is_fed_forward(creep: bool) -> None:
    """20 mm/s, where friction falls with speed most steeply, and bristles of five times the stiffness."""
    c, plant = rig(1e-6, 5e5, creep=creep)
    run, v = ticks_of()[0], 0.02
    x = [0.4 + 0.5 * v * 0.25, 0.4 + 0.5 * v * 0.25 + v * 2.0]
    joins = Errand(way(septic(0.25, rest(0.4), Reference(x[0], v, 0.0, 0.0))), NOSINE)
    creeps = Errand(way(septic(2.0, Reference(x[0], v, 0.0, 0.0), Reference(x[1], v, 0.0, 0.0))), NOSINE)
    pair, _ = run(trial.begin(0.4, c, plant), True, 250, 0, 1e-3, joins, c, plant, 10.0 / 4096)
    _, verdict = run(pair, False, 2000, 500, 1e-3, creeps, c, plant, 10.0 / 4096)
    assert (verdict.rms_m < 1e-5) is creep
