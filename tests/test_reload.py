"""The configured reference changed while the axis runs: no bump, no limit passed, a replay that agrees."""

from __future__ import annotations

import math
from functools import cache
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from axis_rig import ARM, PERIOD_NS, Rig, assert_smooth, loaded, ready, twin
from pneud.axis.cycle import Axis, AxisState
from pneud.axis.requests import NOTHING, Asked, ask
from pneud.config.conversions import axis_of
from pneud.config.reading import with_settings
from pneud.control.force import NO_PRESS
from pneud.control.model import Model
from pneud.control.plan import FOLLOWING, GOING, IDLE, JOINING, RESTING, Plan, follow
from pneud.control.probe import NO_PROBE
from pneud.control.reference import ROOM, Sine, Way, along, at, septic, sine, stays, transfer
from pneud.control.tunables import TUNABLE, tunables
from pneud.log.files.naming import create_log
from pneud.log.files.reader import LoggedState, read_log
from pneud.log.files.writer import LogWriter
from pneud.log.format.header import LogHeader, Rotation
from pneud.log.format.snapshot import from_json, to_json
from pneud.replay import replaying
from pneud.replay.lockstep import Simulation
from pneud.safety.faults import FAULT_NAMES, F
from pneud.safety.supervisor import Supervisor
from pneud.signals import (
    REQUEST_VALUES,
    Answer,
    Estimate,
    Host,
    Reference,
    Request,
    RequestKind,
    State,
    Tick,
)

GAINS, GOTO, TRACK, PIECE = RequestKind.GAINS, RequestKind.GOTO, RequestKind.TRACK, RequestKind.PIECE
DISARM, STOP = RequestKind.DISARM, RequestKind.STOP
H = PERIOD_NS * 1e-9
P = axis_of(loaded().config, loaded().codecs.command_lsb_v)
NOW = tunables(P.controller)
OTHER = Sine(0.45, 0.03, 2.0 * math.pi)
LOW_M, HIGH_M = P.limits.travel_min_m, P.limits.travel_max_m
NOWHERE = Estimate(*(math.nan,) * 8)
AT_NS = 7_000_000_000


def following() -> Rig:
    """Tracking the configured reference, the join behind it."""
    return twin(_following())


def joining() -> Rig:
    """Half-way to it."""
    return twin(_joining())


@cache
def _joining() -> Rig:
    rig = ready()
    rig.tick(ARM, 1.0)
    rig.ticks(300)
    assert rig.axis.state.phase == JOINING
    return rig


@cache
def _following() -> Rig:
    rig = joining()
    while rig.axis.state.phase != FOLLOWING:
        rig.tick()
    rig.ticks(250)
    return rig


def test_all_that_is_tuned_fits_into_a_request() -> None:
    assert len(TUNABLE) + len(Sine._fields) + len(Model._fields) == REQUEST_VALUES


def asked(wanted: Sine, plan: Plan, now: Reference, gains: tuple[float, ...] = NOW) -> Asked:
    s = Supervisor(int(State.TRACKING), 0, 1000, False)
    request = Request(GAINS, (*gains, *wanted))
    return ask(request, s, 0, plan, (), now, NOWHERE, AT_NS, P.controller, P.reference, NO_PROBE, NO_PRESS, P)


sines = st.builds(
    Sine,
    st.floats(LOW_M + 0.01, HIGH_M - 0.01),
    st.floats(0.0, 0.3),
    st.floats(0.0, 2.0 * math.pi * 3.0),
).filter(
    lambda p: (
        p.centre_m - p.amplitude_m >= LOW_M
        and p.centre_m + p.amplitude_m <= HIGH_M
        and p.amplitude_m * p.omega_rad_s <= P.limits.speed_m_s
    )
)


def assert_meets(before: Reference, after: Reference, scale: float = 1.0) -> None:
    """Equal to the rounding of polynomials; that of a derivative grows with its order."""
    x, v, a, j = (abs(p - q) for p, q in zip(before, after, strict=True))
    _, speed, acceleration, jerk = map(abs, before)
    assert x <= 1e-9 * scale
    assert v <= 1e-8 * scale * (1.0 + speed)
    assert a <= 1e-6 * scale * (1.0 + acceleration)
    assert j <= 1e-4 * scale * (1.0 + jerk)


