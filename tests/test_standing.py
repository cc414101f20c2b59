"""An axis at its target: in position or not, and hunting or not, by which cause."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from axis_rig import ENCODER, Rig, in_position_without, loaded, quick, ready
from pneud.axis.standing import AT_WORK, Expected, Standing, cause, judge
from pneud.compiled.backend import INTERPRETED
from pneud.config.conversions import axis_of, expected_of, plant_of
from pneud.control.adaptation import Adaptation
from pneud.control.reference import Sine, rest, septic, sine, way
from pneud.loading import load
from pneud.signals import HUNTING_CURES, Hunting, RequestKind, State
from pneud.study import trial
from pneud.study.trial import Errand
from test_standstill import ticks_of

MS = 1_000_000
P = Expected(
    tolerance_m=20e-6,
    velocity_m_s=2e-3,
    time_ns=50 * MS,
    swing_m=30e-6,
    longest_ns=5_000 * MS,
    step_v=0.05,
    share=1.0 - math.exp(-1.0 / 300.0),
    fast_ns=40 * MS,
    period_ns=MS,
)
numbers = st.floats(allow_nan=True, allow_infinity=True)


def stood(
    seconds: float, error: Any = 0.0, command: Any = 0.0, begin: Standing = AT_WORK, start_s: float = 1.0
) -> list[Standing]:
    """What comes of errors and commands as functions of time, tick by tick."""
    s, states, last_v = begin, [], 0.0
    for i in range(round(1e3 * seconds)):
        t = 1e-3 * i
        e, v = (f(t) if callable(f) else f for f in (error, command))
        s = judge(s, round(1e9 * (start_s + t)), e, 0.0, v - last_v if i else 0.0, True, P)
        last_v = v
        states.append(s)
    return states


def swing(amplitude: float, period_s: float) -> Any:
    return lambda t: amplitude * math.sin(2.0 * math.pi * t / period_s)


def test_in_position_takes_error_speed_and_time() -> None:
    states = stood(0.2, lambda t: 25e-6 if t < 0.1 else -19e-6)
    assert [s.in_position for s in states].index(1) == 150
    assert not any(s.in_position for s in stood(1.0, 21e-6))
    fast = AT_WORK
    for i in range(200):
        fast = judge(fast, i * MS, 0.0, 2.1e-3, 0.0, True, P)
    assert not fast.in_position
    assert not judge(states[-1], 2_000 * MS, 21e-6, 0.0, 0.0, True, P).in_position
    assert judge(AT_WORK, MS, 0.0, 0.0, 0.0, True, P._replace(time_ns=0)).in_position == 1


def test_what_was_not_read_begins_neither_the_statement_nor_its_time() -> None:
    def at(error_m: float, read: Callable[[int], bool]) -> list[Standing]:
        s, found = AT_WORK, []
        for i in range(120):
            s = judge(s, i * MS, error_m if i < 100 else 21e-6, 0.0, 0.0, read(i), P)
            found.append(s)
        return found

    late = at(0.0, lambda i: i >= 20)
    assert [s.within_ns for s in late[19:22]] == [-1, 20 * MS, 20 * MS]
    assert [s.in_position for s in late].index(1) == 70
    gap = at(0.0, lambda i: not 45 <= i < 60)
    assert [s.in_position for s in gap].index(1) == 60
    gone = at(0.0, lambda i: i < 80)
    assert [s.in_position for s in gone] == 50 * [0] + 50 * [1] + 20 * [0]
    slow = at(0.0, lambda i: i % 8 == 0)
    assert [s.in_position for s in slow].index(1) == 56


@pytest.mark.parametrize(
    ("period_s", "found"), [(0.008, Hunting.ENCODER), (0.05, Hunting.VALVE), (0.5, Hunting.FRICTION)]
)
def test_an_error_that_swings_without_end_is_hunting_by_its_period(period_s: float, found: Hunting) -> None:
    states = stood(3.0, swing(20e-6, period_s))
    assert not any(s.hunting for s in states[:1000])
    assert states[-1].hunting == found
    calm = stood(6.0, 0.0, begin=states[-1], start_s=4.0)
    assert calm[0].hunting == found
    assert calm[-1].hunting == 0


@pytest.mark.parametrize(
    ("period_s", "found"), [(0.004, Hunting.ENCODER), (0.03, Hunting.VALVE), (0.2, Hunting.FRICTION)]
)
def test_a_command_that_chatters_is_hunting_by_how_often_it_turns(period_s: float, found: Hunting) -> None:
    states = stood(2.0, 0.0, swing(0.06e3 / 4.0 * period_s, period_s))
    assert not any(s.hunting for s in states[:1000])
    assert states[-1].hunting == found
    assert stood(1.0, 0.0, begin=states[-1], start_s=3.0)[-1].hunting == 0


@pytest.mark.parametrize(
    "error",
    [
        *(swing(14e-6, 0.5), swing(14e-6, 0.004)),  # small
        lambda t: 1e-3 * math.exp(-8.0 * t) * math.cos(100.0 * t),  # dies out
        lambda t: 1e-4 if 2.0 < t < 2.5 else 0.0,  # a push
        lambda t: 1e-4 * t,  # creeps
        swing(1e-3, 12.0),  # slower than what is looked for
    ],
)
def test_what_ends_or_is_small_or_slow_is_no_hunting(error: Any) -> None:
    assert not any(s.hunting for s in stood(30.0, error))


def test_a_push_is_no_chatter() -> None:
    """One that the law answers with 2 V, and ringing."""
    calm = stood(4.0, 0.0, lambda t: 2.0 * math.exp(-10.0 * (t - 2.0)) * math.cos(60.0 * t) if t > 2 else 0.0)
    assert not any(s.hunting for s in calm)


def test_what_it_hunts_by_stays_until_it_hunts_no_longer() -> None:
    states = stood(2.0, 0.0, swing(0.06, 0.004))
    more = stood(3.0, swing(20e-6, 0.5), swing(0.04, 0.004), begin=states[-1], start_s=3.0)
    assert {s.hunting for s in more} == {int(Hunting.ENCODER)}


def test_each_cause_has_a_cure() -> None:
    assert {cause(half * MS, P) for half in (1, 20, 200)} == set(Hunting) - {Hunting.NONE}
    assert set(HUNTING_CURES) == set(Hunting) - {Hunting.NONE}


@given(st.lists(st.tuples(numbers, numbers, numbers, st.booleans()), max_size=30))
def test_nothing_breaks_it(seen: list[tuple[float, float, float, bool]]) -> None:
    s = AT_WORK
    for i, (error_m, velocity_m_s, step_v, measured) in enumerate(seen):
        before, s = s, judge(s, i * MS, error_m, velocity_m_s, step_v, measured, P)
        assert s.in_position in (0, 1)
        assert measured or (s.in_position <= before.in_position and s.within_ns in (-1, before.within_ns))
        assert s.hunting in list(Hunting)


@settings(max_examples=20, deadline=None)
@given(
    st.sampled_from([100.0, 300.0, 1000.0]),
    st.integers(1, 9),
    st.lists(st.floats(-0.24, 0.24), min_size=10, max_size=10),
)
def test_a_time_of_whole_periods_in_position_takes_as_many_ticks_whenever_they_come(
    rate_hz: float, n: int, off: list[float]
) -> None:
    c = loaded().config
    c = c.model_copy(
        update={
            "loop": c.loop.model_copy(update={"rate_hz": rate_hz}),
            "in_position": c.in_position.model_copy(update={"time_s": n / rate_hz}),
        }
    )
    p, s = expected_of(c), AT_WORK
    for i in range(n + 1):
        assert not s.in_position
        t_ns = round(1e9 * (1.0 + (i + off[i]) / rate_hz))
        s = judge(s, t_ns, 0.0, 0.0, 0.0, True, p)
    assert s.in_position


# of the axis


def until_in_position(rig: Rig, limit: int = 3000) -> int:
    for count in range(limit):
        if rig.tick().in_position:
            return count
    raise AssertionError("never in position")


def test_an_axis_is_in_position_at_the_end_of_its_way_and_only_there() -> None:
    rig = ready()
    assert not any(t.in_position for t in rig.ticks(100))
    rig.tick(RequestKind.ARM)
    assert until_in_position(rig) >= 49
    end = rig.tick().reference.position_m + 2e-6
    tick = rig.tick(RequestKind.GOTO, end)
    assert (tick.state, tick.in_position) == (State.MOVING, 0)
    assert abs(tick.reference.position_m - tick.estimate.position_m) < 20e-6
    while tick.state == State.MOVING:
        assert not tick.in_position
        tick = rig.tick()
    assert tick.state == State.HOLDING
    assert not tick.in_position
    assert until_in_position(rig) >= 48
    frozen = rig.axis.freeze()
    assert frozen.standing.in_position == 1
    tick = rig.tick(RequestKind.TRACK, 0.0)
    assert (tick.state, tick.in_position) == (State.TRACKING, 0)
    assert rig.axis.state.standing == AT_WORK
    assert not any(t.in_position for t in rig.ticks(400))
    assert not rig.tick(RequestKind.STOP).in_position
    rig.until(State.HOLDING)
    assert until_in_position(rig) >= 48
    assert not rig.tick(RequestKind.DISARM).in_position
    assert not any(t.in_position for t in rig.ticks(200))


@pytest.mark.parametrize("quickly", [True, False], ids=["compiled", "interpreted"])
def test_an_axis_is_not_in_position_by_an_estimate_that_is_led_on(quickly: bool) -> None:
    def said(missing: range) -> list[int]:
        rig = ready()
        rig.go_on(quick() if quickly else INTERPRETED)
        rig.tick(RequestKind.ARM)
        return in_position_without(rig, ENCODER, missing, 400)

    usual = said(range(0))
    first = usual.index(1)
    assert 0 not in usual[first:]
    assert said(range(first, first + 5)) == usual[:first] + 5 * [0] + usual[first + 5 :]
    assert said(range(first + 1, first + 20)) == usual


# on a rig


class Stood(NamedTuple):
    """What came of it."""

    hunting: set[int]
    last: int
    in_position_ticks: int
    ticks: int


def rested(seconds: float, adapts: bool = True, **changes: Any) -> Stood:
    """A second of sine, then rest, with changes of virtual.toml and of its plant."""
    here = load("virtual.toml", None, changes)
    p, plant = axis_of(here.config, here.codecs.command_lsb_v), plant_of(here.config)
    c = p.controller if adapts else p.controller._replace(adaptation=Adaptation())
    motion, centre_m = p.reference, p.reference.centre_m
    pair = trial.begin(centre_m, c, plant)
    joining = Errand(way(septic(1.0, rest(centre_m), sine(0.0, motion))), motion)
    leaving = Errand(
        way(septic(1.0, sine(1.0, motion), rest(centre_m))), Sine(centre_m, 0.0, motion.omega_rad_s)
    )
    for i in range(2_000):
        pair = ticks_of()[1](pair, i * c.h, i == 0, joining, c, plant, 10.0 / 4096)
    s, found, inside = AT_WORK, set(), 0
    for i in range(1_000 + round(1e3 * seconds)):
        before_v = pair.last_v
        pair = ticks_of()[1](pair, i * c.h, False, leaving, c, plant, 10.0 / 4096)
        if i < 1_000:
            continue
        m = pair.state.motion
        s = judge(s, i * MS, pair.reference_m - m.x, m.v, pair.last_v - before_v, True, p.expected)
        found.add(s.hunting)
        inside += s.in_position
    return Stood(found, s.hunting, inside, i - 999)


def sensors(step_m: float, **control: Any) -> dict[str, Any]:
    return {
        "control": {"motion": {"encoder_resolution_m": step_m}, **control},
        "plant": {"sensors": {"encoder_resolution_m": step_m}},
    }


@pytest.mark.parametrize("seconds", [10.0, pytest.param(60.0, marks=pytest.mark.slow)])
def test_at_rest_it_is_in_position_and_does_not_hunt(seconds: float) -> None:
    stands = rested(seconds)
    assert stands.hunting == {0}
    assert stands.in_position_ticks > 0.98 * stands.ticks


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        (sensors(10e-6, standstill=False), Hunting.ENCODER),
        (
            {"control": {"standstill": False}, "plant": {"friction": {"bristle_stiffness_n_m": 1e6}}},
            Hunting.VALVE,
        ),
        (
            {"control": {"standstill": False, "creep": False}, "plant": {"valve": {"bandwidth_hz": 30.0}}},
            Hunting.VALVE,
        ),
    ],
    ids=["encoder", "bristles", "valve"],
)
def test_a_rig_that_hunts_is_named(changes: dict[str, Any], found: Hunting) -> None:
    stands = rested(5.0, adapts=False, **changes)
    assert stands.last == found
    assert stands.in_position_ticks < 0.5 * stands.ticks
