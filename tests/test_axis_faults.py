"""Every row of the fault table, provoked on an axis that tracks, or that is asked to arm."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from axis_rig import ARM, CLEAR, ENCODER, PERIOD_NS, PRESSURE, VALVE, Rig, ready, tracking
from commands import pneud_here
from pneud.safety.fault_row import Reaction
from pneud.safety.faults import TABLE, F, names
from pneud.safety.supervisor import is_engaged
from pneud.signals import (
    Answer,
    Host,
    RequestKind,
    State,
    Tick,
    ValveState,
)
from provoked import CENTRING, STOPPING, Case, bits, host, ids, moved, overdriven, value


@pytest.mark.parametrize("case", CENTRING, ids=ids)
def test_the_fault_centres_at_once_and_holds_until_it_is_cleared(case: Case) -> None:
    rig = tracking()
    with pytest.MonkeyPatch.context() as patch:
        case.provoke(rig, patch)
        for _ in range(case.ticks - 1):
            assert rig.tick().state == State.TRACKING
        tick = rig.tick(skipped=case.skipped)
        # that FAULT goes with 0 V and Enable 0 is checked by the rig in every tick
        assert tick.state == State.FAULT
        assert names(tick.latched) == names(bits(case.fault, *case.company))
        assert tick.present & tick.latched == tick.latched
        if case.lasting and case.fault != F.ENCODER_JUMP:
            assert rig.tick(CLEAR).state == State.FAULT
            assert rig.tick().present & 1 << case.fault
    rig.frame, rig.measurement, rig.host = (lambda frame: frame), (lambda m: m), 0

    held = [rig.tick(ARM, 1.0), *rig.ticks(30)]
    assert {(t.state, t.latched) for t in held} == {(State.FAULT, tick.latched)}
    cleared = rig.tick(CLEAR)
    assert (cleared.state, cleared.latched) == (State.DISARMED, 0)
    assert {t.state for t in rig.ticks(20)} == {State.DISARMED}


def test_every_row_that_centres_has_a_case() -> None:
    # these have their cases among the tests of homing, of ticks by another daemon's SYNC, and of inputs
    provoked = {case.fault for case in CENTRING} | {F.HOMING_FAILED, F.SYNC_LOST, F.ENABLE_CUT}
    assert provoked == {f.bit for f in TABLE if f.reaction == Reaction.CENTRE}


def test_every_other_row_is_provoked_too() -> None:
    elsewhere = {
        F.SKEW,
        F.LED_BEYOND,
        F.PROGRAM,
        F.PROGRAM_LATE,
        *(F.FORCE_WINDOW, F.FORCE_SPEED, F.FORCE_TIMEOUT, F.FORCE_DIRECTION),
        *(F.INPUT_LOST, F.ENABLE_OFF, F.BRAKE_STUCK, F.BRAKE_UNBALANCED),
        *(F.LOAD_MISSING, F.LOAD_DISAGREES),
    }  # by tests of axes that are led, of programs, of pressing, of inputs and a brake, and of a load cell
    stopping = {f.bit for f in TABLE if f.reaction == Reaction.STOP}
    assert {case.fault for case in STOPPING} | elsewhere == stopping
    assert {case.fault for case in BLOCKING} == {f.bit for f in TABLE if f.reaction == Reaction.NO_ARM}
    # these have tests of their own
    provoked = {case.fault for case in WARNING} | {F.SATURATED, F.OPERATOR_LOST, F.START_REFUSED}
    assert provoked == {f.bit for f in TABLE if f.reaction in (Reaction.WARN, Reaction.LIMIT)}


@pytest.mark.parametrize("case", STOPPING, ids=ids)
def test_the_fault_stops_the_load_under_control_and_then_holds_until_it_is_cleared(case: Case) -> None:
    rig = tracking()
    with pytest.MonkeyPatch.context() as patch:
        case.provoke(rig, patch)
        for _ in range(case.ticks - 1):
            assert rig.tick().state == State.TRACKING
        tick = rig.tick(skipped=case.skipped)
        assert (tick.state, names(tick.latched)) == (State.STOPPING, names(bits(case.fault)))
    if not case.lasting:
        rig.measurement = lambda m: m
    assert rig.until(State.FAULT).latched == bits(case.fault)
    if case.lasting:
        assert rig.tick(CLEAR).state == State.FAULT
    rig.measurement, rig.host = (lambda m: m), 0
    assert {tick.state for tick in [rig.tick(ARM), *rig.ticks(200)]} == {State.FAULT}
    cleared = rig.tick(CLEAR)
    assert (cleared.state, cleared.latched) == (State.DISARMED, 0)


def test_a_command_that_is_held_back_is_shown_and_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = tracking()
    overdriven(rig, monkeypatch)
    for tick in rig.ticks(5):
        assert tick.present == 1 << F.SATURATED
        assert (tick.state, tick.latched, tick.command.saturated) == (State.TRACKING, 0, 1)


def test_a_jump_that_lasts_is_seen_once_and_the_axis_stays_centred() -> None:
    rig = tracking()
    moved(position_m=0.0025)(rig, pytest.MonkeyPatch())
    assert names(rig.tick().latched) == []  # one reading is no fact
    assert names(rig.tick().latched) == ["encoder_jump"]
    assert {t.state for t in rig.ticks(40)} == {State.FAULT}


WARNING = [
    Case(F.RECORDER_LOST, host(Host.RECORDER_LOST)),
    Case(F.CLOCK_STEP, host(Host.CLOCK_STEP)),
    Case(F.SEND_FAILED, host(Host.SEND_FAILED)),
    Case(F.DISK_FULL, host(Host.DISK_FULL)),
    Case(F.CONFIG_CHANGED, host(Host.CONFIG_CHANGED)),
    Case(F.RECEIVE_OVERFLOW, host(Host.RECEIVE_OVERFLOW)),
]


@pytest.mark.parametrize("case", WARNING, ids=ids)
def test_a_warning_is_shown_and_nothing_else(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    rig, quiet = tracking(), tracking()
    case.provoke(rig, monkeypatch)
    for _ in range(20):
        tick, without = rig.tick(), quiet.tick()
        assert tick.present == 1 << case.fault
        assert tick.command == without.command
        assert (tick.state, tick.latched) == (State.TRACKING, 0)


def unreachable(rig: Rig, patch: pytest.MonkeyPatch) -> None:
    # the run-up to the sine begins below its centre; with so little room it cannot
    p = rig.axis.parameters
    low = rig.axis.state.controller.motion.x - 1e-4 if rig.axis.state.controller else 0.0
    reference = p.reference._replace(centre_m=low + 1e-3, amplitude_m=5e-4, omega_rad_s=300.0)
    limits = p.limits._replace(travel_min_m=low)
    patch.setattr(rig.axis, "parameters", p._replace(reference=reference, limits=limits))


def too_far_to_join(rig: Rig, patch: pytest.MonkeyPatch) -> None:
    patch.setattr(rig.axis, "parameters", rig.axis.parameters._replace(join_at_once=True))


def moving(rig: Rig, _: pytest.MonkeyPatch) -> None:
    began_ns = rig.t_ns
    rig.measurement = lambda m: m._replace(position_m=m.position_m + 0.011e-9 * (m.t_ns - began_ns))
    rig.ticks(60)


def just_started(rig: Rig, _: pytest.MonkeyPatch) -> None:
    rig.frame = lambda _: None
    rig.until(State.WAITING)
    rig.frame = lambda frame: frame
    rig.until(State.DISARMED)


def never_together(rig: Rig, _: pytest.MonkeyPatch) -> None:
    just_started(rig, _)
    ids = (ENCODER, PRESSURE, VALVE)
    rig.frame = lambda frame: frame if ids[rig.count % 3] == frame.can_id else None
    rig.axis.thaw(rig.axis.state._replace(controller=None))
    rig.ticks(100)


BLOCKING = [
    Case(F.ENCODER_UNREFERENCED, value(encoder_status=0)),
    Case(F.NO_REALTIME, host(Host.NO_REALTIME)),
    Case(F.UNPROVEN, host(Host.UNPROVEN)),
    Case(F.MOVING, moving),
    Case(F.UNSETTLED, just_started),
    Case(F.UNSETTLED, never_together),
    Case(F.UNREACHABLE, unreachable),
    Case(F.UNREACHABLE, too_far_to_join),
    Case(F.VALVE_ACTIVE, value(valve_state=ValveState.ENABLED)),
    Case(F.VALVE_ACTIVE, value(applied_v=-0.06)),
]


@pytest.mark.parametrize("case", BLOCKING, ids=ids)
def test_the_fault_keeps_the_axis_from_arming_and_says_so(
    case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = ready()
    case.provoke(rig, monkeypatch)
    tick = rig.tick(ARM, 1.0)
    assert (tick.state, names(tick.present), tick.latched) == (State.DISARMED, [case.fault.name.lower()], 0)
    assert {t.state for t in rig.ticks(5)} == {State.DISARMED}


@pytest.mark.parametrize("case", [c for c in CENTRING if c.lasting], ids=ids)
def test_what_would_centre_keeps_from_arming_as_well(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    rig = ready()
    if case.fault in (F.OVERSPEED, F.ENCODER_JUMP):
        rig.measurement = lambda m: m._replace(position_m=m.position_m + 5e-6 * (m.t_ns // PERIOD_NS % 2))
        rig.ticks(5)
    case.provoke(rig, monkeypatch)
    for _ in range(case.ticks - 1):
        rig.tick()
    tick = rig.tick(ARM, 1.0)
    assert not is_engaged(tick.state)
    assert tick.present & 1 << case.fault


@pytest.mark.parametrize("made", [ready, tracking])
@pytest.mark.parametrize("position_m", [-5.0, 0.42, 0.44, 0.9, 1.1, 2000.0])
def test_absurd_readings_are_no_blow_when_the_axis_arms_again(
    position_m: float, made: Callable[[], Rig]
) -> None:
    rig = made()
    before = rig.axis.state.supervisor.state
    rig.measurement = lambda m: m._replace(position_m=position_m)
    assert rig.tick().state == before  # one reading is no fact
    assert not is_engaged(rig.tick().state)
    rig.measurement = lambda m: m
    held = rig.tick()
    while not is_engaged(held.state):  # as soon as it can be done
        assert rig.count < 3000
        held = rig.tick(CLEAR if held.state == State.FAULT else ARM)
    for tick in rig.ticks(300):
        assert tick.state == State.HOLDING
        assert tick.measurement.position_m == pytest.approx(held.measurement.position_m, abs=5e-4)


def test_the_valve_node_is_given_time_to_disable_before_that_is_wrong() -> None:
    rig = tracking()
    shown: list[Tick] = [rig.tick(kind) for kind in (0, 0)]
    rig.host = int(Host.LINK_DOWN)
    shown += rig.ticks(20)
    assert not any(tick.present & 1 << F.VALVE_ACTIVE for tick in shown)


def test_a_jog_that_nobody_renews_is_shown_once_and_ends_in_holding() -> None:
    rig = tracking()
    assert rig.tick(RequestKind.JOG, 0.05, 10.0).state == State.MOVING
    for _ in range(3):
        assert not any(tick.present for tick in rig.ticks(9))
        assert rig.tick(RequestKind.JOG, 0.05, 10.0).present == 0
    shown = [tick.present for tick in rig.ticks(30)]
    assert shown.count(1 << F.OPERATOR_LOST) == 1
    assert sum(shown) == 1 << F.OPERATOR_LOST
    assert rig.until(State.HOLDING).latched == 0


@pytest.mark.slow
def test_moves_over_the_whole_travel_show_nothing_but_limits() -> None:
    rig = ready()
    assert rig.tick(ARM).state == State.HOLDING
    present = 0
    for target in (0.9, 0.1, 0.5, 0.979, 0.021, 0.5):
        assert rig.tick(RequestKind.GOTO, target, 0.0, 0.0, 0.0).answer == Answer.TAKEN
        while (tick := rig.tick()).state == State.MOVING:
            present |= tick.present
        assert tick.state == State.HOLDING
        assert tick.measurement.position_m == pytest.approx(target, abs=2e-3)
        present |= rig.ticks(200)[-1].present
    assert names(present & ~(1 << F.SATURATED)) == []


PUSH = """
schema = 1
name = "push"
description = "Something pushes the load, and lets go."

[[fault]]
kind = "force"
force_n = {force_n}
for_s = 0.3
at_s = 0.4

[expect]
reaction = "none"
faults = []
reason = "the axis is allowed to be that far away, and comes back"

[change.limits]
tracking_error_m = 0.5
"""


@pytest.mark.slow
@pytest.mark.parametrize("force_n", [-500.0, 500.0])
def test_pushes_and_what_comes_back_from_them_are_no_fault(tmp_path: Path, force_n: float) -> None:
    scenario = tmp_path / "push.toml"
    scenario.write_text(PUSH.format(force_n=force_n))
    done = pneud_here("sim", "virtual.toml", "--scenario", scenario, "--duration", 3, "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["faults"] == []
