"""What an axis can be asked to do, on the software rig in simulated time."""

from __future__ import annotations

import math
from functools import cache
from itertools import pairwise

import pytest

from axis_rig import ARM, CLEAR, DISARM, PERIOD_NS, SHUTDOWN, Rig, assert_smooth, ready, twin
from pneud.axis.cycle import Axis
from pneud.axis.stops import soft_limits
from pneud.console import profiles
from pneud.control.plan import FOLLOWING, RESTING
from pneud.control.profile import MOST_PIECES
from pneud.control.reference import Bounds, Septic, Shunned, at, rest, septic
from pneud.safety import supervisor
from pneud.safety.faults import CENTRES, F
from pneud.signals import Answer, RequestKind, State, Tick

STOP, HOLD, GOTO, JOG = RequestKind.STOP, RequestKind.HOLD, RequestKind.GOTO, RequestKind.JOG
TRACK, PIECE, HOME, GAINS = RequestKind.TRACK, RequestKind.PIECE, RequestKind.HOME, RequestKind.GAINS
H = PERIOD_NS * 1e-9


def holding() -> Rig:
    """Armed, and holding still."""
    return twin(_holding())


@cache
def _holding() -> Rig:
    rig = ready()
    assert rig.tick(ARM).state == State.HOLDING
    rig.ticks(100)
    return rig


def moving(ticks: int = 120) -> Rig:
    """On the way 100 mm forward."""
    rig = holding()
    assert rig.tick(GOTO, target(rig)).answer == Answer.TAKEN
    rig.ticks(ticks)
    return rig


def target(rig: Rig, by_m: float = 0.1) -> float:
    return rig.node.truth().position_m + by_m


def test_an_armed_axis_holds_still_where_it_is() -> None:
    rig = ready()
    before = rig.node.truth().position_m
    first = rig.tick(ARM)
    assert (first.state, first.answer) == (State.HOLDING, Answer.TAKEN)
    assert first.reference == rest(first.estimate.position_m)
    assert first.command.s == 0.0
    ticks = rig.ticks(1000)
    assert {t.state for t in ticks} == {State.HOLDING}
    assert {t.reference for t in ticks} == {first.reference}
    assert max(abs(t.estimate.position_m - before) for t in ticks) <= 10e-6


def test_a_short_goto_from_rest_does_not_peak_at_a_speed_that_is_shunned_unless_asked_to() -> None:
    took = []
    for low_m_s, asked in ((0.0, ()), (0.01, ()), (0.01, (0.4, 0.0, 0.0))):
        rig = holding()
        rig.axis.parameters = rig.axis.parameters._replace(shunned=Shunned(low_m_s, 4.0 * low_m_s))
        assert rig.tick(GOTO, target(rig, 1e-3), *asked).answer == Answer.TAKEN
        took.append(rig.axis.state.path.T)
    assert took[0] == took[2] < 0.08
    assert took[1] == pytest.approx(0.2, rel=0.01)


def test_a_goto_arrives_and_holds() -> None:
    rig = holding()
    end = target(rig)
    ticks = [rig.tick(GOTO, end)]
    assert (ticks[0].state, ticks[0].answer) == (State.MOVING, Answer.TAKEN)
    while ticks[-1].state == State.MOVING:
        ticks.append(rig.tick())
        assert len(ticks) < 1000
    assert ticks[-1].state == State.HOLDING
    assert_smooth(ticks, rig.axis.parameters.motion)
    assert max(abs(t.reference.position_m - t.estimate.position_m) for t in ticks) <= 2e-3
    ticks = rig.ticks(500)
    assert {t.reference for t in ticks} == {rest(ticks[0].reference.position_m)}
    assert ticks[-1].reference.position_m == pytest.approx(end, abs=1e-9)
    assert rig.node.truth().position_m == pytest.approx(end, abs=20e-6)


