"""The safety layer alone, over logs: it blocks nothing that was allowed and allows nothing that was blocked.

Checks, supervisor and output chain get what the log says was measured, estimated, asked and wanted by the
law; no controller runs. Every log in tests/golden is judged, and runs made here.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

from axis_rig import ARM, CLEAR, DISARM, Rig, loaded, ready
from pneud.axis.state import AxisParameters
from pneud.config import conversions
from pneud.config.reading import parse
from pneud.log.files.reader import read_log
from pneud.replay.lockstep import simulate
from pneud.safety import checks
from pneud.safety.faults import F, names
from pneud.safety.output import CENTRED, emit
from pneud.safety.supervisor import INITIAL, Supervisor, advance, is_engaged, trip
from pneud.safety.watch import INITIAL as WATCHFUL
from pneud.signals import Answer, Defect, Host, RequestKind, Source, State, Tick, ValveState
from watching import watch

GOLDEN = sorted((Path(__file__).parent / "golden").glob("**/*.mcap"))
DOUBTS = 1 << F.ENCODER_DOUBTFUL | 1 << F.PRESSURE_DOUBTFUL  # by a share over many readings
PRESSURE_JUMP = 1 << F.PRESSURE_JUMP
# found by what is not run here: the law's request, the controller's state, the cycle's exceptions
ELSEWHERE = 1 << F.UNREACHABLE | 1 << F.INTERNAL | 1 << F.UNSETTLED | 1 << F.OPERATOR_LOST | DOUBTS
ENCODER = int(Source.ENCODER)


class Verdict(NamedTuple):
    """What the safety layer says to one tick."""

    present: int
    supervisor: Supervisor
    voltage_v: float
    enable: int
    saturated: int


def judge(ticks: Iterable[Tick], p: AxisParameters) -> Iterator[tuple[Tick, Verdict]]:
    """Every tick with what checks, supervisor and output chain say to it."""
    limits, h = p.limits, p.controller.h
    s, w = INITIAL, WATCHFUL
    last_v, limited = 0.0, 0
    t_before = sampled_ns = read_ns = 0
    for tick in ticks:
        m, e = tick.measurement, tick.estimate
        engaged = is_engaged(s.state)
        read_before = read_ns
        if m.fresh & ENCODER and not m.encoder_defects & Defect.ODD:
            sampled_ns = read_ns = tick.t_ns + m.encoder_offset_ns
        else:
            sampled_ns += tick.t_ns - t_before
        t_before = tick.t_ns

        present = checks.lacking(m, limits) | checks.measured(m, limits) | checks.of_host(m.host)
        w, found = watch(w, m, e, s.state, engaged, last_v, limited, limits)
        present |= found
        if m.pressure_defects & Defect.CONFIRMED:  # the jump lies a reading back, which is not in the log
            present |= tick.present & PRESSURE_JUMP
        known = math.isfinite(e.position_m) or tick.present >> F.NOT_FINITE & 1
        if known:
            present |= checks.believed(e, (read_ns - read_before) * 1e-9, limits)
            if not engaged:
                present |= checks.unready(e, 1 << 62, h)
        kind = request_of(tick, s, p)
        if engaged:
            present |= checks.engaged(m, e, s.state, s.ticks, h, limits)
            follows = s.state not in (State.HOMING, State.PROBING)  # which have no reference
            if (
                known
                and follows
                and not abs(tick.reference.position_m - e.position_m) <= limits.tracking_error_m
            ):
                present |= 1 << F.TRACKING_ERROR
        else:
            engaging = tick.request is not None and tick.request.kind in (ARM, RequestKind.PROBE)
            arming = engaging and s.state == State.DISARMED
            present |= checks.disengaged(m, s.ticks, arming)
        present |= tick.present & ELSEWHERE
        # whether the reference has come to rest is not for the safety layer to say
        after = next(
            (a for a in (advance(s, present, kind, rest) for rest in (False, True)) if a.state == tick.state),
            advance(s, present, kind, False),
        )
        out = CENTRED
        if is_engaged(after.state) or tick.present & ~present & (1 << F.NOT_FINITE | 1 << F.COMMAND_RANGE):
            out = emit(tick.command.law_v, last_v, (1 + m.skipped) * h, p.output)
            if out.saturated:
                present |= 1 << F.SATURATED
            if out.faults:
                after = trip(after, out.faults)
                present |= out.faults
        if tick.present & 1 << F.INTERNAL:
            after = trip(s, 1 << F.INTERNAL, kind)
        last_v, limited, s = out.voltage_v, out.saturated, after
        yield tick, Verdict(present, after, *out[:3])


def request_of(tick: Tick, s: Supervisor, p: AxisParameters) -> int:
    """What the supervisor was asked."""
    if tick.request is None or tick.answer != Answer.TAKEN:
        return 0
    kind, values = tick.request
    if kind == RequestKind.ARM and values == (1.0,):
        return int(RequestKind.TRACK)
    if kind == RequestKind.STOP and p.stop_centres:
        return int(RequestKind.DISARM)
    if kind in (RequestKind.HOLD, RequestKind.JOG) and s.state == State.HOLDING == tick.state:
        return 0
    return kind


def agrees(ticks: Iterable[Tick], p: AxisParameters, *, lsb: float = 0.0) -> set[State]:
    """The verdicts are those of the log; returns the states that it was in."""
    states = set()
    for n, (tick, verdict) in enumerate(judge(ticks, p)):
        where = f"tick {n}: {State(tick.state).label}, {names(tick.present)}"
        states.add(State(tick.state))
        assert names(verdict.present) == names(tick.present), where
        assert verdict.supervisor.state == tick.state, where
        assert names(verdict.supervisor.latched) == names(tick.latched), where
        assert verdict.enable == tick.command.enable, where
        assert abs(verdict.voltage_v - tick.command.voltage_v) <= lsb, where
    return states


@pytest.mark.parametrize("log", GOLDEN, ids=lambda path: path.stem)
def test_over_a_golden_log(log: Path) -> None:
    reader = read_log(log)
    config = parse(reader.config_text, str(log))
    p = conversions.axis_of(config, loaded().codecs.command_lsb_v)
    # a compact log holds what the law wanted only as a single
    states = agrees((t.record.tick for t in reader), p, lsb=1.01 * p.output.lsb_v)
    assert any(is_engaged(state) for state in states)


def test_over_a_run_to_its_end() -> None:
    p = conversions.axis_of(loaded().config, loaded().codecs.command_lsb_v)
    states = agrees((record.tick for record in simulate("virtual.toml", 0.6)), p)
    assert {State.WAITING, State.DISARMED, State.TRACKING, State.STOPPING} <= states


@cache
def run() -> tuple[Tick, ...]:
    """A run with most of what can happen to an axis."""
    return tuple(_run())


def _run() -> Iterator[Tick]:
    rig = Rig()
    yield from rig.ticks(120)
    yield rig.tick(RequestKind.GOTO, 0.6, 0.0, 0.0, 0.0)
    yield rig.tick(RequestKind.PROBE, 1.0, 0.2, 2e-3, 0.05, 150.0, 500.0)
    yield from rig.ticks(100)
    yield rig.tick(RequestKind.STOP)
    yield from rig.ticks(100)
    yield rig.tick(ARM)
    yield from rig.ticks(30)
    yield rig.tick(RequestKind.FORCE, 40.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    yield from rig.ticks(40)
    yield rig.tick(RequestKind.GOTO, 0.45, 0.0, 0.0, 0.0)
    yield from rig.ticks(100)
    yield rig.tick(RequestKind.JOG, 0.1, 20.0)
    yield from rig.ticks(100)
    yield rig.tick(RequestKind.HOLD)
    yield from rig.ticks(50)
    yield rig.tick(RequestKind.TRACK, 0.0)
    yield from rig.ticks(50)
    yield rig.tick(RequestKind.STOP)
    yield from rig.ticks(300)
    for flag in (Host.LINK_DOWN, Host.EMERGENCY, Host.BUS_OFF, Host.NO_REALTIME):
        rig.host = int(flag)
        yield from rig.ticks(3)
        yield rig.tick(CLEAR)
        yield from rig.ticks(200)
        rig.host = 0
        yield from rig.ticks(60)
        yield rig.tick(ARM)
        yield rig.tick(CLEAR)
        yield from rig.ticks(2)
        yield rig.tick(ARM, 1.0)
        yield from rig.ticks(40)
    for changes in (
        {"p1_pa": 2e6},
        {"position_m": 0.7},
        {"applied_v": 3.0},
        {"encoder_status": 0},
        {"valve_state": int(ValveState.FAULT)},
        {"supply_pa": math.nan},
    ):
        rig.measurement = lambda m, changes=changes: m._replace(**changes)  # type: ignore[misc]
        yield from rig.ticks(60)
        rig.measurement = lambda m: m
        yield from rig.ticks(80)
        yield rig.tick(CLEAR)
        yield from rig.ticks(70)
        yield rig.tick(ARM)
        yield from rig.ticks(20)
    rig.frame = lambda _: None
    yield from rig.ticks(60)
    rig.frame = lambda frame: frame
    yield from rig.ticks(60)
    yield rig.tick(CLEAR)
    yield from rig.ticks(80)
    yield rig.tick(ARM)
    yield rig.tick(skipped=60)
    yield from rig.ticks(10)
    yield rig.tick(CLEAR)
    yield from rig.ticks(60)
    yield rig.tick(ARM)
    yield from rig.ticks(10)
    yield rig.tick(DISARM)
    yield from rig.ticks(100)
    yield rig.tick(RequestKind.SHUTDOWN)
    yield rig.tick(ARM)


def test_over_a_run_with_much_that_goes_wrong() -> None:
    p = ready().axis.parameters
    states = agrees(run(), p)
    assert states >= set(State) - {State.HOMING}


@pytest.mark.parametrize(
    "change", [{"supply_min_pa": 7e5}, {"chamber_max_pa": 3e6}, {"tracking_error_m": 1.0}], ids=str
)
def test_a_safety_layer_that_allows_more_or_less_is_noticed(change: dict[str, float]) -> None:
    p = ready().axis.parameters
    with pytest.raises(AssertionError):
        agrees(run(), p._replace(limits=p.limits._replace(**change)))  # type: ignore[arg-type]
