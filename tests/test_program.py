"""A program as data: which record comes behind which, what is waited for, and what is no program."""

from __future__ import annotations

import math
from collections.abc import Iterator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pneud.control import program
from pneud.control.plan import FOLLOWING, GOING
from pneud.control.program import DONE, DUE, ENDED, LATE, STOPPED, UNDER_WAY, Program, Run, Step
from pneud.signals import ALL_SOURCES, Estimate, Reference, Source, State

WAIT = Step(program.WAIT)
RECORDS = st.lists(
    st.one_of(
        st.just(WAIT),
        st.builds(lambda to, n: Step(program.REPEAT, to=to, times=n), st.integers(1, 9), st.integers(1, 3)),
    ),
    min_size=1,
    max_size=9,
)


def estimate(x: float = 0.0, v: float = 0.0, x3: float = 0.0) -> Estimate:
    return Estimate(x, v, 0.0, x3, x3, 0.0, 0.0, 0.0)


def looked(
    run: Run, t_ns: int = 0, state: int = State.HOLDING, x: float = 0.0, goal: float = 0.0, **seen: float
) -> Run:
    phase, inputs = int(seen.get("phase", 0)), int(seen.get("inputs", 0))
    e = estimate(x, seen.get("v", 0.0), seen.get("x3", 0.0))
    r = Reference(goal, seen.get("goes", 0.0), 0.0, 0.0)
    there, read = int(seen.get("there", 0)), int(seen.get("read", ALL_SOURCES))
    return program.look(run, t_ns, int(state), phase, there, e, r, inputs, 10.0, read)


def gone_through(steps: Program, laps: int, most: int = 3000) -> Iterator[int]:
    """The records in the order in which they are begun."""
    run = Run(DUE, next=1, laps=laps, counts=(0,) * len(steps))
    for _ in range(most):
        run = program.begins(run, steps)
        if run.stage == ENDED:
            assert run.lap == laps
            return
        yield run.record
        step = steps[run.record - 1]
        run = program.repeated(run, step) if step.kind == program.REPEAT else run._replace(stage=DUE)


def nested(steps: Program) -> bool:
    """Whether no loop reaches into another one, nor forwards."""
    spans = [(s.to, n) for n, s in enumerate(steps, 1) if s.kind == program.REPEAT]
    return all(a <= b for a, b in spans) and not any(
        a < c <= b < d for a, b in spans for c, d in spans if (a, b) != (c, d)
    )


@settings(max_examples=60, deadline=None)
@given(RECORDS, st.integers(1, 3))
def test_loops_are_gone_through_as_often_as_they_say(listed: list[Step], laps: int) -> None:
    steps = tuple(listed)
    if not program.leads(steps) or not nested(steps):
        return

    def through(first: int, last: int) -> list[int]:
        found: list[int] = []
        at = first
        while at <= last:
            ends = [
                n
                for n in range(at, last + 1)
                if steps[n - 1].kind == program.REPEAT and steps[n - 1].to == at
            ]
            outer = max((n for n in ends if (at, n) not in under), default=0)
            if outer:
                under.append((at, outer))
                for _ in range(steps[outer - 1].times):
                    found.extend([*through(at, outer - 1), outer])
                under.remove((at, outer))
                at = outer + 1
            else:
                found.append(at)
                at += 1
        return found

    under: list[tuple[int, int]] = []
    expected = through(1, len(steps)) * laps
    if len(expected) < 2500:
        assert list(gone_through(steps, laps)) == expected


