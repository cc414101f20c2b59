"""The parts of a cycle by themselves: what is believed, where it is led, what leaves, what is remembered."""

from __future__ import annotations

import math
from typing import Any

import pytest

from axis_rig import PERIOD_NS, loaded, ready, tracking
from pneud.axis.cycle import CENTRED_COMMAND, actuate, put_away
from pneud.axis.guidance import LOSES_REFERENCE, Course, guide, redirect
from pneud.axis.mileage import Odometer
from pneud.axis.requests import NOTHING, Asked
from pneud.axis.sensing import Belief, Driven, believe, sense
from pneud.axis.standing import Standing
from pneud.axis.state import AxisParameters, AxisState, Doubt, configured, switched_on
from pneud.config import conversions
from pneud.control import homing
from pneud.control.homing import AWAY, HALT, TOWARDS, Homing
from pneud.control.plan import COMING_TO_REST, IDLE, JOINING, RESTING, resting
from pneud.control.profile import Profile
from pneud.control.program import PASS, Run, Step
from pneud.control.reference import Septic
from pneud.safety.checks import engaged
from pneud.safety.faults import NO_SENSORS, F, names
from pneud.safety.supervisor import is_engaged
from pneud.signals import ALL_SOURCES, Measurement, Reference, Source, State

P = conversions.axis_of(loaded().config, loaded().codecs.command_lsb_v)
INCREMENTAL = P._replace(homing=P.homing._replace(incremental=True))
TIMEOUT_NS = P.limits.sensor_timeout_ns


def disarmed() -> tuple[AxisState, Measurement]:
    rig = ready()
    return rig.axis.freeze(), rig.tick().measurement


def under_way() -> tuple[AxisState, Measurement]:
    """On the way to the reference, and the measurement of the next tick."""
    rig = tracking()
    return rig.axis.freeze(), rig.tick().measurement


def in_state(state: AxisState, now: State) -> AxisState:
    return state._replace(supervisor=state.supervisor._replace(state=int(now)))


def known(state: AxisState, m: Measurement) -> Belief:
    return believe(state, m, m.t_ns, is_engaged(state.supervisor.state), 0, TIMEOUT_NS)


def led(state: AxisState, m: Measurement, present: int = 0, p: AxisParameters = P) -> Course:
    return guide(state, known(state, m), m, present, p)


def turned(state: AxisState, m: Measurement, after: State, asked: Asked = NOTHING) -> Course:
    return redirect(led(state, m), asked, int(after), state, known(state, m), P)


# what is believed


def test_an_estimate_holds_for_the_instant_of_its_reading() -> None:
    state, m = under_way()
    belief = known(state, m._replace(encoder_offset_ns=-70))
    assert belief.sampled_ns == belief.read_ns == m.t_ns - 70
    assert belief.started_ns == state.started_ns
    without = m._replace(encoder_offset_ns=-70, fresh=int(ALL_SOURCES & ~Source.ENCODER))
    predicted = known(state, without)
    assert predicted.sampled_ns == state.sampled_ns + m.t_ns - state.t_ns
    assert predicted.read_ns == state.read_ns
    assert predicted.estimate.innovation_m == 0.0


@pytest.mark.parametrize("lacking", [bit for bit in range(64) if NO_SENSORS >> bit & 1])
def test_nothing_is_believed_of_sources_that_are_silent(lacking: int) -> None:
    state, m = under_way()
    m = m._replace(fresh=int(Source.PRESSURE))
    belief = believe(state, m, m.t_ns, True, 1 << lacking, TIMEOUT_NS)
    assert belief.controller is None
    assert all(map(math.isnan, belief.estimate))


@pytest.mark.parametrize("is_on", [True, False])
def test_only_a_disengaged_axis_forgets_what_it_knew_long_ago(is_on: bool) -> None:
    state, m = disarmed()
    m = m._replace(fresh=int(Source.ENCODER))
    for late_ns, kept in ((TIMEOUT_NS, True), (TIMEOUT_NS + 1, is_on)):
        t_ns = state.sampled_ns + late_ns - m.encoder_offset_ns
        assert (believe(state, m, t_ns, is_on, 0, TIMEOUT_NS).controller is not None) == kept


def test_estimates_begin_with_a_whole_set() -> None:
    state, m = disarmed()
    state = state._replace(controller=None)
    assert known(state, m._replace(fresh=int(Source.ENCODER))).controller is None
    begun = known(state, m)
    assert begun.estimate.position_m == m.position_m
    assert begun.read_ns == begun.started_ns == begun.sampled_ns == m.t_ns + m.encoder_offset_ns