def test_a_slower_goto_keeps_what_was_asked_for() -> None:
    rig = holding()
    ticks = [rig.tick(GOTO, target(rig, -0.05), 0.1, 1.0, 0.0)]
    while ticks[-1].state == State.MOVING:
        ticks.append(rig.tick())
    assert_smooth(ticks, rig.axis.parameters.motion)
    assert max(abs(t.reference.velocity_m_s) for t in ticks) == pytest.approx(0.1, rel=1e-3)
    assert max(abs(t.reference.acceleration_m_s2) for t in ticks) <= 1.001


@pytest.mark.slow
@pytest.mark.parametrize("by_m", [0.2, -0.1, 0.001])
@pytest.mark.parametrize("after", [30, 100, 200, 300])
def test_a_target_changes_in_motion_without_a_jump(after: int, by_m: float) -> None:
    rig = moving(after)
    before = rig.tick()
    end = before.reference.position_m + by_m
    ticks = [before, rig.tick(GOTO, end)]
    assert ticks[-1].answer == Answer.TAKEN
    while ticks[-1].state == State.MOVING:
        ticks.append(rig.tick())
        assert len(ticks) < 2000
    assert_smooth(ticks, rig.axis.parameters.motion, room=1.5)
    assert ticks[-1].state == State.HOLDING
    assert ticks[-1].reference.position_m == pytest.approx(end, abs=1e-9)
    assert max(abs(b.command.voltage_v - a.command.voltage_v) for a, b in pairwise(ticks)) <= 1.0


def test_a_jog_goes_on_as_long_as_its_lease_is_renewed_then_stops_and_holds() -> None:
    rig = holding()
    ticks = []
    for _ in range(4):
        ticks += [rig.tick(JOG, 0.1, 100), *rig.ticks(59)]
    assert {t.state for t in ticks} == {State.MOVING}
    assert ticks[-1].reference.velocity_m_s == pytest.approx(0.1, rel=1e-6)
    ticks += rig.ticks(100 - 59)
    assert ticks[-1].reference.velocity_m_s == pytest.approx(0.1, rel=1e-6)
    while ticks[-1].state == State.MOVING:
        ticks.append(rig.tick())
        assert len(ticks) < 700
    assert ticks[-1].state == State.HOLDING
    assert_smooth(ticks, rig.axis.parameters.motion)


def test_skipped_ticks_use_up_the_lease() -> None:
    rig = holding()
    rig.tick(JOG, 0.1, 100)
    rig.ticks(60)
    rig.tick(skipped=40)
    velocity = rig.tick().reference.velocity_m_s
    assert rig.ticks(30)[-1].reference.velocity_m_s < velocity


def test_a_jog_changes_its_mind_without_a_jump() -> None:
    rig = holding()
    ticks = [rig.tick(JOG, 0.1, 500), *rig.ticks(150), rig.tick(JOG, -0.2, 500), *rig.ticks(400)]
    assert_smooth(ticks, rig.axis.parameters.motion, room=1.5)
    assert ticks[-1].reference.velocity_m_s == pytest.approx(-0.2, rel=1e-6)
    last = rig.tick(JOG, 0.0, 500)
    assert (last.answer, last.state) == (Answer.TAKEN, State.MOVING)
    assert rig.until(State.HOLDING).reference.velocity_m_s == 0.0


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_jog_brakes_in_time_to_rest_at_the_end_of_the_travel(side: float) -> None:
    rig = holding()
    end = rig.axis.state.path.pieces[0].c0 + side * 0.08
    low, high = (end, 0.98) if side < 0.0 else (0.02, end)
    p = rig.axis.parameters
    margin = p.travel_margin_m
    rig.axis.parameters = p._replace(
        limits=p.limits._replace(travel_min_m=low - margin, travel_max_m=high + margin)
    )
    ticks = [rig.tick(JOG, side * 0.3, 5000)]
    while ticks[-1].state == State.MOVING:
        ticks.append(rig.tick())
        assert len(ticks) < 2000
    assert_smooth(ticks, p.motion)
    assert ticks[-1].reference.position_m == pytest.approx(end, abs=1e-9)
    assert not any(t.latched for t in rig.ticks(300))
    again = rig.tick(JOG, side * 0.3, 5000)
    assert (again.answer, again.state) == (Answer.OUT_OF_TRAVEL, State.HOLDING)
    assert rig.tick(JOG, -side * 0.3, 5000).answer == Answer.TAKEN


