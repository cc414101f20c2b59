"""The tracked sine, and the ways to it and to rest."""

from __future__ import annotations

import math

import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from pneud.control.reference import (
    LEAST_M,
    LEAST_S,
    ROOM,
    Bounds,
    Shunned,
    Sine,
    Way,
    along,
    at,
    move,
    rest,
    septic,
    sine,
    stays,
    still,
    stop,
    to_rest,
    transfer,
    unhurried,
    way,
)
from pneud.signals import Reference

STANDARD = Bounds(0.3, 2.0, 40.0)
SINE = Sine(0.4868, 0.05, math.pi)  # of configs/virtual.toml
DENSE = 300

position = st.floats(0.02, 0.98)
bounds = st.builds(Bounds, st.floats(0.02, 2.0), st.floats(0.1, 20.0), st.floats(1.0, 1000.0))
motions = st.builds(Reference, position, st.floats(-1.0, 1.0), st.floats(-5.0, 5.0), st.floats(-100.0, 100.0))
sines = st.builds(Sine, position, st.floats(0.0, 0.2), st.floats(0.0, 20.0))
times = st.floats(0.0, 1e3)


def look(w: Way) -> list[Reference]:
    return [along(w.T * i / DENSE, w) for i in range(DENSE + 1)]


def close(a: Reference, b: Reference, scale: float = 1.0) -> bool:
    """Equal to the rounding of polynomials whose terms have this size (in position)."""
    return all(abs(x - y) <= 1e-9 * scale * (1.0 + abs(y)) for x, y in zip(a, b, strict=True))


def most(r: Reference, b: Bounds) -> tuple[float, float]:
    return (
        max(b.acceleration_m_s2, ROOM * abs(r.acceleration_m_s2)),
        max(b.jerk_m_s3, ROOM * abs(r.jerk_m_s3)),
    )


def assert_within(w: Way, of: Reference, b: Bounds) -> None:
    acceleration, jerk = most(of, b)
    for r in look(w):
        assert abs(r.acceleration_m_s2) <= 1.001 * acceleration
        assert abs(r.jerk_m_s3) <= 1.001 * jerk


def assert_smooth(w: Way, of: Reference, b: Bounds) -> None:
    acceleration, jerk = most(of, b)
    for p, q in zip(w.pieces, w.pieces[1:], strict=False):
        end, begin = at(p.T, p), at(0.0, q)
        assert end.position_m == pytest.approx(begin.position_m, rel=1e-12, abs=1e-9)
        assert end.velocity_m_s == pytest.approx(begin.velocity_m_s, rel=1e-10, abs=1e-10)
        assert end.acceleration_m_s2 == pytest.approx(begin.acceleration_m_s2, abs=1e-6 * acceleration)
        assert end.jerk_m_s3 == pytest.approx(begin.jerk_m_s3, abs=1e-5 * jerk)


@given(T=st.floats(0.02, 10.0), start=motions, end=motions)
def test_a_septic_meets_its_ends(T: float, start: Reference, end: Reference) -> None:
    p = septic(T, start, end)
    size = max(1.0, *(abs(c) for c in p[1:]))
    assert close(at(0.0, p), start)
    assert close(at(T, p), end, size * max(1.0, T**-3))


@given(T=st.floats(0.02, 10.0), start=motions, end=motions, share=st.floats(0.01, 0.99))
def test_the_derivatives_are_those_of_the_position(
    T: float, start: Reference, end: Reference, share: float
) -> None:
    p = septic(T, start, end)
    step = 1e-4 * T
    t = share * T
    before, now, after = at(t - step, p), at(t, p), at(t + step, p)
    size = sum(abs(c) for c in p[1:])
    for i, order in ((0, 1), (1, 2), (2, 3)):
        slope = (after[i] - before[i]) / (2.0 * step)
        assert slope == pytest.approx(now[i + 1], rel=1e-3, abs=1e-3 * size / T**order)


def test_before_and_after_a_way_it_stands_at_its_ends() -> None:
    there, back = move(rest(0.1), 0.4, STANDARD), move(rest(0.4), 0.2, STANDARD)
    w = way(*there.pieces, *back.pieces)
    assert along(-1.0, w) == rest(0.1)
    assert along(w.T + 1.0, w).position_m == pytest.approx(0.2, abs=1e-12)
    assert along(there.T, w) == pytest.approx(rest(0.4), abs=1e-9)