def test_a_measurement_shows_the_checks_of_its_state() -> None:
    state, m = under_way()
    cut = m._replace(encoder_status=0)
    belief, _, _, present = sense(state, cut, False, m.t_ns, P)
    h, s = P.controller.h, state.supervisor
    assert present & engaged(cut, belief.estimate, s.state, s.ticks, h, P.limits)
    state, m = disarmed()
    live = m._replace(applied_v=1.0)
    assert names(sense(state, live, True, m.t_ns, P).present) == ["valve_active"]
    assert sense(state, m, True, m.t_ns, P).present == 0


# where the axis is led


def test_an_axis_that_is_not_engaged_is_led_nowhere() -> None:
    state, m = disarmed()
    course = led(state, m, present=5)
    assert all(map(math.isnan, course.reference))
    assert (course.plan, course.at_rest, course.present) == (IDLE, False, 5)


def test_an_engaged_axis_follows_its_plan() -> None:
    state, m = under_way()
    course = led(state, m)
    assert course.plan == state.plan
    assert course.reference.position_m == pytest.approx(m.position_m, abs=1e-3)
    assert (course.at_rest, course.found, course.present) == (False, False, 0)


def test_far_from_the_reference_is_a_tracking_error() -> None:
    state, m = under_way()
    limit = abs(led(state, m).reference.position_m - known(state, m).estimate.position_m)
    for tracking_error_m, found in ((limit, []), (math.nextafter(limit, 0.0), ["tracking_error"])):
        p = P._replace(limits=P.limits._replace(tracking_error_m=tracking_error_m))
        assert names(led(state, m, p=p).present) == found
    unknown = known(state, m)._replace(controller=None)
    assert guide(state, unknown, m, 0, p).present == 0  # something else says that better


def test_a_jog_uses_up_its_lease_tick_by_tick() -> None:
    state, m = under_way()
    jogging = state._replace(plan=state.plan._replace(jog_m_s=0.05, lease=7))
    assert led(jogging, m).plan.lease == 6
    assert led(jogging, m._replace(skipped=3)).plan.lease == 3
    assert led(state._replace(plan=state.plan._replace(lease=7)), m).plan.lease == 7


@pytest.mark.parametrize("bit", [bit for bit in range(64) if LOSES_REFERENCE >> bit & 1])
def test_an_encoder_in_doubt_has_lost_its_reference(bit: int) -> None:
    state, m = under_way()
    state = state._replace(referenced=True)
    assert led(state, m).referenced
    assert not led(state, m, 1 << bit).referenced


@pytest.mark.parametrize(
    ("p", "referenced", "now", "counts"),
    [
        (P, False, State.DISARMED, True),
        (INCREMENTAL, True, State.DISARMED, True),
        (INCREMENTAL, False, State.DISARMED, False),
        (INCREMENTAL, True, State.HOMING, False),
    ],
)
def test_a_position_that_is_not_known_is_outside_no_travel(
    p: AxisParameters, referenced: bool, now: State, counts: bool
) -> None:
    state, m = disarmed()
    state = in_state(state, now)._replace(referenced=referenced)
    assert (led(state, m, 1 << F.TRAVEL | 1 << F.MOVING, p).present >> F.TRAVEL & 1) == counts


def at_the_stop(state: AxisState, m: Measurement) -> AxisState:
    way = Homing(TOWARDS, m.t_ns - 10**9, m.position_m + 0.5, m.t_ns - 10**9)
    return in_state(state, State.HOMING)._replace(homing=way, zero_m=0.125)


def test_the_stop_says_where_the_zero_is(monkeypatch: pytest.MonkeyPatch) -> None:
    state, m = disarmed()
    state = at_the_stop(state, m)
    found = homing.Progress(Homing(TOWARDS, 0, 0.0, 0), found=True)
    monkeypatch.setattr(homing, "proceed", lambda *_: found)
    course = led(state, m, p=INCREMENTAL)
    assert (course.found, course.referenced) == (True, True)
    assert course.zero_m == 0.125 + P.homing.stop_m - m.position_m
    assert course.controller is not None
    assert course.controller.motion.x == P.homing.stop_m
    assert not led(state, m, 1 << F.ENCODER_JUMP, INCREMENTAL).referenced


