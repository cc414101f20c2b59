"""Each limit just inside, on and just outside."""

from __future__ import annotations

import math
from typing import Any

import pytest

from pneud.safety import checks
from pneud.safety.checks import LEAVING_TICKS, MOVING_M_S, OFF_CENTRE_V, SETTLING_NS, SETTLING_TICKS, Limits
from pneud.safety.faults import NO_SENSORS, F, names
from pneud.signals import (
    ALL_SOURCES,
    Defect,
    EncoderStatus,
    Estimate,
    Host,
    Measurement,
    Source,
    State,
    ValveState,
)

LIMITS = Limits(
    travel_min_m=0.02,
    travel_max_m=0.98,
    speed_m_s=2.0,
    tracking_error_m=0.02,
    chamber_min_pa=90e3,
    chamber_max_pa=1e6,
    supply_min_pa=450e3,
    supply_max_pa=800e3,
    sensor_timeout_ns=50_000_000,
    valve_timeout_ns=50_000_000,
    deadline_timeout_ns=50_000_000,
    overload_ns=1_000_000_000,
    innovation_m=0.002,
    acceleration_m_s2=80.0,
    braking_m_s2=10.0,
    disagreement_n=800.0,
    saturation_ns=2_000_000_000,
    still_m=5e-5,
    stuck_force_n=200.0,
    stuck_travel_m=0.005,
    stroke_m=1.0,
    dead_length_1_m=0.0132,
    dead_length_2_m=0.0158,
    swing_1_pa_m_s=8e6,
    swing_2_pa_m_s=9e6,
)
GOOD = Measurement(
    t_ns=0,
    fresh=ALL_SOURCES,
    position_m=0.5,
    p1_pa=3e5,
    p2_pa=3e5,
    supply_pa=6e5,
    applied_v=0.0,
    encoder_status=int(EncoderStatus.REFERENCED),
    valve_state=int(ValveState.ENABLED),
    encoder_age_ns=0,
    pressure_age_ns=0,
    valve_age_ns=0,
    encoder_defects=0,
    pressure_defects=0,
    valve_defects=0,
    encoder_offset_ns=0,
    skipped=0,
    host=0,
)
STILL = Estimate(0.5, 0.0, 0.0, 50.0, 50.0, 0.0, 0.0, 0.0)
H = 1e-3


def below(x: float) -> float:
    return math.nextafter(x, -math.inf)


def above(x: float) -> float:
    return math.nextafter(x, math.inf)


@pytest.mark.parametrize(
    ("field", "low", "high", "fault"),
    [
        ("position_m", 0.02, 0.98, "travel"),
        ("p1_pa", 90e3, 1e6, "chamber_pressure"),
        ("p2_pa", 90e3, 1e6, "chamber_pressure"),
        ("supply_pa", 450e3, 800e3, "supply_pressure"),
    ],
)
def test_ranges_of_what_is_measured(field: str, low: float, high: float, fault: str) -> None:
    for value, found in (
        (below(low), [fault]),
        (low, []),
        (above(low), []),
        (below(high), []),
        (high, []),
        (above(high), [fault]),
        (math.nan, [fault, "not_finite"]),
        (math.inf, [fault, "not_finite"]),
        (-math.inf, [fault, "not_finite"]),
    ):
        changed: dict[str, Any] = {field: value}
        assert names(checks.measured(GOOD._replace(**changed), LIMITS)) == found, value


def test_a_good_measurement_shows_no_fault() -> None:
    assert checks.measured(GOOD, LIMITS) == 0
    assert checks.lacking(GOOD, LIMITS) == 0
    assert checks.believed(STILL, H, LIMITS) == 0
    assert checks.engaged(GOOD, STILL, State.TRACKING, 1000, H, LIMITS) == 0


@pytest.mark.parametrize(
    ("source", "field"),
    [
        (Source.ENCODER, "position_m"),
        (Source.PRESSURE, "p1_pa"),
        (Source.PRESSURE, "p2_pa"),
        (Source.PRESSURE, "supply_pa"),
        (Source.VALVE, "applied_v"),
    ],
)
def test_only_fresh_values_have_to_be_numbers(source: Source, field: str) -> None:
    without: dict[str, Any] = {field: math.nan}
    m = GOOD._replace(**without)
    assert checks.measured(m, LIMITS) >> F.NOT_FINITE & 1
    assert not checks.measured(m._replace(fresh=ALL_SOURCES & ~source), LIMITS) >> F.NOT_FINITE & 1


@pytest.mark.parametrize("source", ["encoder", "pressure", "valve"])
@pytest.mark.parametrize("age", [0, 49_999_999, 50_000_000, 50_000_001, 1 << 62])
@pytest.mark.parametrize("defects", range(8))
def test_a_source_without_values_is_named_after_what_came_instead(
    source: str, age: int, defects: int
) -> None:
    m = GOOD._replace(**{f"{source}_age_ns": age, f"{source}_defects": defects})
    # corrupt before frozen before late
    kind = "missing" if not defects else ("corrupt", "frozen", "late")[(defects & -defects).bit_length() - 1]
    found = checks.lacking(m, LIMITS)
    assert names(found) == ([f"{source}_{kind}"] if age > 50_000_000 else [])
    assert found & ~NO_SENSORS == 0


