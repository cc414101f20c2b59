"""What takes a memory to see: each limit just inside, on and just outside, and how long it has to last."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest

from pneud.safety import watch as watch_module
from pneud.safety.checks import Limits
from pneud.safety.fault_row import Fault
from pneud.safety.faults import TABLE, F, names
from pneud.safety.watch import (
    CHAMBER_PA,
    HORIZON_S,
    INITIAL,
    LASTING,
    STILL_READINGS,
    SUPPLY_S,
    VALVE_V,
    Watch,
)
from pneud.signals import ALL_SOURCES, Estimate, Host, Measurement, Source, State, ValveState
from test_safety_checks import GOOD, LIMITS, STILL, above, below
from watching import watch

MS = 1_000_000
Change = Callable[[int], dict[str, Any]]


class Axis:
    """Ticks of a millisecond; each tells what it has found."""

    def __init__(self, limits: Limits = LIMITS) -> None:
        self.w: Watch = INITIAL
        self.m = GOOD
        self.e = STILL
        self.state = int(State.TRACKING)
        self.engaged = True
        self.last_v = 0.0
        self.limited = 0
        self.limits = limits
        self.t_ns = 0

    def tick(self, e: dict[str, Any] | None = None, ms: int = 1, **changes: Any) -> list[str]:
        self.t_ns += ms * MS
        m = self.m._replace(t_ns=self.t_ns, **changes)
        self.w, bits = watch(
            self.w,
            m,
            self.e._replace(**(e or {})),
            self.state,
            self.engaged,
            self.last_v,
            self.limited,
            self.limits,
        )
        return names(bits)

    def lasts(self, fault: F, limit_ms: int, **changes: Any) -> None:
        """The change has to last so long, on end, to count."""
        found = [fault.name.lower()]
        for _ in range(2):
            for n in range(limit_ms + 3):
                assert self.tick(**changes) == (found if n >= limit_ms else []), n
            assert self.tick() == []


@pytest.fixture
def axis() -> Axis:
    axis = Axis()
    for _ in range(300):
        assert axis.tick() == []
    return axis


def test_the_rows_that_have_to_last_are_those_with_a_debounce_of_their_own() -> None:
    by_age = {"sensor_timeout_ns", "valve_timeout_ns", "deadline_timeout_ns"}
    for row in TABLE:
        if LASTING >> row.bit & 1:
            assert row.debounce
        elif row.debounce:
            assert row.debounce in by_age


def test_a_saturated_command_may_last_its_time(axis: Axis) -> None:
    axis.limits = LIMITS._replace(saturation_ns=50 * MS)
    axis.limited = 1
    for n in range(60):
        assert axis.tick() == (["saturated_long"] if n >= 50 else []), n
    axis.limited = 0
    assert axis.tick() == []
    axis.limited = 1
    assert axis.tick() == []
    axis.engaged = False
    assert all(axis.tick() == [] for _ in range(60))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_force_that_nothing_explains(axis: Axis, sign: float) -> None:
    limit = LIMITS.disagreement_n
    for force in (below(limit), limit):
        assert all(axis.tick({"force_n": sign * force}) == [] for _ in range(30))
    axis.lasts(F.FORCE_DISAGREES, 20, e={"force_n": sign * above(limit)})
    axis.engaged = False
    assert all(axis.tick({"force_n": 1e6}) == [] for _ in range(30))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_valve_node_puts_out_one_of_the_last_three_commands(axis: Axis, sign: float) -> None:
    axis.lasts(F.VALVE_DISAGREES, 50, applied_v=sign * above(VALVE_V))
    assert all(axis.tick(applied_v=sign * VALVE_V) == [] for _ in range(60))
    for state in (ValveState.BOOT, ValveState.CENTRED, ValveState.TIMED_OUT, ValveState.FAULT):
        assert all(axis.tick(applied_v=1.0, valve_state=int(state)) == [] for _ in range(60))
    axis.engaged = False
    assert all(axis.tick(applied_v=1.0) == [] for _ in range(60))


@pytest.mark.parametrize(("late", "found"), [(0, []), (1, []), (2, []), (3, ["valve_disagrees"])])
def test_a_command_may_take_up_to_two_ticks_to_be_seen(axis: Axis, late: int, found: list[str]) -> None:
    sent = [0.0] * 4
    seen = []
    for n in range(100):
        sent.append(0.1 * n)
        axis.last_v = sent[-1]
        seen = axis.tick(applied_v=sent[-1 - late])
    assert seen == found


def test_a_valve_node_that_is_not_heard_is_believed_to_go_on_as_it_was(axis: Axis) -> None:
    others = int(ALL_SOURCES & ~Source.VALVE)
    assert axis.tick(applied_v=1.0) == []
    for n in range(1, 60):
        fresh = ALL_SOURCES if n % 7 == 0 else others
        assert axis.tick(applied_v=1.0, fresh=fresh) == (["valve_disagrees"] if n >= 50 else [])
    assert axis.tick() == []
    assert all(axis.tick(applied_v=1.0, fresh=others) == [] for _ in range(60))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_position_that_stands_still_under_a_changing_force(axis: Axis, sign: float) -> None:
    x3 = STILL.x3_n + sign * LIMITS.stuck_force_n
    assert all(axis.tick({"x3_n": x3}) == [] for _ in range(60))
    axis.lasts(F.ENCODER_STUCK, 50, e={"x3_n": x3 + sign * 1e-6})
    # one step of the encoder, and the force counts from there
    for n in range(120):
        x = math.nextafter(0.5, 1.0) if n == 40 else axis.w.seen.position_m
        assert axis.tick({"x3_n": x3 + sign * 1e-6}, position_m=x) == []


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("faster", "found"), [(False, []), (True, ["encoder_stuck"])])
def test_a_moving_load_does_not_stand_still_at_once(
    axis: Axis, sign: float, faster: bool, found: list[str]
) -> None:
    # after two ticks: what the hardest braking leaves of the way, against what a reading cannot hide
    h = 2e-3
    least = (LIMITS.still_m + 0.5 * LIMITS.acceleration_m_s2 * h * h) / h
    moving = {"velocity_m_s": sign * least * (1.0 + (1e-9 if faster else -1e-9))}
    axis.tick(moving, position_m=0.5001)
    assert axis.tick(moving, position_m=0.5001) == []  # once may be chance
    assert axis.tick(moving, position_m=0.5001) == found
    assert axis.tick(moving, position_m=0.5002) == []


def test_a_load_that_stands_still_hides_no_jump_of_a_pressure(axis: Axis) -> None:
    moving = {"velocity_m_s": 1.0}
    for _ in range(2):
        assert axis.tick(moving, position_m=0.5001) == []
    assert set(axis.tick(moving, position_m=0.5001, p1_pa=6e5)) == {"encoder_stuck", "pressure_jump"}


def test_a_reading_counts_from_when_it_was_taken(axis: Axis) -> None:
    axis.tick({"velocity_m_s": 1.0}, position_m=0.5001)
    for n in range(1, 20):  # the same sample, handed over again and again
        assert axis.tick({"velocity_m_s": 1.0}, position_m=0.5001, encoder_offset_ns=-n * 1_000_000) == []


def test_a_load_that_could_have_been_stopped_may_stand_still(axis: Axis) -> None:
    axis.tick({"velocity_m_s": 0.05}, position_m=0.5001)
    assert all(axis.tick({"velocity_m_s": 0.0}, position_m=0.5001) == [] for _ in range(60))


def test_a_position_may_stand_still_where_the_axis_is_not_engaged_or_homes(axis: Axis) -> None:
    axis.engaged = False
    assert all(axis.tick({"x3_n": 1e4 * (n % 2)}) == [] for n in range(200))
    axis.engaged, axis.state = True, int(State.HOMING)
    assert all(axis.tick({"x3_n": 1e4}) == [] for n in range(200))


def test_a_position_that_is_not_read_does_not_stand_still_anew(axis: Axis) -> None:
    without = int(Source.VALVE)
    for n in range(60):
        found = axis.tick({"x3_n": STILL.x3_n + 201.0}, position_m=0.1 * n, fresh=without)
        assert found == (["encoder_stuck"] if n >= 50 else [])


@pytest.mark.parametrize("field", ["p1_pa", "p2_pa"])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_pressure_that_stands_still_while_the_load_moves(axis: Axis, field: str, sign: float) -> None:
    other = "p2_pa" if field == "p1_pa" else "p1_pa"
    step = 2.0**-14  # all numbers here are exact
    axis.limits = LIMITS._replace(stuck_travel_m=64 * step)

    def at(n: int) -> dict[str, Any]:
        return {"position_m": 0.5 + sign * n * step, other: 3e5 + 20.0 * (n % 2)}

    for n in range(1, 100):
        assert axis.tick(**at(n)) == (["pressure_stuck"] if n > 64 else []), n
    # one step of the sensor, and the way counts from there
    one_step: dict[str, Any] = {field: 3e5 + 20.0}
    axis.m = axis.m._replace(**one_step)
    assert axis.tick(**at(100)) == []
    assert axis.tick(**at(164)) == []
    assert axis.tick(**at(165)) == ["pressure_stuck"]
    assert axis.tick(**at(165), fresh=int(ALL_SOURCES & ~Source.PRESSURE)) == []
    axis.engaged = False
    assert axis.tick(**at(165)) == []
    axis.engaged = True
    assert axis.tick(**at(229)) == [], "and from where it was engaged"
    assert axis.tick(**at(230)) == ["pressure_stuck"]


@pytest.mark.parametrize(
    ("field", "x", "room", "swing"),
    [
        ("p1_pa", 0.5, 0.5132, 8e6),
        ("p2_pa", 0.5, 0.5158, 9e6),
        ("p1_pa", 0.0, 0.0132, 8e6),
        ("p2_pa", 1.0, 0.0158, 9e6),
        ("p1_pa", -1.0, 0.0132, 8e6),  # wherever it is read, the piston is in the cylinder
        ("p2_pa", 2.0, 0.0158, 9e6),
        ("p1_pa", 2.0, 1.0132, 8e6),
        ("p2_pa", -1.0, 1.0158, 9e6),
    ],
)
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("ms", [1, 10])
def test_a_pressure_changes_no_faster_than_valve_and_piston_make_it(
    axis: Axis, field: str, x: float, room: float, swing: float, sign: float, ms: int
) -> None:
    most = CHAMBER_PA + swing * 1e-3 * ms / room
    axis.engaged = False
    axis.m = axis.m._replace(position_m=x)
    for change, found in ((most - 1.0, []), (most + 1.0, ["pressure_jump"])):
        assert axis.tick() in ([], ["pressure_jump"])
        assert axis.tick() == []
        changed: dict[str, Any] = {field: 3e5 + sign * change}
        assert axis.tick(ms=ms, **changed) == found
        axis.m = axis.m._replace(**changed)
        assert axis.tick() == []
        axis.m = axis.m._replace(p1_pa=3e5, p2_pa=3e5)


@pytest.mark.parametrize("field", ["p1_pa", "p2_pa"])
def test_the_room_for_a_jump_is_met_exactly(field: str) -> None:
    exact = LIMITS._replace(
        dead_length_1_m=0.0, dead_length_2_m=0.0, swing_1_pa_m_s=1_024_000.0, swing_2_pa_m_s=1_024_000.0
    )
    for ms, change, found in (
        (1, 2048.0, []),
        (1, 2048.25, ["pressure_jump"]),
        (0, 0.0, []),
        (0, 0.25, ["pressure_jump"]),
    ):
        axis = Axis(exact)
        assert axis.tick() == []
        changed: dict[str, Any] = {field: 3e5 + CHAMBER_PA + change}
        assert axis.tick(ms=ms, **changed) == found


def test_a_jump_hides_no_pressure_that_stands_still(axis: Axis) -> None:
    far = 0.5 + 2.0 * LIMITS.stuck_travel_m
    for field in ("p1_pa", "p2_pa"):
        jumped: dict[str, Any] = {field: 9e5, "position_m": far}
        assert axis.tick(**jumped) == ["pressure_stuck", "pressure_jump"]
        axis.tick(p1_pa=4e5, p2_pa=4e5)
        axis.tick(p1_pa=3e5, p2_pa=3e5)


def test_a_condition_may_begin_with_the_clock() -> None:
    axis = Axis()
    without = int(ALL_SOURCES & ~Source.VALVE)
    for n in range(60):
        found = axis.tick(ms=min(n, 1), applied_v=1.0, fresh=without if n else int(ALL_SOURCES))
        assert found == (["valve_disagrees"] if n >= 50 else [])
    assert sorted(axis.w.since_ns) == [-1] * (len(axis.w.since_ns) - 1) + [0]


def test_between_readings_a_pressure_has_time_to_change(axis: Axis) -> None:
    without = int(ALL_SOURCES & ~Source.PRESSURE)
    assert all(axis.tick(fresh=without) == [] for _ in range(9))
    assert axis.tick(p1_pa=3e5 + CHAMBER_PA + 10 * 8e3 / 0.5132 - 1.0) == []


def test_the_first_readings_are_no_jump() -> None:
    assert Axis().tick() == []
    axis = Axis()
    assert axis.tick(p1_pa=math.nan, p2_pa=math.nan, supply_pa=math.nan, position_m=math.nan) == []
    assert axis.tick() == []


@pytest.mark.parametrize("engaged", [True, False])
def test_a_supply_that_will_leave_its_limits(axis: Axis, engaged: bool) -> None:
    axis.engaged = engaged
    # the slow pressure is left behind; the supply is extrapolated from the difference
    reach = (LIMITS.supply_min_pa + HORIZON_S / SUPPLY_S * 6e5) / (1.0 + HORIZON_S / SUPPLY_S)
    for n in range(30):
        slow = axis.w.seen.supply_pa
        edge = (LIMITS.supply_min_pa + HORIZON_S / SUPPLY_S * slow) / (1.0 + HORIZON_S / SUPPLY_S)
        if n == 0:
            assert edge == pytest.approx(reach)
        assert axis.tick(supply_pa=edge + 1.0) == []
    for n in range(20):
        slow = axis.w.seen.supply_pa
        edge = (LIMITS.supply_min_pa + HORIZON_S / SUPPLY_S * slow) / (1.0 + HORIZON_S / SUPPLY_S)
        assert axis.tick(supply_pa=edge - 1.0) == (["supply_falling"] if n >= 10 else []), n
    assert axis.tick(supply_pa=6e5) == []


def test_the_slow_supply_follows_with_its_time_constant(axis: Axis) -> None:
    axis.tick(supply_pa=5.9e5)
    assert axis.w.seen.supply_pa == pytest.approx(6e5 - 1e4 * 1e-3 / SUPPLY_S)
    axis.tick(ms=1000, supply_pa=5.5e5)
    assert axis.w.seen.supply_pa == pytest.approx(5.5e5)
    for strange in (math.nan, math.inf):
        axis.tick(supply_pa=strange)
        axis.tick(supply_pa=6e5)
        assert axis.w.seen.supply_pa == 6e5


@pytest.mark.parametrize("engaged", [True, False])
def test_frames_that_cannot_be_sent(axis: Axis, engaged: bool) -> None:
    axis.engaged = engaged
    axis.lasts(F.SEND_BLOCKED, 50, host=int(Host.SEND_FAILED | Host.CLOCK_STEP))
    down = int(Host.SEND_FAILED | Host.LINK_DOWN)
    assert all(axis.tick(host=down) == [] for _ in range(60)), "link_down says it better"


@pytest.mark.parametrize("engaged", [True, False])
def test_ticks_that_all_come_after_skipped_ones(axis: Axis, engaged: bool) -> None:
    axis.engaged = engaged
    axis.lasts(F.OVERLOADED, 1000, skipped=1)
    for _ in range(1500):
        assert axis.tick(skipped=1) in ([], ["overloaded"])
    assert axis.tick() == []
    assert all(axis.tick(skipped=n % 2) == [] for n in range(1500))


def test_several_conditions_last_each_for_itself(axis: Axis) -> None:
    for n in range(60):
        e = {"force_n": 900.0} if n >= 5 else {}
        found = axis.tick(e, applied_v=1.0)
        assert ("valve_disagrees" in found) == (n >= 50)
        assert ("force_disagrees" in found) == (n >= 25)


AT_ONCE = LIMITS._replace(
    saturation_ns=0,
    overload_ns=0,
    supply_ns=0,
    disagreement_ns=0,
    valve_timeout_ns=0,
    sensor_timeout_ns=0,
)


@pytest.mark.parametrize("fresh", [int(ALL_SOURCES), int(ALL_SOURCES & ~Source.VALVE)])
def test_whatever_is_wrong_at_once_is_shown_at_once(axis: Axis, fresh: int) -> None:
    axis.limits = AT_ONCE
    axis.tick(applied_v=1.0)
    axis.limited = 1
    found = axis.tick(
        {"force_n": 1e4, "x3_n": 1e4},
        fresh=fresh,
        position_m=axis.w.seen.position_m,
        p1_pa=9e5,
        supply_pa=4.6e5,
        applied_v=1.0,
        skipped=1,
        host=int(Host.SEND_FAILED),
    )
    lasting = [row.name for row in TABLE if LASTING >> row.bit & 1]
    assert found == names(sum(1 << F[name.upper()] for name in [*lasting, "pressure_jump"]))


@pytest.mark.parametrize("place", range(3))
def test_each_of_the_last_three_commands_may_differ_so_much(place: int) -> None:
    for near, found in ((VALVE_V, []), (above(VALVE_V), ["valve_disagrees"])):
        axis = Axis(AT_ONCE)
        sent = [5.0, 5.0, 5.0]
        sent[place] = near
        axis.last_v = sent[0]
        axis.w = axis.w._replace(seen=axis.w.seen._replace(command_v=sent[1], earlier_v=sent[2]))
        assert axis.tick(applied_v=0.0) == found


def test_no_estimate_shows_nothing(axis: Axis) -> None:
    nothing = dict.fromkeys(Estimate._fields, math.nan)
    assert all(axis.tick(nothing) == [] for _ in range(60))


def test_the_memory_is_plain_numbers(axis: Axis) -> None:
    axis.tick(applied_v=1.0)
    flat = [*axis.w.since_ns, *axis.w.seen]
    assert all(type(value) in (int, float) for value in flat)
    assert isinstance(axis.m, Measurement)


# each check by itself: just inside, on and just outside its limit

SEEN = INITIAL.seen._replace(
    position_m=0.5,
    x3_n=50.0,
    velocity_m_s=0.0,
    p1_pa=3e5,
    p2_pa=3e5,
    changed1_m=0.5,
    changed2_m=0.5,
    supply_pa=6e5,
)
EXACT = LIMITS._replace(
    stuck_travel_m=0.25,
    dead_length_1_m=0.0,
    dead_length_2_m=0.0,
    swing_1_pa_m_s=1_024_000.0,
    swing_2_pa_m_s=2_048_000.0,
    acceleration_m_s2=64.0,
    still_m=0.25,
)


@pytest.mark.parametrize("field", ["changed1_m", "changed2_m"])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_stuck_pressure_is_told_by_the_way_since_it_changed(field: str, sign: float) -> None:
    for way_m, found in ((below(0.25), 0), (0.25, 0), (0.25 + 2.0**-40, 1 << F.PRESSURE_STUCK)):
        changed: dict[str, Any] = {field: 0.5 - sign * way_m}
        w = SEEN._replace(**changed)
        assert watch_module.pressure_stuck(w, GOOD, EXACT) == found
        moved: dict[str, Any] = {field.replace("changed", "p").replace("_m", "_pa"): above(3e5)}
        assert watch_module.pressure_stuck(w, GOOD._replace(**moved), EXACT) == 0


@pytest.mark.parametrize(("field", "swing"), [("p1_pa", 1_024_000.0), ("p2_pa", 2_048_000.0)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_jump_is_told_by_the_time_since_the_pressures_were_read(
    field: str, swing: float, sign: float
) -> None:
    w = SEEN._replace(pressure_ns=7 * MS)
    m = GOOD._replace(t_ns=9 * MS)
    most = CHAMBER_PA + swing * (2 * MS * 1e-9) / 0.5
    for change, found in ((most - 0.25, 0), (most, 0), (most + 0.25, 1 << F.PRESSURE_JUMP)):
        changed: dict[str, Any] = {field: 3e5 + sign * change}
        assert watch_module.pressure_jump(w, m._replace(**changed), EXACT) == found


def test_a_falling_supply_is_told_by_where_it_will_be() -> None:
    limits = LIMITS._replace(supply_min_pa=4.5e5)
    slow = 6e5
    edge = (4.5e5 + HORIZON_S / SUPPLY_S * slow) / (1.0 + HORIZON_S / SUPPLY_S)  # exact: 5.7e5
    for supply, found in ((edge + 1.0, 0), (edge, 0), (edge - 1.0, 1 << F.SUPPLY_FALLING)):
        m = GOOD._replace(supply_pa=supply)
        assert watch_module.supply_falling(SEEN, m, limits) == found


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_load_that_cannot_have_stopped_is_told_by_speed_and_time(sign: float) -> None:
    # after 1/8 s: braking takes 1/2 m off the way
    now = SEEN._replace(still=STILL_READINGS, changed_ns=500 * MS)
    m = GOOD._replace(t_ns=600 * MS, encoder_offset_ns=25 * MS)
    for speed, found in ((5.9375, 0), (6.0, 0), (6.0625, 1 << F.ENCODER_STUCK)):
        moved = now._replace(velocity_m_s=sign * speed)
        assert watch_module.encoder_stuck_in_motion(moved, m, EXACT) == found
        assert watch_module.encoder_stuck_in_motion(moved._replace(still=1), m, EXACT) == 0
        assert watch_module.encoder_stuck_in_motion(moved._replace(still=3), m, EXACT) == found


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_reading_that_stands_under_a_changing_force(sign: float) -> None:
    for change, found in ((199.0, 0), (200.0, 0), (201.0, 1 << F.ENCODER_STUCK)):
        e = STILL._replace(x3_n=50.0 + sign * change)
        tracking, homing = int(State.TRACKING), int(State.HOMING)
        assert watch_module.encoder_stuck_under_force(SEEN, e, tracking, LIMITS) == found
        assert watch_module.encoder_stuck_under_force(SEEN, e, homing, LIMITS) == 0


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_force_between_pressures_and_motion(sign: float) -> None:
    limit = LIMITS.disagreement_n
    for force, found in ((below(limit), 0), (limit, 0), (above(limit), 1 << F.FORCE_DISAGREES)):
        assert watch_module.force_disagrees(STILL._replace(force_n=sign * force), LIMITS) == found


@pytest.mark.parametrize("place", range(3))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_valve_node_follows_one_of_three_commands(place: int, sign: float) -> None:
    for near, found in ((below(VALVE_V), 0), (VALVE_V, 0), (above(VALVE_V), 1 << F.VALVE_DISAGREES)):
        sent = [5.0, 5.0, 5.0]
        sent[place] = sign * near
        w = SEEN._replace(command_v=sent[1], earlier_v=sent[2])
        for before in (False, True):  # once heard, it is what it says
            assert watch_module.valve_disagrees(w, GOOD, sent[0], before) == found
            m = GOOD._replace(valve_state=int(ValveState.CENTRED))
            assert watch_module.valve_disagrees(w, m, sent[0], before) == 0
        silent = GOOD._replace(fresh=int(ALL_SOURCES & ~Source.VALVE))
        assert watch_module.valve_disagrees(w, silent, sent[0], False) == 0
        assert watch_module.valve_disagrees(w, silent, sent[0], True) == 1 << F.VALVE_DISAGREES


def all_at_once(source: Source) -> tuple[int, int]:
    """What is found where only one source is read, and all of it is wrong."""
    w = SEEN._replace(changed2_m=0.0, velocity_m_s=9.0, still=5, command_v=5.0, earlier_v=5.0)
    m = GOOD._replace(fresh=int(source), t_ns=125 * MS, p1_pa=9e6, supply_pa=1e5, applied_v=0.0)
    _, lasting, bits = watch_module.look(w, m, STILL, int(State.TRACKING), True, 5.0, 0, False, EXACT)
    return lasting, bits


def test_each_check_is_made_where_its_source_is_read() -> None:
    assert all_at_once(Source.ENCODER) == (0, 1 << F.ENCODER_STUCK)
    assert all_at_once(Source.PRESSURE) == (
        1 << F.SUPPLY_FALLING,
        1 << F.PRESSURE_STUCK | 1 << F.PRESSURE_JUMP,
    )
    assert all_at_once(Source.VALVE) == (1 << F.VALVE_DISAGREES, 0)


@pytest.mark.parametrize(("state", "found"), [(State.TRACKING, 1 << F.ENCODER_STUCK), (State.HOMING, 0)])
def test_a_load_may_be_pressed_against_the_stop_while_homing(state: State, found: int) -> None:
    e = STILL._replace(x3_n=1e4)
    _, lasting, bits = watch_module.look(SEEN, GOOD, e, int(state), True, 0.0, 0, False, LIMITS)
    assert (lasting, bits) == (found, 0)


@pytest.mark.parametrize("row", [row for row in TABLE if LASTING >> row.bit & 1], ids=lambda row: row.name)
def test_each_condition_lasts_as_long_as_the_table_says(row: Fault) -> None:
    forever = dict.fromkeys((r.debounce for r in TABLE if LASTING >> r.bit & 1), 1 << 60)
    limits = LIMITS._replace(**{**forever, row.debounce: 3 * MS})
    w, bit = INITIAL, 1 << row.bit
    for t_ns, found in ((MS, 0), (4 * MS - 1, 0), (4 * MS, bit), (9 * MS, bit)):
        w, lasted = watch_module.remember(w, SEEN, LASTING, t_ns, limits)
        assert lasted & bit == found
        assert lasted & ~bit in (0, 1 << F.SEND_BLOCKED, 1 << F.VALVE_DISAGREES)  # which share a time
    assert set(w.since_ns) == {MS}
    w, lasted = watch_module.remember(w, SEEN, LASTING & ~bit, 10 * MS, limits)
    assert (sorted(w.since_ns), lasted & bit) == ([-1, *[MS] * 6], 0)
    w, lasted = watch_module.remember(w, SEEN, LASTING, 13 * MS - 1, limits)
    assert (sorted(w.since_ns), lasted & bit) == ([*[MS] * 6, 13 * MS - 1], 0)


def test_the_memory_of_positions_can_be_lost() -> None:
    w = watch_module.forget_position(Watch(INITIAL.since_ns, SEEN))
    assert w.since_ns == INITIAL.since_ns
    gone = [name for name, value in w.seen._asdict().items() if math.isnan(value)]
    assert gone == ["position_m", "changed1_m", "changed2_m"]
    kept = w.seen._replace(position_m=0.5, changed1_m=0.5, changed2_m=0.5)
    assert kept == SEEN


def test_conditions_that_a_single_number_shows() -> None:
    assert [watch_module.saturated_long(n) for n in (0, 1)] == [0, 1 << F.SATURATED_LONG]
    assert [watch_module.overloaded(GOOD._replace(skipped=n)) for n in (0, 1, 2)] == [
        0,
        1 << F.OVERLOADED,
        1 << F.OVERLOADED,
    ]
    failed, down = int(Host.SEND_FAILED), int(Host.LINK_DOWN)
    assert [watch_module.send_blocked(GOOD._replace(host=n)) for n in (0, failed, down, failed | down)] == [
        0,
        1 << F.SEND_BLOCKED,
        0,
        0,
    ]


@pytest.mark.parametrize("engaged", [True, False])
def test_what_is_not_read_stays_as_it_was_seen(engaged: bool) -> None:
    m = Measurement(10 * MS, 0, 0.7, 4e5, 2e5, 5e5, 1.0, 1, 2, 0, 0, 0, 0, 0, 0, -MS, 0, 0)
    e = STILL._replace(x3_n=70.0, velocity_m_s=0.3)
    unread = SEEN._replace(command_v=3.0, earlier_v=2.0)
    assert watch_module.seen(SEEN._replace(command_v=2.0), m, e, engaged, 3.0) == unread
    encoder = watch_module.seen(SEEN, m._replace(fresh=int(Source.ENCODER)), e, engaged, 0.0)
    assert encoder == SEEN._replace(position_m=0.7, x3_n=70.0, velocity_m_s=0.3, changed_ns=9 * MS)
    pressure = watch_module.seen(SEEN, m._replace(fresh=int(Source.PRESSURE)), e, engaged, 0.0)
    assert pressure.supply_pa == pytest.approx(6e5 - 1e5 * 0.01 / SUPPLY_S)
    assert pressure == SEEN._replace(
        p1_pa=4e5,
        p2_pa=2e5,
        pressure_ns=10 * MS,
        changed1_m=0.7,
        changed2_m=0.7,
        supply_pa=pressure.supply_pa,
    )


def test_what_is_read_again_counts_as_still_only_while_the_axis_is_engaged() -> None:
    w = SEEN._replace(still=4, changed_ns=2 * MS)
    m = GOOD._replace(t_ns=10 * MS, encoder_offset_ns=-MS)
    again = watch_module.seen(w, m, STILL, True, 0.0)
    assert (again.still, again.changed_ns) == (5, 2 * MS)
    again = watch_module.seen(w, m, STILL, False, 0.0)
    assert (again.still, again.changed_ns) == (0, 9 * MS)
    moved = m._replace(position_m=0.6)
    one, other = (watch_module.seen(w, moved, STILL, engaged, 0.0) for engaged in (True, False))
    assert (one.changed1_m, one.changed2_m) == (0.5, 0.5)
    assert (other.changed1_m, other.changed2_m) == (0.6, 0.6)
