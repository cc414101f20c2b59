"""The rig's nodes on the bus: timing, arbitration, valve node, truth, the real-time runner."""

from __future__ import annotations

import math
import multiprocessing
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from plant_reference import IDEAL, REALISTIC
from pneud import resources
from pneud.bus.codec import Codecs, load_codecs
from pneud.bus.inbox import Inbox
from pneud.bus.wire import wire_time_ns
from pneud.config.bus_tables import BusConfig
from pneud.rig.answering import serve
from pneud.rig.dynamics import advance, initial_state
from pneud.rig.node import PlantNode
from pneud.rig.transmission import Item, Wire
from pneud.rig.truth import SLOTS, TruthReader, TruthWriter, truth_memory
from pneud.signals import ALL_SOURCES, Frame, ValveState

CODECS: Codecs = load_codecs(BusConfig(), resources.find("pneud.dbc"))
MS = 1_000_000
SYNC_NS, DATA_NS = 60_500, 122_100  # 55 and 111 bits with 10 % stuffing
QUIET = REALISTIC._replace(pressure_noise_pa=0.0)


class Rig:
    """A controller's half of the conversation."""

    def __init__(self, node: PlantNode) -> None:
        self.node = node
        self.ticks = 0
        self.commands = 0

    def sync(self, t_ns: int) -> None:
        self.node.on_frame(Frame(t_ns, 0x080, CODECS.sync.encode(counter=self.ticks % 240 + 1)))
        self.ticks += 1

    def command(self, t_ns: int, volts: float, enable: int = 1) -> None:
        data = CODECS.valve_command.encode(volts, enable, 1, counter=self.commands % 256)
        self.commands += 1
        self.node.on_frame(Frame(t_ns, 0x203, data))

    def answers(self, until_ns: int) -> list[Frame]:
        frames = []
        while (due := self.node.due()) is not None and due <= until_ns:
            frames += self.node.poll(due)
        return frames

    def tick(self, t_ns: int, volts: float, enable: int = 1) -> dict[int, Frame]:
        self.sync(t_ns)
        frames = {frame.can_id: frame for frame in self.answers(t_ns + 600_000)}
        self.command(t_ns + 600_000, volts, enable)
        return frames


def valve_status(frames: dict[int, Frame]) -> tuple[float, int]:
    applied, state = CODECS.valve_status.decode(frames[0x183].data)
    return applied, state


def test_wire_times_are_those_of_a_stuffed_frame() -> None:
    assert (wire_time_ns(1, 1e6), wire_time_ns(8, 1e6), wire_time_ns(8, math.inf)) == (SYNC_NS, DATA_NS, 0)


def test_answers_come_when_and_in_the_order_a_real_bus_delivers_them() -> None:
    rig = Rig(PlantNode(QUIET, CODECS, 1))
    rig.sync(5 * MS)
    frames = rig.answers(6 * MS)
    first = 5 * MS + SYNC_NS + 20_000 + DATA_NS
    assert [(f.can_id, f.stamp_ns) for f in frames] == [
        (0x181, first), (0x182, first + DATA_NS), (0x183, first + 2 * DATA_NS),
    ]  # fmt: skip
    position, status, age = CODECS.encoder.decode(frames[0].data)
    assert (position, status, age) == (pytest.approx(0.4368, abs=1e-9), 1, pytest.approx(2e-5))
    p1, p2, supply = CODECS.pressure.decode(frames[1].data)
    assert (p2, supply) == (3e5, 6e5)
    assert p1 == pytest.approx(initial_state(QUIET).p1, abs=10.0)
    assert valve_status({0x183: frames[2]}) == (0.0, ValveState.BOOT)
    assert all(
        c.valid(f.data)
        for c, f in zip((CODECS.encoder, CODECS.pressure, CODECS.valve_status), frames, strict=True)
    )