@given(t=times, p=sines)
def test_the_sine_has_its_own_derivatives(t: float, p: Sine) -> None:
    r = sine(t, p)
    w = p.omega_rad_s
    assert abs(r.position_m - p.centre_m) <= p.amplitude_m + 1e-15
    assert r.acceleration_m_s2 == pytest.approx(-w * w * (r.position_m - p.centre_m), abs=1e-9)
    assert r.jerk_m_s3 == pytest.approx(-w * w * r.velocity_m_s, abs=1e-9)
    energy = (r.position_m - p.centre_m) ** 2 * w * w + r.velocity_m_s**2
    assert energy == pytest.approx((p.amplitude_m * w) ** 2, abs=1e-9)


def test_a_sine_without_amplitude_or_frequency_stands_still() -> None:
    assert sine(7.0, Sine(0.5, 0.0, 3.0)) == rest(0.5)
    assert sine(7.0, Sine(0.5, 0.1, 0.0)) == rest(0.5)


@given(start=position, end=position, b=bounds)
def test_from_rest_to_rest_keeps_every_bound_and_reaches_one(start: float, end: float, b: Bounds) -> None:
    w = move(rest(start), end, b)
    seen = look(w)
    use = max(
        max(abs(r.velocity_m_s) for r in seen) / b.speed_m_s,
        max(abs(r.acceleration_m_s2) for r in seen) / b.acceleration_m_s2,
        max(abs(r.jerk_m_s3) for r in seen) / b.jerk_m_s3,
    )
    assert use <= 1.001
    assert use >= 0.9 or w.T <= 2.001 * LEAST_S
    low, high = min(start, end), max(start, end)
    assert all(low - 1e-9 <= r.position_m <= high + 1e-9 for r in seen)
    begins = rest(start if abs(end - start) >= LEAST_M else end)
    assert along(0.0, w) == begins
    assert_smooth(w, begins, b)


@given(st.floats(0.0, 0.5), bounds)
def test_a_move_peaks_at_no_speed_that_is_shunned_unless_it_is_told_to(distance: float, b: Bounds) -> None:
    shunned = Shunned(9e-3, 37e-3)
    gentler = unhurried(b, distance, shunned)
    top = max(abs(r.velocity_m_s) for r in look(move(rest(0.0), distance, gentler)))
    assert gentler == b or top == pytest.approx(shunned.low_m_s)
    assert top <= 1.001 * shunned.low_m_s or top >= 0.999 * min(shunned.high_m_s, b.speed_m_s)
    assert unhurried(b, distance, Shunned()) == b


@given(st.floats(0.0, 0.5), bounds)
def test_a_move_has_no_more_jerk_than_leaves_the_valve_some_room(distance: float, b: Bounds) -> None:
    gentler = unhurried(b, distance, Shunned(jerk_m_s3=12.0))
    assert gentler == b._replace(jerk_m_s3=min(b.jerk_m_s3, 12.0))


@pytest.mark.parametrize("b", [STANDARD, Bounds(0.02, 0.1, 1.0), Bounds(2.0, 20.0, 1000.0)])
def test_no_distance_is_no_way(b: Bounds) -> None:
    assert move(rest(0.3), 0.3, b) == still(0.3)
    assert move(rest(0.3), 0.1 + 0.2, b) == still(0.1 + 0.2)  # which is not 0.3
    assert set(look(still(0.3))) == {rest(0.3)}


@example(Reference(0.5, -0.0, 1.0, -5e-167), 0.75, Bounds(1.0, 1.0, 1.0))
@example(Reference(0.5, 1e-200, -1e-200, 0.0), 0.75, Bounds(1.0, 1.0, 1.0))
@example(Reference(0.5, 1.0, -1.0, 1.0), 0.5 + 1e-16, Bounds(1.0, 1.0, 1.0))
@given(start=motions, end=position, b=bounds)
def test_a_motion_is_led_anywhere_without_a_jump(start: Reference, end: float, b: Bounds) -> None:
    w = move(start, end, b)
    acceleration, _ = most(start, b)
    assert close(along(0.0, w), start)
    last = along(w.T, w)
    assert last.position_m == pytest.approx(end, abs=1e-9)
    assert abs(last.velocity_m_s) <= 1e-9
    assert abs(last.acceleration_m_s2) <= 1e-6 * acceleration
    assert_smooth(w, start, b)
    assert_within(w, start, b)
    eased = along(w.pieces[0].T, w).velocity_m_s
    fastest = max(b.speed_m_s, abs(start.velocity_m_s), abs(eased)) * 1.001 + 1e-9
    gained = LEAST_S * (abs(start.acceleration_m_s2) + LEAST_S * abs(start.jerk_m_s3))
    assert all(abs(r.velocity_m_s) <= fastest + gained for r in look(w))


