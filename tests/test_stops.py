"""An axis on its end stop: it can be armed, is led away slowly, and may not be led further out."""

from __future__ import annotations

from functools import cache

import pytest

from axis_rig import ARM, Rig, quick
from pneud.axis.state import INSIDE, AxisParameters
from pneud.axis.stops import (
    BEYOND_M,
    BRAKING_DISTANCE,
    GENTLE,
    NEAR_M,
    SLIP_M,
    TRAVEL,
    excused,
    gentle,
    outside,
    soft_limits,
    way_inside,
)
from pneud.control.reference import rest
from pneud.safety.checks import MOVING_M_S
from pneud.safety.faults import names
from pneud.safety.supervisor import is_engaged
from pneud.signals import Answer, Estimate, Request, RequestKind, State, Tick
from test_safety_checks import LIMITS, STILL, above

GOTO, JOG, TRACK = RequestKind.GOTO, RequestKind.JOG, RequestKind.TRACK
STROKE_M = LIMITS.stroke_m
LOW_M, HIGH_M = LIMITS.travel_min_m, LIMITS.travel_max_m


def on_stop(front: bool, p1_pa: float = 3e5, p2_pa: float = 3e5, load_n: float = 0.0, **limits: float) -> Rig:
    """Disarmed, and lying on a stop."""
    rig = Rig()
    p = rig.axis.parameters
    rig.axis = quick().axis(p._replace(limits=p.limits._replace(**limits)))  # type: ignore[arg-type]
    k = p.controller.cylinder
    x1 = k.x_e1 + (k.stroke_m if front else 0.0)
    rig.node._state = rig.node._state._replace(x1=x1, p1=p1_pa, p2=p2_pa)
    rig.node.force_ext_n = load_n
    rig.until(State.DISARMED)
    rig.ticks(100)
    return rig


@cache
def parameters() -> AxisParameters:
    return Rig().axis.parameters


def led(rig: Rig, request: Request, ticks: int, until: State = State.HOLDING) -> list[Tick]:
    """The ticks until the axis is in a state, the first being that of the request."""
    found = [rig.tick(request.kind, *request.values)]
    while len(found) < ticks and (len(found) < 2 or found[-1].state != until):
        found.append(rig.tick())
    return found


@pytest.mark.parametrize(
    ("front", "p1_pa", "p2_pa", "load_n"),
    [
        (False, 101e3, 101e3, 0.0),
        (False, 3e5, 3e5, 150.0),
        (False, 1.1e5, 6e5, 0.0),
        (True, 101e3, 101e3, -50.0),
        (True, 6e5, 1.1e5, 0.0),
    ],
)
def test_an_axis_on_a_stop_is_armed_where_it_lies_and_led_away_slowly(
    front: bool, p1_pa: float, p2_pa: float, load_n: float
) -> None:
    rig = on_stop(front, p1_pa, p2_pa, load_n)
    assert rig.tick().present == 0
    assert rig.tick(ARM).state == State.HOLDING
    held = rig.ticks(200)
    assert all(tick.state == State.HOLDING and not tick.present for tick in held)
    low_m, high_m = soft_limits(parameters())
    way = led(rig, Request(GOTO, (low_m if not front else high_m, 0.0, 0.0, 0.0)), 4000)
    assert way[0].answer == Answer.TAKEN
    assert not any(tick.latched for tick in way)
    assert way[-1].state == State.HOLDING
    assert max(abs(tick.estimate.velocity_m_s) for tick in way) <= 0.1
    bound_v = GENTLE * 5.0 + 1e-3
    out = [tick for tick in way if not LOW_M <= tick.measurement.position_m <= HIGH_M]
    assert max(abs(tick.command.voltage_v) for tick in out) <= bound_v
    rig.ticks(200)
    assert rig.node.truth().position_m == pytest.approx(low_m if not front else high_m, abs=1e-4)


@pytest.mark.parametrize("front", [False, True])
def test_it_may_be_asked_to_track_or_to_jog_at_once(front: bool) -> None:
    rig = on_stop(front)
    assert rig.tick(ARM, 1.0).state == State.TRACKING
    assert all(tick.state == State.TRACKING for tick in rig.ticks(1500))
    other = on_stop(front)
    other.tick(ARM)
    inwards, outwards = (-0.1, 0.1) if front else (0.1, -0.1)
    assert other.tick(JOG, outwards, 100.0).answer == Answer.OUT_OF_TRAVEL
    assert other.tick(JOG, inwards, 2000.0).state == State.MOVING
    assert not any(tick.latched for tick in other.ticks(1000))
    assert other.tick(TRACK, 0.0).answer == Answer.TAKEN  # asked again on the way
    assert not any(tick.latched for tick in other.ticks(500))