def test_nothing_is_handed_out_before_its_transmission_has_ended() -> None:
    node = PlantNode(QUIET, CODECS, 1)
    rig = Rig(node)
    rig.sync(0)
    first = SYNC_NS + 20_000 + DATA_NS
    assert node.due() is not None
    assert node.poll(first - 1) == []
    assert [f.can_id for f in node.poll(first)] == [0x181]
    assert node.due() == first + DATA_NS
    assert [f.can_id for f in node.poll(MS)] == [0x182, 0x183]
    assert node.due() is None


@given(apart_ns=st.integers(1, 400_000), late=st.booleans())
def test_the_inbox_knows_when_a_sync_was_heard_that_waited_for_the_command(apart_ns: int, late: bool) -> None:
    rig, inbox = Rig(PlantNode(QUIET, CODECS, 1)), Inbox(CODECS, BusConfig())
    t_ns = 5 * MS
    for _ in range(3):
        for frame in rig.answers(t_ns):
            inbox.feed(frame)
        rig.sync(t_ns)
        inbox.begin(t_ns)
        frames = rig.answers(t_ns + 700_000)
        for frame in frames:
            inbox.feed(frame)
        m = inbox.measurement(0, 0)
        assert m.fresh == ALL_SOURCES
        assert t_ns + m.encoder_offset_ns + 20_000 + DATA_NS == frames[0].stamp_ns
        command_ns = t_ns + (900_000 if late else 700_000)
        rig.command(command_ns, 0.0, 0)
        inbox.commanded_ns = command_ns
        inbox.thaw(inbox.freeze())
        t_ns = command_ns + apart_ns


def test_without_bus_timing_answers_come_after_the_node_delay_alone() -> None:
    rig = Rig(PlantNode(QUIET._replace(bitrate_bit_s=math.inf), CODECS, 1))
    rig.sync(MS)
    assert [(f.can_id, f.stamp_ns) for f in rig.answers(2 * MS)] == [
        (i, MS + 20_000) for i in (0x181, 0x182, 0x183)
    ]


def test_the_lowest_identifier_wins_but_nothing_interrupts_a_frame() -> None:
    wire = Wire()
    for ready, can_id in ((0, 0x203), (10, 0x183), (20, 0x080), (150, 0x181)):
        wire.add(Item(ready, can_id, 100, None))
    order = []
    while wire.upcoming is not None:
        end, item = wire.take()
        order.append((item.can_id, end))
    assert order == [(0x203, 100), (0x080, 200), (0x181, 300), (0x183, 400)]


def test_a_node_has_one_mailbox_for_a_frame_but_keeps_the_one_under_way() -> None:
    wire = Wire()
    wire.add(Item(0, 0x181, 100, "under way"))
    wire.add(Item(0, 0x182, 100, "old"))
    wire.replace(Item(50, 0x181, 100, "second"))
    wire.replace(Item(60, 0x182, 100, "new"))
    assert [item.load for item in wire.waiting] == ["under way", "second", "new"]


def test_an_overloaded_bus_keeps_a_bounded_queue() -> None:
    rig = Rig(PlantNode(QUIET, CODECS, 1))
    for k in range(500):
        rig.sync(k * 200_000)
        rig.command(k * 200_000 + 150_000, 0.0, 0)
        rig.node.poll(k * 200_000 + 150_000)
    assert len(rig.node._wire.waiting) <= 70


