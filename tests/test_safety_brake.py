"""A brake by itself and under the state machine: it lets go of nothing that nobody bears."""

from __future__ import annotations

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from pneud.safety.brake import Brake, BrakeRules, is_holding, is_let_go, is_wanted, judge, proceed
from pneud.safety.faults import CENTRES, STOPS, F
from pneud.safety.supervisor import INITIAL, Supervisor, advance, is_engaged
from pneud.signals import Hold, RequestKind, State

MS = 1_000_000
ENGAGED, BALANCING, RELEASING = Hold.ENGAGED, Hold.BALANCING, Hold.RELEASING
RELEASED, ENGAGING = Hold.RELEASED, Hold.ENGAGING
PLAIN = BrakeRules(used=True, release_ns=50 * MS, engage_ns=30 * MS, balance_ns=1000 * MS)
TOLD = PLAIN._replace(feedback=2, feedback_ns=10 * MS)
STUCK, UNBALANCED = 1 << F.BRAKE_STUCK, 1 << F.BRAKE_UNBALANCED


def after(hold: Hold, ms: int, rules: BrakeRules = PLAIN, inputs: int = 0, **more: bool) -> Hold:
    said = {"engaged": True, "wanted": True, "balanced": False} | more
    return Hold(proceed(Brake(hold), **said, inputs=inputs, t_ns=ms * MS, p=rules).hold)


@pytest.mark.parametrize("hold", [h for h in Hold if h])
def test_whoever_is_not_engaged_is_held(hold: Hold) -> None:
    assert after(hold, 500, engaged=False, balanced=True) == ENGAGED


def test_it_lets_go_of_what_the_piston_bears_and_takes_its_time() -> None:
    assert after(ENGAGED, 5) == BALANCING
    assert after(ENGAGED, 5, wanted=False) == ENGAGED
    assert after(BALANCING, 5) == BALANCING
    assert after(BALANCING, 5, balanced=True) == RELEASING
    assert after(BALANCING, 5, wanted=False, balanced=True) == ENGAGED
    assert after(RELEASING, 49) == RELEASING
    assert after(RELEASING, 50) == RELEASED
    assert after(RELEASING, 49, wanted=False) == ENGAGING
    assert after(RELEASED, 500) == RELEASED
    assert after(RELEASED, 500, wanted=False) == ENGAGING
    assert after(ENGAGING, 29) == ENGAGING
    assert after(ENGAGING, 30, wanted=False) == ENGAGED


def test_it_has_let_go_when_the_input_says_so_and_holds_when_that_says_so_or_time_is_over() -> None:
    assert after(RELEASING, 60, TOLD) == RELEASING
    assert after(RELEASING, 60, TOLD, inputs=2) == RELEASED
    assert after(ENGAGING, 35, TOLD, inputs=2) == ENGAGING
    assert after(ENGAGING, 35, TOLD) == ENGAGED
    assert after(ENGAGING, 40, TOLD, inputs=2) == ENGAGED


def test_it_is_fresh_for_one_tick_and_remembers_when_it_turned() -> None:
    first = proceed(Brake(RELEASING, 0), True, True, True, 0, 50 * MS, PLAIN)
    assert first == Brake(RELEASED, 50 * MS, -1, 1)
    assert proceed(first, True, True, True, 0, 51 * MS, PLAIN) == Brake(RELEASED, 50 * MS, -1, 0)
    wrong = Brake(ENGAGED, 0, 7)
    assert proceed(wrong, True, True, False, 0, 8, PLAIN).wrong_ns == 7
    assert proceed(Brake(BALANCING, 0, 7), True, True, True, 0, 8, PLAIN).wrong_ns == -1


@pytest.mark.parametrize(
    ("hold", "inputs", "allowed_ms"),
    [(RELEASING, 0, 60), (RELEASED, 0, 10), (ENGAGED, 2, 40), (BALANCING, 2, 40), (ENGAGING, 2, 40)],
)
def test_a_brake_that_does_something_else_is_stuck(hold: Hold, inputs: int, allowed_ms: int) -> None:
    b, faults = judge(Brake(hold), inputs, 0, TOLD)
    assert (b.wrong_ns, faults) == (0, 0)
    b, faults = judge(b, inputs, allowed_ms * MS, TOLD)
    assert faults == 0
    b, faults = judge(b, inputs, allowed_ms * MS + 1, TOLD)
    assert faults == STUCK
    b, faults = judge(b, 2 - inputs, allowed_ms * MS + 2, TOLD)
    assert (b.wrong_ns, faults) == (-1, 0)


