"""Inputs by their roles, and what outputs say."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pneud.safety.brake import BrakeRules
from pneud.safety.faults import F
from pneud.safety.station import UNHEARD, Inputs, Judged, Roles, judge, told
from pneud.signals import Heard, Hold, State, Station

MS = 1_000_000
START, ENABLE, PART = 1, 2, 4
ROLES = Roles(used=True, lost_ns=100 * MS, enable=ENABLE, start=START)
OFF, CUT = 1 << F.ENABLE_OFF, 1 << F.ENABLE_CUT
LOST, REFUSED = 1 << F.INPUT_LOST, 1 << F.START_REFUSED


def said(bits: int, age_ms: int = 0) -> Heard:
    return Heard(bits, age_ms * MS)


def test_nothing_is_said_where_there_are_no_inputs() -> None:
    assert judge(Inputs(), None, 0, Roles(used=True)) == Judged(Inputs(), False, 0)


@pytest.mark.parametrize("heard", [None, said(ENABLE | START, 101)])
def test_what_is_not_heard_is_lost_and_begins_nothing_when_it_comes_back(heard: Heard | None) -> None:
    lost = judge(Inputs(ENABLE, 0), heard, 0, ROLES)
    assert lost == Judged(Inputs(ENABLE, UNHEARD), False, LOST)
    back = judge(lost.inputs, said(ENABLE | START), 0, ROLES)
    assert back == Judged(Inputs(ENABLE | START, 1), False, 0)


def test_an_age_at_its_bound_is_not_lost() -> None:
    assert judge(Inputs(), said(ENABLE, 100), 0, ROLES).faults == 0


def test_without_enable_it_stops_or_lets_go() -> None:
    assert judge(Inputs(), said(PART), 0, ROLES).faults == OFF
    assert judge(Inputs(), said(PART), 0, ROLES._replace(cuts=True)).faults == CUT
    assert judge(Inputs(), said(PART), 0, ROLES._replace(enable=0)).faults == 0


def test_a_start_begins_when_it_comes_on_and_not_while_it_is() -> None:
    first = judge(Inputs(), said(ENABLE | START), 0, ROLES)
    assert not first.starts  # it stood before anybody looked
    off = judge(first.inputs, said(ENABLE), 0, ROLES)
    assert not off.starts
    on = judge(off.inputs, said(ENABLE | START), 0, ROLES)
    assert on.starts
    assert not judge(on.inputs, said(ENABLE | START), 0, ROLES).starts


def test_a_start_that_is_none_begins_nothing() -> None:
    before = judge(Inputs(), said(ENABLE), 0, ROLES._replace(start=0)).inputs
    assert not judge(before, said(ENABLE | START), 0, ROLES._replace(start=0)).starts


def test_a_refusal_is_shown_for_a_second() -> None:
    refused = Inputs(ENABLE, 1, 5)
    assert judge(refused, said(ENABLE), 5 + 999 * MS, ROLES).faults == REFUSED
    assert judge(refused, said(ENABLE), 5 + 1000 * MS, ROLES).faults == 0


OUT = Roles(used=True, in_position=1, ready=2, engaged=4, fault=8, brake=16)
NO_BRAKE, FREES = BrakeRules(), BrakeRules(used=True)


def outputs(state: State, present: int = 0, latched: int = 0, near: int = 0, program: int = 0) -> int:
    return told(0, state, present, latched, near, program, Hold.ENGAGED, OUT, NO_BRAKE).outputs


def test_outputs_say_how_the_axis_is() -> None:
    assert outputs(State.DISARMED) == OUT.ready
    assert outputs(State.DISARMED, 1 << F.MOVING) == 0
    assert outputs(State.WAITING) == 0
    assert outputs(State.HOLDING, near=1) == OUT.ready | OUT.engaged | OUT.in_position
    assert outputs(State.FAULT, latched=1) == OUT.fault


def test_a_program_puts_out_what_is_its_own() -> None:
    assert outputs(State.WAITING, program=32 | OUT.fault | OUT.brake) == 32


@pytest.mark.parametrize("hold", [h for h in Hold if h])
def test_a_brake_gets_power_by_its_kind(hold: Hold) -> None:
    free = hold in (Hold.RELEASING, Hold.RELEASED)
    frees = told(7, State.HOLDING, 0, 0, 0, 0, hold, OUT, FREES)
    assert frees == Station(7, OUT.ready | OUT.engaged | (OUT.brake if free else 0), hold)
    holds = told(7, State.HOLDING, 0, 0, 0, 0, hold, OUT, FREES._replace(frees=False))
    assert bool(holds.outputs & OUT.brake) != free


def test_without_a_brake_nothing_is_said_of_one() -> None:
    assert told(0, State.HOLDING, 0, 0, 0, 0, Hold.ENGAGED, Roles(used=True), NO_BRAKE).brake == Hold.NONE


@settings(max_examples=30, deadline=None)
@given(st.lists(st.tuples(st.booleans(), st.integers(0, 200)), max_size=30))
def test_every_start_was_seen_off_before(ticks: list[tuple[bool, int]]) -> None:
    state, seen_off = Inputs(), False
    for on, age_ms in ticks:
        found = judge(state, said(ENABLE | (START if on else 0), age_ms), 0, ROLES)
        lost = age_ms > 100
        assert found.starts == (on and seen_off and not lost)
        seen_off = not lost and not on
        state = found.inputs
