"""An axis that goes through a program: what it does at each record, and what ends it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache
from itertools import pairwise

import pytest

from axis_rig import ARM, CLEAR, Rig, assert_smooth, quick, ready, twin
from pneud.compiled.backend import INTERPRETED
from pneud.control import program
from pneud.control.program import Step
from pneud.safety.faults import F
from pneud.safety.faults import names as fault_names
from pneud.signals import Answer, Host, RequestKind, Stage, State, Tick

RECORD, RUN, GO_ON = RequestKind.RECORD, RequestKind.RUN, RequestKind.GO_ON
EXACT = Step(
    program.GOTO, ends=program.EXACT, tolerance_m=1e-4, velocity_m_s=5e-3, time_s=0.01, timeout_s=5.0
)
FAST = Step(program.GOTO, ends=program.FAST, tolerance_m=2e-3, timeout_s=5.0)
WAIT = Step(program.WAIT, time_s=0.02)
MOVE = EXACT._replace(kind=program.MOVE)


@cache
def _holding() -> Rig:
    rig = ready()
    rig.go_on(quick())
    assert rig.tick(ARM).state == State.HOLDING
    rig.ticks(50)
    rig.go_on(INTERPRETED)
    return rig


def holding(quickly: bool = True) -> Rig:
    rig = twin(_holding())
    if quickly:
        rig.go_on(quick())
    return rig


def load(rig: Rig, steps: Sequence[Step]) -> None:
    for values in ((), *(tuple(map(float, step)) for step in steps)):
        assert rig.tick(RECORD, *values).answer == Answer.TAKEN


def begun(steps: Sequence[Step], laps: float = 1.0, shared: float = 0.0, quickly: bool = True) -> Rig:
    rig = holding(quickly)
    load(rig, steps)
    assert rig.tick(RUN, 1.0, laps, shared).answer == Answer.TAKEN
    return rig


def to_the_end(rig: Rig, limit: int = 12_000) -> Iterator[Tick]:
    for _ in range(limit):
        tick = rig.tick()
        yield tick
        if tick.progress.stage in (Stage.ENDED, Stage.STOPPED):
            return
    raise AssertionError(f"record {tick.progress.step} has no end")


def here() -> float:
    return holding(quickly=False).tick().reference.position_m


def test_records_are_done_one_after_the_other() -> None:
    x = here()
    rig = begun([EXACT._replace(target_m=x + 0.02), WAIT, MOVE._replace(target_m=-0.01), WAIT])
    ticks = list(to_the_end(rig))
    assert [t.progress.step for a, t in pairwise(ticks) if t.progress.step != a.progress.step] == [2, 3, 4]
    assert ticks[-1].progress.stage == Stage.ENDED
    assert ticks[-1].progress.lap == 1
    assert ticks[-1].reference.position_m == pytest.approx(x + 0.01, abs=1e-9)
    waited = [t for t in ticks if t.progress.step == 4 and t.progress.stage == Stage.UNDER_WAY]
    assert len(waited) == pytest.approx(20, abs=1)
    done = [t for t in ticks if t.progress.step == 1 and t.progress.stage == Stage.DUE]
    assert len(done) == 1
    assert abs(done[0].reference.position_m - done[0].estimate.position_m) <= 1e-4
    assert done[0].state == State.HOLDING


def test_a_fast_one_leads_on_without_a_stop() -> None:
    x = here()
    early = FAST._replace(target_m=x + 0.03, tolerance_m=0.013)
    rig = begun([early, EXACT._replace(target_m=x + 0.06, speed_m_s=0.2)])
    ticks = [t for t in to_the_end(rig) if t.state == State.MOVING]
    through = next(t for t in ticks if t.progress.step == 1 and t.progress.stage == Stage.DUE)
    assert abs(through.estimate.position_m - x - 0.03) <= 0.013
    assert through.reference.velocity_m_s > 0.0
    moving = [t for t in ticks if t.progress.step == 2][:100]
    assert min(t.reference.velocity_m_s for t in moving) > 0.0
    assert_smooth(ticks, rig.axis.parameters.motion, room=1.01)


@pytest.mark.parametrize("tolerance_m", [2e-4, 1e-3, 8e-3])
@pytest.mark.parametrize("further_m", [0.0, 5e-4, 0.03])
def test_a_fast_one_that_brakes_already_leads_on_without_turning(
    tolerance_m: float, further_m: float
) -> None:
    x = here()
    early = FAST._replace(target_m=x + 0.03, tolerance_m=tolerance_m)
    ticks = list(to_the_end(begun([early, EXACT._replace(target_m=x + 0.03 + further_m)])))
    assert next(t for t in ticks if t.progress.step == 2).reference.acceleration_m_s2 < 0.0
    assert min(t.reference.velocity_m_s for t in ticks) >= -1e-9
    assert max(t.reference.position_m for t in ticks) <= x + 0.03 + further_m + 1e-9


def test_one_that_only_sets_out_leaves_the_next_to_wait_on_the_way() -> None:
    x = here()
    until = Step(program.UNTIL, what=program.POSITION, low=x + 0.02, high=1e9, timeout_s=3.0)
    out = EXACT._replace(target_m=x + 0.05, ends=program.AT_ONCE, timeout_s=0.0)
    rig = begun([out, until, EXACT._replace(target_m=x)])
    ticks = list(to_the_end(rig))
    first = next(t for t in ticks if t.progress.step == 3)
    assert x + 0.02 <= first.estimate.position_m < x + 0.03
    assert ticks[-1].reference.position_m == pytest.approx(x, abs=1e-9)


def test_loops_jumps_outputs_and_rounds_take_a_tick_each() -> None:
    steps = [
        WAIT._replace(time_s=0.0),
        Step(program.OUTPUT, bit=3, on=1),
        Step(program.REPEAT, to=1, times=3),
        Step(program.JUMP, to=6),
        WAIT._replace(time_s=9.0),
        Step(program.OUTPUT, bit=3, on=0),
    ]
    ticks = list(to_the_end(begun(steps, laps=2.0)))
    assert [t.progress.step for t in ticks][:-1] == [1, 2, 3, 1, 2, 3, 1, 2, 3, 4, 6] * 2
    assert [t.progress.outputs for t in ticks[:11]] == [0, *[8] * 9, 0]
    assert [t.progress.lap for t in ticks] == [0] * 11 + [1] * 11 + [2]


def test_a_workpiece_is_reckoned_with_without_a_bump() -> None:
    x = here()
    rig = begun([WAIT, EXACT._replace(target_m=x + 0.03, mass_kg=4.0), WAIT._replace(time_s=0.2)])
    own_kg = rig.axis.parameters.controller.cylinder.M
    ticks = list(to_the_end(rig))
    law = rig.axis.state.law
    assert {law.cylinder.M, law.sliding.M} == {own_kg}  # the last record carries nothing
    steps_v = [abs(b.command.voltage_v - a.command.voltage_v) for a, b in pairwise(ticks)]
    changes = [n for n, (a, b) in enumerate(pairwise(ticks)) if a.progress.step != b.progress.step]
    usual_v = max(v for n, v in enumerate(steps_v) if all(abs(n - c) > 3 for c in changes))
    assert max(steps_v[n] for n in changes) <= 2.0 * usual_v + 0.05


def test_another_motion_ends_it_and_it_can_go_on() -> None:
    x = here()
    rig = begun([WAIT, MOVE._replace(target_m=0.04), WAIT])
    while rig.tick().reference.position_m < x + 0.01:
        pass
    held = rig.tick(RequestKind.HOLD)
    assert (held.answer, held.progress.stage, held.progress.step) == (Answer.TAKEN, Stage.STOPPED, 2)
    rig.until(State.HOLDING)
    assert rig.tick(RequestKind.MARK).progress.stage == Stage.STOPPED
    assert rig.tick(RUN, 0.0, 0.0, 0.0).answer == Answer.TAKEN
    assert list(to_the_end(rig))[-1].reference.position_m == pytest.approx(x + 0.04, abs=1e-9)


@pytest.mark.parametrize("kind", [RequestKind.STOP, RequestKind.DISARM])
def test_a_stop_ends_it(kind: RequestKind) -> None:
    rig = begun([MOVE._replace(target_m=0.04)])
    rig.ticks(100)
    stopped = rig.tick(kind)
    assert (stopped.state, stopped.progress.stage, stopped.progress.step) == (
        State.STOPPING,
        Stage.STOPPED,
        1,
    )
    rig.until(State.HOLDING if kind == RequestKind.STOP else State.DISARMED)


def test_what_is_late_is_a_fault_or_goes_on_elsewhere() -> None:
    never = Step(program.UNTIL, what=program.INPUT, bit=0, on=1, timeout_s=0.05)
    rig = begun([WAIT, never, WAIT])
    ticks = list(to_the_end(rig))
    assert ticks[-1].progress.step == 2
    assert fault_names(ticks[-1].present) == ["program_late"]
    assert rig.until(State.FAULT).latched == 1 << F.PROGRAM_LATE
    assert rig.tick(CLEAR).state == State.DISARMED
    assert rig.tick(ARM).progress.stage == Stage.STOPPED
    rig = begun([WAIT, never._replace(otherwise=4), WAIT._replace(time_s=9.0), WAIT])
    assert {t.progress.step for t in to_the_end(rig)} == {1, 2, 4}


def test_a_way_out_of_the_travel_is_a_fault_of_its_record() -> None:
    rig = begun([WAIT, MOVE._replace(target_m=2.0)])
    last = list(to_the_end(rig))[-1]
    assert (last.progress.step, fault_names(last.present)) == (2, ["program"])
    assert rig.until(State.FAULT).latched == 1 << F.PROGRAM


def test_records_shared_with_others_wait_for_them() -> None:
    rig = begun([WAIT, Step(program.PASS), WAIT], shared=1.0)
    for record in (1, 2, 3):
        assert next(t for t in to_the_end(rig) if t.progress.stage == Stage.DONE).progress.step == record
        assert {t.progress.stage for t in rig.ticks(30)} == {Stage.DONE}
        assert rig.tick(GO_ON, 9.0).answer == Answer.MALFORMED
        assert rig.tick(GO_ON).answer == Answer.TAKEN
    assert rig.tick().progress.stage == Stage.ENDED
    assert rig.tick(GO_ON).answer == Answer.WRONG_STATE


def test_what_is_no_program_is_refused_and_nothing_moves() -> None:
    rig = holding()
    x = here()
    beyond = EXACT._replace(target_m=5.0)
    quick_one = EXACT._replace(target_m=x, speed_m_s=50.0)
    heavy = EXACT._replace(target_m=x, mass_kg=1e5)
    assert rig.tick(RUN, 1.0, 1.0, 0.0).answer == Answer.NO_PROFILE
    for step, answer in (
        (beyond, Answer.OUT_OF_TRAVEL),
        (quick_one, Answer.BEYOND_LIMITS),
        (heavy, Answer.BEYOND_LIMITS),
        (WAIT._replace(kind=0), Answer.MALFORMED),
    ):
        assert rig.tick(RECORD, *map(float, step)).answer == answer
    load(rig, [WAIT])
    for values in ((0.0, 0.0, 0.0), (2.0, 1.0, 0.0), (1.0, -1.0, 0.0), (1.0, 1.0, 2.0), (1.0,)):
        assert rig.tick(RUN, *values).answer in (Answer.NO_PROFILE, Answer.MALFORMED)
    assert rig.tick(RUN, 1.0, 0.0, 0.0).answer == Answer.TAKEN
    assert rig.tick(RUN, 1.0, 0.0, 0.0).answer == Answer.WRONG_STATE
    assert rig.tick(RECORD).answer == Answer.WRONG_STATE
    assert rig.tick().progress.stage != Stage.STOPPED
    idle = ready()
    load(idle, [WAIT])
    assert idle.tick(RUN, 1.0, 1.0, 0.0).answer == Answer.WRONG_STATE
    assert {t.state for t in rig.ticks(5)} == {State.HOLDING}


def test_a_program_has_a_most_of_records() -> None:
    rig = holding()
    load(rig, [WAIT] * program.MOST_STEPS)
    assert rig.tick(RECORD, *map(float, WAIT)).answer == Answer.MALFORMED


TWELVE = (
    EXACT._replace(target_m=0.50),
    EXACT._replace(target_m=0.49, speed_m_s=0.15),
    WAIT,
    MOVE._replace(target_m=0.01, ends=program.FAST, tolerance_m=2e-3, mass_kg=3.0),
    EXACT._replace(target_m=0.53, ends=program.AT_ONCE, timeout_s=0.0, mass_kg=3.0),
    Step(program.UNTIL, what=program.POSITION, low=0.515, high=1e9, timeout_s=5.0, mass_kg=3.0),
    FAST._replace(target_m=0.53, mass_kg=3.0),
    EXACT._replace(target_m=0.54, speed_m_s=0.15, mass_kg=3.0),
    WAIT._replace(mass_kg=3.0),
    MOVE._replace(target_m=-0.01, ends=program.FAST, tolerance_m=2e-3),
    FAST._replace(target_m=0.51),
    WAIT,
)


@pytest.mark.parametrize("record", range(1, 13))
def test_a_fault_in_any_record_centres_is_named_and_the_program_goes_on_there(record: int) -> None:
    rig = begun(TWELVE)
    assert next(
        t for t in to_the_end(rig) if t.progress.step == record and t.progress.stage == Stage.UNDER_WAY
    )
    rig.host = int(Host.LINK_DOWN)
    struck = rig.tick()
    rig.host = 0
    assert (struck.state, struck.command.voltage_v, struck.command.enable) == (State.FAULT, 0.0, 0)
    assert fault_names(struck.latched) == ["link_down"]
    assert (struck.progress.stage, struck.progress.step) == (Stage.STOPPED, record)
    while rig.tick(CLEAR).answer != Answer.TAKEN:
        assert rig.count < 20_000
    while rig.tick(ARM).answer != Answer.TAKEN:
        assert rig.count < 20_000
    assert rig.tick(RUN, 0.0, 0.0, 0.0).answer == Answer.TAKEN
    ticks = list(to_the_end(rig))
    assert ticks[-1].progress.stage == Stage.ENDED
    gone = list(dict.fromkeys(t.progress.step for t in ticks))
    led = {3: [2], 6: [5], 9: [8], 12: [11]}.get(record, [])  # where it waited is gone to again
    assert gone == [*led, *range(record, 13)]


def test_compiled_and_not_it_comes_out_the_same_to_the_bit() -> None:
    a, b = (begun(TWELVE[:4], quickly=quickly) for quickly in (True, False))
    assert [repr(t) for t in to_the_end(a)] == [repr(t) for t in to_the_end(b)]
    assert a.axis.freeze() == b.axis.freeze()