def test_a_stop_on_the_way_is_a_stop() -> None:
    rig = on_stop(False)
    rig.tick(ARM)
    rig.tick(GOTO, 0.5, 0.0, 0.0, 0.0)
    rig.ticks(800)
    assert rig.tick(RequestKind.STOP).state == State.STOPPING
    assert not rig.until(State.HOLDING).latched


@pytest.mark.parametrize("front", [False, True])
def test_a_travel_may_end_behind_the_stops(front: bool) -> None:
    rig = on_stop(front, travel_min_m=-0.005, travel_max_m=STROKE_M + 0.005)
    assert rig.tick(ARM).state == State.HOLDING
    target = STROKE_M - 0.001 if front else 0.001
    assert rig.tick(GOTO, target + (0.0005 if front else -0.0005)).answer == Answer.OUT_OF_TRAVEL
    way = led(rig, Request(GOTO, (target, 0.0, 0.0, 0.0)), 4000)
    assert way[-1].state == State.HOLDING
    assert not any(tick.latched for tick in way)


def test_who_is_pushed_further_out_is_stopped() -> None:
    rig = on_stop(False)
    rig.tick(ARM)
    rig.ticks(20)
    began = rig.count
    rig.measurement = lambda m: m._replace(position_m=m.position_m - 2e-5 * (rig.count - began))
    found = rig.ticks(200)
    assert not is_engaged(found[-1].state)
    assert set(names(found[-1].latched)) <= {"travel", "braking_distance"}


def test_what_lies_beyond_the_cylinder_cannot_be_armed() -> None:
    rig = on_stop(False)
    rig.measurement = lambda m: m._replace(position_m=m.position_m - 0.01)
    rig.ticks(200)
    tick = rig.tick(ARM)
    assert (tick.answer, names(tick.present)) == (Answer.BLOCKED, ["travel"])


@pytest.mark.parametrize(
    ("before_m", "position_m", "engaged", "found"),
    [
        (INSIDE, 0.5, False, INSIDE),
        (0.0, LOW_M, True, INSIDE),  # it has come inside
        (0.0, HIGH_M, True, INSIDE),
        (INSIDE, 0.01, False, 0.01),
        (0.015, 0.01, False, 0.01),
        (INSIDE, 0.01, True, INSIDE),  # it has left its travel
        (0.005, 0.01, True, 0.01),
        (0.01, 0.005, True, 0.01),
        (0.99, 0.985, True, 0.985),
        (0.985, 0.99, True, 0.985),
        (INSIDE, -BEYOND_M, False, -BEYOND_M),
        (INSIDE, STROKE_M + BEYOND_M, False, STROKE_M + BEYOND_M),
        (INSIDE, -above(BEYOND_M), False, INSIDE),
        (0.0, above(STROKE_M + BEYOND_M), True, INSIDE),
    ],
)
def test_where_it_lies_outside(before_m: float, position_m: float, engaged: bool, found: float) -> None:
    assert outside(before_m, position_m, engaged, LIMITS) == found


def moving(velocity_m_s: float) -> Estimate:
    return STILL._replace(velocity_m_s=velocity_m_s)


@pytest.mark.parametrize(
    ("outside_m", "position_m", "velocity_m_s", "found"),
    [
        (INSIDE, 0.01, 0.0, 0),
        (0.01, 0.01, 0.0, TRAVEL | BRAKING_DISTANCE),
        (0.01, 0.01, 1.0, TRAVEL | BRAKING_DISTANCE),
        (0.01, 0.01, -MOVING_M_S, TRAVEL | BRAKING_DISTANCE),
        (0.01, 0.01, -above(MOVING_M_S), TRAVEL),
        (0.01, 0.0095 - SLIP_M, 0.0, 0),
        (0.99, 0.99, -1.0, TRAVEL | BRAKING_DISTANCE),
        (0.99, 0.99, above(MOVING_M_S), TRAVEL),
        (0.99, 0.9905 + SLIP_M, 0.0, 0),
    ],
)
def test_what_is_excused_outside(
    outside_m: float, position_m: float, velocity_m_s: float, found: int
) -> None:
    assert excused(outside_m, position_m, moving(velocity_m_s), LIMITS) == found


def test_the_command_outside_is_bounded() -> None:
    p = parameters()
    assert gentle(p).output.u_max_v == GENTLE * p.output.u_max_v
    assert gentle(p)._replace(output=p.output) == p


def test_from_inside_there_is_no_way_inside() -> None:
    assert way_inside(rest(0.5), parameters()) == ((), rest(0.5))


@pytest.mark.parametrize(("from_m", "to_m"), [(0.0, NEAR_M), (STROKE_M, STROKE_M - NEAR_M)])
def test_without_a_margin_the_way_ends_off_the_stop(from_m: float, to_m: float) -> None:
    p = parameters()
    wide = p.limits._replace(travel_min_m=0.0, travel_max_m=STROKE_M)
    pieces, end = way_inside(rest(from_m), p._replace(limits=wide, travel_margin_m=0.0))
    assert pieces
    assert end == rest(to_m)
