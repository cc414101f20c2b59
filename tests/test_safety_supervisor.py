"""The state machine, explored to the end: every state, request, fault and pair of faults."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import combinations

import pytest

from pneud.safety.fault_row import Reaction
from pneud.safety.faults import BLOCKS_ARM, CENTRES, NO_SENSORS, STOPS, TABLE, F, mask
from pneud.safety.supervisor import INITIAL, START_TICKS, Supervisor, advance, is_engaged, trip
from pneud.signals import ENGAGED, RequestKind, State

REQUESTS = (0, *RequestKind)
SINGLES = [1 << fault for fault in F]
PAIRS = [a | b for a, b in combinations(SINGLES, 2)]
# one row of each kind that the supervisor tells apart
KINDS = [
    1 << fault
    for fault in (
        F.ENCODER_MISSING, F.TRAVEL, F.EMERGENCY, F.MOVING, F.ENCODER_UNREFERENCED, F.CLOCK_STEP, F.SATURATED,
    )
]  # fmt: skip
ARM, DISARM, CLEAR, SHUTDOWN = (
    RequestKind.ARM,
    RequestKind.DISARM,
    RequestKind.CLEAR,
    RequestKind.SHUTDOWN,
)
STOP, HOLD, GOTO, JOG = RequestKind.STOP, RequestKind.HOLD, RequestKind.GOTO, RequestKind.JOG
TRACK, HOME, PROBE = RequestKind.TRACK, RequestKind.HOME, RequestKind.PROBE
STEERED = {
    HOLD: State.MOVING,
    GOTO: State.MOVING,
    JOG: State.MOVING,
    TRACK: State.TRACKING,
    HOME: State.HOMING,
    RequestKind.FORCE: State.PRESSING,
}
Step = tuple[Supervisor, int, int, bool, Supervisor]


def essence(s: Supervisor) -> Supervisor:
    """What of a state decides on its successors: not which faults are latched, nor time after the start."""
    ticks = s.ticks if s.state == State.STARTING else 0
    return s._replace(latched=int(bool(s.latched)), ticks=ticks)


def explore(pairs: list[int]) -> list[Step]:
    """Every step from every state that can be reached, and from all that are engaged."""
    todo = [INITIAL, *(Supervisor(int(state), 0, 0, False) for state in ENGAGED)]
    seen = {essence(s) for s in todo}
    steps = []
    while todo:
        s = todo.pop()
        # nothing is looked at while starting
        for present in [0, *SINGLES, *(pairs if s.state != State.STARTING else ())]:
            for request in REQUESTS:
                for at_rest in (False, True):
                    after = advance(s, present, request, at_rest)
                    steps.append((s, present, request, at_rest, after))
                    if essence(after) not in seen:
                        seen.add(essence(after))
                        todo.append(after)
    return steps


@pytest.fixture(
    scope="module",
    params=[
        pytest.param([a | b for a, b in combinations(KINDS, 2)], id="kinds"),
        pytest.param(PAIRS, id="all", marks=pytest.mark.slow),
    ],
)
def explored(request: pytest.FixtureRequest) -> list[Step]:
    """Each fault alone, and pairs: of all kinds of faults, or of all faults."""
    return explore(request.param)


@pytest.fixture
def steps(explored: list[Step]) -> list[Step]:
    """All steps; a machine without a memory of its own does the same step again."""
    s, present, request, at_rest, after = explored[-1]
    assert advance(s, present, request, at_rest) == after
    return explored


@pytest.fixture
def ways(steps: list[Step]) -> set[tuple[Supervisor, int, Supervisor]]:
    """What leads from where to where."""
    return {(essence(s), request, essence(after)) for s, _, request, _, after in steps}


def reached(
    ways: set[tuple[Supervisor, int, Supervisor]], start: Iterable[Supervisor], without: tuple[int, ...]
) -> set[int]:
    """States that are come to from some others by whatever happens, certain requests apart."""
    seen = set(start)
    while new := {b for a, request, b in ways if a in seen and b not in seen and request not in without}:
        seen |= new
    return {s.state for s in seen}


def test_all_states_of_the_supervisor_are_reached(steps: list[Step]) -> None:
    assert {after.state for *_, after in steps} == set(State)
    assert len(steps) > 10_000


def test_only_four_requests_engage_and_only_from_disarmed_without_faults(steps: list[Step]) -> None:
    engaging = [step for step in steps if is_engaged(step[4].state) and not is_engaged(step[0].state)]
    ends_in = {ARM: State.HOLDING, TRACK: State.TRACKING, HOME: State.HOMING, PROBE: State.PROBING}
    assert {request for _, _, request, _, _ in engaging} == set(ends_in)
    for s, present, request, _, after in engaging:
        assert (s.state, after.state) == (State.DISARMED, ends_in[RequestKind(request)])
        # who has to home has no reference yet, and who is being tested is not proven
        allowed = 1 << F.ENCODER_UNREFERENCED if request == HOME else 0
        allowed |= 1 << F.UNPROVEN if request in (HOME, PROBE) else 0
        assert not present & BLOCKS_ARM & ~allowed
        assert not s.closing


def test_fault_is_left_by_clear_alone_and_for_disarmed(steps: list[Step]) -> None:
    left = [step for step in steps if step[0].state == State.FAULT != step[4].state]
    assert left
    for _, present, request, _, after in left:
        assert request == CLEAR
        assert not present & (CENTRES | STOPS)
        assert after._replace(closing=False) == Supervisor(State.DISARMED, 0, 0, False)


def test_no_way_leads_from_a_fault_to_motion_but_by_clear_and_then_by_arming(
    ways: set[tuple[Supervisor, int, Supervisor]],
) -> None:
    faults = {after for _, _, after in ways if after.state == State.FAULT}
    assert faults
    assert reached(ways, faults, (CLEAR,)) == {State.FAULT}
    assert reached(ways, faults, (ARM, TRACK, HOME, PROBE)) == {State.FAULT, State.DISARMED, State.WAITING}
    assert reached(ways, faults, ()) >= set(ENGAGED)


def test_nothing_engages_before_it_is_armed(ways: set[tuple[Supervisor, int, Supervisor]]) -> None:
    centred = {State.STARTING, State.WAITING, State.DISARMED}
    assert reached(ways, [INITIAL], (ARM, TRACK, HOME, PROBE)) == centred
    assert reached(ways, [INITIAL], ()) == set(State)


def test_clear_leaves_fault_as_soon_as_the_cause_is_gone(steps: list[Step]) -> None:
    for s, present, request, _, after in steps:
        if s.state == State.FAULT and request == CLEAR and not present & (CENTRES | STOPS):
            assert after.state == State.DISARMED


def test_a_centring_fault_takes_one_cycle_from_every_engaged_state(steps: list[Step]) -> None:
    met = set()
    for s, present, _, _, after in steps:
        if is_engaged(s.state) and present & CENTRES:
            met.add(s.state)
            assert after.state == State.FAULT
            assert after.latched == s.latched | present & (CENTRES | STOPS)
    assert met == set(ENGAGED)


def test_latched_faults_stay_until_fault_is_left(steps: list[Step]) -> None:
    for s, *_, after in steps:
        if not (s.state == State.FAULT != after.state):
            assert after.latched & s.latched == s.latched


def test_nothing_is_latched_but_in_fault_and_on_the_way_to_it(steps: list[Step]) -> None:
    for *_, after in steps:
        assert after.latched == 0 or after.state in (State.FAULT, State.STOPPING)
        assert after.state != State.FAULT or after.latched


def test_a_fault_found_before_a_stop_ends_in_fault(steps: list[Step]) -> None:
    for s, present, request, at_rest, after in steps:
        if s.state == State.STOPPING and not present & CENTRES:
            latched = s.latched | present & STOPS
            centred = s.centring or request in (DISARM, SHUTDOWN)
            ended = State.FAULT if latched else State.DISARMED if centred else State.HOLDING
            if request == RequestKind.CENTRE:
                ended = State.FAULT if latched else State.DISARMED
            over = at_rest or request == RequestKind.CENTRE
            assert (after.state, after.latched) == (ended if over else State.STOPPING, latched)


def test_a_stop_fault_and_the_requests_to_end_stop_under_control(steps: list[Step]) -> None:
    for s, present, request, at_rest, after in steps:
        if is_engaged(s.state) and s.state != State.STOPPING and not present & CENTRES:
            leaves = bool(present & STOPS) or request in (DISARM, SHUTDOWN)
            slow = s.state in (State.HOMING, State.PROBING)
            if request == RequestKind.CENTRE or (slow and (leaves or request == STOP)):
                assert after.state == (State.FAULT if after.latched else State.DISARMED)
            elif leaves or request == STOP:
                assert after.state == State.STOPPING
                assert after.centring == leaves
            elif s.state == State.PROBING:
                assert after.state == (State.DISARMED if at_rest else State.PROBING)
            elif s.state != State.HOMING and request in STEERED:
                assert after.state == STEERED[RequestKind(request)]
            else:
                assert after.state == (State.HOLDING if at_rest else s.state)


def test_once_a_stop_is_to_end_centred_it_does(steps: list[Step]) -> None:
    for s, *_, after in steps:
        if s.state == after.state == State.STOPPING:
            assert after.centring >= s.centring
        assert not after.centring or after.state == State.STOPPING


def test_shutdown_is_for_good(steps: list[Step]) -> None:
    for s, _, request, _, after in steps:
        assert after.closing == (s.closing or request == SHUTDOWN)
        assert not (after.closing and is_engaged(after.state) and not is_engaged(s.state))


def test_lost_sensors_lead_back_to_waiting_only_where_nothing_is_latched(steps: list[Step]) -> None:
    for s, present, _, _, after in steps:
        if s.state in (State.WAITING, State.DISARMED):
            assert (after.state == State.WAITING) == bool(present & NO_SENSORS)


def test_warnings_change_nothing(steps: list[Step]) -> None:
    warnings = mask(Reaction.WARN, Reaction.LIMIT)
    for s, present, request, at_rest, after in steps[::7]:
        assert advance(s, present | warnings, request, at_rest) == after


def test_what_only_keeps_from_arming_changes_nothing_else(steps: list[Step]) -> None:
    hindrances = mask(Reaction.NO_ARM)
    for s, present, request, at_rest, after in steps[::7]:
        if request not in (ARM, TRACK, HOME, PROBE):
            assert advance(s, present | hindrances, request, at_rest) == after


def test_requests_that_are_not_known_change_nothing(steps: list[Step]) -> None:
    for s, present, request, at_rest, after in steps[::7]:
        if request == 0:
            assert advance(s, present, 99, at_rest) == after


def test_ticks_count_from_the_entry_into_a_state(steps: list[Step]) -> None:
    for s, *_, after in steps:
        assert after.ticks == (s.ticks + 1 if after.state == s.state else 0)


@pytest.mark.parametrize("present", [0, *SINGLES])
def test_starting_lasts_its_ticks_whatever_is_asked(present: int) -> None:
    s, states = INITIAL, []
    for i in range(START_TICKS + 1):
        s = advance(s, present, REQUESTS[i % len(REQUESTS)], True)
        states.append(s.state)
    assert states == [State.STARTING] * START_TICKS + [State.WAITING]


@pytest.mark.parametrize("state", list(State))
def test_a_fault_found_behind_the_supervisor_is_latched_in_every_state(state: State) -> None:
    s = trip(Supervisor(state, 1 << F.TRAVEL, 5, False), 1 << F.INTERNAL)
    assert s == Supervisor(State.FAULT, 1 << F.TRAVEL | 1 << F.INTERNAL, 0, False)
    assert trip(s, 1, SHUTDOWN).closing
    assert not trip(s, 1, ARM).closing
    assert trip(s._replace(closing=True), 1).closing


def test_the_engaged_states_are_those_of_the_signals() -> None:
    assert tuple(state for state in State if is_engaged(state)) == ENGAGED


def test_every_row_that_holds_the_axis_also_keeps_it_from_arming() -> None:
    for fault in TABLE:
        assert bool(BLOCKS_ARM >> fault.bit & 1) == (fault.reaction not in (Reaction.WARN, Reaction.LIMIT))
