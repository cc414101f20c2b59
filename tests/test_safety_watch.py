"""What takes a memory to see: each limit just inside, on and just outside, and how long it has to last."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest

from pneud.safety.checks import Limits
from pneud.safety.faults import TABLE, F, names
from pneud.safety.watch import CHAMBER_PA, HORIZON_S, INITIAL, LASTING, SUPPLY_S, VALVE_V, Watch
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