def test_a_record_waits_for_what_it_says() -> None:
    near = Run(UNDER_WAY, what=program.NEAR, target_m=0.3, tolerance_m=0.01)
    assert looked(near, x=0.288, goal=0.3).stage == UNDER_WAY
    assert looked(near, x=0.291, goal=0.292).stage == UNDER_WAY
    assert looked(near, State.MOVING, x=0.291, goal=0.293).stage == DUE
    standing = Run(UNDER_WAY, what=program.STANDING, tolerance_m=0.01, velocity_m_s=0.002, time_ns=5)
    for x, goal in ((0.0111, 0.0), (1.1e-5, 1.1e-5)):
        assert looked(standing, 3, x=x, goal=goal).within_ns == -1
    assert looked(standing, 3, State.MOVING, x=0.009, goal=0.9e-5).within_ns == 3
    begun = looked(standing, 3, x=-0.009, v=0.3)
    assert (begun.within_ns, begun.stage) == (3, UNDER_WAY)
    assert looked(begun, 7).stage == UNDER_WAY
    assert looked(begun, 8).stage == DUE
    assert looked(begun, 8, State.MOVING).stage == DUE
    assert looked(begun, 8, State.MOVING, goes=1e-9).stage == UNDER_WAY
    assert looked(begun, 8, v=-0.0021).stage == UNDER_WAY
    assert looked(begun, 8, x=0.02).within_ns == -1
    joined = Run(UNDER_WAY, what=program.JOINED)
    assert looked(joined, phase=GOING).stage == UNDER_WAY
    assert looked(joined, phase=FOLLOWING).stage == DUE
    between = Run(UNDER_WAY, what=program.POSITION, low=0.1, high=0.2)
    assert [looked(between, x=x).stage for x in (0.09, 0.1, 0.2, 0.21)] == [UNDER_WAY, DUE, DUE, UNDER_WAY]
    thrust = Run(UNDER_WAY, what=program.THRUST, low=50.0, high=1e9)
    assert [looked(thrust, x3=n).stage for n in (59.0, 61.0)] == [UNDER_WAY, DUE]
    given_ = Run(UNDER_WAY, what=program.INPUT, bit=2, on=1)
    assert [looked(given_, inputs=bits).stage for bits in (3, 4)] == [UNDER_WAY, DUE]
    assert looked(given_._replace(on=0), inputs=4).stage == UNDER_WAY
    pressed = Run(UNDER_WAY, what=program.PRESSED)
    assert looked(pressed, 1, state=program.PRESSING).stage == UNDER_WAY
    assert looked(pressed, 1, state=program.PRESSING, there=1).stage == DUE
    assert looked(pressed, 0, state=program.PRESSING, there=1).stage == UNDER_WAY  # of the record before


def test_what_is_shared_waits_for_the_others() -> None:
    run = Run(UNDER_WAY, shared=1)
    assert looked(run).stage == DONE
    assert looked(run._replace(stage=DONE)).stage == DONE


def test_a_record_is_late_after_its_time() -> None:
    run = Run(UNDER_WAY, what=program.POSITION, low=1.0, high=2.0, since_ns=5, timeout_ns=10)
    assert [looked(run, t).stage for t in (14, 15)] == [UNDER_WAY, LATE]
    assert looked(run._replace(timeout_ns=0), 10**15).stage == UNDER_WAY


@pytest.mark.parametrize("state", [State.STOPPING, State.FAULT, State.DISARMED, State.HOMING])
@pytest.mark.parametrize("stage", [UNDER_WAY, DUE, DONE, LATE])
def test_whatever_the_axis_is_taken_from_is_stopped(state: State, stage: int) -> None:
    found = looked(Run(stage, record=3, next=4), state=state)
    again = stage != DUE
    assert found == Run(STOPPED, record=3, next=3 if again else 4, kept=int(again))


def test_a_step_is_what_it_was_as_a_request() -> None:
    step = Step(program.UNTIL, what=program.INPUT, bit=3, on=1, timeout_s=2.0, otherwise=7)
    found = program.step_of(tuple(map(float, step)))
    assert found == step
    assert [type(value) for value in found] == [type(value) for value in step]


@pytest.mark.parametrize(
    "changes",
    [
        {"kind": 0},
        {"kind": 99},
        {"kind": 1.5},
        {"ends": 3},
        {"tolerance_m": -1.0},
        {"speed_m_s": -1e-3},
        {"time_s": 1e7},
        {"timeout_s": -1.0},
        {"mass_kg": -1.0},
        {"what": program.POSITION},
        {"bit": 32},
        {"on": 2},
        {"low": 1.0},
        {"times": -1},
        {"kind": program.REPEAT},
        {"kind": program.UNTIL},
    ],
)
def test_what_is_no_step_is_refused(changes: dict[str, float]) -> None:
    values = tuple(float(v) for v in WAIT._replace(**changes))  # type: ignore[arg-type]
    assert program.step_of(values) is None
    assert program.step_of(values[1:]) is None


def test_goals_lie_in_the_program() -> None:
    assert not program.leads(())
    assert program.leads((WAIT, Step(program.JUMP, to=1)))
    assert not program.leads((WAIT, Step(program.JUMP, to=3)))
    assert not program.leads((Step(program.REPEAT, times=2),))
    assert not program.leads((WAIT._replace(otherwise=2),))


