"""Pressing with a force: the law, what ends it, and the ways from position to force and back."""

from __future__ import annotations

from functools import cache

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from axis_rig import (
    ARM,
    DISARM,
    PRESSURE,
    H,
    Rig,
    in_position_without,
    loaded,
    quick,
    ready,
    tracking,
    twin,
)
from pneud.compiled.backend import INTERPRETED
from pneud.config.conversions import axis_of, pressing_of
from pneud.control import force
from pneud.control.force import Aim, Press, Pressing, damping_n_s_m, proceed, stiffness_n_m
from pneud.control.tunables import tunables
from pneud.physics.plant import Detail
from pneud.rig.detail import touching
from pneud.safety.faults import F, names
from pneud.signals import Answer, Estimate, RequestKind, State, Tick

FORCE, HOLD, GOTO, STOP, GAINS = (
    *(RequestKind.FORCE, RequestKind.HOLD, RequestKind.GOTO),
    *(RequestKind.STOP, RequestKind.GAINS),
)
USUAL = (30.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # less than friction holds: the load stays
P = Pressing(500.0, 400.0, 6000.0, 0.2, 5.0, 2.0, 0.01, 50_000_000)
AIM = Aim(200.0, 4000.0, 0.1, 0.9, 0.2, 1.0)
LAW = axis_of(loaded().config, loaded().codecs.command_lsb_v).controller
ROD_N = LAW.cylinder.rod_force_n
MS = 1_000_000


def asked(**values: float) -> tuple[float, ...]:
    """The usual request, but for some values."""
    fields = ("force_n", "rate_n_s", "low_m", "high_m", "speed_m_s", "time_s")
    return tuple(values.get(name, value) for name, value in zip(fields, USUAL, strict=True))


def seen(
    position_m: float, velocity_m_s: float = 0.0, force_n: float = 0.0, piston_n: float = 0.0
) -> Estimate:
    x3_n = piston_n + ROD_N
    return Estimate(position_m, velocity_m_s, force_n, x3_n, x3_n, 0.0, 0.0, 0.0)


def begun(aim: Aim = AIM, position_m: float = 0.5, piston_n: float = 0.0) -> Press:
    return force.begin(aim, force.NO_PRESS, False, seen(position_m, piston_n=piston_n), 0, LAW)


def holding() -> Rig:
    rig = ready()
    assert rig.tick(ARM).state == State.HOLDING
    rig.ticks(200)
    return rig


@cache
def _held() -> Rig:
    return holding()


def pressing(ticks: int = 200, **values: float) -> Rig:
    rig = holding()
    tick = rig.tick(FORCE, *asked(**values))
    assert (tick.answer, tick.state) == (Answer.TAKEN, State.PRESSING)
    rig.ticks(ticks)
    return rig


def piston_n(tick: Tick) -> float:
    return tick.estimate.x3_n - ROD_N


def test_the_force_comes_by_its_ramp_and_stays_and_says_so() -> None:
    rig = holding()
    before = piston_n(rig.tick())
    first = rig.tick(FORCE, *asked(force_n=before - 40.0, rate_n_s=1000.0))
    ticks = [first, *rig.ticks(400)]
    assert all(tick.state == State.PRESSING for tick in ticks)
    assert piston_n(ticks[20]) > before - 25.0
    assert abs(piston_n(ticks[-1]) - (before - 40.0)) < 1.0
    assert not ticks[5].in_position
    assert ticks[-1].in_position
    assert max(abs(tick.error_m) for tick in ticks) < 1e-9


@pytest.mark.parametrize("quickly", [True, False], ids=["compiled", "interpreted"])
def test_a_force_counts_as_reached_in_a_tick_whose_pressures_were_read(quickly: bool) -> None:
    def said(missing: range) -> list[int]:
        rig = twin(_held())
        rig.go_on(quick() if quickly else INTERPRETED)
        rig.tick(FORCE, *asked())
        return in_position_without(rig, PRESSURE, missing, 300)

    usual = said(range(0))
    first = usual.index(1)
    assert said(range(first, first + 3))[: first + 4] == [*usual[:first], 0, 0, 0, 1]
    assert said(range(first + 1, first + 4))[: first + 4] == usual[: first + 4]


def test_without_a_force_that_holds_it_a_load_moves_and_no_faster_than_was_asked_for() -> None:
    rig = holding()
    rig.tick(FORCE, *asked(force_n=200.0, speed_m_s=0.1))
    ticks = rig.ticks(900)
    assert all(tick.state == State.PRESSING for tick in ticks)
    assert 0.04 < max(tick.estimate.velocity_m_s for tick in ticks) < 0.1
    assert not ticks[-1].in_position


@pytest.mark.parametrize(
    ("values", "answer"),
    [
        ({"force_n": 1000.0}, Answer.BEYOND_LIMITS),
        ({"force_n": -500.0}, Answer.BEYOND_LIMITS),
        ({"speed_m_s": 5.0}, Answer.BEYOND_LIMITS),
        ({"rate_n_s": -1.0}, Answer.MALFORMED),
        ({"rate_n_s": 1e-3}, Answer.MALFORMED),
        ({"speed_m_s": -0.1}, Answer.MALFORMED),
        ({"time_s": -1.0}, Answer.MALFORMED),
        ({"low_m": 0.6, "high_m": 0.8}, Answer.OUT_OF_TRAVEL),
        ({"low_m": 0.0, "high_m": 0.8}, Answer.OUT_OF_TRAVEL),
        ({"low_m": 0.8, "high_m": 0.3}, Answer.OUT_OF_TRAVEL),
    ],
)
def test_what_cannot_be_asked_for_is_refused(values: dict[str, float], answer: Answer) -> None:
    rig = holding()
    tick = rig.tick(FORCE, *asked(**values))
    assert (tick.answer, tick.state) == (answer, State.HOLDING)
    assert ready().tick(FORCE, *asked(**values)).answer in (Answer.WRONG_STATE, answer)


def test_a_force_that_is_off_while_a_load_swings_is_not_shut_in() -> None:
    press = begun(AIM)._replace(wanted_n=AIM.force_n, slow_n=0.0)
    off_n = 0.5 * force.tolerance_n(AIM, P)
    for beyond, shut in ((0.9, 1), (-0.9, 1), (1.1, 0), (-1.1, 0)):
        e = seen(0.5, piston_n=AIM.force_n + beyond * off_n)
        assert force.proceed(press, e, 1_000_000, LAW.h, LAW, P).press.shut == shut


def test_near_the_end_of_its_window_a_load_is_kept_so_slow_that_it_can_be_braked() -> None:
    aim = AIM._replace(speed_m_s=1.5, braking_m_s2=10.0)
    rooms = (0.8, 0.05, 0.0, -1.0)
    assert [force.allowed_m_s(aim, room, 0.0) for room in rooms] == pytest.approx([1.5, 1.0, 0.02, 0.02])
    assert force.allowed_m_s(AIM, 0.0, 0.03) == pytest.approx(0.02)
    v = force.allowed_m_s(aim, 0.05, 0.03)
    assert v * 0.03 + v * v / 20.0 == pytest.approx(0.05)
    assert force.braked_after_s(0.0) > 2.0 * force.braked_after_s(30.0) > 0.0
    press = begun(aim)
    late_s = force.braked_after_s((stiffness_n_m(press, LAW) / LAW.cylinder.M) ** 0.5)
    share = force.allowed_m_s(aim, 0.05, late_s) / 1.5
    middle, near_high, near_low = (force.bounds_n(press, 50.0, x, 0.0, LAW) for x in (0.5, 0.85, 0.15))
    assert (near_high[0], near_low[1]) == pytest.approx(middle)
    assert near_high[1] - 50.0 == pytest.approx((middle[1] - 50.0) * share)
    assert 50.0 - near_low[0] == pytest.approx((50.0 - middle[0]) * share)


def test_a_load_that_nothing_stops_comes_to_rest_within_the_travel() -> None:
    rig = holding()
    rig.go_on(quick())
    rig.tick(GOTO, 0.95)
    rig.until(State.HOLDING)
    assert rig.tick(FORCE, *asked(force_n=100.0)).state == State.PRESSING
    assert names(rig.until(State.STOPPING).latched) == ["force_window"]
    assert names(rig.until(State.FAULT).latched) == ["force_window"]


def test_only_a_load_that_is_led_can_be_pressed() -> None:
    assert ready().tick(FORCE, *USUAL).answer == Answer.WRONG_STATE
    assert tracking().tick(FORCE, *USUAL).state == State.PRESSING


def test_position_takes_over_without_a_step_of_force() -> None:
    rig = pressing()
    ticks = [rig.tick(HOLD), *rig.ticks(200)]
    assert ticks[-1].state == State.HOLDING
    forces = [piston_n(tick) for tick in ticks]
    assert max(forces) - min(forces) < 12.0
    assert abs(ticks[-1].error_m) < 50e-6


@pytest.mark.parametrize(
    ("kind", "values", "state"),
    [
        (HOLD, (), State.MOVING),
        (GOTO, (0.6,), State.MOVING),
        (RequestKind.JOG, (0.05, 100.0), State.MOVING),
        (RequestKind.TRACK, (0.0,), State.TRACKING),
        (STOP, (), State.STOPPING),
        (DISARM, (), State.STOPPING),
    ],
)
def test_every_way_leads_back_to_position(kind: int, values: tuple[float, ...], state: State) -> None:
    rig = pressing(60)
    tick = rig.tick(kind, *values)
    assert (tick.answer, tick.state) == (Answer.TAKEN, state)
    assert all(not tick.latched for tick in rig.ticks(300))


def test_another_force_goes_on_from_where_the_ramp_is() -> None:
    rig = pressing(20, rate_n_s=1000.0)
    before = rig.axis.state.press
    rig.tick(FORCE, *asked(force_n=-30.0, rate_n_s=500.0))
    after = rig.axis.state.press
    assert after.wanted_n == pytest.approx(before.wanted_n, abs=1.1)
    assert (after.aim.force_n, after.aim.rate_n_s, after.reached) == (-30.0, 500.0, 0)
    assert rig.ticks(600)[-1].in_position


def test_gains_may_change_meanwhile() -> None:
    rig = pressing()
    law = rig.axis.state.law
    tick = rig.tick(GAINS, *tunables(law))
    assert (tick.answer, tick.state) == (Answer.TAKEN, State.PRESSING)
    assert rig.ticks(100)[-1].in_position


def test_what_a_load_is_pressed_against_is_not_learnt_as_friction_or_load() -> None:
    rig = holding()
    rig.node.force_ext_n = 150.0  # as of a spring
    rig.ticks(300)
    assert rig.tick(FORCE, *asked(force_n=150.0)).state == State.PRESSING
    rig.ticks(50)
    learnt = rig.axis.state.controller.learnt  # type: ignore[union-attr]
    rig.tick(GOTO, 0.44)
    rig.ticks(60)
    after = rig.axis.state.controller.learnt  # type: ignore[union-attr]
    assert rig.axis.state.pressed
    assert (after.load_n, after.friction, after.mass) == (learnt.load_n, learnt.friction, learnt.mass)
    rig.node.force_ext_n = 0.0
    rig.tick(GOTO, 0.5)
    rig.ticks(200)
    assert not rig.axis.state.pressed
    assert rig.axis.state.controller.learnt.load_n != learnt.load_n  # type: ignore[union-attr]


def test_compiled_or_not_it_is_the_same_to_the_last_bit() -> None:
    one = pressing(5)
    other = twin(one)
    other.go_on(quick())
    for _ in range(150):
        assert repr(one.tick()) == repr(other.tick())
    assert repr(one.axis.state) == repr(other.axis.state)


@pytest.mark.parametrize(
    ("values", "fault"),
    [
        ({"force_n": 300.0, "low_m": 0.3, "high_m": 0.44}, F.FORCE_WINDOW),
        ({"force_n": 300.0, "time_s": 0.1}, F.FORCE_TIMEOUT),
    ],
)
def test_what_ends_it_stops_under_control_and_latches(values: dict[str, float], fault: F) -> None:
    rig = holding()
    assert rig.tick(FORCE, *asked(**values)).state == State.PRESSING
    stopping = rig.until(State.STOPPING)
    assert names(stopping.latched) == [fault.name.lower()]
    ended = rig.until(State.FAULT)
    assert names(ended.latched) == [fault.name.lower()]
    assert abs(ended.estimate.velocity_m_s) < 0.05


def test_a_load_that_is_torn_away_is_brought_to_rest() -> None:
    rig = pressing()
    rig.node.force_ext_n = -250.0
    assert names(rig.until(State.STOPPING).latched) == ["force_speed"]
    ended = rig.until(State.FAULT)
    assert names(ended.latched) == ["force_speed"]
    assert abs(ended.estimate.velocity_m_s) < 0.1


def test_a_force_against_the_one_that_was_asked_for_ends_it() -> None:
    wrong = seen(0.5, piston_n=-45.0)
    found = proceed(begun(), wrong, MS, H, LAW, P)
    assert found.ended == force.FINE
    assert proceed(found.press, wrong, 51 * MS, H, LAW, P).ended == force.DIRECTION
    away = proceed(begun(), seen(0.489, piston_n=10.0), MS, H, LAW, P)
    assert proceed(away.press, seen(0.489), 51 * MS, H, LAW, P).ended == force.DIRECTION
    assert proceed(away.press, seen(0.495), 51 * MS, H, LAW, P).ended == force.FINE


@pytest.mark.parametrize(
    ("e", "now_ns", "ended"),
    [
        (seen(0.5), MS, force.FINE),
        (seen(0.95), MS, force.WINDOW),
        (seen(0.05), MS, force.WINDOW),
        (seen(0.5, 0.41), MS, force.SPEED),
        (seen(0.5, -0.41), MS, force.SPEED),
        (seen(0.5, 0.3), MS, force.FINE),
        (seen(0.5), 999 * MS, force.FINE),
        (seen(0.5), 1000 * MS - 240_000, force.TIMEOUT),
        (seen(0.5), 1001 * MS, force.TIMEOUT),
    ],
)
def test_every_bound_ends_it(e: Estimate, now_ns: int, ended: int) -> None:
    assert proceed(begun(), e, now_ns, H, LAW, P).ended == ended


@pytest.mark.parametrize("off_ns", [-240_000, 0, 240_000])
def test_a_force_is_reached_in_the_tick_in_which_its_time_is_over(off_ns: int) -> None:
    p = pressing_of(loaded().config)
    there = seen(0.5, force_n=200.0, piston_n=200.0)
    press = begun()._replace(slow_n=0.0, wanted_n=200.0)
    reached = []
    for i in range(60):
        press = proceed(press, there, i * MS + (off_ns if i else 0), H, LAW, p).press
        reached.append(press.reached)
    assert reached.index(1) == round(1e3 * loaded().config.in_position.time_s)


def test_too_fast_for_a_while_is_too_fast() -> None:
    once = proceed(begun(), seen(0.5, 0.21), MS, H, LAW, P).press
    assert proceed(once, seen(0.5, 0.21), 21 * MS, H, LAW, P).ended == force.SPEED
    slow = proceed(once, seen(0.5, 0.1), 10 * MS, H, LAW, P).press
    assert proceed(slow, seen(0.5, 0.21), 21 * MS, H, LAW, P).ended == force.FINE


def test_a_force_that_was_there_once_is_in_time_for_good() -> None:
    press, there = begun(), seen(0.5, force_n=200.0, piston_n=200.0)
    for tick in range(1, 400):
        press = proceed(press, there, tick * MS, H, LAW, P).press
    assert (press.reached, press.ever, press.shut) == (1, 1, 1)
    less = seen(0.5, force_n=150.0, piston_n=150.0)
    lost = proceed(press, less, 2000 * MS, H, LAW, P)
    assert lost.ended == force.FINE
    for tick in range(2001, 2100):
        lost = proceed(lost.press, less, tick * MS, H, LAW, P)
    assert (lost.press.reached, lost.press.shut, lost.ended) == (0, 0, force.FINE)


@given(st.floats(1e2, 1e6), st.floats(1.0, 1e3))
@settings(max_examples=20)
def test_a_stiffness_is_told_by_force_and_travel(stiffness: float, speed_mm_s: float) -> None:
    press, x = begun(), 0.5
    for tick in range(1, 100):
        x += 1e-6 * speed_mm_s
        press = proceed(press, seen(x, force_n=stiffness * (x - 0.5)), tick * MS, H, LAW, P).press
    usual = LAW.cylinder.M * (force.UNTOLD * force.DAMPED * force.loop_rad_s(LAW)) ** 2
    found = stiffness_n_m(press, LAW)
    assert min(stiffness, usual) * 0.99 <= found <= max(stiffness, usual) * 1.01
    assert damping_n_s_m(press, LAW) > 0.0
    if speed_mm_s > 100.0:
        assert found == pytest.approx(stiffness, rel=0.05)


def test_a_spring_pushes_and_never_pulls() -> None:
    front = Detail(on=True, contact_n_m=1000.0, contact_m=0.5, contact_n_s_m=10.0)
    assert touching(0.51, 0.0, front) == pytest.approx(10.0)
    assert touching(0.51, 0.5, front) == pytest.approx(15.0)
    assert touching(0.51, -5.0, front) == 0.0
    assert touching(0.49, 1.0, front) == touching(0.51, 1.0, Detail()) == 0.0
    rear = front._replace(contact_side=-1.0)
    assert touching(0.49, 0.0, rear) == pytest.approx(-10.0)
    assert touching(0.49, -0.5, rear) == pytest.approx(-15.0)
    assert touching(0.51, 0.0, rear) == 0.0