@pytest.mark.parametrize("state", range(256))
def test_states_of_the_valve_node(state: int) -> None:
    known = {0: [], 1: [], 2: [], 3: ["valve_timed_out"], 4: ["valve_fault"]}
    assert names(checks.measured(GOOD._replace(valve_state=state), LIMITS)) == known.get(
        state, ["valve_fault"]
    )


@pytest.mark.parametrize("status", range(8))
def test_status_of_the_encoder(status: int) -> None:
    expected = [
        *(["encoder_error"] if status & 4 else []),
        *(["encoder_unreferenced"] if not status & 1 else []),
    ]
    assert names(checks.measured(GOOD._replace(encoder_status=status), LIMITS)) == expected


@pytest.mark.parametrize("host", [0, *(int(flag) for flag in Host), 0x5555, 0x2AAA, sum(Host)])
def test_each_flag_of_the_machine_has_its_fault(host: int) -> None:
    assert names(checks.of_host(host)) == sorted(
        (flag.name.lower() for flag in Host if host & flag and flag.name), key=lambda name: F[name.upper()]
    )


@pytest.mark.parametrize(("speed", "found"), [(below(2.0), []), (2.0, []), (above(2.0), ["overspeed"])])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_speed(speed: float, found: list[str], sign: float) -> None:
    assert names(checks.believed(STILL._replace(velocity_m_s=sign * speed), H, LIMITS)) == found


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("interval", [0.0, 0.001, 0.05])
def test_a_jump_is_what_no_force_could_do_since_the_last_reading(sign: float, interval: float) -> None:
    most = 0.002 + 0.5 * 80.0 * interval * interval
    for innovation, found in ((below(most), []), (most, []), (above(most), ["encoder_jump"])):
        e = STILL._replace(innovation_m=sign * innovation)
        assert names(checks.believed(e, interval, LIMITS)) == found


