"""A reference that another axis gives: without a jolt, without lag, and held where both are at rest."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pneud.control.leading import (
    ALONE,
    AT_REST_NS,
    GANTRY,
    LEADS,
    LONGEST_NS,
    NOT_LED,
    POSITION,
    REFERENCE,
    Leading,
    Led,
    aim,
    anew,
    carried,
    follow,
    is_told,
    shifted,
    skew_m,
    smoothed,
)
from pneud.control.reference import Bounds, Sine, rest, sine, still
from pneud.signals import Reference, Told

BOUNDS = Bounds(0.3, 2.0, 40.0)
P = Leading(REFERENCE, 1.0, 0.0, 50.0, low_m=0.0, high_m=1.0, speed_m_s=1.0)
MS = 1_000_000
places = st.floats(0.2, 0.8)
rates = st.floats(-1.0, 1.0)


def told(r: Reference, t_ns: int = 0, x: float = 0.5, v: float = 0.0) -> Told:
    return Told(t_ns, *r, x, v)


def near(a: Reference, b: Reference, by: tuple[float, ...] = (1e-9, 1e-7, 1e-5, 1e-2)) -> bool:
    return all(abs(x - y) <= most for x, y, most in zip(a, b, by, strict=True))


@given(places, rates, rates, rates, st.floats(0.0, 0.1), st.floats(0.0, 0.1))
def test_to_be_carried_on_twice_is_to_be_carried_on(
    x: float, v: float, a: float, j: float, t: float, more: float
) -> None:
    r = Reference(x, v, a, j)
    assert near(carried(carried(r, t), more), carried(r, t + more))
    assert carried(rest(x), t) == rest(x)


@given(places, rates, places, rates, st.floats(0.0, 0.2), st.floats(0.0, 0.2), st.floats(5.0, 300.0))
def test_the_filter_does_not_care_how_time_is_divided(
    x: float, v: float, goal: float, speed: float, t: float, more: float, w: float
) -> None:
    s = Led(x=x, v=v, a=0.1, j=-0.2)
    once = smoothed(s, goal + speed * (t + more), speed, t + more, w)
    twice = smoothed(smoothed(s, goal + speed * t, speed, t, w), goal + speed * (t + more), speed, more, w)
    for name, most in (("x", 1e-9), ("v", 1e-7), ("a", 1e-4), ("j", 1e-1)):
        assert getattr(once, name) == pytest.approx(getattr(twice, name), abs=most)


def test_the_filter_follows_a_constant_speed_without_lag_and_without_swinging() -> None:
    s, w, h = Led(x=0.0), 50.0, 1e-3
    passed = []
    for i in range(1, 1001):
        s = smoothed(s, 0.2 * h * i, 0.2, h, w)
        passed.append(s.v)
    assert s.x == pytest.approx(0.2, abs=1e-9)
    s = Led(x=0.0)
    for _ in range(1000):
        s = smoothed(s, 1.0, 0.0, h, w)
        assert 0.0 <= s.x <= 1.0 + 1e-12
    assert s.x == pytest.approx(1.0, abs=1e-9)


def test_nobody_leads_who_has_said_nothing_or_said_it_long_ago() -> None:
    word = told(rest(0.5))
    assert is_told(word, 2 * MS, REFERENCE)
    assert not is_told(None, 0, REFERENCE)
    assert not is_told(word, LONGEST_NS + 1, REFERENCE)
    assert not is_told(word, -1, REFERENCE)
    nowhere = word._replace(position_m=math.nan)
    assert not is_told(nowhere, 0, REFERENCE)
    assert is_told(nowhere, 0, POSITION)
    assert not is_told(word._replace(measured_m=math.nan), 0, POSITION)


@given(places, places, st.sampled_from([-2.0, -0.5, 0.3, 1.0]), st.integers(0, 400))
@settings(max_examples=30)
def test_following_begins_where_the_axis_was_and_ends_with_the_other(
    own: float, other: float, scale: float, begins_ms: int
) -> None:
    motion = Sine(other, 0.05, 2.0 * math.pi * 0.5)
    p = P._replace(scale=scale, offset_m=0.5 - scale * other)
    led, before, since = NOT_LED, rest(own), 0
    for ms in range(0, 4000, 2):
        now_ns = ms * MS
        said = told(sine((ms - 2) * 1e-3, motion), now_ns - 2 * MS) if ms >= begins_ms else None
        guided = follow(led, still(own), since, said, now_ns, BOUNDS, p)
        led, r = guided.led, guided.reference
        assert not guided.lost
        steps = abs(r.position_m - before.position_m), abs(r.velocity_m_s - before.velocity_m_s)
        assert steps[0] <= 2e-3 * 1.0
        assert steps[1] <= 2e-3 * 8.0
        assert abs(r.acceleration_m_s2 - before.acceleration_m_s2) <= 2e-3 * 200.0
        before = r
    there = sine(3.998, motion)
    wanted = Reference(p.offset_m + scale * there[0], *(scale * part for part in there[1:]))
    assert near(before, wanted, (1e-6, 1e-5, 1e-3, 1.0))


def test_one_who_is_no_longer_led_knows_where_he_was_going() -> None:
    moving = Reference(0.5, 0.2, 0.0, 0.0)
    first = follow(NOT_LED, still(0.5), 0, told(moving), 0, BOUNDS, P)
    assert not first.lost
    later = follow(first.led, still(0.5), 0, None, 10 * MS, BOUNDS, P)
    assert later.lost
    assert later.reference == carried(first.reference, 0.01)
    waiting = follow(NOT_LED, still(0.5), 0, None, 10 * MS, BOUNDS, P)
    assert (waiting.lost, waiting.reference, waiting.at_rest) == (False, rest(0.5), False)


def test_what_leads_beyond_the_limits_is_told() -> None:
    for r, beyond in (
        (rest(0.5), False),
        (rest(1.1), True),
        (rest(-0.1), True),
        (Reference(0.5, 1.2, 0.0, 0.0), True),
    ):
        led = Led(since_ns=0, path=still(0.0))
        assert follow(led, still(0.5), 0, told(r, 30 * MS), 30 * MS, BOUNDS, P).beyond is beyond


def test_a_measured_position_is_followed_smoothly() -> None:
    p, led = P._replace(how=POSITION, bandwidth_rad_s=60.0), NOT_LED
    noise = (1e-5, -1e-5, 0.0)
    accelerations = []
    for ms in range(0, 2000, 2):
        x = 0.5 + 0.1 * math.sin(2e-3 * ms) + noise[ms // 2 % 3]
        word = told(rest(math.nan), ms * MS, x, 0.2 * math.cos(2e-3 * ms))
        guided = follow(led, still(0.5), 0, word, ms * MS, BOUNDS, p)
        led = guided.led
        accelerations.append(abs(guided.reference.acceleration_m_s2))
    assert guided.reference.position_m == pytest.approx(0.5 + 0.1 * math.sin(2e-3 * 1998), abs=6e-4)
    assert max(accelerations) < 3.0


def test_a_follower_is_at_rest_when_the_other_has_been_for_a_while() -> None:
    led = follow(NOT_LED, still(0.5), 0, told(rest(0.5)), 0, BOUNDS, P).led
    for ms, wanted in ((2, False), (20, False), (30, False), (30 + AT_REST_NS // MS, True)):
        guided = follow(led, still(0.5), 0, told(rest(0.5), ms * MS), ms * MS, BOUNDS, P)
        led = guided.led
        assert guided.at_rest is wanted
    moving = told(Reference(0.5, 0.1, 0.0, 0.0), 200 * MS)
    assert not follow(led, still(0.5), 0, moving, 200 * MS, BOUNDS, P).at_rest


def test_the_skew_is_that_of_one_instant() -> None:
    p = P._replace(how=GANTRY, offset_m=0.1)
    word = told(rest(0.3), 0, 0.3, 0.5)
    assert skew_m(word, 0.402, 2 * MS, p) == pytest.approx(0.001)
    assert math.isnan(skew_m(None, 0.4, 0, p))
    assert math.isnan(skew_m(word, 0.4, LONGEST_NS + 1, p))
    assert math.isnan(skew_m(word, 0.4, -1, p))


def test_the_halves_of_a_gantry_give_way_to_each_other_and_then_hold() -> None:
    p = P._replace(how=LEADS, coupling=0.5, bandwidth_rad_s=50.0)
    moving, led = Reference(0.5, 0.1, 0.0, 0.0), NOT_LED
    assert aim(moving, led, p._replace(how=ALONE)) is moving
    for ms in range(0, 1000, 2):
        led = shifted(led, moving, 1e-3, ms * MS, p)
    assert led.x == pytest.approx(-0.5e-3, rel=1e-3)
    assert aim(moving, led, p).position_m == pytest.approx(0.4995)
    for ms in range(1000, 1040, 2):  # at rest, and still giving way
        led = shifted(led, rest(0.6), -1e-3, ms * MS, p)
    assert led.v > 0.0
    for ms in range(1040, 3000, 2):
        led = shifted(led, rest(0.6), -1e-3, ms * MS, p)
    held = led.x
    assert held == pytest.approx(0.5e-3, rel=1e-2)
    for ms in range(3000, 3100, 2):
        led = shifted(led, rest(0.6), 2e-3, ms * MS, p)
    assert (led.x, led.v, led.a, led.j) == (held, 0.0, 0.0, 0.0)
    assert aim(rest(0.6), led, p)[1:] == (0.0, 0.0, 0.0)
    same = shifted(led, moving, 2e-3, 3098 * MS, p)  # no time has passed
    assert same.x == held
    unknown = shifted(led, moving, math.nan, 3200 * MS, p)
    assert unknown.x == pytest.approx(held)


def test_who_is_led_anew_keeps_a_gantrys_shift() -> None:
    led = Led(since_ns=5, at_ns=7, x=1e-3, still_ns=6)
    assert anew(led, P) == NOT_LED
    assert anew(led, P._replace(how=GANTRY)) == led._replace(since_ns=-1, still_ns=-1)