@pytest.mark.parametrize(
    ("kind", "after"),
    [
        (STOP, 130),
        (HOLD, 250),
        *(pytest.param(k, n, marks=pytest.mark.slow) for k in (STOP, HOLD) for n in (5, 60, 190, 330)),
    ],
)
def test_stop_and_hold_come_to_rest_and_hold(kind: RequestKind, after: int) -> None:
    rig = moving(after)
    ticks = [rig.tick(), rig.tick(kind)]
    expected = State.STOPPING if kind == STOP else State.MOVING
    assert (ticks[-1].state, ticks[-1].answer) == (expected, Answer.TAKEN)
    while ticks[-1].state == expected:
        ticks.append(rig.tick())
        assert len(ticks) < 600
    assert ticks[-1].state == State.HOLDING
    assert_smooth(ticks, rig.axis.parameters.motion, room=1.5)
    assert {t.state for t in rig.ticks(50)} == {State.HOLDING}


def test_a_stop_may_end_centred() -> None:
    rig = moving()
    rig.axis.parameters = rig.axis.parameters._replace(stop_centres=True)
    assert rig.tick(STOP).state == State.STOPPING
    assert rig.until(State.DISARMED).latched == 0


def test_a_stop_asked_for_becomes_one_that_centres() -> None:
    rig = moving()
    rig.tick(STOP)
    rig.ticks(20)
    assert rig.tick(DISARM).state == State.STOPPING
    rig.until(State.DISARMED)


def test_a_hold_repeated_does_not_take_longer() -> None:
    one, two = moving(), moving()
    a, b = one.tick(HOLD), two.tick(HOLD)
    while a.state == State.MOVING:
        assert (a.reference, a.state) == (b.reference, b.state)
        a, b = one.tick(), two.tick(HOLD)
    assert a.state == b.state == State.HOLDING
    assert two.tick(HOLD).state == State.HOLDING


def test_a_stop_after_a_hold_goes_on_with_its_way() -> None:
    rig = moving()
    rig.tick(HOLD)
    rig.ticks(20)
    way = rig.axis.state.path
    assert rig.tick(STOP).state == State.STOPPING
    assert rig.axis.state.path is way
    rig.until(State.HOLDING)


def test_a_stop_fault_stops_under_control_centres_and_latches(monkeypatch: pytest.MonkeyPatch) -> None:
    bit = 1 << F.SUPPLY_PRESSURE
    rig = moving()
    with monkeypatch.context() as patch:
        patch.setattr(supervisor, "STOPS", bit)
        patch.setattr(supervisor, "CENTRES", CENTRES & ~bit)
        rig.measurement = lambda m: m._replace(supply_pa=1e5)
        first = rig.ticks(2)[-1]
        assert (first.state, first.command.enable) == (State.STOPPING, 1)
        last = rig.until(State.FAULT)
    assert last.latched == bit


@pytest.mark.slow
def test_the_configured_reference_is_tracked_from_any_motion() -> None:
    rig = moving()
    ticks = [rig.tick(), rig.tick(TRACK, 0.0)]
    assert ticks[-1].state == State.TRACKING
    while rig.axis.state.phase != FOLLOWING:
        ticks.append(rig.tick())
        assert len(ticks) < 4000
    ticks += rig.ticks(100)
    assert_smooth(ticks, rig.axis.parameters.motion, room=1.5)
    ticks = [rig.tick(GOTO, target(rig, 0.02))]
    assert ticks[0].state == State.MOVING
    rig.until(State.HOLDING)