def assert_bumpless(path: Way, start: Reference, end: Reference) -> None:
    """From one motion to the other without a step up to the jerk, and within the bounds of a transfer."""
    assert_meets(start, along(0.0, path))
    assert_meets(end, along(path.T, path))
    for p, q in pairwise(path.pieces):
        assert_meets(at(p.T, p), at(0.0, q))
    bounds = P.transfer
    acceleration = max(bounds.acceleration_m_s2, *(ROOM * abs(r.acceleration_m_s2) for r in (start, end)))
    jerk = max(bounds.jerk_m_s3, *(ROOM * abs(r.jerk_m_s3) for r in (start, end)))
    for i in range(301):
        r = along(path.T * i / 300, path)
        assert abs(r.acceleration_m_s2) <= 1.001 * acceleration
        assert abs(r.jerk_m_s3) <= 1.001 * jerk


@given(old=sines, new=sines, t_ns=st.integers(0, 10**10))
@example(
    old=Sine(0.030000000000000002, 2.2250738585072014e-308, 4.656612873077393e-10),
    new=Sine(0.03, 0.0, 0.0),
    t_ns=0,
)
@settings(deadline=None)
def test_from_anywhere_on_a_reference_it_goes_over_without_a_bump_or_stays(
    old: Sine, new: Sine, t_ns: int
) -> None:
    plan = Plan(FOLLOWING, AT_NS - t_ns, IDLE.path)
    plan, now, _ = follow(plan, AT_NS, old, ())
    found = asked(new, plan, now)
    if found.answer != Answer.TAKEN:
        assert found == NOTHING._replace(answer=int(Answer.OUT_OF_TRAVEL))
        assert not stays(transfer(now, sine(0.0, new), P.transfer), LOW_M, HIGH_M)
        return
    assert found.plan is not None
    assert (found.plan.phase, found.plan.since_ns, found.reference) == (JOINING, AT_NS, new)
    assert stays(found.plan.path, LOW_M, HIGH_M)
    assert_bumpless(found.plan.path, now, sine(0.0, new))
    # the plan goes on with the reference where the way ends
    end_ns = AT_NS + round(found.plan.path.T * 1e9)
    last, there, _ = follow(found.plan, end_ns, new, ())
    assert (last.phase, last.since_ns) == (FOLLOWING, end_ns)
    assert there == sine(0.0, new)


@given(first=sines, second=sines, start=st.floats(0.1, 0.9), share=st.floats(0.0, 0.999))
@settings(deadline=None)
def test_from_a_way_that_joins_one_reference_it_goes_over_to_another(
    first: Sine, second: Sine, start: float, share: float
) -> None:
    path = transfer(Reference(start, 0.0, 0.0, 0.0), sine(0.0, first), P.transfer)
    assume(stays(path, LOW_M, HIGH_M))
    plan = Plan(JOINING, AT_NS - round(share * path.T * 1e9), path)
    _, now, _ = follow(plan, AT_NS, first, ())
    found = asked(second, plan, now)
    assert found.answer in (Answer.TAKEN, Answer.OUT_OF_TRAVEL)
    if found.plan is not None:
        assert_bumpless(found.plan.path, now, sine(0.0, second))


@pytest.mark.parametrize("phase", [IDLE.phase, RESTING, GOING])
@pytest.mark.parametrize("uploaded", [False, True])
def test_what_does_not_follow_it_goes_on_as_it_is(phase: int, uploaded: bool) -> None:
    plan = IDLE._replace(phase=JOINING if uploaded else phase, uploaded=uploaded)
    found = asked(OTHER, plan, Reference(0.3, 0.1, 0.0, 0.0))
    assert (found.answer, found.plan, found.reference) == (Answer.TAKEN, None, OTHER)


SPEED = P.limits.speed_m_s


@pytest.mark.parametrize(
    ("wanted", "answer"),
    [
        (OTHER._replace(amplitude_m=-0.01), Answer.MALFORMED),
        (OTHER._replace(omega_rad_s=-0.1), Answer.MALFORMED),
        (OTHER._replace(amplitude_m=0.0, omega_rad_s=2.0 * math.pi * 20.01), Answer.MALFORMED),
        (OTHER._replace(centre_m=math.nan), Answer.MALFORMED),
        (OTHER._replace(centre_m=LOW_M + 0.029), Answer.OUT_OF_TRAVEL),
        (OTHER._replace(centre_m=HIGH_M - 0.029), Answer.OUT_OF_TRAVEL),
        (Sine(0.5, 0.3, 1.001 * SPEED / 0.3), Answer.BEYOND_LIMITS),
        (Sine(0.08, 0.05, 2.0 * math.pi * 2.0), Answer.OUT_OF_TRAVEL),  # there is no room for the run-up
    ],
)
@pytest.mark.parametrize("gains", [NOW, (*NOW[:1], 9e4, *NOW[2:])], ids=["these gains", "other gains"])
def test_a_reference_that_the_axis_cannot_follow_changes_nothing(
    wanted: Sine, answer: Answer, gains: tuple[float, ...]
) -> None:
    rig = following()
    other = twin(rig)
    tick = rig.tick(GAINS, *gains, *wanted)
    assert tick.answer == answer
    assert tick._replace(request=None, answer=0) == other.tick()
    assert rig.axis.state == other.axis.state