def test_nobody_who_tells_nothing_is_stuck() -> None:
    assert judge(Brake(RELEASED), 0, 1000 * MS, PLAIN) == (Brake(RELEASED), 0)


def test_a_load_that_cannot_be_borne_is_a_fault() -> None:
    assert judge(Brake(BALANCING, 5), 0, 1000 * MS + 5, PLAIN)[1] == 0
    assert judge(Brake(BALANCING, 5), 0, 1000 * MS + 6, PLAIN)[1] == UNBALANCED


def test_it_holds_until_it_has_let_go() -> None:
    assert [h for h in Hold if h and not is_holding(Brake(h), PLAIN)] == [RELEASED]
    assert not is_holding(Brake(ENGAGED), BrakeRules())


def test_it_is_wanted_where_the_load_is_to_be_led() -> None:
    free, held = Brake(RELEASED), Brake(ENGAGED)
    resting = PLAIN._replace(at_rest=True)
    assert is_wanted(held, False, False, False, 0, PLAIN)
    assert is_wanted(held, False, True, True, 1, PLAIN)
    assert is_wanted(free, True, False, False, 0, PLAIN)
    assert not is_wanted(free, True, False, True, 0, PLAIN)
    assert not is_wanted(held, True, False, False, 0, PLAIN)
    assert is_wanted(free, False, True, True, 0, resting)
    assert not is_wanted(free, False, True, True, 1, resting)
    assert not is_wanted(held, False, True, True, 0, resting)
    assert is_wanted(held, False, False, True, 0, resting)


FAULTS = (0, 0, 0, 1 << F.TRAVEL, 1 << F.SUPPLY_FALLING, 1 << F.MOVING, STUCK, UNBALANCED)


class Braked(RuleBasedStateMachine):
    """A state machine with a brake, whatever is asked of it and whatever goes wrong; a millisecond a step."""

    def __init__(self) -> None:
        super().__init__()
        self.s: Supervisor = INITIAL
        self.b = Brake()
        self.t_ns = self.told_ns = 0
        self.freed_balanced = True
        self.let_go_before = False

    @rule(
        request=st.sampled_from([0, 0, 0, *RequestKind]),
        present=st.sampled_from(FAULTS),
        at_rest=st.booleans(),
        balanced=st.booleans(),
        feedback=st.booleans(),
        in_position=st.booleans(),
        ticks=st.sampled_from([1, 3, 12, 60]),
        rules=st.sampled_from([PLAIN, TOLD, TOLD._replace(at_rest=True)]),
    )
    def pass_time(
        self, request: int, present: int, at_rest: bool, balanced: bool, feedback: bool, in_position: bool,
        ticks: int, rules: BrakeRules,
    ) -> None:  # fmt: skip
        for _ in range(ticks):
            self.t_ns += MS
            inputs = 2 if feedback else 0
            before = self.s
            self.b, found = judge(self.b, inputs, self.t_ns, rules)
            bits = present | found
            centring = (
                before.centring or bits & STOPS or request in (RequestKind.DISARM, RequestKind.SHUTDOWN)
            )
            stopping = before.state == State.STOPPING
            may = not (stopping and centring and self.b.hold != ENGAGED)
            self.s = advance(before, bits, request, at_rest and may)
            engaged = is_engaged(self.s.state)
            state = self.s.state
            wanted = is_wanted(
                self.b, state == State.STOPPING, state == State.HOLDING, at_rest, int(in_position), rules
            )
            old = self.b
            self.b = proceed(old, engaged, wanted, balanced, inputs, self.t_ns, rules)
            if is_let_go(self.b.hold) and not is_let_go(old.hold):
                assert balanced and old.hold == BALANCING
                self.told_ns = self.t_ns
            if self.b.hold == RELEASED and old.hold != RELEASED:
                assert self.t_ns - self.told_ns >= rules.release_ns
            if before.state == State.STOPPING and state == State.DISARMED and request != RequestKind.CENTRE:
                assert old.hold == ENGAGED  # it held before the valve was let go
            if bits & CENTRES and is_engaged(before.state):
                assert self.b.hold == ENGAGED
            request = 0

    @invariant()
    def nobody_lets_go_of_what_is_not_engaged(self) -> None:
        if not is_engaged(self.s.state):
            assert self.b.hold == ENGAGED
            assert not is_let_go(self.b.hold)


Braked.TestCase.settings = settings(max_examples=15, stateful_step_count=25, deadline=None)
TestBraked = Braked.TestCase