def test_only_what_is_under_way_is_halted() -> None:
    assert program.halted(Run(DUE)).stage == STOPPED
    assert program.halted(Run(ENDED)).stage == ENDED
    assert not math.isnan(Run().target_m)


def test_a_run_waits_for_what_its_kind_of_step_is_done_with() -> None:
    def what(step: Step) -> tuple[int, int]:
        run = program.awaiting(Run(record=3, led=1), step, 7, 1)
        assert (run.stage, run.since_ns) == (UNDER_WAY, 7)
        return run.what, run.led

    assert what(Step(program.GOTO)) == (program.NOTHING, 3)
    assert what(Step(program.MOVE, ends=program.FAST)) == (program.NEAR, 3)
    assert what(Step(program.GOTO, ends=program.EXACT)) == (program.STANDING, 3)
    assert what(Step(program.TRACK)) == (program.JOINED, 3)
    assert what(Step(program.FORCE)) == (program.PRESSED, 3)
    assert what(WAIT) == (program.NOTHING, 1)
    assert what(Step(program.UNTIL, what=program.THRUST)) == (program.THRUST, 1)


@pytest.mark.parametrize(
    ("step", "key", "ends"),
    [
        (WAIT, "time_s", DUE),
        (Step(program.UNTIL, what=program.INPUT, on=0), "time_s", DUE),
        (Step(program.UNTIL, what=program.INPUT, on=1), "timeout_s", LATE),
        (Step(program.GOTO, ends=program.EXACT, tolerance_m=1.0), "time_s", DUE),
        (Step(program.FORCE), "timeout_s", LATE),
    ],
)
@settings(max_examples=20, deadline=None)
@given(st.integers(1, 12), st.lists(st.integers(-240_000, 240_000), min_size=13, max_size=13))
def test_a_time_of_whole_periods_takes_as_many_ticks_whenever_they_come(
    step: Step, key: str, ends: int, n: int, off_ns: list[int]
) -> None:
    begun_ns = 1_000_000_000 + off_ns[0]
    numbers = step._asdict() | {key: n * 1e-3}
    run = program.awaiting(Run(record=1), Step(**numbers), begun_ns, 1_000_000)
    run, ticks = looked(run, begun_ns), 0
    while run.stage == UNDER_WAY:
        ticks += 1
        run = looked(run, 1_000_000_000 + ticks * 1_000_000 + off_ns[ticks])
    assert (run.stage, ticks) == (ends, n)


def test_a_time_out_shorter_than_the_ticks_is_one_all_the_same() -> None:
    run = program.awaiting(
        Run(record=1), Step(program.UNTIL, what=program.INPUT, on=1, timeout_s=1e-4), 0, 10**6
    )
    assert looked(run, 1_000_000).stage == LATE


@pytest.mark.parametrize(
    ("step", "needs"),
    [
        (Step(program.GOTO, ends=program.EXACT, tolerance_m=1e-3, velocity_m_s=1e-3), Source.ENCODER),
        (Step(program.GOTO, ends=program.FAST, tolerance_m=1e-3), Source.ENCODER),
        (Step(program.UNTIL, what=program.POSITION, high=1.0), Source.ENCODER),
        (Step(program.UNTIL, what=program.THRUST, low=-20.0, high=1.0), Source.PRESSURE),
        (WAIT, Source(0)),
        (Step(program.UNTIL, what=program.INPUT), Source(0)),
    ],
)
def test_what_was_not_read_neither_begins_a_while_nor_ends_it(step: Step, needs: Source) -> None:
    others, none = ALL_SOURCES & ~needs, Run(record=1)
    at_once = program.awaiting(none, step._replace(time_s=0.0), 0, 2)
    assert looked(at_once, 0, read=others).stage == (UNDER_WAY if needs else DUE)
    assert looked(at_once, 0, read=int(needs)).stage == DUE
    run = program.awaiting(none, step._replace(time_s=5e-9), 0, 2)
    assert looked(run, 1, read=others).within_ns == (-1 if needs else 1)
    begun = looked(run, 1, read=int(needs))
    assert begun.within_ns == 1
    over = looked(begun, 9, read=others)
    assert (over.stage, over.within_ns) == ((UNDER_WAY, 1) if needs else (DUE, -1))
    assert looked(over, 10, read=int(needs)).stage == DUE
    late = begun._replace(timeout_ns=20)
    assert looked(late, 20, read=others).stage == (LATE if needs else DUE)
