"""Which ticks the tracking error is over: whole periods, and motions that have come to their end."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pneud.control.reference import Bounds, Sine, along, move, rest, sine, transfer
from pneud.loop.tracking import AFTER_S, MOTIONS, Tracking, in_words
from pneud.signals import Reference, Request, RequestKind, State

HZ = 1000
BOUNDS = Bounds(0.3, 2.0, 40.0)
WAY = Sine(0.5, 0.05, math.pi)


def follow(tracking: Tracking, duration_s: float, way: Sine = WAY, hz: float = HZ) -> Tracking:
    """Track a sine with an error that belongs to its phase."""
    for k in range(round(duration_s * hz)):
        error_m = 1e-3 * max(0.0, math.sin(way.omega_rad_s * k / hz))
        tracking.add(round(k * 1e9 / hz), State.TRACKING, None, error_m, sine(k / hz, way), 0.1)
    return tracking


@settings(max_examples=20, deadline=None)
@given(st.floats(8.2, 16.0))
def test_the_figure_does_not_hang_on_where_a_run_ends(duration_s: float) -> None:
    found = follow(Tracking(True), duration_s, hz=100).tracking_mm()
    # half a sine: its mean square is a quarter
    assert found["rms"] == pytest.approx(0.5, rel=2e-2)
    assert found["max"] == pytest.approx(1.0, rel=1e-2)
    assert found["periods"] in ((duration_s - AFTER_S) // 2 - 1, (duration_s - AFTER_S) // 2)
    assert (found["against"], found["after_s"]) == ("plant", AFTER_S)
    assert "reason" not in found


@pytest.mark.parametrize(
    ("frequency_hz", "hz"), [(0.5, 1000), (2.0, 250), (5.0, 1000), (20.0, 1000), (0.2, 100)]
)
def test_periods_of_any_length(frequency_hz: float, hz: int) -> None:
    way = Sine(0.5, 0.01, 2.0 * math.pi * frequency_hz)
    found = follow(Tracking(True), AFTER_S + 4.6 / frequency_hz, way, hz).tracking_mm()
    assert found["periods"] == 4
    assert found["rms"] == pytest.approx(0.5, rel=0.05)


@pytest.mark.parametrize("duration_s", [1.0, 2.9])
def test_without_a_whole_period_the_reason_stands_there(duration_s: float) -> None:
    tracking = follow(Tracking(False), duration_s)
    found = tracking.tracking_mm()
    assert (found["rms"], found["max"], found["periods"], found["against"]) == (None, None, 0, "encoder")
    assert found["reason"].startswith("no whole period of the reference")
    assert in_words(found) == f"no tracking error: {found['reason']}"
    assert tracking.command_v() is None


def test_an_axis_that_did_nothing_has_a_reason_too() -> None:
    tracking = Tracking(True)
    for k in range(9000):
        tracking.add(k * 1_000_000, State.DISARMED, None, math.nan, (math.nan,) * 4, 0.0)
    assert tracking.tracking_mm()["reason"] == "the axis neither tracked nor moved"


def test_a_reference_that_stands_has_no_periods_and_no_errors_no_figure() -> None:
    tracking = Tracking(True)
    for k in range(9000):
        tracking.add(k * 1_000_000, State.TRACKING, None, 1e-3, rest(0.3), 0.0)
    assert tracking.tracking_mm()["periods"] == 0
    tracking = Tracking(True)
    for k in range(12_000):
        tracking.add(k * 1_000_000, State.TRACKING, None, math.nan, sine(k * 1e-3, WAY), 0.0)
    assert tracking.tracking_mm()["reason"] == "no position was told"


@pytest.mark.parametrize("duration_s", [3.1, 5.0, 6.0, 7.0])
def test_a_short_run_is_judged_by_the_last_period_that_it_has(duration_s: float) -> None:
    found = follow(Tracking(True), duration_s).tracking_mm()
    assert (found["periods"], found["rms"]) == (1, pytest.approx(0.5, rel=1e-2))
    assert 0.0 < found["after_s"] < AFTER_S
    assert f"over 1 whole period from {found['after_s']:g} s on" in in_words(found)


@pytest.mark.parametrize("seconds", [3.5, 5.0, 8.0, 16.0])
@pytest.mark.parametrize("slow", [1.0, 6.0])
def test_the_way_that_joins_the_reference_is_in_no_period(slow: float, seconds: float) -> None:
    """However long it is: what does not end as it began is no period."""
    tracking = Tracking(True)
    join = transfer(rest(0.1), sine(0.0, WAY), Bounds(0.3 / slow, 2.0, 40.0))
    for k in range(round(1e3 * (join.T + seconds))):
        t = k * 1e-3
        reference, error_m = (along(t, join), 1.0) if t < join.T else (sine(t - join.T, WAY), 1e-3)
        tracking.add(k * 1_000_000, State.TRACKING, None, error_m, reference, 0.1)
    found = tracking.tracking_mm()
    assert found["periods"] >= max(1, (seconds - AFTER_S) // 2 - 1)
    assert found["max"] == pytest.approx(1.0)


def test_periods_of_two_stretches_add_up_and_a_fault_between_ends_one() -> None:
    tracking = Tracking(True)
    for start_s in (0.0, 20.0):
        for k in range(10_000):
            t_ns = round(start_s * 1e9) + k * 1_000_000
            tracking.add(t_ns, State.TRACKING, None, 1e-3, sine(k * 1e-3, WAY), 0.1)
        tracking.add(t_ns + 1_000_000, State.FAULT, None, 5.0, (math.nan,) * 4, 0.0)
    found = tracking.tracking_mm()
    assert found["periods"] == 4
    assert (found["rms"], found["max"]) == (pytest.approx(1.0), pytest.approx(1.0))
    assert tracking.command_v() == {"max": 0.1, "mean_step": 0.0}


def motion(
    tracking: Tracking, t_s: float, request: Request, error_m: float, state: int = State.MOVING
) -> float:
    way = move(rest(0.2), 0.4, BOUNDS)
    for k in range(round(way.T * HZ)):
        taken = request if k == 0 else None
        t_ns = round(t_s * 1e9) + k * 1_000_000
        tracking.add(t_ns, state, taken, error_m, along(k / HZ, way), 0.5)
    return t_s + way.T


def test_each_motion_has_its_own() -> None:
    tracking, goto = Tracking(True), RequestKind.GOTO
    t_s = motion(tracking, 1.0, Request(goto, (0.4, 0.0, 0.0, 0.0)), 1e-3)
    t_s = motion(tracking, t_s, Request(goto, (0.1, 0.0, 0.0, 0.0)), -2e-3)  # while it still moves
    tracking.add(round(t_s * 1e9), State.HOLDING, None, 9.0, rest(0.4), 0.0)
    t_s = motion(tracking, t_s + 1.0, Request(RequestKind.JOG, (0.1, 200.0)), 3e-3)
    tracking.add(round(t_s * 1e9), State.HOLDING, None, 9.0, rest(0.4), 0.0)
    t_s = motion(tracking, t_s + 1.0, Request(RequestKind.TRACK, (1.0,)), 4e-3, State.TRACKING)
    tracking.add(round(t_s * 1e9), State.HOLDING, None, 9.0, rest(0.4), 0.0)
    motion(tracking, t_s + 1.0, Request(goto, (0.4, 0.0, 0.0, 0.0)), 99.0)  # not at its end
    found = tracking.tracking_mm()
    assert [(m["kind"], m["to_mm"]) for m in found["motions"]] == [
        ("goto", 400.0), ("goto", 100.0), ("jog", None), ("track", None),
    ]  # fmt: skip
    assert [m["rms"] for m in found["motions"]] == [pytest.approx(e) for e in (1.0, 2.0, 3.0, 4.0)]
    assert [m["max"] for m in found["motions"]] == [pytest.approx(e) for e in (1.0, 2.0, 3.0, 4.0)]
    assert found["periods"] == 0
    assert found["rms"] == pytest.approx(math.sqrt((1 + 4 + 9 + 16) / 4), rel=1e-3)
    assert "over 4 motions" in in_words(found)


def test_no_more_motions_are_kept_than_anybody_reads() -> None:
    tracking = Tracking(True)
    for k in range(2 * MOTIONS):
        request = Request(RequestKind.GOTO, (0.001 * k, 0.0, 0.0, 0.0))
        tracking.add(k * 1_000_000, State.MOVING, request, 1e-3, Reference(0.1, 0.0, 0.0, 0.0), 0.1)
    found = tracking.tracking_mm()["motions"]
    assert len(found) == MOTIONS
    assert found[-1]["to_mm"] == pytest.approx(2 * MOTIONS - 2)
