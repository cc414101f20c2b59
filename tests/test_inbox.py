"""The inbox: only frames of this tick with a right checksum and a moving counter make a measurement."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pneud import resources
from pneud.bus.codec import load_codecs
from pneud.bus.inbox import NEVER_NS, Counts, Inbox
from pneud.bus.wire import CAN_ERR_FLAG, wire_time_ns
from pneud.config.bus_tables import BusConfig, FrameConfig, FramesConfig
from pneud.signals import ALL_SOURCES, Defect, Frame, Host, Measurement, Source

BUS = BusConfig()
FREE = BusConfig(sync=False)
CODECS = load_codecs(BUS, resources.configs() / "pneud.dbc")
MS = 1_000_000
ENCODER, PRESSURE, VALVE = CODECS.encoder, CODECS.pressure, CODECS.valve_status


def encoder(stamp: int, counter: int, position: float = 0.25, age: float = 0.0, status: int = 1) -> Frame:
    return Frame(stamp, ENCODER.can_id, ENCODER.encode(position, status, age, counter=counter & 255))


def pressure(stamp: int, counter: int, p1: float = 3e5) -> Frame:
    return Frame(stamp, PRESSURE.can_id, PRESSURE.encode(p1, 2e5, 6e5, counter=counter & 255))


def valve(stamp: int, counter: int, applied: float = 1.5, state: int = 2) -> Frame:
    return Frame(stamp, VALVE.can_id, VALVE.encode(applied, state, counter=counter & 255))


def broken(frame: Frame) -> Frame:
    return frame._replace(data=frame.data[:-1] + bytes((frame.data[-1] ^ 1,)))


def tick(inbox: Inbox, t_ns: int, *frames: Frame) -> Measurement:
    inbox.begin(t_ns)
    for frame in frames:
        inbox.feed(frame)
    return inbox.measurement(0, 0)


def a_set(t_ns: int, counter: int) -> tuple[Frame, Frame, Frame]:
    return encoder(t_ns + 1000, counter), pressure(t_ns + 2000, counter), valve(t_ns + 3000, counter)


def test_a_set_is_complete_and_carries_the_values() -> None:
    inbox = Inbox(CODECS, BUS)
    inbox.begin(MS)
    complete = [inbox.complete]
    for frame in a_set(MS, 7):
        inbox.feed(frame)
        complete.append(inbox.complete)
    assert complete == [False, False, False, True]
    m = inbox.measurement(skipped=3, host=5)
    assert m == Measurement(
        MS, ALL_SOURCES, 0.25, 3e5, 2e5, 6e5, 1.5, 1, 2, 0, 0, 0, 0, 0, 0, wire_time_ns(1, 1e6), 3, 5
    )
    assert inbox.complete is False
    assert inbox.counts() == Counts(3, 0, 0, 0, 0, 0, 0, ())


def test_before_anything_was_heard_values_are_unknown_and_infinitely_old() -> None:
    m = tick(Inbox(CODECS, BUS), MS)
    assert m.fresh == 0
    floats = (m.position_m, m.p1_pa, m.p2_pa, m.supply_pa, m.applied_v)
    assert all(math.isnan(value) for value in floats)
    assert (m.encoder_status, m.valve_state) == (0, 0)
    assert {m.encoder_age_ns, m.pressure_age_ns, m.valve_age_ns} == {NEVER_NS}
    assert (m.encoder_defects, m.pressure_defects, m.valve_defects) == (0, 0, 0)


def test_an_absent_source_keeps_its_value_and_ages() -> None:
    inbox = Inbox(CODECS, BUS)
    tick(inbox, MS, *a_set(MS, 1))
    m = tick(inbox, 3 * MS, pressure(3 * MS + 10, 2), valve(3 * MS + 20, 2))
    assert m.fresh == Source.PRESSURE | Source.VALVE
    assert m.position_m == 0.25
    assert m.encoder_age_ns == 2 * MS - 1000
    assert (m.pressure_age_ns, m.valve_age_ns) == (0, 0)


@pytest.mark.parametrize(
    ("damage", "defect", "counted"),
    [
        (broken, Defect.CORRUPT, "crc"),
        (lambda f: f._replace(data=f.data[:7]), Defect.CORRUPT, "crc"),
        (lambda f: f._replace(data=b""), Defect.CORRUPT, "crc"),
        (lambda f: encoder(f.stamp_ns, 1, 0.5), Defect.FROZEN, "stale"),
        (lambda f: f._replace(stamp_ns=2 * MS - 1), Defect.LATE, "late"),
        (lambda f: encoder(2 * MS + 10_000, 2, 0.5, age=2e-5), Defect.LATE, "late"),
        (lambda f: encoder(9 * MS, 2, 0.5, age=0.00255), Defect.LATE, "late"),
    ],
)
def test_a_bad_frame_is_not_used_but_told(damage: Any, defect: Defect, counted: str) -> None:
    inbox = Inbox(CODECS, BUS)
    tick(inbox, MS, *a_set(MS, 1))
    m = tick(inbox, 2 * MS, damage(encoder(2 * MS + 1000, 2, 0.5)))
    assert m.fresh == 0
    assert m.position_m == 0.25
    assert m.encoder_defects == defect
    assert (m.pressure_defects, m.valve_defects) == (0, 0)
    assert inbox.counts()._asdict()[counted] == 1
    good = tick(inbox, 3 * MS, encoder(3 * MS + 1000, 3, 0.75))
    assert (good.position_m, good.encoder_defects) == (0.75, 0), "a valid frame ends the complaint"


def test_defects_add_up_until_a_valid_frame() -> None:
    inbox = Inbox(CODECS, BUS)
    tick(inbox, MS, *a_set(MS, 1))
    tick(inbox, 2 * MS, broken(encoder(2 * MS + 1, 2)))
    m = tick(inbox, 3 * MS, encoder(3 * MS + 1, 1), encoder(0, 2))
    assert m.encoder_defects == Defect.CORRUPT | Defect.FROZEN | Defect.LATE


def test_a_frame_sampled_exactly_at_sync_is_in_time() -> None:
    inbox = Inbox(CODECS, BUS)
    assert tick(inbox, MS, encoder(MS + 20_000, 1, age=2e-5)).fresh == Source.ENCODER


def test_what_is_left_over_from_the_last_tick_updates_nothing() -> None:
    inbox = Inbox(CODECS, BUS)
    tick(inbox, MS, *a_set(MS, 1))
    inbox.feed(encoder(MS + 900_000, 2, 0.9))  # after measurement(), before begin()
    m = tick(inbox, 2 * MS)
    assert (m.fresh, m.position_m, m.encoder_defects) == (0, 0.25, Defect.LATE)
    assert inbox.counts().late == 1
    assert tick(inbox, 3 * MS, *a_set(3 * MS, 3)).fresh == ALL_SOURCES
    assert inbox.counts().lost == 2, "the late frame itself was not lost; pressure and valve missed one each"


def test_the_last_of_two_frames_in_one_tick_counts() -> None:
    inbox = Inbox(CODECS, BUS)
    m = tick(inbox, MS, encoder(MS + 1, 1, 0.1), encoder(MS + 2, 2, 0.2))
    assert m.position_m == ENCODER.decode(encoder(0, 0, 0.2).data)[0]


def test_the_first_counter_is_taken_and_later_ones_wrap() -> None:
    inbox = Inbox(CODECS, BUS)
    for i in range(600):
        t = (i + 1) * MS
        assert tick(inbox, t, *a_set(t, i + 250)).fresh == ALL_SOURCES
    assert inbox.counts() == Counts(1800, 0, 0, 0, 0, 0, 0, ())


def test_gaps_in_the_counter_are_lost_frames() -> None:
    inbox = Inbox(CODECS, BUS)
    for t, counter in ((1, 254), (2, 1), (3, 2), (4, 12)):
        tick(inbox, t * MS, encoder(t * MS + 1, counter))
    assert inbox.counts().lost == 2 + 9


def test_two_counters_under_one_identifier_lose_nothing() -> None:
    inbox = Inbox(CODECS, BUS)
    for i in range(1, 400):
        t = i * MS
        one, other = encoder(t + 1, i), encoder(t + 2, i + 100)
        tick(inbox, t, one, other, pressure(t + 3, i), valve(t + 4, i))
    assert inbox.counts().lost <= 256, "only those of the tick under way are in doubt"
    for i in range(400, 500):
        t = i * MS
        tick(inbox, t, *a_set(t, i))
    assert inbox.counts().lost <= 1


def test_a_frame_lost_after_a_clash_is_counted_again() -> None:
    inbox = Inbox(CODECS, BUS)
    for i in range(1, 40):
        tick(inbox, i * MS, encoder(i * MS + 1, i), encoder(i * MS + 2, i + 100))
    for i in range(40, 400):
        tick(inbox, i * MS, encoder(i * MS + 1, i))
    before = inbox.counts().lost
    tick(inbox, 400 * MS, encoder(400 * MS + 1, 403))
    assert inbox.counts().lost == before + 3


def test_corrupt_frames_are_not_lost_ones() -> None:
    inbox = Inbox(CODECS, BUS)
    frames = [encoder(MS + i, i) for i in range(6)]
    tick(inbox, MS, frames[0], broken(frames[1]), broken(frames[2]), frames[4])
    assert inbox.counts()._replace(rx=0) == Counts(0, 1, 2, 0, 0, 0, 0, ())


def test_free_running_takes_what_came_since_the_last_measurement() -> None:
    inbox = Inbox(CODECS, FREE)
    inbox.feed(encoder(MS - 5000, 1, 0.5, age=3e-5))
    m = tick(inbox, MS, pressure(MS + 1, 1))
    assert m.fresh == Source.ENCODER | Source.PRESSURE
    assert m.encoder_age_ns == 0
    assert m.encoder_offset_ns == -5000 - 30_000 - wire_time_ns(8, 1e6)
    m = tick(inbox, 2 * MS)
    assert m.fresh == 0
    assert m.encoder_age_ns == MS + 5000 + 30_000
    assert m.encoder_defects == 0


def test_free_running_does_not_take_frames_older_than_can_be_told() -> None:
    inbox = Inbox(CODECS, FREE)
    m = tick(inbox, MS, encoder(MS, 1, age=0.00255))
    assert (m.fresh, m.encoder_defects, m.encoder_age_ns) == (0, Defect.LATE, NEVER_NS)


def test_wire_time_is_that_of_the_bit_rate() -> None:
    assert wire_time_ns(1, 1e6) == 60_500
    assert wire_time_ns(8, 5e5) == 244_200
    assert wire_time_ns(8, math.inf) == 0
    inbox = Inbox(CODECS, BusConfig(bitrate_bit_s=math.inf))
    assert tick(inbox, MS, *a_set(MS, 1)).encoder_offset_ns == 0


@pytest.mark.parametrize(
    ("commanded_ns", "delay_ns"),
    [(MS - 122_100, 0), (MS - 122_099, 1), (MS - 1, 122_099), (MS, 0), (MS + 7, 7), (-1, 0)],
)
def test_sync_waits_for_the_end_of_the_own_command(commanded_ns: int, delay_ns: int) -> None:
    inbox = Inbox(CODECS, BUS)
    inbox.commanded_ns = commanded_ns
    assert tick(inbox, MS, *a_set(MS, 1)).encoder_offset_ns == 60_500 + delay_ns
    again = Inbox(CODECS, BUS)
    again.thaw(inbox.freeze())
    assert tick(again, MS, *a_set(MS, 2)).encoder_offset_ns == 60_500 + delay_ns


def test_frames_of_others_are_told_apart() -> None:
    inbox = Inbox(CODECS, BUS)
    inbox.begin(0)
    command = CODECS.valve_command.encode(1.0, 1, 1, counter=0)
    for frame in (
        Frame(1, CODECS.sync.can_id, b"\x01"),
        Frame(1, CODECS.valve_command.can_id, command),
        Frame(1, 0x20000000 | 0x40, bytes(8)),  # error frame
        Frame(1, 0x40000000 | ENCODER.can_id, b""),  # remote request
        Frame(1, 0x80000000 | ENCODER.can_id, encoder(1, 1).data),  # 29-bit identifier
        Frame(1, 0x082, b"\x20\x81\x01" + bytes(5)),
        Frame(1, 0x081, b"\x00\x50\x01" + bytes(5)),
        Frame(1, 0x082, b"\x00\x00\x00" + bytes(5)),
        Frame(1, 0x701, b"\x05"),
        Frame(1, 0x7FF, b""),
    ):
        inbox.feed(frame)
    assert inbox.counts() == Counts(9, 0, 0, 0, 0, 2, 1, ((1, 0x5000), (2, 0)))
    m = inbox.measurement(0, 0)
    assert m.fresh == 0
    assert m.encoder_age_ns == NEVER_NS


ids = st.one_of(
    st.sampled_from([ENCODER.can_id, PRESSURE.can_id, VALVE.can_id, 0x080, 0x203, 0x081]),
    st.integers(0, 2**32 - 1),
)
noise = st.builds(Frame, st.integers(-(2**40), 2**62), ids, st.binary(max_size=8))
proper = st.builds(
    lambda make, stamp, counter: make(stamp, counter),
    st.sampled_from([encoder, pressure, valve]),
    st.integers(0, 20 * MS),
    st.integers(0, 255),
)
damaged = proper.map(broken)
steps = st.lists(
    st.one_of(noise, proper, damaged, st.integers(1, 15).map(lambda k: k * MS), st.none()), max_size=60
)


@pytest.mark.parametrize("bus", [BUS, FREE], ids=["sync", "free"])
@given(steps=steps)
def test_any_sequence_is_digested_twice_alike_and_only_valid_frames_are_used(
    bus: BusConfig, steps: list[Any]
) -> None:
    one, two = Inbox(CODECS, bus), Inbox(CODECS, bus)
    valid = {PRESSURE.can_id: set(), VALVE.can_id: set(), ENCODER.can_id: set()}  # type: ignore[var-annotated]
    began = None
    for step in steps:
        if step is None:
            m = one.measurement(0, 0)
            assert repr(m) == repr(two.measurement(0, 0))
            for value, can_id in (
                (m.position_m, ENCODER.can_id),
                (m.p1_pa, PRESSURE.can_id),
                (m.applied_v, VALVE.can_id),
            ):
                assert math.isnan(value) or value in valid[can_id]
            if bus.sync and began is None:
                assert m.fresh == 0
            began = None
        elif isinstance(step, int):
            one.begin(step)
            two.begin(step)
            began = step
        else:
            one.feed(step)
            two.feed(step)
            codec = {c.can_id: c for c in (ENCODER, PRESSURE, VALVE)}.get(step.can_id)
            in_time = not bus.sync or (began is not None and step.stamp_ns >= began)
            if codec is not None and codec.valid(step.data) and in_time:
                valid[step.can_id].add(codec.decode(step.data)[0])
    assert one.counts() == two.counts()
    fed = sum(isinstance(step, Frame) for step in steps)
    assert one.counts().rx + one.counts().error_frames == fed


@given(st.lists(st.tuples(st.integers(0, 255), st.booleans()), min_size=1, max_size=80))
def test_counters_account_for_every_frame(moves: list[tuple[int, bool]]) -> None:
    inbox = Inbox(CODECS, BUS)
    inbox.begin(0)
    seen: int | None = None
    stale = used = 0
    for counter, damage in moves:
        frame = encoder(1, counter)
        inbox.feed(broken(frame) if damage else frame)
        if not damage:
            stale += counter == seen
            used += counter != seen
            seen = counter
    counts = inbox.counts()
    assert counts.stale == stale
    assert counts.crc == sum(damage for _, damage in moves)
    assert bool(inbox.measurement(0, 0).fresh) is bool(used)


def emcy(node: int, code: int) -> Frame:
    return Frame(MS, 0x080 + node, code.to_bytes(2, "little") + bytes(6))


@pytest.mark.parametrize("node", [1, 2, 3])
def test_an_emergency_of_a_node_of_the_axis_holds_until_it_is_reset(node: int) -> None:
    inbox = Inbox(CODECS, BUS)
    inbox.feed(emcy(4, 0x1000))
    assert inbox.conditions == 0, "node 4 belongs to somebody else"
    inbox.feed(emcy(node, 0x5000))
    assert inbox.conditions == Host.EMERGENCY
    inbox.feed(emcy(node % 3 + 1, 0))
    assert inbox.conditions == Host.EMERGENCY
    inbox.feed(emcy(node, 0))
    assert inbox.conditions == 0
    inbox.feed(emcy(node, 0x5000))
    inbox.feed(Frame(MS, 0x700 + node, b"\x05"))
    assert inbox.conditions == Host.EMERGENCY
    inbox.feed(Frame(MS, 0x700 + node, b"\x00"))
    assert inbox.conditions == 0, "it has booted"


def test_heartbeats_are_waited_for_only_where_they_are_configured() -> None:
    inbox = Inbox(CODECS, BUS)
    for n in range(100):
        inbox.begin(n * 1000 * MS)
    assert inbox.conditions == 0

    frames = FramesConfig(
        pressure=BUS.frames.pressure.model_copy(update={"heartbeat_timeout_ms": 100.0}),
        valve_status=BUS.frames.valve_status.model_copy(update={"heartbeat_timeout_ms": 200.0}),
    )
    inbox = Inbox(CODECS, BUS.model_copy(update={"frames": frames}))

    def lost(ms: int) -> bool:
        inbox.begin(ms * MS)
        return inbox.conditions == Host.HEARTBEAT_LOST

    def beat(node: int, ms: int, state: int = 5) -> None:
        inbox.feed(Frame(ms * MS, 0x700 + node, bytes((state,))))

    assert [lost(1000), lost(1100), lost(1101)] == [False, False, True]
    beat(2, 1150)
    assert [lost(1151), lost(1200), lost(1201)] == [False, False, True]
    beat(3, 1210)
    beat(1, 1210)
    assert [lost(1211), lost(1250), lost(1251)] == [False, False, True]
    beat(2, 1260)
    assert not lost(1261)
    for state in (0, 4, 127):
        beat(3, 1262, state)
        assert lost(1262), "one that is not operational sends no measurements"
        beat(3, 1263, 0x80 | 5)  # node guarding toggles the highest bit
        assert not lost(1263)
    inbox.feed(Frame(1400 * MS, 0x702, b""))
    assert lost(1400)


def error(can_id: int, second: int = 0) -> Frame:
    return Frame(MS, CAN_ERR_FLAG | can_id, bytes((0, second, 0, 0, 0, 0, 0, 0)))


@pytest.mark.parametrize("passive", [0x10, 0x20, 0x30])
@pytest.mark.parametrize("better", [0x40, 0x04, 0x08, 0x0C])
def test_an_error_passive_controller_is_so_until_it_says_otherwise(passive: int, better: int) -> None:
    inbox = Inbox(CODECS, BUS)
    inbox.feed(error(0x004, better))
    inbox.feed(error(0x004, 0x01))  # a receive buffer of its own has overflowed
    inbox.feed(Frame(MS, CAN_ERR_FLAG | 0x004, b"\x00"))
    assert inbox.conditions == 0
    inbox.feed(error(0x004, passive))
    inbox.feed(error(0x004, 0x03))
    inbox.feed(error(0x088, passive))  # bus error, protocol violation: says nothing about the state
    assert inbox.conditions == Host.BUS_PASSIVE
    inbox.feed(error(0x004, better))
    assert inbox.conditions == 0
    assert inbox.counts().error_frames == 7


def test_bus_off_ends_with_a_restart() -> None:
    inbox = Inbox(CODECS, BUS)
    inbox.feed(error(0x004, 0x30))
    inbox.feed(error(0x040))
    assert inbox.conditions == Host.BUS_PASSIVE | Host.BUS_OFF
    inbox.feed(error(0x100))
    assert inbox.conditions == 0
    inbox.feed(error(0x044, 0x30))
    inbox.feed(emcy(1, 7))
    inbox.bus_restarted()
    assert inbox.conditions == Host.EMERGENCY, "a node's emergency outlives the interface"


def test_two_devices_with_one_identifier_clash() -> None:
    inbox = Inbox(CODECS, BUS)
    count = 0
    clashed = []
    for n in range(1, 41):
        inbox.begin(n * MS)
        clashed.append(inbox.conditions == Host.IDENTIFIER_CLASH)
        for _ in range(2 if n < 20 else 1):
            count += 1
            inbox.feed(pressure(n * MS + 1, count))
        inbox.measurement(0, 0)
    first = clashed.index(True)
    assert 8 < first < 20
    assert all(clashed[first:])
    for n in range(41, 61):
        inbox.begin(n * MS)
    assert inbox.conditions == 0


def test_a_clash_that_has_ended_is_forgotten_while_frames_go_on() -> None:
    inbox = Inbox(CODECS, BUS)
    count = 0
    clashed = []
    for n in range(1, 700):
        inbox.begin(n * MS)
        clashed.append(inbox.conditions == Host.IDENTIFIER_CLASH)
        for _ in range(2 if n < 400 else 1):
            count += 1
            inbox.feed(pressure(n * MS + 1, count))
        inbox.measurement(0, 0)
    assert all(clashed[20:500])
    assert not any(clashed[600:])


def test_frames_that_come_late_or_not_at_all_are_no_clash() -> None:
    inbox = Inbox(CODECS, BUS)
    count = 0
    for n in range(1, 2000):
        late = n % 3 == 0
        for _ in range(2 if n % 3 == 1 else 0 if late else 1):  # what is late comes with the next
            count += 1
            inbox.feed(pressure(n * MS, count))
        inbox.begin(n * MS)
        assert inbox.conditions == 0
    for n in range(2000, 2100):  # nothing comes at all
        inbox.begin(n * MS)
    for n in range(2100, 2200):
        count += 1
        inbox.begin(n * MS)
        inbox.feed(pressure(n * MS + 1, count))
        assert inbox.conditions == 0


def test_devices_that_send_by_themselves_may_send_as_often_as_they_like() -> None:
    inbox = Inbox(CODECS, FREE)
    for n in range(100):
        inbox.begin(n * MS)
        for k in range(5):
            inbox.feed(pressure(n * MS + k, 5 * n + k))
    assert inbox.conditions == 0


def test_a_heartbeat_needs_a_node() -> None:
    with pytest.raises(ValueError, match="heartbeat_timeout_ms needs node"):
        FrameConfig(message="X", heartbeat_timeout_ms=100.0)
