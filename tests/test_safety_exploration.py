"""The axis in every state, met by every fault, every two faults and every request.

Bits of the fault table are given to the axis as if its checks had found them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from itertools import combinations

import pytest

from axis_rig import ARM, Rig, ready, tracking, twin
from pneud.axis.cycle import Axis, AxisState
from pneud.control.tunables import tunables
from pneud.safety import checks
from pneud.safety.faults import BLOCKS_ARM, CENTRES, STOPS, F
from pneud.safety.supervisor import Supervisor, is_engaged
from pneud.signals import ENGAGED, Host, Measurement, Request, RequestKind, State, Tick

SINGLES = [1 << fault for fault in F]
PAIRS = [a | b for a, b in combinations(SINGLES, 2)]
PROBE = Request(RequestKind.PROBE, (1.0, 0.2, 2e-3, 0.05, 150.0, 100.0))
FORCE = Request(RequestKind.FORCE, (150.0, 0.0, 0.0, 0.0, 0.0, 0.0))
REQUESTS = (
    None,
    Request(RequestKind.ARM),
    Request(RequestKind.ARM, (1.0,)),
    Request(RequestKind.DISARM),
    Request(RequestKind.CLEAR),
    Request(RequestKind.SHUTDOWN),
    Request(RequestKind.MARK),
    Request(RequestKind.STOP),
    Request(RequestKind.HOLD),
    Request(RequestKind.HOME),
    Request(RequestKind.GOTO, (0.6, 0.0, 0.0, 0.0)),
    Request(RequestKind.JOG, (0.05, 20.0)),
    Request(RequestKind.TRACK, (0.0,)),
    Request(RequestKind.PIECE),
    PROBE,
    FORCE,
    Request(RequestKind.GAINS, (1e9,) * 9),
    Request(RequestKind.GAINS, (*tunables(ready().axis.state.law), 0.4, 0.03, 3.0)),
    Request(99, (1.0, 2.0)),
)
ENGAGING = (RequestKind.ARM, RequestKind.HOME, RequestKind.PROBE)


def holding() -> Rig:
    rig = ready()
    assert rig.tick(ARM).state == State.HOLDING
    rig.ticks(20)
    return rig


def after(rig: Rig, kind: int, *values: float) -> Rig:
    rig.tick(kind, *values)
    rig.ticks(3)
    return rig


def homing() -> Rig:
    """As if it were looking for its reference, which it need not have."""
    rig = holding()
    state = rig.axis.state
    rig.axis.thaw(state._replace(supervisor=state.supervisor._replace(state=int(State.HOMING))))
    return rig


def waiting() -> Rig:
    rig = ready()
    rig.frame = lambda _: None
    rig.until(State.WAITING)
    rig.frame = lambda frame: frame
    return rig


def faulty() -> Rig:
    rig = tracking()
    rig.host = int(Host.LINK_DOWN)
    assert rig.tick().state == State.FAULT
    rig.host = 0
    rig.ticks(20)
    return rig


# an axis in each state, in both kinds of stop, and shutting down
SITUATIONS: dict[str, Callable[[], Rig]] = {
    "starting": Rig,
    "waiting": waiting,
    "disarmed": ready,
    "tracking": tracking,
    "moving": lambda: after(holding(), RequestKind.GOTO, 0.6, 0.0, 0.0, 0.0),
    "jogging": lambda: after(holding(), RequestKind.JOG, 0.05, 100.0),
    "holding": holding,
    "homing": homing,
    "stopping, then holding": lambda: after(tracking(), RequestKind.STOP),
    "stopping, then centred": lambda: after(tracking(), RequestKind.DISARM),
    "shutting down": lambda: after(tracking(), RequestKind.SHUTDOWN),
    "probing": lambda: after(ready(), PROBE.kind, *PROBE.values),
    "pressing": lambda: after(holding(), FORCE.kind, *FORCE.values),
    "fault": faulty,
}


@cache
def situation(name: str) -> Rig:
    return SITUATIONS[name]()


def next_measurement(rig: Rig) -> Measurement:
    """What the axis would be given in its next tick."""
    caught: list[Measurement] = []
    copy = twin(rig)
    copy.measurement = lambda m: caught.append(m) or m  # type: ignore[func-returns-value]
    copy.tick()
    return caught[0]


def test_all_states_are_among_the_situations() -> None:
    found = {State(situation(name).axis.state.supervisor.state) for name in SITUATIONS}
    assert found == set(State)


def steps(
    name: str, presents: list[int], patch: pytest.MonkeyPatch
) -> Iterator[tuple[AxisState, int, Request | None, Tick, Axis]]:
    """One tick for each of the faults, with each of the requests."""
    rig = situation(name)
    m, frozen, axis = next_measurement(rig), rig.axis.freeze(), Axis(rig.axis.parameters)
    for present in presents:
        patch.setattr(checks, "of_host", lambda _, bits=present: bits)
        for request in REQUESTS:
            axis.thaw(frozen)
            yield frozen, present, request, axis.cycle(m, request, m.t_ns), axis
    assert axis.failure is None


@pytest.mark.parametrize("name", SITUATIONS)
@pytest.mark.parametrize(
    "presents", [pytest.param([0, *SINGLES], id="one"), pytest.param(PAIRS, id="two", marks=pytest.mark.slow)]
)
def test_whatever_happens_the_axis_does_only_what_it_may(
    name: str, presents: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    p = situation(name).axis.parameters
    reached = set()
    for frozen, present, request, tick, axis in steps(name, presents, monkeypatch):
        before: Supervisor = frozen.supervisor
        reached.add(tick.state)
        where = (name, present, request, tick.state)
        assert tick.present & present == present, where
        # nothing but 0 V and Enable 0 leaves where the axis is not engaged
        if not is_engaged(tick.state):
            assert (tick.command.voltage_v, tick.command.enable) == (0.0, 0), where
        # what centres does so in the same tick, past the slew limit
        if present & CENTRES and is_engaged(before.state):
            assert tick.state == State.FAULT, where
            assert tick.latched & present & CENTRES, where
        # what stops leads to rest, never to another motion
        if present & STOPS and is_engaged(before.state):
            assert tick.state in (State.STOPPING, State.FAULT), where
        # only an operator engages, only a disarmed axis, only without anything that forbids it
        if is_engaged(tick.state) and not is_engaged(before.state):
            assert request is not None, where
            assert request.kind in ENGAGING, where
            assert before.state == State.DISARMED, where
            allowed = 1 << F.ENCODER_UNREFERENCED if request.kind == RequestKind.HOME else 0
            allowed |= 1 << F.UNPROVEN if request.kind in (RequestKind.HOME, RequestKind.PROBE) else 0
            assert not tick.present & BLOCKS_ARM & ~allowed, where
        # only an operator leaves a fault, and only when it is over
        if before.state == State.FAULT and tick.state != State.FAULT:
            assert request is not None, where
            assert request.kind == RequestKind.CLEAR, where
            assert not present & (CENTRES | STOPS), where
            assert tick.state == State.DISARMED, where
        # no request widens a limit
        assert axis.parameters.limits is p.limits, where
        assert axis.parameters.output is p.output, where
    assert State.FAULT in reached or not is_engaged(before.state)


@pytest.mark.parametrize("state", ENGAGED)
def test_an_exception_in_any_engaged_state_centres_first_and_is_told_second(
    state: State, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(_: int) -> int:
        raise ZeroDivisionError

    rig = next(r for r in map(situation, SITUATIONS) if r.axis.state.supervisor.state == state)
    axis, m = Axis(rig.axis.parameters), next_measurement(rig)
    axis.thaw(rig.axis.freeze())
    monkeypatch.setattr(checks, "of_host", broken)
    tick = axis.cycle(m, None, m.t_ns)
    assert (tick.state, tick.command.voltage_v, tick.command.enable) == (State.FAULT, 0.0, 0)
    assert tick.latched == 1 << F.INTERNAL
    assert isinstance(axis.failure, ZeroDivisionError)