@given(start=motions, end=position, b=bounds)
def test_a_way_turns_in_its_first_two_pieces_or_not_at_all(start: Reference, end: float, b: Bounds) -> None:
    w = move(start, end, b)
    side = math.copysign(1.0, end - along(sum(p.T for p in w.pieces[:2]), w).position_m)
    for p in w.pieces[2:]:
        assert all(side * at(p.T * i / 20, p).velocity_m_s >= -1e-9 for i in range(21))


@settings(max_examples=60, deadline=None)
@given(
    start=position,
    end=position,
    share=st.floats(0.02, 0.999),
    further=st.one_of(st.just(0.0), st.floats(0.0, 0.01), st.floats(0.0, 0.5)),
    before=bounds,
    after=bounds,
)
def test_a_motion_led_on_the_way_that_it_goes_does_not_turn(
    start: float, end: float, share: float, further: float, before: Bounds, after: Bounds
) -> None:
    """Wherever on a way the next begins, to the same end or a farther one, braking harder where it must."""
    assume(abs(end - start) > 5e-3)  # shorter ones are as short as pieces may be
    side = math.copysign(1.0, end - start)
    w = move(rest(start), end, before)
    now = along(share * w.T, w)
    on = move(now, end + side * further, after, before)
    size = 1e-4 * before.speed_m_s
    assert min(side * r.velocity_m_s for r in look(on)) >= -size
    assert close(along(0.0, on), now)
    assert along(on.T, on).position_m == pytest.approx(end + side * further, abs=1e-9)
    hardest = Bounds(*map(max, before, after))
    assert_smooth(on, now, hardest)
    assert_within(on, now, hardest)


def test_a_motion_that_is_to_brake_more_gently_than_it_can_brakes_as_hard_as_it_may() -> None:
    w = move(rest(0.1), 0.6, STANDARD)
    now, gentle = along(0.75 * w.T, w), Bounds(0.3, 0.2, 4.0)
    assert min(r.velocity_m_s for r in look(move(now, 0.6, gentle))) < -0.01
    assert min(r.velocity_m_s for r in look(move(now, 0.6, gentle, STANDARD))) >= -1e-9


def test_a_long_way_is_cruised_at_the_bound() -> None:
    w = move(rest(0.1), 0.9, STANDARD)
    cruise = along(0.5 * w.T, w)
    assert cruise.velocity_m_s == pytest.approx(0.3)
    assert cruise[2:] == pytest.approx((0.0, 0.0), abs=1e-9)
    assert w.T <= 0.8 / 0.3 + 0.3


@given(speed=st.floats(0.01, 0.29), end=st.floats(0.7, 0.9))
def test_a_target_further_on_does_not_slow_the_motion(speed: float, end: float) -> None:
    w = move(Reference(0.2, speed, 0.0, 0.0), end, STANDARD)
    top = max(r.velocity_m_s for r in look(w))
    before = True
    for r in look(w):
        before = before and r.velocity_m_s < 0.99 * top
        assert not before or r.velocity_m_s >= speed - 1e-9


def test_a_motion_faster_than_the_bounds_slows_down_where_it_can() -> None:
    fast = Reference(0.1, 0.5, 0.0, 0.0)
    assert along(0.6 * move(fast, 0.9, STANDARD).T, move(fast, 0.9, STANDARD)).velocity_m_s == pytest.approx(
        0.3
    )
    w = move(fast, 0.1 + 0.5 * 0.5 * 0.46875 + 0.002, STANDARD)  # hardly more than it takes to stop
    assert all(r.velocity_m_s >= -1e-9 for r in look(w))
    assert_within(w, fast, STANDARD)


@given(start=motions, b=bounds)
def test_to_rest_ends_at_rest_within_the_bounds(start: Reference, b: Bounds) -> None:
    w = to_rest(start, b)
    acceleration, jerk = most(start, b)
    assert close(along(0.0, w), start)
    end = along(w.T, w)
    assert abs(end.velocity_m_s) <= 1e-9
    assert abs(end.acceleration_m_s2) <= 1e-6 * acceleration
    assert abs(end.jerk_m_s3) <= 1e-4 * jerk
    assert_smooth(w, start, b)
    assert_within(w, start, b)