def test_sensors_sample_at_the_end_of_sync_and_truth_is_at_its_send_stamp() -> None:
    p = IDEAL._replace(disturbance=0)
    node = PlantNode(p, CODECS, 1)
    rig = Rig(node)
    rig.sync(0)
    rig.command(300_000, 2.0)
    # answers of the first SYNC keep the wire busy: the command waits for the last of them
    applied_at = SYNC_NS + 20_000 + 3 * DATA_NS + DATA_NS
    sync_at = 80 * MS // 2
    rig.command(20 * MS, 2.0)
    rig.sync(sync_at)
    frames = {f.can_id: f for f in rig.answers(sync_at + MS)}
    s = advance(initial_state(p), 0.0, 0.0, 0.0, applied_at * 1e-9, p)
    s = advance(s, 2.0, 0.0, applied_at * 1e-9, (20 * MS + DATA_NS) * 1e-9, p)
    s = advance(s, 2.0, 0.0, (20 * MS + DATA_NS) * 1e-9, sync_at * 1e-9, p)
    truth = node.truth()
    assert truth.t_ns == sync_at
    assert truth.position_m == pytest.approx(s.x1 - p.cylinder.x_e1, abs=1e-12)
    sampled = advance(s, 2.0, 0.0, sync_at * 1e-9, (sync_at + SYNC_NS) * 1e-9, p)
    position, _, _ = CODECS.encoder.decode(frames[0x181].data)
    assert sampled.v > 0.1
    assert position == pytest.approx(sampled.x1 - p.cylinder.x_e1, abs=0.51e-6)


def test_counters_count_by_one_and_wrap() -> None:
    rig = Rig(PlantNode(QUIET, CODECS, 1))
    seen = [CODECS.pressure.counter(rig.tick(k * MS, 0.0, 0)[0x182].data) for k in range(300)]
    assert seen == [k % 256 for k in range(300)]


def test_noise_is_the_same_for_a_seed() -> None:
    def run(seed: int) -> list[bytes]:
        rig = Rig(PlantNode(REALISTIC, CODECS, seed))
        return [rig.tick(k * MS, 0.3)[0x182].data for k in range(20)]

    assert run(3) == run(3)
    assert run(3) != run(4)


def test_the_valve_node_boots_centred_and_applies_the_dac_value_of_a_command() -> None:
    rig = Rig(PlantNode(QUIET, CODECS, 1))
    lsb = 10.0 / 4096
    assert valve_status(rig.tick(0, 1.0)) == (0.0, ValveState.BOOT)
    applied, state = valve_status(rig.tick(MS, 5.0))
    assert state == ValveState.ENABLED
    assert applied == pytest.approx(round(1.0 / lsb) * lsb, abs=0.25e-3)
    assert valve_status(rig.tick(2 * MS, -0.5, 0))[0] == pytest.approx(5.0 - lsb, abs=0.25e-3)
    assert valve_status(rig.tick(3 * MS, 0.0, 0)) == (0.0, ValveState.CENTRED)


def test_a_silent_controller_centres_the_valve_until_it_disables_once() -> None:
    rig = Rig(PlantNode(QUIET, CODECS, 1))
    rig.tick(0, 2.0)
    assert valve_status(rig.tick(MS, 2.0))[1] == ValveState.ENABLED
    rig.node.poll(50 * MS)
    assert rig.node.valve.state == ValveState.ENABLED
    rig.node.poll(53 * MS)
    assert (rig.node.valve.state, rig.node.valve.output_v) == (ValveState.TIMED_OUT, 0.0)
    assert valve_status(rig.tick(60 * MS, 2.0)) == (0.0, ValveState.TIMED_OUT)
    assert valve_status(rig.tick(61 * MS, 2.0, 0)) == (0.0, ValveState.TIMED_OUT)
    assert valve_status(rig.tick(62 * MS, 2.0, 1)) == (0.0, ValveState.CENTRED)
    assert valve_status(rig.tick(63 * MS, 2.0))[1] == ValveState.ENABLED


def test_syncs_alone_do_not_keep_the_valve_open() -> None:
    rig = Rig(PlantNode(QUIET, CODECS, 1))
    rig.tick(0, 2.0)
    for k in range(1, 60):
        rig.sync(k * MS)
    assert rig.node.valve.state == ValveState.TIMED_OUT


def test_a_stall_of_the_plant_is_no_time_out() -> None:
    node = PlantNode(QUIET, CODECS, 1)
    rig = Rig(node)
    for k in range(200):  # all fed at once, long after they were sent
        rig.sync(k * MS)
        rig.command(k * MS + 600_000, 0.1)
    node.poll(200 * MS)
    assert node.valve.state == ValveState.ENABLED