def test_homing_that_fails_says_so() -> None:
    state, m = disarmed()
    late = Homing(AWAY, m.t_ns - P.homing.longest_ns - 2 * PERIOD_NS, m.position_m, m.t_ns)
    state = in_state(state, State.HOMING)._replace(homing=late)
    assert names(led(state, m).present) == ["homing_failed"]


# what requests and changes of state make of it


def test_without_a_request_nothing_changes() -> None:
    state, m = under_way()
    course = led(state, m)
    assert redirect(course, NOTHING, int(State.TRACKING), state, known(state, m), P) is course


def test_what_arms_takes_over_without_a_bump() -> None:
    state, m = disarmed()
    here = resting(m.position_m, m.t_ns)
    course = turned(state, m, State.HOLDING, Asked(1, 1, plan=here))
    assert course.plan == here
    assert course.reference == Reference(m.position_m, 0.0, 0.0, 0.0)
    assert course.controller is not None
    assert led(state, m).controller is not None
    driven = actuate(course, int(State.HOLDING), m, known(state, m), 0.0, state.law, P)
    assert driven.command.s == 0.0


def test_a_plan_that_is_asked_for_is_followed_from_the_next_tick_on() -> None:
    state, m = under_way()
    here = resting(0.4, m.t_ns)
    course = turned(state, m, State.MOVING, Asked(1, plan=here))
    assert course.plan == here
    assert course.reference == led(state, m).reference


def test_what_holds_stands_where_the_reference_was() -> None:
    state, m = under_way()
    course = turned(state, m, State.HOLDING)
    assert course.plan == resting(led(state, m).reference.position_m, known(state, m).sampled_ns)


def test_what_stops_comes_to_rest_once() -> None:
    state, m = under_way()
    course = turned(state, m, State.STOPPING)
    assert (course.plan.phase, course.plan.since_ns) == (COMING_TO_REST, known(state, m).sampled_ns)
    stopping = in_state(state, State.STOPPING)._replace(plan=course.plan)
    assert turned(stopping, m, State.STOPPING).plan == course.plan


@pytest.mark.parametrize(("lease", "lost"), [(1, False), (0, True)])
def test_a_jog_without_its_operator_comes_to_rest(lease: int, lost: bool) -> None:
    state, m = under_way()
    state = in_state(state, State.MOVING)
    state = state._replace(plan=state.plan._replace(jog_m_s=0.05, lease=lease))
    course = turned(state, m, State.MOVING)
    assert names(course.present) == (["operator_lost"] if lost else [])
    assert (course.plan.phase == COMING_TO_REST) == lost
    renewed = turned(state, m, State.MOVING, Asked(1, plan=state.plan._replace(lease=9)))
    assert (renewed.present, renewed.plan.lease) == (0, 9)


def test_other_gains_change_the_controller_alone() -> None:
    state, m = under_way()
    other = state.law._replace(observer=state.law.observer._replace(L=1.5 * state.law.observer.L))
    sliding = other.sliding._replace(gains=other.sliding.gains._replace(k1=2.0 * other.sliding.gains.k1))
    course = turned(state, m, State.TRACKING, Asked(1, law=other._replace(sliding=sliding)))
    before = led(state, m)
    assert course._replace(controller=None) == before._replace(controller=None)
    assert course.controller is not None
    assert before.controller is not None
    assert course.controller.blend != before.controller.blend


def test_homing_begins_without_a_plan_and_without_a_reference() -> None:
    state, m = disarmed()
    course = turned(state._replace(referenced=True), m, State.HOMING, Asked(1, 1))
    belief = known(state, m)
    assert course.homing == homing.set_out(belief.estimate.position_m, belief.sampled_ns)
    assert (course.plan, course.referenced) == (IDLE, False)
    away_m_s = -P.homing.side * P.homing.speed_m_s
    assert course.reference == Reference(belief.estimate.position_m, away_m_s, 0.0, 0.0)


def test_homing_goes_on_as_it_was() -> None:
    state, m = disarmed()
    state = in_state(state, State.HOMING)._replace(homing=Homing(HALT, m.t_ns, 0.5, m.t_ns), referenced=True)
    course = turned(state, m, State.HOMING)
    assert course.homing == led(state, m).homing
    assert (course.referenced, course.reference.velocity_m_s) == (True, 0.0)


