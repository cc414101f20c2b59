"""Homing of an incremental encoder: against the stop and back, on the software rig in simulated time."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import pytest

from axis_rig import ARM, CLEAR, DISARM, ENCODER, SHUTDOWN, Rig, loaded, quick, twin
from pneud import resources
from pneud.axis.cycle import Axis
from pneud.config import conversions
from pneud.config.models import Config
from pneud.config.reading import parse
from pneud.config.sections import ConfigError
from pneud.control import homing
from pneud.control.homing import AWAY, BACK, HALT, TOWARDS, Homing
from pneud.rig.node import PlantNode
from pneud.safety.faults import F, names
from pneud.signals import Answer, Estimate, Host, Measurement, RequestKind, State, Tick

HOME, GOTO, JOG, STOP = RequestKind.HOME, RequestKind.GOTO, RequestKind.JOG, RequestKind.STOP


def config(**homing_: Any) -> Config:
    here = loaded().config
    encoder = here.encoder.model_copy(
        update={"kind": "incremental", "homing": here.encoder.homing.model_copy(update=homing_)}
    )
    return here.model_copy(update={"encoder": encoder})


def unhomed(start_m: float = 0.05, plant: dict[str, Any] | None = None, **homing_: Any) -> Rig:
    """Switched on, its encoder showing 0 wherever the load is."""
    c = config(**homing_)
    rig = Rig()
    rig.axis = Axis(conversions.axis_of(c, loaded().codecs.command_lsb_v))
    x1 = start_m + c.cylinder.dead_length_1_m
    p = conversions.plant_of(c)._replace(initial_x1=x1, encoder_zero_m=start_m, **(plant or {}))
    rig.node = PlantNode(p, loaded().codecs, 3, advance=quick().advance)
    rig.until(State.DISARMED)
    while "unsettled" in names(rig.tick().present):
        assert rig.count < 200
    return rig


def homed(rig: Rig, limit: int = 60_000) -> list[Tick]:
    first = rig.tick(HOME)
    assert (first.answer, first.state) == (Answer.TAKEN, State.HOMING)
    ticks = [first]
    while ticks[-1].state == State.HOMING:
        ticks.append(rig.tick())
        assert len(ticks) < limit
    return ticks


@cache
def _holding() -> Rig:
    rig = unhomed(0.01, speed_m_s=0.05)
    assert homed(rig)[-1].state == State.HOLDING
    return rig


def holding() -> Rig:
    """Homed, and holding."""
    return twin(_holding())


@pytest.mark.slow
def test_homing_forgets_nothing_that_was_learnt() -> None:
    rig = unhomed(0.01, speed_m_s=0.05)
    controller = rig.axis.state.controller
    assert controller is not None
    learnt = controller.learnt._replace(friction=0.9, mass=1.1)
    rig.axis.state = rig.axis.state._replace(controller=controller._replace(learnt=learnt))
    assert homed(rig)[-1].state == State.HOLDING
    controller = rig.axis.state.controller
    assert controller is not None
    assert (controller.learnt.friction, controller.learnt.mass) == (0.9, 1.1)


def known(rig: Rig) -> bool:
    return rig.axis.state.referenced


@pytest.mark.parametrize(
    ("start_m", "stop"),
    [
        (0.02, "rear"),
        pytest.param(0.0, "rear", marks=pytest.mark.slow),
        pytest.param(1.0, "front", marks=pytest.mark.slow),
        pytest.param(0.98, "rear", marks=pytest.mark.slow),  # the way off the stop is blocked at first
        pytest.param(0.5, "front", marks=pytest.mark.slow),
    ],
)
def test_homing_finds_the_zero_gently_from_anywhere(start_m: float, stop: str) -> None:
    rig = unhomed(start_m, stop=stop, speed_m_s=0.05)
    p = rig.axis.parameters
    limits, rod_n = p.homing, p.controller.cylinder.rod_force_n
    ticks = homed(rig)
    assert ticks[-1].state == State.HOLDING
    assert not any(t.latched for t in ticks)
    assert rig.axis.state.zero_m == pytest.approx(start_m, abs=5e-6)
    assert max(abs(t.estimate.x3_n - rod_n) for t in ticks) <= 1.1 * limits.force_n
    assert max(abs(t.estimate.velocity_m_s) for t in ticks) <= 5.0 * limits.speed_m_s
    assert all(math.isfinite(sum(t.reference)) for t in ticks)
    after = rig.ticks(300)
    assert {t.state for t in after} == {State.HOLDING}
    assert not any(t.present for t in after)
    last, true_m = after[-1], rig.node.truth().position_m
    assert last.measurement.position_m == pytest.approx(true_m, abs=5e-6)
    assert abs(true_m - limits.stop_m) == pytest.approx(limits.back_off_m, abs=5e-3)


def test_after_homing_it_goes_where_it_is_told() -> None:
    rig = holding()
    assert rig.tick(GOTO, 0.1).answer == Answer.TAKEN
    rig.until(State.HOLDING)
    rig.ticks(300)
    assert rig.node.truth().position_m == pytest.approx(0.1, abs=20e-6)
    rig.tick(DISARM)
    rig.until(State.DISARMED)
    while rig.tick().present:
        assert rig.count < 20_000
    assert rig.tick(ARM).state == State.HOLDING  # the reference stays
    assert rig.tick(HOME).state == State.HOMING
    assert not known(rig)


def test_before_homing_nothing_else_moves() -> None:
    rig = unhomed()
    assert names(rig.tick().present) == ["encoder_unreferenced"]
    for kind, values in ((ARM, ()), (ARM, (1.0,)), (GOTO, (0.5,)), (JOG, (0.1, 100.0))):
        tick = rig.tick(kind, *values)
        assert (tick.state, tick.answer) == (State.DISARMED, Answer.NOT_REFERENCED)
    rig.measurement = lambda m: m._replace(supply_pa=1e5)
    rig.tick()  # one reading is no fact
    assert rig.tick(ARM).answer == Answer.BLOCKED
    assert rig.tick(HOME).answer == Answer.BLOCKED


def test_homing_is_refused_where_it_makes_no_sense() -> None:
    rig = Rig()
    rig.until(State.DISARMED)
    rig.ticks(100)
    assert rig.tick(HOME).answer == Answer.WRONG_STATE  # an absolute encoder
    other = unhomed()
    assert other.tick(HOME, 1.0).answer == Answer.MALFORMED
    other.tick(HOME)
    for kind in (HOME, GOTO, ARM):
        assert other.tick(kind, *((0.5,) if kind == GOTO else ())).answer == Answer.WRONG_STATE
    third = unhomed()
    third.tick(SHUTDOWN)
    assert third.tick(HOME).answer == Answer.CLOSING


@pytest.mark.parametrize("kind", [STOP, DISARM, SHUTDOWN])
def test_stopped_while_homing_the_valve_is_centred_at_once(kind: RequestKind) -> None:
    rig = unhomed()
    rig.tick(HOME)
    rig.ticks(1500)
    tick = rig.tick(kind)
    assert (tick.answer, tick.state, tick.command.enable) == (Answer.TAKEN, State.DISARMED, 0)
    assert not known(rig)


def test_cut_behind_the_stop_it_can_be_cleared_and_homed_again() -> None:
    rig = unhomed(0.01, speed_m_s=0.05)
    rig.tick(HOME)
    while not known(rig):
        rig.tick()
        assert rig.count < 60_000
    rig.ticks(5)
    rig.host = int(Host.CONSOLE_LOST)
    lost = rig.tick()
    rig.host = 0
    assert (lost.state, names(lost.latched)) == (State.FAULT, ["console_lost"])
    assert names(rig.tick().present) == ["encoder_unreferenced"], "at the stop, which lies beyond the travel"
    assert rig.tick(CLEAR).state == State.DISARMED
    assert homed(rig)[-1].state == State.HOLDING


@pytest.mark.slow
def test_a_load_that_is_stuck_is_not_taken_for_homed() -> None:
    rig = unhomed()
    stuck = rig.node.p.friction._replace(coulomb_n=400.0, static_n=400.0)
    rig.node.p = rig.node.p._replace(friction=stuck)
    ticks = homed(rig)
    assert (ticks[-1].state, names(ticks[-1].latched)) == (State.FAULT, ["homing_failed"])
    assert not known(rig)
    rig.ticks(5)
    assert rig.tick(CLEAR).state == State.DISARMED


@pytest.mark.slow
@pytest.mark.parametrize("dead_zone_v", [0.05, 0.14])
def test_a_dead_zone_that_is_not_as_identified_does_not_matter(dead_zone_v: float) -> None:
    rig = unhomed(0.01)
    rig.node.p = rig.node.p._replace(valve=rig.node.p.valve._replace(dead_zone_v=dead_zone_v))
    assert homed(rig)[-1].state == State.HOLDING
    assert rig.axis.state.zero_m == pytest.approx(0.01, abs=5e-6)


def test_a_jump_of_the_encoder_loses_the_reference() -> None:
    rig = holding()
    rig.measurement = lambda m: m._replace(position_m=m.position_m + 0.01)
    tick = rig.ticks(2)[-1]
    assert tick.state == State.FAULT
    assert "encoder_jump" in names(tick.latched)
    assert not known(rig)
    rig.until(State.FAULT)
    rig.ticks(200)
    assert rig.tick(CLEAR).state == State.DISARMED
    rig.ticks(100)
    assert rig.tick(ARM).answer == Answer.NOT_REFERENCED


def test_an_encoder_that_fell_silent_may_have_lost_count() -> None:
    rig = holding()
    rig.tick(DISARM)
    rig.until(State.DISARMED)
    rig.frame = lambda frame: None if frame.can_id == ENCODER else frame
    rig.ticks(70)
    assert not known(rig)


def test_frozen_while_homing_it_thaws_to_the_same_ticks() -> None:
    rig = unhomed(0.04)
    rig.tick(HOME)
    rig.ticks(700)
    frozen = rig.axis.freeze()
    assert frozen.homing.lag_m != 0.0
    raw: list[Measurement] = []

    def kept(m: Measurement) -> Measurement:
        raw.append(m)
        return m

    rig.measurement = kept
    ticks = rig.ticks(300)
    other = Axis(rig.axis.parameters)
    other.thaw(frozen)
    again = [other.cycle(m, None, m.t_ns) for m in raw]
    assert [repr(t) for t in again] == [repr(t) for t in ticks]


P = conversions.axis_of(config(), 5e-4)


def at(position_m: float, velocity_m_s: float = 0.0, x3_n: float = 0.0) -> Estimate:
    return Estimate(position_m, velocity_m_s, 0.0, x3_n, x3_n, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("begun", "e", "after_ns", "expected"),
    [
        (Homing(AWAY, 0, 0.5, 0), at(0.531, 0.02), 1, "TOWARDS"),
        (Homing(AWAY, 0, 0.5, 0), at(0.5, 0.0, 119.0), homing.STILL_NS, "TOWARDS"),
        (Homing(AWAY, 0, 0.5, 0), at(0.5, 0.0, 50.0), homing.STILL_NS, "AWAY"),
        (Homing(TOWARDS, 0, 0.5, 0), at(0.4, 0.0, -119.0), homing.STILL_NS, "found"),
        (Homing(TOWARDS, 0, 0.5, 0), at(0.495, 0.0, -119.0), homing.STILL_NS, "failed"),
        (Homing(BACK, 0, 0.0, 0), at(0.031, 0.02), 1, "HALT"),
        (Homing(BACK, 0, 0.0, 0), at(0.001, 0.0, 119.0), homing.STILL_NS, "failed"),
        (Homing(HALT, 0, 0.03, 0), at(0.031, 0.02), homing.STILL_NS, "HALT"),
        (Homing(HALT, 0, 0.03, 0), at(0.031, 0.001), homing.STILL_NS, "done"),
        (Homing(TOWARDS, 0, 0.5, 0), at(0.3, -0.02), P.homing.longest_ns + 1, "failed"),
    ],
)
def test_each_part_ends_as_it_should(begun: Homing, e: Estimate, after_ns: int, expected: str) -> None:
    progress = homing.proceed(begun, e, after_ns, 1e-3, 0.0, P.homing)
    if expected in ("found", "failed", "done"):
        assert getattr(progress, expected)
    else:
        assert not (progress.found or progress.failed or progress.done)
        assert progress.homing.part == getattr(homing, expected)


def test_without_its_inverse_the_dead_zone_is_left_alone() -> None:
    rig = unhomed()
    m = rig.inbox.measurement(0, 0)._replace(p1_pa=3e5, p2_pa=3.3e5, supply_pa=6e5)
    s, e = (
        Homing(TOWARDS, 0, 0.0, 0),
        at(0.0, 0.0, 3e5 * P.controller.cylinder.A1 - 3.3e5 * P.controller.cylinder.A2),
    )
    plain = P.controller._replace(sliding=P.controller.sliding._replace(invert_dead_zone=False))
    inverted, direct = (
        homing.command(s, m, e, P.homing, P.controller),
        homing.command(s, m, e, P.homing, plain),
    )
    assert inverted < direct < 0.0
    assert homing.command(s._replace(part=AWAY), m, e, P.homing, plain) > 0.0


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("back_off_m = 0.01", "ends at 0.01 m, outside limits.travel 0.02 … 0.98 m"),
        ('back_off_m = 0.01\nstop = "front"', "ends at 0.99 m"),
        ("speed_m_s = 0.5", "less than or equal to 0.1"),
    ],
)
def test_a_homing_that_cannot_be_is_refused(text: str, words: str) -> None:
    whole = (resources.configs() / "virtual.toml").read_text()
    begin, end = whole.index("[encoder]"), whole.index("[control]")
    changed = f'{whole[:begin]}[encoder]\nkind = "incremental"\n[encoder.homing]\n{text}\n{whole[end:]}'
    with pytest.raises(ConfigError, match=words):
        parse(changed, "x")


def test_the_fault_has_its_row() -> None:
    assert names(1 << F.HOMING_FAILED) == ["homing_failed"]