def test_commands_that_are_not_valid_do_not_count() -> None:
    good = CODECS.valve_command.encode(1.0, 1, 1, counter=5)
    bad_crc = good[:7] + bytes([good[7] ^ 1])
    for data in (bad_crc, good, b"", good[:4]):
        node = PlantNode(QUIET, CODECS, 1)
        node.on_frame(Frame(0, 0x203, good))
        for k in range(1, 70):
            node.on_frame(Frame(k * MS, 0x203, data))
        assert node.valve.state == ValveState.TIMED_OUT, data


def test_frames_of_others_are_ignored() -> None:
    node = PlantNode(QUIET, CODECS, 1)
    for can_id in (0x181, 0x080 | 0x20000000, 0x080 | 0x80000080, 0x80 | 0x40000000):
        node.on_frame(Frame(MS, can_id, bytes(8)))
    assert not node.started
    assert node.due() is None


def test_an_incomplete_sync_is_not_answered() -> None:
    node = PlantNode(QUIET, CODECS, 1)
    node.on_frame(Frame(MS, 0x080, b""))
    assert node.poll(3 * MS) == []


@given(
    st.lists(
        st.tuples(st.integers(-MS, 5 * MS), st.sampled_from([0x80, 0x203, 0x181]), st.binary(max_size=8)),
        max_size=15,
    )
)
def test_no_sequence_of_frames_breaks_the_node(steps: list[tuple[int, int, bytes]]) -> None:
    node = PlantNode(QUIET, CODECS, 1)
    t, last = 0, -1
    for gap, can_id, data in steps:
        t += gap
        node.on_frame(Frame(t, can_id, data))
        for frame in node.poll(t):
            assert last <= frame.stamp_ns
            last = frame.stamp_ns
    assert all(math.isfinite(x) for x in node.state[:8])


def test_the_hook_loses_delays_and_changes_frames_both_ways() -> None:
    seen: list[tuple[int, bool]] = []

    def hook(frame: Frame, outgoing: bool) -> tuple[Frame, ...]:
        seen.append((frame.can_id, outgoing))
        if frame.can_id == 0x181:
            return ()
        if frame.can_id == 0x182:
            return (frame._replace(stamp_ns=frame.stamp_ns + 2 * MS),)
        if frame.can_id == 0x183:
            return (frame, frame._replace(data=bytes(8)))
        return () if frame.can_id == 0x203 else (frame,)

    node = PlantNode(QUIET, CODECS, 1, hook=hook)
    rig = Rig(node)
    rig.command(0, 3.0)
    rig.sync(MS)
    frames = rig.answers(10 * MS)
    assert [f.can_id for f in frames] == [0x183, 0x183, 0x182]
    assert frames[2].stamp_ns == MS + SYNC_NS + 20_000 + 2 * DATA_NS + 2 * MS
    assert node.valve.state == ValveState.CENTRED
    assert (0x203, False) in seen
    assert (0x181, True) in seen


def test_a_force_and_other_parameters_hold_from_when_they_are_set() -> None:
    node = PlantNode(QUIET, CODECS, 1)
    node.advance(0)
    node.force_ext_n = 300.0
    node.advance(50 * MS)
    assert node.state.x1 < 0.449
    node.p = node.p._replace(gas=node.p.gas._replace(supply_pa=5e5))
    rig = Rig(node)
    assert CODECS.pressure.decode(rig.tick(51 * MS, 0.0)[0x182].data)[2] == 5e5