@pytest.mark.parametrize("field", [f for f in Estimate._fields if f != "x3_n"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_an_estimate_that_is_no_number(field: str, value: float) -> None:
    assert names(checks.believed(STILL._replace(**{field: value}), H, LIMITS)) == ["not_finite"]


@pytest.mark.parametrize(("skipped", "found"), [(0, []), (49, []), (50, ["deadline"]), (2000, ["deadline"])])
def test_a_deadline_is_missed_when_ticks_lie_further_apart(skipped: int, found: list[str]) -> None:
    assert names(checks.engaged(GOOD._replace(skipped=skipped), STILL, State.TRACKING, 0, H, LIMITS)) == found


@pytest.mark.parametrize("state", [ValveState.BOOT, ValveState.CENTRED])
@pytest.mark.parametrize(("ticks", "found"), [(0, []), (50, []), (51, ["valve_rebooted"])])
def test_the_valve_node_has_its_time_out_to_be_enabled(state: int, ticks: int, found: list[str]) -> None:
    assert (
        names(checks.engaged(GOOD._replace(valve_state=state), STILL, State.TRACKING, ticks, H, LIMITS))
        == found
    )


@pytest.mark.parametrize("state", [State.TRACKING, State.MOVING, State.HOLDING, State.STOPPING])
def test_an_engaged_axis_needs_the_encoders_reference(state: State) -> None:
    lost = GOOD._replace(encoder_status=0)
    assert names(checks.engaged(lost, STILL, state, 0, H, LIMITS)) == ["encoder_lost_reference"]


def test_homing_does_without_the_encoders_reference_and_without_the_travel_it_gives() -> None:
    fast = STILL._replace(position_m=0.97, velocity_m_s=1.0)
    assert checks.engaged(GOOD._replace(encoder_status=0), fast, State.HOMING, 0, H, LIMITS) == 0


@pytest.mark.parametrize("speed", [0.1, 1.0, 2.0])
def test_the_load_has_to_be_able_to_come_to_rest_within_the_travel(speed: float) -> None:
    way = 0.5 * speed * speed / 10.0
    for x, v, found in (
        (0.98 - way - 1e-9, speed, []),
        (0.98 - way + 1e-9, speed, ["braking_distance"]),
        (0.98 - way + 1e-9, -speed, []),
        (0.02 + way + 1e-9, -speed, []),
        (0.02 + way - 1e-9, -speed, ["braking_distance"]),
        (0.02 + way - 1e-9, speed, []),
        (0.98, 0.0, []),
        (1.0, 0.0, []),  # beyond the travel it has a fault of its own
        (0.01, 0.0, []),
    ):
        e = STILL._replace(position_m=x, velocity_m_s=v)
        assert names(checks.engaged(GOOD, e, State.TRACKING, 0, H, LIMITS)) == found, (x, v)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_load_that_comes_to_rest_on_the_limit_is_within_it(sign: float) -> None:
    exact = LIMITS._replace(travel_min_m=0.25, travel_max_m=0.75, braking_m_s2=2.0)
    for x, found in ((0.5, []), (0.5 + sign * 2.0**-40, ["braking_distance"])):
        e = STILL._replace(position_m=x, velocity_m_s=sign)
        assert names(checks.engaged(GOOD, e, State.TRACKING, 0, H, exact)) == found


@pytest.mark.parametrize(
    ("changes", "active"),
    [
        ({"valve_state": ValveState.ENABLED}, True),
        ({"applied_v": above(OFF_CENTRE_V)}, True),
        ({"applied_v": -above(OFF_CENTRE_V)}, True),
        ({"applied_v": OFF_CENTRE_V}, False),
        ({"applied_v": -OFF_CENTRE_V}, False),
        ({"valve_state": ValveState.BOOT}, False),
    ],
)
def test_a_valve_that_should_be_centred(changes: dict[str, Any], active: bool) -> None:
    m = GOOD._replace(valve_state=int(ValveState.CENTRED))._replace(**changes)
    silent = m._replace(fresh=ALL_SOURCES & ~Source.VALVE)
    bit = 1 << F.VALVE_ACTIVE if active else 0
    assert checks.disengaged(m, LEAVING_TICKS - 1, False) == 0
    assert checks.disengaged(m, LEAVING_TICKS, False) == bit
    assert checks.disengaged(m, 0, True) == bit
    assert checks.disengaged(silent, LEAVING_TICKS, False) == 0
    assert checks.disengaged(silent, 0, True) == bit


@pytest.mark.parametrize(
    ("h", "settled_ns", "found"),
    [
        (1e-3, SETTLING_NS - 1, ["unsettled"]),
        (1e-3, SETTLING_NS, []),
        (1e-2, round(SETTLING_TICKS * 1e7) - 1, ["unsettled"]),
        (1e-2, round(SETTLING_TICKS * 1e7), []),
        (1e-3, 0, ["unsettled"]),
        (1e-3, -1, ["unsettled"]),
    ],
)
def test_estimates_have_to_be_so_old_to_arm_on(h: float, settled_ns: int, found: list[str]) -> None:
    assert names(checks.unready(STILL, settled_ns, h)) == found


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_load_has_to_stand_still_to_arm(sign: float) -> None:
    for speed, found in ((MOVING_M_S, []), (above(MOVING_M_S), ["moving"])):
        assert names(checks.unready(STILL._replace(velocity_m_s=sign * speed), SETTLING_NS, H)) == found


def test_whatever_is_wrong_at_once_is_shown_at_once() -> None:
    silent = GOOD._replace(
        encoder_age_ns=1 << 62,
        pressure_age_ns=1 << 62,
        valve_age_ns=1 << 62,
        encoder_defects=int(Defect.CORRUPT),
        pressure_defects=int(Defect.FROZEN),
        valve_defects=int(Defect.LATE),
    )
    assert names(checks.lacking(silent, LIMITS)) == ["encoder_corrupt", "pressure_frozen", "valve_late"]
    silent = silent._replace(encoder_defects=0, pressure_defects=int(Defect.CORRUPT), valve_defects=0)
    assert names(checks.lacking(silent, LIMITS)) == ["encoder_missing", "pressure_corrupt", "valve_missing"]
    silent = silent._replace(encoder_defects=int(Defect.LATE), valve_defects=int(Defect.CORRUPT))
    assert names(checks.lacking(silent, LIMITS)) == ["encoder_late", "pressure_corrupt", "valve_corrupt"]
    silent = silent._replace(encoder_defects=int(Defect.FROZEN), valve_defects=int(Defect.FROZEN))
    assert names(checks.lacking(silent, LIMITS)) == ["encoder_frozen", "pressure_corrupt", "valve_frozen"]

    wrong = GOOD._replace(encoder_status=4, position_m=2.0, p1_pa=2e6, supply_pa=math.nan)
    shown = ["encoder_error", "encoder_unreferenced", "chamber_pressure", "supply_pressure"]
    for state, fault in ((ValveState.TIMED_OUT, "valve_timed_out"), (ValveState.FAULT, "valve_fault")):
        found = names(checks.measured(wrong._replace(valve_state=int(state)), LIMITS))
        assert found == [*shown, fault, "travel", "not_finite"]

    jumped = STILL._replace(velocity_m_s=5.0, innovation_m=1.0)
    assert names(checks.believed(jumped, H, LIMITS)) == ["overspeed", "encoder_jump"]

    late = GOOD._replace(skipped=50, valve_state=int(ValveState.BOOT), encoder_status=0)
    assert names(checks.engaged(late, jumped, State.TRACKING, 1000, H, LIMITS)) == [
        "valve_rebooted", "deadline", "encoder_lost_reference", "braking_distance",
    ]  # fmt: skip
    assert names(checks.unready(jumped, 0, H)) == ["moving", "unsettled"]
