"""The movement test on three rigs: every mistake of wiring is named within its bounds, and no healthy
rig is taken for a wrong one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import pytest

from axis_rig import CLEAR, Rig, ready
from pneud.axis.state import AxisParameters
from pneud.config import conversions
from pneud.loading import Loaded, load
from pneud.signals import Defect, Frame, Host, Measurement, RequestKind, State, Tick, ValveState
from pneud.study.commissioning.movement import Finding, Verdict
from pneud.study.commissioning.testing import MovementTest
from pneud.study.commissioning.truths import drawn
from straight import played

MOST_M, MOST_M_S = 5e-3, 0.1
AFTER_S = 0.3  # watched behind the last probe
LONGEST_S = 120.0


def rig(
    areas_m2: tuple[float, float],
    stroke_m: float,
    mass_kg: float,
    orifice_m2: float,
    coulomb_n: float,
    step_m: float,
) -> dict[str, Any]:
    """Of another size than the packaged one."""
    friction = {
        "coulomb_n": coulomb_n,
        "static_n": 1.5 * coulomb_n,
        "viscous_n_s_m": coulomb_n,
        "bristle_stiffness_n_m": 9e4,
    }
    return {
        "cylinder": {
            "piston_area_1_m2": areas_m2[0],
            "piston_area_2_m2": areas_m2[1],
            "stroke_m": stroke_m,
            "dead_length_1_m": 0.02,
            "dead_length_2_m": 0.02,
            "moving_mass_kg": mass_kg,
        },
        "valve": {"orifice_area_m2": orifice_m2},
        "control": {"friction": friction, "motion": {"encoder_resolution_m": step_m}},
        "limits": {"travel_min_m": 0.02 * stroke_m, "travel_max_m": 0.98 * stroke_m},
        "reference": {"effective_centre_m": 0.5 * stroke_m + 0.02, "amplitude_m": 0.2 * stroke_m},
        "plant": {
            "initial_x1_m": 0.45 * stroke_m + 0.02,
            "friction": friction,
            "sensors": {"encoder_resolution_m": step_m},
        },
    }


RIGS: dict[str, dict[str, Any]] = {
    "40x1000": {},
    "16x100": rig((2.0106e-4, 1.7279e-4), 0.1, 0.8, 1.972e-6, 6.0, 1e-5),
    "32x300": rig((8.0425e-4, 6.9115e-4), 0.3, 8.0, 6.903e-6, 24.1, 5e-6),
}
WIRINGS: dict[str, tuple[dict[str, Any], Finding | None]] = {
    "none": ({}, None),
    "swapped hoses": ({"swapped_hoses": True}, Finding.SWAPPED_HOSES),
    "inverted encoder": ({"encoder_inverted": True}, Finding.ENCODER_INVERTED),
    "exchanged pressures": ({"exchanged_pressures": True}, Finding.EXCHANGED_PRESSURES),
    "dead a": ({"dead_pressure": "a"}, Finding.DEAD_PRESSURE_1),
    "dead b": ({"dead_pressure": "b"}, Finding.DEAD_PRESSURE_2),
    "shut": ({"supply_shut": True}, Finding.SUPPLY_SHUT),
    "unplugged": ({"valve_unplugged": True}, Finding.VALVE_UNPLUGGED),
    "x10": ({"encoder_scale": 10.0}, Finding.ENCODER_SCALE_LARGE),
    "x25.4": ({"encoder_scale": 25.4}, Finding.ENCODER_SCALE_LARGE),
    "/10": ({"encoder_scale": 0.1}, Finding.ENCODER_SCALE_SMALL),
    "/25.4": ({"encoder_scale": 1.0 / 25.4}, Finding.ENCODER_SCALE_SMALL),
    "blocked": ({"blocked": True}, Finding.BLOCKED),
}


class Outcome(NamedTuple):
    """What a movement test has come to, and how the load has really moved in each of its probes."""

    verdict: Verdict | None
    way_m: float
    speed_m_s: float


def outcome(loaded: Loaded, seed: int) -> Outcome:
    test = MovementTest(conversions.axis_of(loaded.config, loaded.codecs.command_lsb_v))
    way_m, speed_m_s, from_m, before, left = 0.0, 0.0, None, 0, round(AFTER_S * loaded.config.loop.rate_hz)
    for tick, place_m, moving_m_s in played(loaded, test.ask, LONGEST_S, seed):
        test.see(tick)
        if tick.state == State.PROBING and before != State.PROBING:
            from_m = place_m
        before = tick.state
        if from_m is not None:
            way_m, speed_m_s = max(way_m, abs(place_m - from_m)), max(speed_m_s, abs(moving_m_s))
        if test.verdict is not None:
            left -= 1
            if left < 0:
                break
    return Outcome(test.verdict, way_m, speed_m_s)


@pytest.mark.slow
@pytest.mark.parametrize("wiring", WIRINGS)
@pytest.mark.parametrize("name", RIGS)
def test_a_mistake_is_named_on_every_rig_within_the_bounds(name: str, wiring: str) -> None:
    made, finding = WIRINGS[wiring]
    change = {**RIGS[name], "plant": {**RIGS[name].get("plant", {}), "wiring": made}}
    found = outcome(load("virtual.toml", None, change), 1)
    assert found.verdict is not None
    assert found.verdict.findings == (() if finding is None else (finding,))
    assert found.way_m <= MOST_M
    assert found.speed_m_s <= MOST_M_S


def altered(**values: float) -> Callable[[Rig], None]:
    """Readings of the axis replaced."""

    def begin(rig: Rig) -> None:
        def measurement(m: Measurement) -> Measurement:
            return m._replace(**values)  # type: ignore[arg-type]

        rig.measurement = measurement

    return begin


def told(host: Host) -> Callable[[Rig], None]:
    def begin(rig: Rig) -> None:
        rig.host = int(host)

    return begin


def silent(rig: Rig) -> None:
    def lost(_: Frame) -> None:
        return None

    rig.frame = lost


def jumped(rig: Rig) -> None:
    rig.measurement = lambda m: m._replace(position_m=m.position_m + 0.1)


INJECTED: dict[str, Callable[[Rig], None]] = {
    **{host.name or "": told(host) for host in (
        Host.LINK_DOWN, Host.OTHER_CONTROLLER, Host.EMERGENCY, Host.HEARTBEAT_LOST,
        Host.BUS_OFF, Host.IDENTIFIER_CLASH, Host.CONSOLE_LOST, Host.SEND_FAILED,
    )},
    "silent nodes": silent,
    "encoder error": altered(encoder_status=5),
    "encoder jump": jumped,
    "chamber pressure": altered(p1_pa=1.2e6),
    "supply": altered(supply_pa=2e5),
    "valve state": altered(valve_state=int(ValveState.FAULT)),
    "not a number": altered(position_m=float("nan")),
    "corrupt encoder": altered(fresh=6, encoder_defects=int(Defect.CORRUPT), encoder_age_ns=60_000_000),
}  # fmt: skip


class Sitting:
    """A movement test on the rig, tick by tick."""

    def __init__(self, rig: Rig) -> None:
        self.rig, self.test, self._last = rig, MovementTest(parameters(rig)), rig.tick()

    def tick(self) -> Tick:
        asked = self.test.ask(self._last.state, self._last.present)
        kind, values = (0, ()) if asked is None else asked
        self._last = self.rig.tick(kind, *values)
        self.test.see(self._last)
        return self._last

    def until(self, state: State, limit: int = 3000) -> Tick:
        return next(tick for tick in (self.tick() for _ in range(limit)) if tick.state == state)


def parameters(rig: Rig) -> AxisParameters:
    return rig.axis.parameters


def probing() -> Sitting:
    tested = Sitting(ready())
    tested.until(State.PROBING)
    for _ in range(50):
        assert tested.tick().state == State.PROBING
    return tested


@pytest.mark.slow
@pytest.mark.parametrize("name", INJECTED)
def test_a_fault_amid_a_probe_centres_and_the_test_can_be_begun_again(name: str) -> None:
    tested = probing()
    frame, measurement = tested.rig.frame, tested.rig.measurement
    INJECTED[name](tested.rig)
    ended = next(t for t in (tested.tick() for _ in range(200)) if t.state != State.PROBING)
    assert (ended.state, ended.command.voltage_v, ended.command.enable) == (State.FAULT, 0.0, 0)
    assert tested.test.verdict is not None
    assert not tested.test.verdict.passed
    assert tested.test.verdict.unfinished
    tested.rig.frame, tested.rig.measurement, tested.rig.host = frame, measurement, 0
    tested.rig.ticks(100)
    assert tested.rig.tick(CLEAR).state in (State.DISARMED, State.WAITING)
    Sitting(tested.rig).until(State.PROBING)


@pytest.mark.parametrize("kind", [RequestKind.STOP, RequestKind.DISARM, None])
def test_stopped_or_left_by_its_operator_the_test_ends_and_can_be_begun_again(
    kind: RequestKind | None,
) -> None:
    tested = probing()
    for _ in range(400):
        tick = tested.rig.tick(kind or 0)
        tested.test.see(tick)
        if tick.state != State.PROBING:
            break
    assert (tick.state, tick.command.enable) == (State.DISARMED, 0)
    assert tested.test.verdict == Verdict((Finding.STOPPED,))
    assert tested.test.verdict.unfinished
    Sitting(tested.rig).until(State.PROBING)


@pytest.mark.slow
@pytest.mark.parametrize("first", [0, 10, 20, 30])
def test_no_healthy_rig_is_taken_for_a_wrong_one(first: int) -> None:
    """Ten of forty; of a valve that is open at rest, and moves the load itself, just that is said."""
    for seed in range(first, first + 10):
        change = RIGS[tuple(RIGS)[seed % len(RIGS)]]
        believed = load("virtual.toml", None, change)
        found = outcome(hidden(believed, change, seed), seed)
        assert found.verdict is not None
        if found.verdict.findings == (Finding.OPEN_AT_REST,):
            assert opens_at_rest(hidden(believed, change, seed))
            continue
        assert found.verdict.passed, (seed, found)
        assert found.way_m <= MOST_M, (seed, found)
        assert found.speed_m_s <= MOST_M_S, (seed, found)


def hidden(believed: Loaded, change: dict[str, Any], seed: int) -> Loaded:
    plant = {**change.get("plant", {}), **drawn(believed.config, seed)["plant"]}
    return load("virtual.toml", None, {**change, "plant": plant})


def opens_at_rest(loaded: Loaded) -> bool:
    valve = conversions.plant_of(loaded.config).valve
    return abs(valve.centre_v) > valve.dead_zone_v
