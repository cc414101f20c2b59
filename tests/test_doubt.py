"""One reading is no fact: what is held back, what confirms it, and what it costs."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from axis_rig import Rig, quick, ready, tracking, twin
from pneud.axis.doubt import DIGESTED, DIGESTING, LEAST_SHARE, hear_pressures, is_confirmed, listen
from pneud.axis.state import AxisState, Doubt
from pneud.safety.faults import F, names
from pneud.safety.supervisor import is_engaged
from pneud.signals import Defect, Measurement, Request, RequestKind, Source, State, Tick

ENCODER, PRESSURE = int(Source.ENCODER), int(Source.PRESSURE)
ODD, CONFIRMED = int(Defect.ODD), int(Defect.CONFIRMED)
Change = Callable[[Measurement, int], Measurement]


def off(field: str, by: float, times: int = 1) -> Change:
    """The first readings are off."""

    def change(m: Measurement, n: int) -> Measurement:
        return m._replace(**{field: getattr(m, field) + by}) if n < times else m

    return change


def to_and_fro(field: str, by: float, beside: float) -> Change:
    """Every other reading is off by the one, those between by the other."""
    return lambda m, n: m._replace(**{field: getattr(m, field) + (beside if n % 2 else by)})


def lost(bit: int, **before: Any) -> Change:
    """The first reading is lost, and its values are those before."""

    def change(m: Measurement, n: int) -> Measurement:
        if n:
            return m
        m = m._replace(fresh=m.fresh & ~bit, encoder_age_ns=1_000_000, pressure_age_ns=1_000_000)
        return m._replace(**before) if bit == PRESSURE else m

    return change


@cache
def _at_peak() -> Rig:
    rig = tracking()
    while abs(rig.axis.state.controller.motion.v) < 0.15:  # type: ignore[union-attr]
        rig.tick()
    return rig


@cache
def _at_rest() -> Rig:
    rig = ready()
    assert rig.tick(RequestKind.ARM).state == State.HOLDING
    rig.ticks(300)
    return rig


BOTH = pytest.mark.parametrize("begun", [_at_peak, _at_rest], ids=["moving", "resting"])


def run(begun: Callable[[], Rig], change: Change, ticks: int) -> tuple[list[Tick], list[float]]:
    """The ticks, and where the load truly was."""
    rig = twin(begun())
    rig.go_on(quick())
    began = rig.count
    rig.measurement = lambda m: change(m, rig.count - began)
    found, truth = [], []
    for _ in range(ticks):
        found.append(rig.tick())
        truth.append(rig.node.truth().position_m)
    return found, truth


@BOTH
@pytest.mark.parametrize(
    "change",
    [
        *(off("position_m", by) for by in (1e-5, -1e-4, 1e-3, -1e-3, 1e-2, -1.0)),
        *(off(f"p{chamber}_pa", by) for chamber in (1, 2) for by in (1e5, -1e5)),
        *(off("supply_pa", by) for by in (2e5, -2e5, 3e5)),
    ],
)
def test_one_odd_reading_costs_next_to_nothing(begun: Callable[[], Rig], change: Change) -> None:
    quiet, true = run(begun, lambda m, _: m, 120)
    found, truth = run(begun, change, 120)
    assert not any(tick.latched for tick in found)
    assert max(abs(a - b) for a, b in zip(truth, true, strict=True)) <= 0.03e-3
    voltages = ((a.command.voltage_v, b.command.voltage_v) for a, b in zip(found, quiet, strict=True))
    assert max(abs(a - b) for a, b in voltages) <= 0.5


@BOTH
@settings(deadline=None, max_examples=60)
@given(by=st.floats(1.5e-5, 2.0), side=st.sampled_from([-1.0, 1.0]))
def test_one_odd_position_is_as_good_as_lost(begun: Callable[[], Rig], by: float, side: float) -> None:
    odd, _ = run(begun, off("position_m", side * by), 1)
    without, _ = run(begun, lost(ENCODER), 1)
    assert odd[0].estimate == without[0].estimate
    assert odd[0].command == without[0].command
    assert odd[0].measurement.encoder_defects == ODD
    assert abs(odd[0].measurement.position_m - without[0].measurement.position_m) < 1e-3


@BOTH
@settings(deadline=None, max_examples=30)
@given(by=st.floats(6e4, 2e6), field=st.sampled_from(["p1_pa", "p2_pa"]))
def test_one_odd_pressure_is_as_good_as_lost(begun: Callable[[], Rig], by: float, field: str) -> None:
    odd, _ = run(begun, off(field, by), 1)
    seen = begun().axis.state.watch.seen
    known = {"p1_pa": seen.p1_pa, "p2_pa": seen.p2_pa}
    without, _ = run(begun, lost(PRESSURE, **known), 1)
    assert odd[0].estimate == without[0].estimate
    assert odd[0].command == without[0].command
    assert odd[0].measurement._replace(pressure_defects=0, pressure_age_ns=0) == without[
        0
    ].measurement._replace(pressure_age_ns=0, encoder_age_ns=0)
    assert odd[0].measurement.pressure_defects == ODD


@BOTH
@settings(deadline=None, max_examples=30)
@given(by=st.floats(2e-5, 1.0), side=st.sampled_from([-1.0, 1.0]))
def test_what_persists_counts_a_tick_later(begun: Callable[[], Rig], by: float, side: float) -> None:
    found, _ = run(begun, off("position_m", side * by, 3), 2)
    assert [tick.measurement.encoder_defects for tick in found] == [ODD, CONFIRMED]
    assert found[1].estimate.innovation_m == pytest.approx(side * by, abs=1e-5)


@BOTH
@settings(deadline=None, max_examples=20)
@given(steps=st.lists(st.floats(-3e-6, 3e-6), min_size=20, max_size=20))
def test_what_noise_explains_is_never_held_back(begun: Callable[[], Rig], steps: list[float]) -> None:
    found, _ = run(begun, lambda m, n: m._replace(position_m=m.position_m + steps[n]), 20)
    assert not any(tick.measurement.encoder_defects for tick in found)


@BOTH
@pytest.mark.parametrize(("by", "beside"), [(1e-4, -1e-4), (1e-3, -1e-3), (1e-4, 0.0), (1e-3, 0.0)])
def test_positions_that_alternate_are_a_fault_before_the_load_is_off(
    begun: Callable[[], Rig], by: float, beside: float
) -> None:
    _, true = run(begun, lambda m, _: m, 100)
    found, truth = run(begun, to_and_fro("position_m", by, beside), 100)
    first = next(n for n, tick in enumerate(found) if tick.latched)
    assert names(found[first].latched) == ["encoder_doubtful"]
    assert found[first].state == State.STOPPING
    assert max(abs(a - b) for a, b in zip(truth[:first], true, strict=False)) <= 0.1e-3


@BOTH
@pytest.mark.parametrize(("by", "beside"), [(1e5, -1e5), (1e5, 0.0)])
def test_pressures_that_alternate_are_a_fault_before_the_load_is_off(
    begun: Callable[[], Rig], by: float, beside: float
) -> None:
    _, true = run(begun, lambda m, _: m, 100)
    found, truth = run(begun, to_and_fro("p1_pa", by, beside), 100)
    first = next(n for n, tick in enumerate(found) if tick.latched)
    assert names(found[first].latched) == ["pressure_doubtful"]
    assert max(abs(a - b) for a, b in zip(truth[:first], true, strict=False)) <= 0.1e-3


def test_a_position_that_stands_still_once_under_a_moving_load_is_odd() -> None:
    kept: list[float] = [_at_peak().axis.state.watch.seen.position_m]
    found, _ = run(_at_peak, lambda m, n: m._replace(position_m=kept[0]) if n == 0 else m, 40)
    assert found[0].measurement.encoder_defects == ODD
    assert found[0].measurement.fresh & ENCODER  # it is read, and says the same again
    assert not any(tick.latched for tick in found)


def test_an_encoder_that_stands_still_under_a_moving_load_is_caught_with_its_second_reading() -> None:
    kept = _at_peak().axis.state.watch.seen.position_m
    found, _ = run(_at_peak, lambda m, _: m._replace(position_m=kept), 2)
    assert [names(tick.latched) for tick in found] == [[], ["encoder_stuck"]]


def test_readings_that_are_lost_behind_an_odd_one_keep_what_was_believed() -> None:
    def change(m: Measurement, n: int) -> Measurement:
        odd = m._replace(position_m=m.position_m + 0.5, p1_pa=m.p1_pa + 5e5)
        if n == 0:
            return odd
        return odd._replace(fresh=m.fresh & ~(ENCODER | PRESSURE)) if n < 5 else m

    found, _ = run(_at_peak, change, 10)
    assert not any(tick.latched for tick in found)
    first = found[0].measurement
    assert all(abs(tick.measurement.position_m - first.position_m) < 2e-3 for tick in found)
    assert all(tick.measurement.p1_pa == first.p1_pa for tick in found[:5])


def heard(state: AxisState, rig: Rig, **changes: Any) -> tuple[Measurement, Doubt, int]:
    m = twin(rig).tick().measurement
    m = m._replace(**{name: getattr(m, name) + by for name, by in changes.items()})
    return listen(state, m, m.t_ns, rig.axis.parameters)


def test_readings_behind_a_confirmed_one_count_at_once_while_the_filter_follows() -> None:
    rig = twin(_at_rest())
    d = rig.axis.state.doubt._replace(innovation_m=1e-4, encoder_ns=rig.t_ns)
    m, after, _ = heard(rig.axis.state._replace(doubt=d), rig, position_m=1e-4)
    assert m.encoder_defects == CONFIRMED
    assert after.slack_m == pytest.approx(DIGESTING * 1e-4, rel=0.1)
    assert after.innovation_m == 0.0
    m, later, _ = heard(rig.axis.state._replace(doubt=after), rig, position_m=1e-4)
    assert (m.encoder_defects, later.slack_m) == (0, DIGESTED * after.slack_m)


def test_of_an_axis_without_estimates_nothing_is_held_back() -> None:
    rig = twin(_at_rest())
    state = rig.axis.state._replace(controller=None, doubt=Doubt(innovation_m=1.0, slack_m=1.0))
    m, after, present = heard(state, rig, position_m=0.3)
    assert (m.encoder_defects, after.innovation_m, after.slack_m, present) == (0, 0.0, 0.0, 0)


@pytest.mark.parametrize("field", ["position_m", "p1_pa", "supply_pa"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_what_is_not_finite_is_another_fault(field: str, value: float) -> None:
    changes: dict[str, Any] = {field: value}
    found, _ = run(_at_rest, lambda m, _: m._replace(**changes), 1)
    assert found[0].latched >> F.NOT_FINITE & 1
    assert found[0].measurement.encoder_defects == found[0].measurement.pressure_defects == 0


@pytest.mark.parametrize(
    ("before", "now", "confirmed"),
    [
        (1e-4, 1e-4, True),
        (1e-4, LEAST_SHARE * 1e-4, True),
        (1e-4, LEAST_SHARE * 0.99e-4, False),
        (1e-4, -1e-4, False),
        (0.0, 1e-4, False),
        (-1e-4, -2e-4, True),
        (-1e-4, -2.02e-3, False),
    ],
)
def test_what_confirms_an_innovation(before: float, now: float, confirmed: bool) -> None:
    assert is_confirmed(Doubt(innovation_m=before), now, 1.9e-3) == confirmed


def test_pressures_that_do_not_confirm_one_another_are_both_odd() -> None:
    rig = twin(_at_rest())
    p, w, d = rig.axis.parameters, rig.axis.state.watch.seen, rig.axis.state.doubt
    m = twin(rig).tick().measurement
    up, down = m._replace(supply_pa=9e5), m._replace(supply_pa=1e5)
    first, d, _ = hear_pressures(w, d, up, p.limits, p.gate)
    assert (first.supply_pa, d.pressure_share) == (m.supply_pa, 0.0)
    second, d, _ = hear_pressures(w, d, down, p.limits, p.gate)
    assert (second.supply_pa, d.pressure_share) == (m.supply_pa, p.gate.rate)
    third, d, _ = hear_pressures(w, d, down, p.limits, p.gate)
    assert (third.supply_pa, third.pressure_defects, d.pressure_ns) == (1e5, CONFIRMED, -1)


@pytest.mark.slow
def test_over_a_minute_of_lost_and_odd_readings() -> None:
    def change(m: Measurement, n: int) -> Measurement:
        if n % 250 == 7:
            return m._replace(fresh=0)
        return m._replace(position_m=m.position_m + 1e-3 * (-1.0) ** n) if n % 997 == 3 else m

    found, truth = run(_at_peak, change, 60_000)
    assert all(is_engaged(tick.state) and not tick.latched for tick in found)
    wanted = [t.reference.position_m - t.reference.velocity_m_s * 55e-6 for t in found]
    errors = [a - b for a, b in zip(wanted, truth, strict=True)][5000:]
    assert math.sqrt(sum(e * e for e in errors) / len(errors)) <= 0.02e-3
    steps = [abs(b.command.voltage_v - a.command.voltage_v) for a, b in pairwise(found)]
    assert sum(steps) / len(steps) <= 0.03


def test_a_request_beside_an_odd_reading_is_taken() -> None:
    rig = twin(_at_rest())
    rig.measurement = lambda m: m._replace(position_m=m.position_m + 0.01)
    request = Request(RequestKind.GOTO, (0.5, 0.0, 0.0, 0.0))
    assert rig.tick(request.kind, *request.values).state == State.MOVING


@pytest.mark.parametrize("wait", [0, 3, 7, 11])
def test_an_encoder_that_slips_for_good_at_rest_is_caught(wait: int) -> None:
    found, _ = run(_at_rest, lambda m, n: m._replace(position_m=m.position_m + 1e-3) if n >= wait else m, 20)
    assert "encoder_stuck" in names(found[-1].latched)
    assert found[wait].latched == 0