def test_a_profile_is_uploaded_tracked_and_ends_in_holding() -> None:
    rig = holding()
    here, bounds = rig.axis.state.path.pieces[0].c0, rig.axis.parameters.motion
    pieces = profiles.steps([here + 0.02, here + 0.05, here + 0.03], 0.1, bounds)
    answers = [rig.tick(kind, *values) for kind, values in profiles.requests(pieces)]
    assert {t.answer for t in answers} == {Answer.TAKEN}
    assert (len(answers), answers[-1].state) == (len(pieces) + 2, State.TRACKING)
    refused = rig.tick(PIECE)
    assert (refused.answer, refused.state) == (Answer.WRONG_STATE, State.TRACKING)
    ticks = [answers[-1]]
    while ticks[-1].state == State.TRACKING:
        ticks.append(rig.tick())
        assert len(ticks) < 3000
    assert ticks[-1].state == State.HOLDING
    assert_smooth(ticks, bounds)
    assert rig.axis.state.phase == RESTING
    assert ticks[-1].reference.position_m == pytest.approx(here + 0.03, abs=1e-9)
    assert len(ticks) * H == pytest.approx(profiles.duration_s(pieces) + 0.5, abs=0.4)
    assert max(abs(t.reference.position_m - t.estimate.position_m) for t in ticks) <= 2e-3
    assert rig.tick(TRACK, 1.0).state == State.TRACKING
    assert rig.tick(PIECE).answer == Answer.WRONG_STATE
    assert rig.tick(STOP).state == State.STOPPING
    assert rig.tick(PIECE).answer == Answer.TAKEN
    rig.until(State.HOLDING)
    assert rig.tick(TRACK, 1.0).answer == Answer.NO_PROFILE


def piece(start: float, end: float, T: float = 1.0) -> Septic:
    return septic(T, rest(start), rest(end))


@pytest.mark.parametrize(
    ("values", "answer"),
    [
        (piece(0.5, 0.55), Answer.TAKEN),
        (piece(0.5, 0.55)._replace(T=0.0), Answer.MALFORMED),
        (piece(0.5, 0.55)._replace(T=math.inf), Answer.MALFORMED),
        (piece(0.5, 0.55)._replace(c3=math.nan), Answer.MALFORMED),
        (piece(0.5, 0.55)[:5], Answer.MALFORMED),
        (piece(0.50001, 0.55), Answer.MALFORMED),  # does not meet the end of the one before
        (piece(0.5, 0.9795), Answer.OUT_OF_TRAVEL),
        (piece(0.5, 0.6, 0.3), Answer.BEYOND_LIMITS),
    ],
)
def test_each_piece_is_looked_at(values: tuple[float, ...], answer: Answer) -> None:
    rig = holding()
    rig.tick(PIECE)
    assert rig.tick(PIECE, *piece(0.45, 0.5)).answer == Answer.TAKEN
    assert rig.tick(PIECE, *values).answer == answer
    assert len(rig.axis.state.profile) == (2 if answer == Answer.TAKEN else 1)


def test_a_profile_has_an_end() -> None:
    rig = holding()
    full = (piece(0.5, 0.5, 0.1),) * MOST_PIECES
    rig.axis.thaw(rig.axis.state._replace(profile=full))
    assert rig.tick(PIECE, *piece(0.5, 0.5, 0.1)).answer == Answer.MALFORMED
    rig.axis.thaw(rig.axis.state._replace(profile=full[:-1]))
    assert rig.tick(PIECE, *piece(0.5, 0.5, 0.1)).answer == Answer.TAKEN