@pytest.mark.parametrize(
    ("wanted", "answer"),
    [
        (Sine(0.5, 0.3, SPEED / 0.3), Answer.TAKEN),  # at the very limit
        (Sine(0.5 * (LOW_M + HIGH_M), 0.5 * (HIGH_M - LOW_M) - 1e-9, 0.1), Answer.TAKEN),
        (Sine(0.5, 0.0, 2.0 * math.pi * 20.0), Answer.TAKEN),
        (Sine(0.5, 0.3, 1.001 * SPEED / 0.3), Answer.BEYOND_LIMITS),
    ],
)
def test_a_disarmed_axis_judges_by_the_same_limits(wanted: Sine, answer: Answer) -> None:
    rig = ready()
    assert rig.tick(GAINS, *NOW, *wanted).answer == answer
    assert rig.axis.state.reference == (wanted if answer == Answer.TAKEN else None)


def test_gains_that_are_refused_take_the_reference_along() -> None:
    rig = following()
    before = rig.axis.state
    assert rig.tick(GAINS, NOW[0], 1e9, *NOW[2:], *OTHER).answer == Answer.UNSTABLE
    assert (rig.axis.state.reference, rig.axis.state.law, rig.axis.state.plan) == (
        None,
        before.law,
        before.plan,
    )
    assert rig.tick(GAINS, *NOW[:1], -1.0, *NOW[2:], *OTHER).answer == Answer.MALFORMED
    assert rig.tick(GAINS, *NOW, *OTHER[:2]).answer == Answer.MALFORMED
    assert rig.axis.state.reference is None


@pytest.mark.parametrize("begin", [joining, following], ids=["joining", "following"])
def test_while_tracking_neither_reference_nor_command_steps(begin: object) -> None:
    rig: Rig = begin()  # type: ignore[operator]
    undisturbed = twin(rig)
    before = rig.ticks(100)
    usual = max(abs(b.command.voltage_v - a.command.voltage_v) for a, b in pairwise(before))
    assert undisturbed.ticks(100) == before
    change = rig.tick(GAINS, *NOW, *OTHER)
    assert change.answer == Answer.TAKEN
    assert change._replace(request=None, answer=0) == undisturbed.tick()
    ticks = [before[-1], change]
    while rig.axis.state.phase == JOINING:
        ticks.append(rig.tick())
        assert len(ticks) < 2000
    ticks += rig.ticks(300)
    assert {t.state for t in ticks} == {State.TRACKING}
    assert not any(t.latched for t in ticks)
    assert_smooth(ticks, P.transfer, room=ROOM)
    steps = [abs(b.command.voltage_v - a.command.voltage_v) for a, b in pairwise(ticks)]
    assert max(steps[:5]) <= 2.0 * usual
    assert max(abs(t.reference.position_m - t.estimate.position_m) for t in ticks) <= 3e-3
    state = rig.axis.state
    assert state.reference == OTHER
    assert ticks[-1].reference == sine((state.sampled_ns - state.phase_ns) * 1e-9, OTHER)


def test_gains_and_reference_change_in_one_tick() -> None:
    rig = following()
    wanted = (*NOW[:1], 9e4, *NOW[2:])
    undisturbed = twin(rig).tick()
    change = rig.tick(GAINS, *wanted, *OTHER)
    assert (change.answer, change.reference) == (Answer.TAKEN, undisturbed.reference)
    assert change.command.law_v == pytest.approx(undisturbed.command.law_v, abs=1e-9)
    assert tunables(rig.axis.state.law) == wanted
    assert rig.axis.state.reference == OTHER
    assert {t.state for t in rig.ticks(300)} == {State.TRACKING}


def test_gains_alone_leave_the_reference_and_its_time_as_they_are() -> None:
    rig = following()
    rig.tick(GAINS, *NOW, *OTHER)
    rig.ticks(50)
    plan = rig.axis.state.plan
    rig.tick(GAINS, *NOW[:1], 9e4, *NOW[2:])
    assert (rig.axis.state.plan, rig.axis.state.reference) == (plan, OTHER)


