"""The axis from switching on to shutting down, on the software rig in simulated time."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise
from types import ModuleType

import pytest

import pneud.axis.cycle
import pneud.axis.guidance
import pneud.axis.sensing
from axis_rig import (
    ARM,
    CLEAR,
    DISARM,
    ENCODER,
    PERIOD_NS,
    PRESSURE,
    SHUTDOWN,
    Rig,
    loaded,
    ready,
    same,
    tracking,
)
from pneud.axis.cycle import FOLLOWING, Axis
from pneud.bus.inbox import Inbox
from pneud.config import conversions
from pneud.control.adaptation import Learnt, Shake
from pneud.control.laws.situation import LawOutput
from pneud.control.plan import COMING_TO_REST, JOINING, SETTLE_NS
from pneud.control.reference import along, sine, stays, to_rest
from pneud.safety.checks import SETTLING_NS
from pneud.safety.faults import names
from pneud.safety.supervisor import START_TICKS, is_engaged
from pneud.signals import ALL_SOURCES, RequestKind, Source, State, Tick, ValveState


def repeated(ticks: list[Tick]) -> list[str]:
    """Ticks as text, in which NaN equals itself."""
    return [repr(tick) for tick in ticks]


@pytest.fixture(scope="module")
def followed() -> Iterator[tuple[Rig, list[Tick]]]:
    """A run from arming until some time after the join, and its ticks."""
    rig = ready()
    ticks = [rig.tick(ARM, 1.0)]
    while rig.axis.state.phase != FOLLOWING:
        ticks.append(rig.tick())
        assert len(ticks) < 3000
    ticks += rig.ticks(300)
    yield rig, ticks


def test_starting_centres_for_its_ticks_before_anything_else() -> None:
    rig = Rig()
    states = [rig.tick(kind).state for kind in (*RequestKind, *([ARM] * START_TICKS))]
    assert states[:START_TICKS] == [State.STARTING] * START_TICKS
    assert states[START_TICKS] == State.WAITING
    assert not any(is_engaged(state) for state in states)


def test_without_sensors_it_waits_and_names_what_is_missing() -> None:
    rig = Rig()
    rig.frame = lambda _: None
    ticks = rig.ticks(100)
    assert ticks[-1].state == State.WAITING
    assert set(names(ticks[-1].present)) == {
        *("encoder_missing", "pressure_missing", "valve_missing", "encoder_unreferenced"),
        *("travel", "chamber_pressure", "supply_pressure"),  # values never seen are within no limits
    }
    assert not any(is_engaged(tick.state) for tick in ticks)


def test_it_can_arm_as_soon_as_the_estimates_have_settled_and_not_before() -> None:
    rig = Rig()
    refused = [rig.tick(ARM) for _ in range(SETTLING_NS // PERIOD_NS)]
    assert not any(is_engaged(tick.state) for tick in refused)
    assert names(refused[-1].present) == ["unsettled"]
    assert rig.tick(ARM, 1.0).state == State.TRACKING


def test_engaging_does_not_step(followed: tuple[Rig, list[Tick]]) -> None:
    first = followed[1][0]
    assert first.state == State.TRACKING
    assert first.command.s == 0.0
    assert abs(first.command.voltage_v) <= 0.2
    assert first.reference.position_m == first.estimate.position_m
    assert first.reference[1:] == (0.0, 0.0, 0.0)


def test_the_way_to_the_reference_keeps_the_bounds_and_never_steps(
    followed: tuple[Rig, list[Tick]],
) -> None:
    rig, ticks = followed
    bounds = rig.axis.parameters.transfer
    h = PERIOD_NS * 1e-9
    for a, b in pairwise(ticks):
        assert b.reference.position_m == pytest.approx(
            a.reference.position_m + h * a.reference.velocity_m_s, abs=h * h * bounds.acceleration_m_s2
        )
        assert abs(b.reference.velocity_m_s) <= bounds.speed_m_s * 1.001
        assert abs(b.reference.acceleration_m_s2) <= bounds.acceleration_m_s2 * 1.001
        assert (
            abs(b.reference.acceleration_m_s2 - a.reference.acceleration_m_s2) <= 1.001 * h * bounds.jerk_m_s3
        )
    assert all(tick.state == State.TRACKING and tick.latched == 0 for tick in ticks)


def test_the_references_zero_is_the_join(followed: tuple[Rig, list[Tick]]) -> None:
    rig, ticks = followed
    state, last = rig.axis.state, ticks[-1]
    assert state.phase == FOLLOWING
    assert last.reference == sine((state.sampled_ns - state.phase_ns) * 1e-9, rig.axis.parameters.reference)
    joined = next(t for t in ticks if t.t_ns + t.measurement.encoder_offset_ns >= state.phase_ns)
    assert joined.reference.position_m == pytest.approx(rig.axis.parameters.reference.centre_m, abs=2e-4)


def test_the_load_follows(followed: tuple[Rig, list[Tick]]) -> None:
    assert all(abs(t.reference.position_m - t.estimate.position_m) <= 2e-3 for t in followed[1])


@pytest.mark.parametrize("after", [0, 1, 30, 200])
def test_a_frozen_state_thaws_to_the_same_ticks(after: int) -> None:
    rig = tracking()
    rig.ticks(after)
    frozen = rig.axis.freeze()
    seen: list[Tick] = [rig.tick() for _ in range(40)] + [rig.tick(DISARM)] + rig.ticks(40)
    other = Axis(rig.axis.parameters)
    other.thaw(frozen)
    again = [other.cycle(t.measurement, t.request, t.t_ns) for t in seen]
    assert repeated(again) == repeated(seen)
    assert other.freeze() == rig.axis.freeze()


def test_the_state_of_an_axis_is_all_that_it_remembers() -> None:
    rig = tracking()
    kept = {name: value for name, value in vars(rig.axis).items() if name not in ("_state", "parameters")}
    assert kept == {"failure": None}


@pytest.mark.parametrize("ends", [DISARM, SHUTDOWN])
@pytest.mark.parametrize("after", [0, 5, 100])
def test_being_told_to_end_it_comes_to_rest_and_centres(ends: RequestKind, after: int) -> None:
    rig = tracking()
    rig.ticks(after)
    before = rig.tick()
    first = rig.tick(ends)
    assert first.state == State.STOPPING
    assert first.reference.position_m == pytest.approx(before.reference.position_m, abs=5e-4)
    assert first.reference.velocity_m_s == pytest.approx(before.reference.velocity_m_s, abs=3e-3)
    way = rig.axis.state.path
    assert rig.axis.state.phase == COMING_TO_REST
    stopping = [first]
    while (tick := rig.tick()).state == State.STOPPING:
        stopping.append(tick)
        assert len(stopping) < 2000
    assert tick.state == State.DISARMED
    assert tick.latched == 0
    assert stopping[-1].reference == pytest.approx(along(way.T, way), abs=1e-9)
    assert stopping[-1].reference.velocity_m_s == pytest.approx(0.0, abs=1e-9)
    assert abs(stopping[-1].estimate.velocity_m_s) <= 0.03
    assert len(stopping) == pytest.approx(way.T * 1e3 + SETTLE_NS / PERIOD_NS, abs=2)


def test_after_shutdown_it_never_arms_again() -> None:
    rig = tracking()
    rig.tick(SHUTDOWN)
    rig.until(State.DISARMED)
    while rig.tick().present:
        assert rig.count < 5000
    assert {rig.tick(ARM).state for _ in range(100)} == {State.DISARMED}


def test_after_disarm_it_arms_again_when_asked() -> None:
    rig = tracking()
    rig.tick(DISARM)
    rig.until(State.DISARMED)
    while rig.tick().present:
        assert rig.count < 5000
    again = rig.tick(ARM, 1.0)
    assert again.state == State.TRACKING
    assert again.command.s == 0.0


def test_a_fault_while_stopping_centres_at_once() -> None:
    rig = tracking()
    rig.tick(DISARM)
    rig.measurement = lambda m: m._replace(valve_state=int(ValveState.FAULT))
    assert rig.tick().state == State.FAULT


def test_shutdown_asked_in_the_tick_of_an_exception_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = tracking()
    with monkeypatch.context() as patch:
        patch.setattr(pneud.axis.sensing, "act", lambda *_: 1 / 0)
        assert rig.tick(SHUTDOWN).state == State.FAULT
    assert isinstance(rig.axis.failure, ZeroDivisionError)
    rig.ticks(2)
    assert rig.tick(CLEAR).state == State.DISARMED
    still_m = rig.tick().measurement.position_m
    rig.measurement = lambda m: m._replace(position_m=still_m)  # nothing but the shutdown is in the way
    while rig.tick().present:
        assert rig.count < 500
    assert rig.tick(ARM).state == State.DISARMED


LEARNT = Learnt(0.01, -0.02, 1.1, 1.2, 0.9, 1.0, 3.0, 0.95)


def taught(rig: Rig) -> Rig:
    """With something learnt, and with what the last samples have left."""
    controller = rig.axis.state.controller
    assert controller is not None
    learnt = LEARNT._replace(shake=Shake(1e-5, 1e-5, 1e-5, 1e-5))
    rig.axis.state = rig.axis.state._replace(controller=controller._replace(learnt=learnt))
    return rig


def test_what_was_learnt_outlives_sensors_that_are_silent() -> None:
    rig = taught(ready())
    rig.frame = lambda _: None
    rig.ticks(100)
    assert rig.axis.freeze().controller is None
    assert rig.axis.state.learnt[:8] == LEARNT[:8]
    rig.frame = same
    rig.tick()
    controller = rig.axis.state.controller
    assert controller is not None
    assert controller.learnt == LEARNT


def test_what_was_learnt_outlives_an_exception_and_what_is_not_finite(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for output in (lambda *_: 1 / 0, lambda state, *_: (state, LawOutput(math.nan, 0.0, 0.0))):
        rig = taught(tracking())
        with monkeypatch.context() as patch:
            patch.setattr(pneud.axis.sensing, "act", output)
            assert rig.tick().state == State.FAULT
        assert rig.axis.freeze().controller is None
        rig.tick()
        controller = rig.axis.state.controller
        assert controller is not None
        assert controller.learnt[:8] == pytest.approx(LEARNT[:8], abs=0.02)


def test_an_axis_starts_with_what_an_earlier_run_had_learnt() -> None:
    rig = Rig()
    p = rig.axis.parameters._replace(learnt=LEARNT)
    rig.axis = Axis(p)
    rig.tick()
    controller = rig.axis.state.controller
    assert controller is not None
    assert controller.learnt == LEARNT


@pytest.mark.parametrize(
    ("module", "function"),
    [
        (pneud.axis.sensing, "observe"),
        (pneud.axis.sensing, "act"),
        (pneud.axis.sensing, "emit"),
        (pneud.axis.cycle, "advance"),
        (pneud.axis.guidance, "follow"),
    ],
)
def test_an_exception_anywhere_centres_and_the_first_one_is_kept(
    module: ModuleType, function: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = tracking()
    assert rig.axis.state.phase == JOINING
    causes = [ValueError("first"), KeyError("second")]

    def fails(*_: object) -> None:
        raise causes.pop(0) if len(causes) > 1 else causes[0]

    monkeypatch.setattr(module, function, fails)
    first = rig.tick()
    assert (first.state, names(first.latched), names(first.present)) == (
        State.FAULT,
        ["internal"],
        ["internal"],
    )
    assert math.isnan(first.command.law_v)
    rig.tick()
    assert str(rig.axis.failure) == "first"


@pytest.mark.parametrize("can_id", [ENCODER, PRESSURE, 0x183, None])
def test_frames_missing_for_less_than_the_time_out_change_little(can_id: int | None) -> None:
    rig, whole = tracking(), tracking()
    rig.frame = lambda frame: None if can_id in (None, frame.can_id) else frame
    without = rig.ticks(20)
    whole.ticks(20)
    rig.frame = lambda frame: frame
    after, usual = rig.ticks(40), whole.ticks(40)
    assert {t.state for t in without + after} == {State.TRACKING}
    assert not any(t.present for t in without + after)
    assert without[-1].measurement.fresh != ALL_SOURCES
    for a, b in zip(after[20:], usual[20:], strict=True):
        assert a.estimate.position_m == pytest.approx(b.estimate.position_m, abs=1e-3)
        assert a.reference == b.reference


def test_without_the_encoder_the_position_is_predicted() -> None:
    rig = tracking()
    while abs(rig.tick().estimate.velocity_m_s) < 0.03:
        assert rig.count < 1000
    rig.frame = lambda frame: None if frame.can_id == ENCODER else frame
    for _ in range(20):
        tick = rig.tick()
        true_m = rig.node.truth().position_m
        assert not tick.measurement.fresh & Source.ENCODER
        assert tick.estimate.innovation_m == 0.0
        assert tick.estimate.position_m == pytest.approx(true_m, abs=1e-3)
    assert abs(tick.estimate.position_m - tick.measurement.position_m) > 3e-4


@pytest.mark.parametrize("skipped", [1, 10, 30])
def test_after_skipped_ticks_reference_and_estimate_are_where_they_belong(skipped: int) -> None:
    rig = tracking()
    before = rig.tick()
    after = rig.tick(skipped=skipped)
    assert after.state == State.TRACKING
    assert after.t_ns - before.t_ns == (1 + skipped) * PERIOD_NS
    path, began_ns = rig.axis.state.path, rig.axis.state.phase_ns
    instant_ns = after.t_ns + after.measurement.encoder_offset_ns
    assert after.reference == along((instant_ns - began_ns) * 1e-9, path)
    assert after.estimate.position_m == pytest.approx(rig.node.truth().position_m, abs=5e-4)
    assert {t.state for t in rig.ticks(50)} == {State.TRACKING}


@pytest.mark.parametrize("step_ns", [0, -5 * PERIOD_NS, 1, 3_600_000_000_000])
def test_a_strange_time_gives_no_strange_numbers(step_ns: int) -> None:
    rig = ready()
    m = rig.tick().measurement
    t_ns = rig.t_ns + step_ns
    tick = rig.axis.cycle(m._replace(t_ns=t_ns), None, t_ns)
    assert not is_engaged(tick.state)
    assert all(math.isfinite(x) for x in tick.estimate)
    assert tick.estimate.position_m == pytest.approx(m.position_m, abs=1e-4)


def test_a_long_pause_starts_the_estimates_anew() -> None:
    rig = ready()
    rig.measurement = lambda m: m._replace(position_m=m.position_m + 0.3)
    tick = rig.tick(skipped=5000)
    assert tick.estimate.velocity_m_s == 0.0
    assert "encoder_jump" not in names(tick.present)
    assert "unsettled" in names(tick.present)


def test_sensors_lost_and_found_start_the_estimates_anew() -> None:
    rig = ready()
    rig.frame = lambda _: None
    waiting = rig.until(State.WAITING)
    assert rig.axis.state.controller is None
    assert math.isnan(waiting.estimate.position_m)
    rig.frame = lambda frame: frame
    rig.measurement = lambda m: m._replace(position_m=m.position_m + 0.1)
    found = rig.tick()
    assert found.state == State.DISARMED
    assert found.estimate.position_m == found.measurement.position_m
    assert (found.estimate.velocity_m_s, found.estimate.d_hat_n_s) == (0.0, 0.0)
    assert names(found.present) == ["unsettled"]


def test_a_measurement_that_was_no_number_is_forgotten() -> None:
    rig = ready()
    rig.measurement = lambda m: m._replace(p1_pa=math.nan)
    assert names(rig.tick().present) == ["chamber_pressure", "not_finite"]
    rig.measurement = lambda m: m
    rig.tick()
    assert names(rig.tick().present) == ["unsettled"]
    while rig.tick().present:
        assert rig.count < 300
    assert rig.tick(ARM, 1.0).state == State.TRACKING


def test_free_running_sensors_do_not_count_time_twice() -> None:
    config = loaded().config.model_copy(
        update={"bus": loaded().config.bus.model_copy(update={"sync": False})}
    )
    rig = tracking()
    rig.inbox = Inbox(loaded().codecs, config.bus)
    rig.axis = Axis(conversions.axis_of(config, loaded().codecs.command_lsb_v))
    rig.count = 0
    rig.until(State.DISARMED)
    rig.ticks(60)
    rig.frame = lambda frame: None if frame.can_id == ENCODER and rig.count % 2 else frame
    for _ in range(40):
        state = rig.axis.state
        rig.tick()
        assert rig.axis.state.sampled_ns - state.sampled_ns == pytest.approx(PERIOD_NS, abs=1000)


def test_a_mark_is_ignored() -> None:
    rig, other = tracking(), tracking()
    a, b = rig.tick(RequestKind.MARK), other.tick()
    assert repr(a._replace(request=None, answer=0)) == repr(b)


def test_a_stop_near_the_end_of_the_travel_stays_within_it() -> None:
    rig = tracking()
    while abs(rig.tick().reference.velocity_m_s) < 0.05:
        assert rig.count < 1000
    p = rig.axis.parameters
    here = rig.tick().reference
    limits = p.limits._replace(travel_max_m=here.position_m + 2.6e-3)
    rig.axis.parameters = p._replace(limits=limits)
    assert not stays(to_rest(here, p.motion), 0.0, limits.travel_max_m)
    tick = rig.tick(DISARM)
    assert tick.state == State.STOPPING
    way = rig.axis.state.path
    assert along(way.T, way).position_m <= limits.travel_max_m


def test_faults_of_both_kinds_of_watch_are_latched_together() -> None:
    rig = tracking()
    rig.measurement = lambda m: m._replace(supply_pa=1e5, p1_pa=1e4)
    found = rig.ticks(2)[-1].latched
    assert names(found) == ["chamber_pressure", "supply_pressure", "pressure_jump"]


@pytest.mark.parametrize(("gap", "fault"), [(0, ["encoder_jump"]), (30, [])])
def test_after_a_gap_the_encoder_may_have_gone_further(gap: int, fault: list[str]) -> None:
    rig = ready()
    rig.frame = lambda frame: None if frame.can_id == ENCODER else frame
    rig.ticks(gap)
    rig.frame = lambda frame: frame
    rig.measurement = lambda m: m._replace(position_m=m.position_m + 0.005)
    found = names(rig.ticks(2)[-1].present)
    assert [name for name in found if name == "encoder_jump"] == fault


@pytest.mark.parametrize("skipped", [0, 1, 20])
def test_the_slew_limit_counts_the_time_since_the_last_command(
    skipped: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = tracking()
    p = rig.axis.parameters
    rig.axis.parameters = p._replace(output=p.output._replace(slew_v_s=10.0))
    monkeypatch.setattr(pneud.axis.sensing, "act", lambda state, *_: (state, LawOutput(5.0, 0.0, 0.0)))
    last_v = rig.axis.state.last_v
    command = rig.tick(skipped=skipped).command
    assert command.voltage_v == pytest.approx(last_v + 0.01 * (1 + skipped), abs=3e-4)
    assert command.saturated == 1


@pytest.mark.parametrize("fresh", [True, False])
def test_the_observer_is_told_what_was_applied_else_what_was_sent(fresh: bool) -> None:
    rig, usual = tracking(), tracking()
    valve = 0 if fresh else int(Source.VALVE)
    sent_v = rig.axis.state.last_v
    usual.measurement = lambda m: m._replace(fresh=m.fresh & ~valve, applied_v=1.5 if fresh else sent_v)
    rig.measurement = lambda m: m._replace(fresh=m.fresh & ~valve, applied_v=1.5)
    assert rig.tick().estimate == usual.tick().estimate
    assert rig.axis.state.controller is not None
    assert rig.axis.state.controller.applied_v == (1.5 if fresh else sent_v)