def test_behind_homing_the_axis_holds_where_it_is() -> None:
    state, m = disarmed()
    state = in_state(state, State.HOMING)
    course = turned(state, m, State.HOLDING)
    belief = known(state, m)
    assert course.plan == resting(belief.estimate.position_m, belief.sampled_ns)
    assert course.plan.phase == RESTING
    assert course.reference == Reference(belief.estimate.position_m, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("after", [State.TRACKING, State.HOMING])
def test_an_engaged_axis_knows_where_it_is(after: State) -> None:
    state, m = under_way()
    course = led(state, m)._replace(controller=None)
    with pytest.raises(AssertionError):
        redirect(course, NOTHING, int(after), state, known(state, m), P)


# what leaves, and what is remembered


@pytest.mark.parametrize("skipped", [0, 2])
def test_a_command_may_slew_for_the_time_since_the_last_one(skipped: int) -> None:
    state, m = under_way()
    p = P._replace(output=P.output._replace(slew_v_s=10.0))
    course, belief = led(state, m), known(state, m)
    driven = actuate(course, int(State.TRACKING), m._replace(skipped=skipped), belief, 4.0, state.law, p)
    assert driven.command.voltage_v == pytest.approx(4.0 - 0.01 * (1 + skipped), abs=3e-4)
    assert driven.command.saturated == 1
    assert driven.controller != course.controller


def test_homing_asks_without_the_law(monkeypatch: pytest.MonkeyPatch) -> None:
    state, m = disarmed()
    course, belief = turned(state, m, State.HOMING), known(state, m)
    driven = actuate(course, int(State.HOMING), m, belief, 0.0, state.law, P)
    assert driven.command.law_v == homing.command(course.homing, m, belief.estimate, P.homing, state.law)
    assert (driven.command.s, driven.command.ustar, driven.faults) == (0.0, 0.0, 0)
    assert driven.controller == course.controller
    monkeypatch.setattr(homing, "command", lambda *_: math.nan)
    assert names(actuate(course, int(State.HOMING), m, belief, 0.0, state.law, P).faults) == ["not_finite"]


DOUBT, STANDING, ODOMETER = Doubt(encoder_share=0.1), Standing(turns=2), Odometer(heading=-1)
RUN = Run(record=3)


def kept(state: AxisState, m: Measurement, after: State, **asked: Any) -> AxisState:
    course, belief = led(state, m), known(state, m)
    driven = Driven(course.controller, CENTRED_COMMAND._replace(voltage_v=1.5, saturated=1), 0)
    supervisor = state.supervisor._replace(state=int(after))
    law = state.law._replace(h=0.002)
    return put_away(
        state,
        m.t_ns,
        belief,
        state.watch,
        course,
        Asked(1, **asked),
        law,
        supervisor,
        driven,
        DOUBT,
        0.001,
        STANDING,
        ODOMETER,
        RUN,
        P,
    )


def test_all_of_a_tick_is_remembered() -> None:
    state, m = under_way()
    after = kept(state, m, State.TRACKING)
    course, belief = led(state, m), known(state, m)
    assert (after.t_ns, after.sampled_ns, after.read_ns) == (m.t_ns, belief.sampled_ns, belief.read_ns)
    assert after.started_ns == state.started_ns
    assert (after.last_v, after.limited, after.law.h) == (1.5, 1, 0.002)
    assert (after.plan, after.controller, after.plan.phase) == (course.plan, course.controller, JOINING)
    assert (after.profile, after.reference, after.watch) == (state.profile, state.reference, state.watch)
    assert (after.doubt, after.outside_m, after.standing) == (DOUBT, 0.001, STANDING)
    assert after.odometer == ODOMETER
    assert after.run == RUN
    assert after.program == state.program
    assert kept(state, m, State.TRACKING, program=(Step(PASS),)).program == (Step(PASS),)


def test_an_axis_that_is_not_engaged_keeps_no_plan() -> None:
    state, m = under_way()
    assert kept(state, m, State.FAULT).plan == IDLE


def test_what_was_asked_for_is_kept() -> None:
    state, m = under_way()
    profile: Profile = (Septic(1.0, *[0.0] * 8),)
    other = P.reference._replace(amplitude_m=0.01)
    after = kept(state, m, State.TRACKING, profile=profile, reference=other)
    assert (after.profile, after.reference) == (profile, other)
    assert configured(after, P) == other
    again = kept(after, m, State.TRACKING)
    assert (again.profile, again.reference) == (profile, other)


def test_an_axis_that_was_switched_on_knows_nothing() -> None:
    state = switched_on(P)
    assert (state.supervisor.state, state.controller, state.plan) == (State.STARTING, None, IDLE)
    assert (state.law, configured(state, P)) == (P.controller, P.reference)