@given(start=motions, b=bounds)
def test_to_rest_runs_no_further_than_physics_needs(start: Reference, b: Bounds) -> None:
    w = to_rest(start, b)
    acceleration, jerk = most(start, b)
    # no motion with these bounds ends its acceleration, then its velocity, over much less
    ease = 4.5 * abs(start.acceleration_m_s2) / jerk + LEAST_S
    speed = (
        abs(start.velocity_m_s)
        + 0.5 * ease * abs(start.acceleration_m_s2)
        + ease * ease * abs(start.jerk_m_s3) / 12
    )
    least = 0.5 * speed * (speed / acceleration + acceleration / jerk)
    needed = speed * (ease + LEAST_S) + 2.5 * least
    assert max(abs(r.position_m - start.position_m) for r in look(w)) <= needed


@pytest.mark.parametrize("t", [i * 0.05 for i in range(40)])
def test_the_standard_sine_stops_soon_from_wherever_it_is(t: float) -> None:
    w = to_rest(sine(t, SINE), STANDARD)
    assert w.T <= 0.3
    assert all(abs(r.position_m - sine(t, SINE).position_m) <= 0.016 for r in look(w))
    assert_within(w, sine(t, SINE), STANDARD)


@given(start=position, p=sines, b=bounds)
def test_a_transfer_leads_from_rest_onto_the_sine(start: float, p: Sine, b: Bounds) -> None:
    first = sine(0.0, p)
    w = transfer(rest(start), first, b)
    acceleration, jerk = most(first, b)
    assert along(0.0, w) == pytest.approx(rest(start), abs=1e-9)
    end = along(w.T, w)
    assert end.position_m == pytest.approx(first.position_m, abs=1e-9)
    assert end.velocity_m_s == pytest.approx(first.velocity_m_s, abs=1e-9)
    assert end.acceleration_m_s2 == pytest.approx(first.acceleration_m_s2, abs=1e-6 * acceleration)
    assert end.jerk_m_s3 == pytest.approx(first.jerk_m_s3, abs=1e-4 * jerk)
    assert_smooth(w, first, b)
    assert_within(w, first, b)
    fastest = max(b.speed_m_s, abs(first.velocity_m_s) + LEAST_S**2 * abs(first.jerk_m_s3))
    assert all(abs(r.velocity_m_s) <= 1.001 * fastest for r in look(w))


@pytest.mark.parametrize("start", [0.02, 0.08, 0.436, 0.4868, 0.54, 0.98])
def test_a_transfer_across_the_stroke_stays_within_it(start: float) -> None:
    w = transfer(rest(start), sine(0.0, SINE), STANDARD)
    assert stays(w, 0.02 - 1e-12, 0.98 + 1e-12)
    assert all(abs(r.velocity_m_s) <= 0.3003 for r in look(w))
    assert 2.1875 * abs(start - 0.4868) / 0.3 + 1.5 >= w.T


def test_whether_a_way_stays_is_seen_between_its_ends() -> None:
    there_and_back = way(*move(rest(0.3), 0.6, STANDARD).pieces, *move(rest(0.6), 0.3, STANDARD).pieces)
    assert stays(there_and_back, 0.3 - 1e-9, 0.6 + 1e-9)
    assert not stays(there_and_back, 0.3, 0.599)
    assert not stays(there_and_back, 0.301, 0.6)
    assert not stays(there_and_back, math.nan, 0.6)


def test_a_stop_that_fits_is_the_stop_that_was_asked_for() -> None:
    start = Reference(0.5, 0.2, 0.0, 0.0)
    assert stop(start, STANDARD, 0.02, 0.98) == to_rest(start, STANDARD)


@given(t=times, b=bounds)
def test_a_sine_never_stops_outside_the_travel_it_moves_in(t: float, b: Bounds) -> None:
    low, high = SINE.centre_m - SINE.amplitude_m, SINE.centre_m + SINE.amplitude_m
    margin = 3e-4  # a stop takes LEAST_S twice, however hard: up to ½ a (1.5 LEAST_S)² beyond the sine's end
    w = stop(sine(t, SINE), b, low - margin, high + margin)
    assert stays(w, low - margin, high + margin)
    assert close(along(0.0, w), sine(t, SINE))
    assert abs(along(w.T, w).velocity_m_s) <= 1e-9


def test_a_stop_that_cannot_be_is_made_as_hard_as_possible() -> None:
    start = Reference(0.979, 1.0, 0.0, 0.0)
    w = stop(start, STANDARD, 0.02, 0.98)
    assert not stays(w, 0.02, 0.98)
    assert pytest.approx(2.0 * LEAST_S) == w.T
    assert abs(along(w.T, w).velocity_m_s) <= 1e-9
