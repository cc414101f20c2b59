"""What an axis is put through once it is commissioned: within bounds, and judged by its ticks alone."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence

import pytest

from pneud.axis.state import AxisParameters
from pneud.axis.stops import soft_limits
from pneud.compiled.backend import INTERPRETED
from pneud.config import conversions
from pneud.console import profiles
from pneud.control.profile import extent
from pneud.loading import load
from pneud.replay.lockstep import Simulation, backend_of
from pneud.safety.faults import F
from pneud.signals import Answer, Record, Reference, Request, RequestKind, State
from pneud.study.commissioning.playing import QUIET_S
from pneud.study.commissioning.verification import (
    DWELL_S,
    SINE_S,
    Part,
    Seen,
    Verification,
    Verified,
    came_to,
    course,
    worst,
)
from pneud.study.judging import Figure, tolerances

T = tolerances(5e-6)
H_NS = 1_000_000
QUIET = round(QUIET_S / 1e-3) + 1
STEP = Part("1 mm", to_m=0.501, dwell_s=DWELL_S)


@pytest.fixture(scope="module")
def template() -> Record:
    return list(Simulation(load("virtual.toml"), 0.01, how=INTERPRETED).records())[-1]


@pytest.fixture(scope="module")
def axis() -> AxisParameters:
    loaded = load("virtual.toml")
    return conversions.axis_of(loaded.config, loaded.codecs.command_lsb_v)


def ticked(
    r: Record, i: int, state: State, reference_m: float, position_m: float, volts: float = 0.0
) -> Record:
    m = r.tick.measurement._replace(position_m=position_m)
    tick = r.tick._replace(
        t_ns=i * H_NS,
        measurement=m,
        reference=Reference(reference_m, 0.0, 0.0, 0.0),
        command=r.tick.command._replace(voltage_v=volts),
        state=int(state),
        estimate=r.tick.estimate._replace(position_m=position_m),
        request=None,
        latched=0,
    )
    return r._replace(tick=tick, truth_m=math.nan)


def seen(records: Sequence[Record]) -> list[Seen]:
    return [Seen(r.tick, r.truth_m) for r in records]


def stepped(r: Record, places_m: Sequence[float], moving: int) -> list[Record]:
    return [
        ticked(r, i, State.MOVING if i < moving else State.HOLDING, 0.501, at_m)
        for i, at_m in enumerate(places_m)
    ]


def test_a_step_is_in_position_when_it_stays_there(template: Record) -> None:
    places_m = [0.5] * 50 + [0.50108] * 10 + [0.501] * 100 + [0.50097] * 5 + [0.501] * 100
    over, after = came_to(STEP, seen(stepped(template, places_m, moving=55)), T)
    assert [over.part, over.what, after.what] == ["1 mm", "overshoot_m", "in_position_s"]
    assert [over.value, over.limit, after.value, after.limit] == pytest.approx([80e-6, 50e-6, 0.110, 0.4])
    assert (over.ratio > 1.0, after.ratio > 1.0) == (True, False)


def test_a_step_that_ends_beside_its_target_is_never_in_position(template: Record) -> None:
    over, after = came_to(STEP, seen(stepped(template, [0.5] * 50 + [0.50097] * 100, moving=50)), T)
    assert over.value == 0.0
    assert math.isinf(after.value)
    missed = Verified((over, after)).as_json()
    assert json.loads(json.dumps(missed, allow_nan=False))["figures"][1]["value"] is None


def test_a_sine_is_judged_at_its_full_width(template: Record) -> None:
    """Neither while it is learnt and swells, nor where it fades."""
    n = round(SINE_S * 1e3)
    off_m = [1e-3 if i < 4990 or i > n - 2000 else 1e-4 for i in range(n)]
    records = [
        ticked(template, i, State.TRACKING, 0.5, 0.5 - off, 0.1 * (i % 2)) for i, off in enumerate(off_m)
    ]
    late = [ticked(template, 0, State.HOLDING, 0.5, 0.5)]
    figures = came_to(Part("sine"), seen(late + records), T)
    assert [f.what for f in figures] == ["rms_m", "max_m", "mean_step_v"]
    assert [f.value for f in figures] == pytest.approx([1e-4, 1e-4, 0.1])
    assert [f.limit for f in figures] == [5e-5, 2e-4, 0.15]


def test_rest_is_judged_when_the_load_has_settled(template: Record) -> None:
    part = Part("rest", to_m=0.5, dwell_s=8.0)
    records = [
        ticked(template, i, State.HOLDING, 0.5, 0.5 + (1e-3 if i < 2990 else 4e-6)) for i in range(8000)
    ]
    most, step = came_to(part, seen(records), T)
    assert [most.value, most.limit, step.value, step.limit] == pytest.approx([4e-6, 15e-6, 0.0, 0.02])


def test_the_worst_of_several_steps_counts() -> None:
    figures = [Figure("1 mm", "overshoot_m", value, 50e-6) for value in (1e-5, 7e-5, 2e-5)]
    assert worst(figures) == (figures[1],)


@pytest.mark.parametrize("file", ["virtual.toml", "rig.toml", "paper-case1.toml"])
def test_all_motions_stay_within_travel_and_bounds(file: str) -> None:
    loaded = load(file)
    p = conversions.axis_of(loaded.config, loaded.codecs.command_lsb_v)
    low_m, high_m = soft_limits(p)
    parts = course(p, loaded.config.cylinder.stroke_m)
    assert {"sine", "rest", "1 mm", "10 mm", "100 mm"} <= {part.name for part in parts}
    for part in parts:
        assert low_m <= part.to_m <= high_m
        assert f"{1e3 * part.to_m:.4g} mm" in part.words or part.pieces
        if part.pieces:
            profiles.check(part.pieces, p.motion, low_m, high_m)
            assert max(extent(piece).speed_m_s for piece in part.pieces) <= p.limits.speed_m_s


def test_a_short_axis_goes_as_far_as_it_may(axis: AxisParameters) -> None:
    short = axis._replace(limits=axis.limits._replace(travel_min_m=0.0, travel_max_m=0.1, stroke_m=0.1))
    parts = course(short, 0.1)
    assert [part.name for part in parts[-3:]] == ["", "70 mm", "70 mm"]
    narrow = short._replace(motion=short.motion._replace(speed_m_s=0.01))
    sine = next(part for part in course(narrow, 0.1) if part.name == "sine")
    assert 0.002 < max(extent(piece).high_m for piece in sine.pieces) - 0.05 < 0.0032


def test_it_arms_asks_and_ends(axis: AxisParameters, template: Record) -> None:
    v = Verification(axis, (STEP,), T)
    assert v.ask(State.WAITING, 0) is None
    assert next(filter(None, (v.ask(State.DISARMED, 0) for _ in range(QUIET)))) == Request(RequestKind.ARM)
    armed = ticked(template, 0, State.HOLDING, 0.5, 0.5)
    armed = armed._replace(
        tick=armed.tick._replace(request=Request(RequestKind.ARM), answer=int(Answer.TAKEN))
    )
    v.see(armed)
    asked = None
    while asked is None:
        v.see(ticked(template, 0, State.HOLDING, 0.5, 0.5))
        asked = v.ask(State.HOLDING, 0)
    assert asked == Request(RequestKind.GOTO, (0.501,))
    for record in stepped(template, [0.5] * 50 + [0.501] * 1000, moving=50):
        first = record.tick.t_ns == 0
        request = Request(RequestKind.GOTO, (0.501,)) if first else None
        v.see(record._replace(tick=record.tick._replace(request=request, answer=int(Answer.TAKEN))))
        assert v.verdict is None
        if record.tick.t_ns < 1049 * H_NS:
            assert v.ask(record.tick.state, 0) is None
    assert v.ask(State.HOLDING, 0) is None
    assert v.verdict is not None
    assert v.verdict.holds
    assert v.ask(State.HOLDING, 0) == Request(RequestKind.SHUTDOWN)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"latched": 1 << F.TRACKING_ERROR}, "tracking_error"),
        ({"request": Request(RequestKind.STOP)}, "stopped"),
        (
            {"request": Request(RequestKind.GOTO, (9.0,)), "answer": int(Answer.OUT_OF_TRAVEL)},
            "goto: out_of_travel",
        ),
    ],
)
def test_what_ends_it_is_told(
    axis: AxisParameters, template: Record, change: dict[str, object], why: str
) -> None:
    v = Verification(axis, (STEP,), T)
    v.ask(State.HOLDING, 0)
    record = ticked(template, 1, State.MOVING, 0.5, 0.5)
    v.see(record._replace(tick=record.tick._replace(**change)))  # type: ignore[arg-type]
    assert v.verdict is not None
    assert (v.verdict.figures, v.verdict.words) == ((), why)
    assert not v.verdict.holds


def test_an_axis_that_cannot_be_armed_is_not_waited_for(axis: AxisParameters) -> None:
    v = Verification(axis, (STEP,), T)
    while v.ask(State.DISARMED, 1 << F.SUPPLY_PRESSURE) is None:
        pass
    assert v.verdict == Verified((), "the axis is disarmed", ("supply_pressure",))


@pytest.mark.slow
def test_the_packaged_axis_holds_all_limits(axis: AxisParameters) -> None:
    loaded = load("virtual.toml")
    v = Verification(axis, course(axis, loaded.config.cylinder.stroke_m), T)
    for record in Simulation(loaded, 100.0, 1, backend_of(loaded), operator=v.ask).records():
        v.see(record)
    assert v.verdict is not None
    assert (v.verdict.failure, v.verdict.missed) == ("", ())
    assert {f.part for f in v.verdict.figures} == {"sine", "rest", "1 mm", "10 mm", "100 mm"}