def test_who_holds_or_goes_elsewhere_tracks_it_when_asked_to() -> None:
    rig = ready()
    rig.tick(ARM)
    rig.ticks(60)
    rig.tick(GOTO, 0.47)
    rig.ticks(20)
    plan = rig.axis.state.plan
    tick = rig.tick(GAINS, *NOW, *OTHER)
    assert (tick.answer, tick.state, rig.axis.state.plan) == (Answer.TAKEN, State.MOVING, plan)
    rig.until(State.HOLDING)
    assert rig.tick(TRACK, 0.0).answer == Answer.TAKEN
    while rig.axis.state.phase == JOINING:
        last = rig.tick()
    state = rig.axis.state
    assert last.reference == sine((state.sampled_ns - state.phase_ns) * 1e-9, OTHER)


def test_who_follows_a_profile_goes_on_with_it() -> None:
    rig = ready()
    rig.tick(ARM)
    rig.ticks(60)
    here = rig.tick().reference
    piece = septic(0.5, here, here._replace(position_m=here.position_m + 0.01))
    assert rig.tick(PIECE, *piece).answer == Answer.TAKEN
    rig.tick(TRACK, 1.0)
    rig.ticks(20)
    undisturbed = twin(rig)
    assert rig.tick(GAINS, *NOW, *OTHER).answer == Answer.TAKEN
    undisturbed.tick()
    assert [t.reference for t in rig.ticks(600)] == [t.reference for t in undisturbed.ticks(600)]
    assert rig.axis.state.supervisor.state == State.HOLDING


def test_a_disarmed_axis_arms_onto_it() -> None:
    rig = ready()
    assert rig.tick(GAINS, *NOW, *OTHER).answer == Answer.TAKEN
    assert rig.tick(ARM, 1.0).state == State.TRACKING
    while rig.axis.state.phase == JOINING:
        last = rig.tick()
    assert last.reference.position_m == pytest.approx(OTHER.centre_m, abs=1e-3)


def test_an_axis_that_joins_at_once_starts_on_it() -> None:
    rig = ready()
    rig.axis.parameters = P._replace(join_at_once=True)
    here = Sine(rig.node.truth().position_m, 0.01, 1.0)
    assert rig.tick(ARM, 1.0).answer == Answer.BLOCKED
    assert rig.tick(GAINS, *NOW, *here).answer == Answer.TAKEN
    tick = rig.tick(ARM, 1.0)
    assert (tick.state, tick.reference) == (State.TRACKING, sine(0.0, here))


def test_one_out_of_the_run_ups_reach_keeps_a_disarmed_axis_from_tracking() -> None:
    rig = ready()
    assert rig.tick(GAINS, *NOW, 0.08, 0.05, 2.0 * math.pi * 2.0).answer == Answer.TAKEN
    tick = rig.tick(ARM, 1.0)
    assert (tick.answer, tick.state) == (Answer.BLOCKED, State.DISARMED)
    assert tick.present & 1 << F.UNREACHABLE


@pytest.mark.parametrize(
    ("host", "state"),
    [(Host.NO_REALTIME, State.TRACKING), (Host.BUS_PASSIVE, State.STOPPING), (Host.LINK_DOWN, State.FAULT)],
)
def test_a_fault_of_the_same_tick_goes_first(host: Host, state: State) -> None:
    rig = following()
    rig.host = int(host)
    tick = rig.tick(GAINS, *NOW, *OTHER)
    assert (tick.answer, tick.state) == (Answer.TAKEN, state)
    assert (rig.axis.state.phase == JOINING) == (state == State.TRACKING)
    assert rig.axis.state.reference == OTHER
    if state == State.STOPPING:
        assert_smooth([tick, *rig.ticks(100)], P.motion, room=4.0)
        assert rig.until(State.FAULT).present & 1 << F.BUS_PASSIVE


def test_who_comes_to_rest_does_so_and_keeps_it() -> None:
    rig = following()
    assert rig.tick(STOP).state == State.STOPPING
    plan = rig.axis.state.plan
    assert rig.tick(GAINS, *NOW, *OTHER).answer == Answer.TAKEN
    assert rig.axis.state.plan == plan
    rig.until(State.HOLDING)
    rig.tick(DISARM)
    rig.until(State.DISARMED)
    assert rig.axis.state.reference == OTHER