@pytest.mark.parametrize(
    ("kind", "values", "answer"),
    [
        (GOTO, (0.5,), Answer.TAKEN),
        (GOTO, (0.5, 0.0, 0.0, 0.0), Answer.TAKEN),
        (GOTO, (), Answer.MALFORMED),
        (GOTO, (0.5, 0.1, 1.0, 10.0, 1.0), Answer.MALFORMED),
        (GOTO, (math.nan,), Answer.MALFORMED),
        (GOTO, (0.5, -0.1), Answer.MALFORMED),
        (GOTO, (0.5, 0.0, math.inf), Answer.MALFORMED),
        (GOTO, (0.9791,), Answer.OUT_OF_TRAVEL),
        (GOTO, (0.0209,), Answer.OUT_OF_TRAVEL),
        (GOTO, (0.979,), Answer.TAKEN),
        (GOTO, (0.5, 0.51), Answer.BEYOND_LIMITS),
        (GOTO, (0.5, 0.0, 5.1), Answer.BEYOND_LIMITS),
        (GOTO, (0.5, 0.0, 0.0, 101.0), Answer.BEYOND_LIMITS),
        (JOG, (0.1,), Answer.MALFORMED),
        (JOG, (0.1, 0.0), Answer.MALFORMED),
        (JOG, (0.1, 1e10), Answer.MALFORMED),
        (JOG, (-0.51, 100.0), Answer.BEYOND_LIMITS),
        (JOG, (math.nan, 100.0), Answer.MALFORMED),
        (TRACK, (), Answer.MALFORMED),
        (TRACK, (2.0,), Answer.MALFORMED),
        (TRACK, (1.0,), Answer.NO_PROFILE),
        (HOLD, (), Answer.TAKEN),
        (HOLD, (1.0,), Answer.MALFORMED),
        (ARM, (), Answer.WRONG_STATE),
        (CLEAR, (), Answer.WRONG_STATE),
        (99, (), Answer.MALFORMED),
        (RequestKind.MARK, (1.0, 2.0), Answer.TAKEN),
    ],
)
def test_what_is_asked_of_a_holding_axis_is_answered(
    kind: int, values: tuple[float, ...], answer: Answer
) -> None:
    rig = holding()
    before = rig.tick()
    tick = rig.tick(kind, *values)
    assert tick.answer == answer
    assert tick.request is not None
    if answer != Answer.TAKEN:
        assert tick.state == State.HOLDING
        assert tick.reference == before.reference


@pytest.mark.parametrize("kind", [STOP, HOLD, GOTO, JOG, TRACK, DISARM, CLEAR])
def test_what_needs_an_engaged_axis_is_refused_by_a_disarmed_one(kind: RequestKind) -> None:
    values = {GOTO: (0.5,), JOG: (0.1, 10.0), TRACK: (0.0,)}.get(kind, ())
    tick = ready().tick(kind, *values)
    assert (tick.state, tick.answer) == (State.DISARMED, Answer.WRONG_STATE)


def test_while_stopping_nothing_else_is_taken() -> None:
    rig = moving()
    rig.tick(STOP)
    for kind, values in ((GOTO, (0.5,)), (JOG, (0.1, 10.0)), (TRACK, (0.0,)), (HOLD, ()), (ARM, ())):
        tick = rig.tick(kind, *values)
        assert (tick.state, tick.answer) == (State.STOPPING, Answer.WRONG_STATE)


def test_a_fault_in_the_same_tick_wins() -> None:
    rig = holding()
    rig.measurement = lambda m: m._replace(supply_pa=1e5)
    rig.tick()  # one reading is no fact
    tick = rig.tick(GOTO, 0.5)
    assert (tick.state, tick.answer) == (State.FAULT, Answer.BLOCKED)
    assert rig.tick(CLEAR).answer == Answer.BLOCKED
    rig.measurement = lambda m: m
    assert rig.tick(CLEAR).answer == Answer.TAKEN


def test_after_shutdown_arming_is_refused_by_name() -> None:
    rig = ready()
    assert rig.tick(SHUTDOWN).answer == Answer.TAKEN
    assert rig.tick(ARM).answer == Answer.CLOSING


def test_a_way_back_that_would_leave_the_travel_first_brakes_harder_or_is_refused() -> None:
    rig = moving(170)
    here = rig.tick().reference
    p = rig.axis.parameters
    assert here.velocity_m_s > 0.3

    def narrow(room_m: float) -> None:
        limits = p.limits._replace(travel_max_m=here.position_m + room_m, braking_m_s2=1e9)
        rig.axis.parameters = p._replace(limits=limits)

    narrow(0.012)
    assert rig.tick(GOTO, 0.3).answer == Answer.OUT_OF_TRAVEL
    narrow(0.03)
    ticks = [rig.tick(GOTO, 0.3), *rig.ticks(300)]
    assert ticks[0].answer == Answer.TAKEN
    assert max(t.reference.position_m for t in ticks) <= here.position_m + 0.03