def test_a_late_runner_stays_silent_for_what_it_missed() -> None:
    rig = Rig(PlantNode(QUIET, CODECS, 1))
    for k in range(4):
        rig.sync(k * MS)
    frames = rig.node.poll(4 * MS, current_only=True)
    assert [(f.can_id, f.stamp_ns // MS) for f in frames] == [(0x181, 3), (0x182, 3), (0x183, 3)]
    assert [CODECS.encoder.counter(f.data) for f in frames] == [0, 0, 0]


def test_truth_is_found_by_the_stamp_of_its_sync() -> None:
    memory = truth_memory()
    reader, writer = TruthReader(memory), TruthWriter(memory)
    assert math.isnan(reader.get(0, 10**18))
    for k in range(3 * SLOTS):
        writer.put(k * MS, k * 0.001)
    last = 3 * SLOTS - 1
    assert reader.get((last - 2) * MS - 100, (last - 2) * MS + 100) == (last - 2) * 0.001
    assert reader.get(0, 10**18) == last * 0.001
    assert math.isnan(reader.get((last - SLOTS) * MS, (last - SLOTS) * MS))


def test_truth_is_carried_on_to_an_instant_near_by() -> None:
    memory = truth_memory()
    reader, writer = TruthReader(memory), TruthWriter(memory)
    assert math.isnan(reader.near(0))
    writer.put(10 * MS, 0.5, 0.1, 2.0)
    assert reader.near(10 * MS) == 0.5
    assert reader.near(14 * MS) == pytest.approx(0.5 + 0.4e-3 + 16e-6)
    assert reader.near(8 * MS) == pytest.approx(0.5 - 0.2e-3 + 4e-6)
    assert math.isnan(reader.near(21 * MS))


def test_truth_crosses_a_fork() -> None:
    memory = truth_memory()
    child = multiprocessing.get_context("fork").Process(target=TruthWriter(memory).put, args=(7, 0.25))
    child.start()
    child.join()
    assert TruthReader(memory).get(7, 7) == 0.25


class FakeLink:
    """Sends a SYNC each 2 ms of real time and a command after each full set."""

    def __init__(self) -> None:
        self.rig_counter = 0
        self.next_ns = time.monotonic_ns()
        self.synced_ns = 0
        self.sent: list[tuple[int, int, bytes]] = []  # (time since SYNC, identifier, data)
        self.incoming: list[Frame] = []

    def watch_clock(self) -> int:
        return 0

    def drain(self, into: list[Frame]) -> int:
        now = time.monotonic_ns()
        if now >= self.next_ns and self.rig_counter < 20:
            self.rig_counter += 1
            self.synced_ns = now
            self.incoming.append(Frame(now, 0x080, CODECS.sync.encode(counter=self.rig_counter)))
            self.incoming.append(
                Frame(now, 0x203, CODECS.valve_command.encode(0.0, 1, 1, counter=self.rig_counter))
            )
            self.next_ns += 2 * MS
        count = len(self.incoming)
        into += self.incoming
        self.incoming.clear()
        return count

    def send(self, can_id: int, data: bytes) -> int:
        now = time.monotonic_ns()
        self.sent.append((now - self.synced_ns, can_id, data))
        return now

    def wait(self, timeout_s: float) -> bool:
        assert timeout_s >= 0.0
        time.sleep(min(timeout_s, 1e-3))
        return False


def test_the_runner_answers_sends_nothing_early_and_tells_of_the_time_out() -> None:
    link, node = FakeLink(), PlantNode(QUIET, CODECS, 1)
    memory = truth_memory()
    states: list[ValveState] = []
    serve(
        link, node,
        stop=lambda: ValveState.TIMED_OUT in states,
        truth=TruthWriter(memory), on_valve_state=states.append,
    )  # fmt: skip
    assert states[-1] == ValveState.TIMED_OUT
    assert states[-2] == ValveState.ENABLED
    answered = [data for _, can_id, data in link.sent if can_id == 0x181]
    assert answered
    first = SYNC_NS + 20_000 + DATA_NS
    for since_ns, can_id, _ in link.sent:
        assert since_ns >= first + (can_id - 0x181) * DATA_NS
    assert [CODECS.encoder.counter(data) for data in answered] == list(range(len(answered)))
    assert TruthReader(memory).get(0, 1 << 62) == pytest.approx(node.truth().position_m)