def story(rig: Rig) -> list[Tick]:
    """The reference changed while joining, following, moving, and once more to what it was."""
    requests = {
        5: (ARM, (1.0,)),
        200: (GAINS, (*NOW, *OTHER)),
        1200: (GAINS, (*NOW[:1], 9e4, *NOW[2:], *P.reference)),
        1400: (GAINS, (*NOW, *OTHER._replace(centre_m=2.0))),
        1500: (GOTO, (0.5,)),
        1600: (GAINS, (*NOW, *OTHER)),
        1900: (TRACK, (0.0,)),
    }
    asked_for = (requests.get(n, (0, ())) for n in range(2200))
    return [rig.tick(kind, *values) for kind, values in asked_for]


def test_frozen_and_thawed_at_any_time_it_goes_on_alike() -> None:
    rig = ready()
    other = Axis(P)
    other.thaw(rig.axis.freeze())
    for i, t in enumerate(story(rig)):
        if i % 41 == 0:  # another axis takes over, by way of what stands in a log
            frozen = from_json(AxisState, to_json(other.freeze()))
            assert repr(frozen) == repr(other.freeze())
            other = Axis(P)
            other.thaw(frozen)
        assert repr(other.cycle(t.measurement, t.request, t.t_ns)) == repr(t)
    assert other.freeze() == rig.axis.freeze()


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log in parts of a run whose reference changes twice."""
    folder = tmp_path_factory.mktemp("reloaded")
    requests = {
        60: Request(ARM, (1.0,)),
        400: Request(GAINS, (*NOW, *OTHER)),
        900: Request(GAINS, (*NOW, *OTHER._replace(amplitude_m=0.9))),
        1300: Request(GAINS, (*NOW[:1], 9e4, *NOW[2:], 0.46, 0.02, 3.0)),
    }
    run = Simulation(loaded(), 1.6, 2, requests=requests)
    here = loaded()
    header = LogHeader(
        "virtual", "simulated", 1000.0, "full", here.path.name, here.text, here.dbc.name,
        here.dbc.read_bytes(), FAULT_NAMES, 0, {},
    )  # fmt: skip
    path = folder / "x.mcap"
    writer = LogWriter(create_log(path), header, Rotation(path, 60_000, 0, 0, True, 0, 0))
    for n, record in enumerate(run.records(), start=1):
        writer.write(record)
        if n % 150 == 0:
            writer.snapshot({"axis": run.axis.freeze(), "inbox": run.inbox.freeze()})
    writer.close()
    answers = [(t.request.kind, t.answer) for t in read_log(folder) if t.request is not None]
    assert answers[:4] == [
        (ARM, Answer.TAKEN),
        (GAINS, Answer.TAKEN),
        (GAINS, Answer.OUT_OF_TRAVEL),
        (GAINS, Answer.TAKEN),
    ]
    assert len(list(folder.iterdir())) >= 4
    return folder


def test_a_log_with_changes_replays_identically_from_its_start_and_from_anywhere(parts: Path) -> None:
    whole = replaying.replay(read_log(parts))
    assert (whole.identical, whole.truncated) == (True, False), whole.first
    for from_s in (0.2, 0.41, 0.8, 1.25, 1.31, 1.5):
        outcome = replaying.replay(read_log(parts), from_s=from_s)
        assert outcome.identical, outcome.first
        assert outcome.ticks == whole.ticks - round(from_s * 1000)
    for path in sorted(parts.iterdir()):
        assert replaying.replay(read_log(path)).identical


def test_what_if_from_the_middle_takes_the_other_gains_unless_they_were_changed_in_the_run(
    parts: Path,
) -> None:
    log = read_log(parts)
    other = with_settings(log.config_text, "other", [f"control.k3={1.01 * NOW[3]}"])
    for from_s in (0.0, 0.3, 0.8):  # a request for another reference, which has the gains in it, is between
        outcome = replaying.replay(log, other, from_s)
        assert outcome.first is not None
        assert outcome.first.variable.startswith("command.")
        assert outcome.mismatches > 400
        assert outcome.first.tick <= max(from_s * 1000, 70) + 20
    changed = replaying.replay(log, other, 1.45)
    assert changed.identical, changed.first
    heavier = with_settings(log.config_text, "other", ["cylinder.moving_mass_kg=20.0"])
    assert not replaying.replay(log, heavier, 1.45).identical


def test_a_state_without_the_field_is_that_of_an_axis_with_the_configured_reference(parts: Path) -> None:
    (first, *_) = (item.data for item in read_log(parts).items() if isinstance(item, LoggedState))
    without = first.replace(b',"reference":null', b"")
    assert without != first
    # by their words: a load cell that there is not weighs NaN, which equals nothing
    assert repr(from_json(replaying.Snapshot, without)) == repr(from_json(replaying.Snapshot, first))