def test_a_jog_that_cannot_brake_in_time_is_refused() -> None:
    rig = moving(170)
    here = rig.tick().reference
    p = rig.axis.parameters
    limits = p.limits._replace(travel_max_m=here.position_m + 0.012, braking_m_s2=1e9)
    rig.axis.parameters = p._replace(limits=limits)
    assert rig.tick(JOG, -0.2, 100).answer == Answer.OUT_OF_TRAVEL
    assert rig.tick(JOG, 0.2, 100).answer == Answer.OUT_OF_TRAVEL


def test_a_reference_out_of_reach_is_not_tracked() -> None:
    rig = holding()
    p = rig.axis.parameters
    rig.axis.parameters = p._replace(reference=p.reference._replace(centre_m=0.9799, amplitude_m=0.0))
    assert rig.tick(TRACK, 0.0).answer == Answer.TAKEN
    rig.axis.parameters = p._replace(reference=p.reference._replace(centre_m=0.981, amplitude_m=0.0))
    assert rig.tick(TRACK, 0.0).answer == Answer.OUT_OF_TRAVEL


STORY: list[tuple[int, int, tuple[float, ...]]] = [
    (5, GOTO, (0.48,)),
    (150, GOTO, (0.42,)),
    (300, HOLD, ()),
    (500, JOG, (0.1, 150.0)),
    (1000, PIECE, ()),
    (1001, PIECE, tuple(piece(0.44, 0.46, 0.6))),
    (1002, PIECE, tuple(piece(0.46, 0.45, 0.5))),
    (1003, TRACK, (1.0,)),
    (3000, STOP, ()),
    (3100, GOTO, (2.0,)),
    (3101, TRACK, (0.0,)),
    (3400, DISARM, ()),
]


def told(rig: Rig) -> list[Tick]:
    """The ticks of a story with every kind of motion in it."""
    asked = {n: (kind, values) for n, kind, values in STORY}
    ticks = []
    for n in range(3900):
        kind, values = asked.get(n, (0, ()))
        ticks.append(rig.tick(kind, *values))
    return ticks


@pytest.mark.slow
def test_frozen_and_thawed_in_any_state_it_goes_on_alike() -> None:
    rig = holding()
    first = rig.axis.freeze()
    ticks = told(rig)
    assert {t.state for t in ticks} == {
        State.HOLDING, State.MOVING, State.TRACKING, State.STOPPING, State.DISARMED,
    }  # fmt: skip
    other = Axis(rig.axis.parameters)
    other.thaw(first)
    for i, t in enumerate(ticks):
        if i % 37 == 0:  # another axis takes over
            frozen = other.freeze()
            other = Axis(rig.axis.parameters)
            other.thaw(frozen)
        assert repr(other.cycle(t.measurement, t.request, t.t_ns)) == repr(t)
    assert other.freeze() == rig.axis.freeze()


def test_the_soft_limits_lie_inside_the_travel() -> None:
    p = ready().axis.parameters
    assert soft_limits(p) == pytest.approx((0.021, 0.979))


def test_the_end_of_a_piece_is_where_the_next_begins() -> None:
    for before, after in pairwise(profiles.steps([0.3, 0.4], 0.1, Bounds(0.5, 5.0, 100.0))):
        assert at(before.T, before) == pytest.approx(at(0.0, after), abs=1e-6)


@pytest.mark.parametrize("values", [(0.5, 1e-15), (0.5, 0.1, 5e-324), (0.5, 0.1, 1.0, 5e-324), (0.5, -0.1)])
def test_a_way_that_would_take_for_ever_is_refused(values: tuple[float, ...]) -> None:
    assert holding().tick(GOTO, *values).answer == Answer.MALFORMED


@pytest.mark.parametrize("velocity", [1e-15, -5e-324])
def test_a_jog_that_does_not_move_is_refused(velocity: float) -> None:
    assert holding().tick(JOG, velocity, 100.0).answer == Answer.MALFORMED
