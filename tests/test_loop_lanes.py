"""The loop over several axes: one SYNC, one wait for all answers, a command and a record for each."""

from __future__ import annotations

import time
from itertools import takewhile
from typing import Any

import pytest

from pneud.axis.cycle import Axis
from pneud.bus.inbox import Inbox
from pneud.bus.link import Link
from pneud.config import conversions
from pneud.loading import load
from pneud.log.live.ring import Ring
from pneud.loop.lane import Lane
from pneud.loop.loop import Loop
from pneud.loop.options import Options
from pneud.loop.recorder_watch import RecorderWatch
from pneud.loop.turn import END_TICKS, Turn
from pneud.rig.node import PlantNode
from pneud.safety.faults import F
from pneud.safety.supervisor import is_engaged
from pneud.signals import Frame, Host, Record, State

RATE_HZ = 100.0
LOADED = load("virtual.toml", None, {"loop": {"rate_hz": RATE_HZ}})
SYNC, COMMAND = LOADED.codecs.sync, LOADED.codecs.valve_command
OPTIONS = Options(RATE_HZ, 0.8, 0.0, auto_arm=True, duration_s=0.8, end_on_fault=True, no_realtime=False)


class Carrier:
    """The software rig in this process; of several commands in a tick it takes the first."""

    dropped = 0

    def __init__(self) -> None:
        self.node = PlantNode(conversions.plant_of(LOADED.config), LOADED.codecs, 0)
        self.sent: list[Frame] = []

    def fileno(self) -> int:
        return 0

    def drain(self, _: int, into: list[Frame], wait_ns: int = 0) -> int:
        if wait_ns:
            time.sleep(min(wait_ns, 100_000) * 1e-9)
        frames = self.node.poll(time.monotonic_ns())
        into.extend(frames)
        return len(frames)

    def send(self, can_id: int, data: bytes) -> None:
        frame = Frame(time.monotonic_ns(), can_id, data)
        if SYNC.can_id in (can_id, *(frame.can_id for frame in self.sent[-1:])):
            self.node.on_frame(frame)
        self.sent.append(frame)

    def close(self) -> None:
        pass


class Kept(Ring):
    """Keeps what is put."""

    records: list[Record]
    fails_at = -1

    def put(self, record: Record) -> None:
        self.records.append(record)
        if len(self.records) == self.fails_at:
            raise RuntimeError("no more")


def lane(link: Link, options: Options = OPTIONS) -> Lane:
    axis = Axis(conversions.axis_of(LOADED.config, LOADED.codecs.command_lsb_v))
    ring = Kept.create(slots=8)
    ring.records = []  # type: ignore[attr-defined]
    turn = Turn(axis, Inbox(LOADED.codecs, LOADED.config.bus), LOADED.codecs)
    return Lane(turn, link, RecorderWatch(ring, 0), options)


def records(of: Lane) -> list[Record]:
    kept: Any = of.recorder.ring
    return list(kept.records)


@pytest.mark.parametrize("axes", [1, 2, 3])
def test_one_sync_and_a_command_for_each_axis_in_every_tick(axes: int) -> None:
    carrier = Carrier()
    link = Link("here", carrier)
    lanes = [lane(link) for _ in range(axes)]
    Loop(lanes, LOADED.codecs, link, OPTIONS).run()
    ticks = len(records(lanes[0]))
    assert [frame.can_id for frame in carrier.sent] == [SYNC.can_id, *[COMMAND.can_id] * axes] * ticks
    for other in lanes[1:]:
        assert [r.frames for r in records(other)] == [r.frames for r in records(lanes[0])]
    # all have heard the same, so all say the same, until a command has held up a SYNC that came late
    found = ([r.tick.measurement.encoder_offset_ns for r in records(one)] for one in lanes)
    alike = sum(1 for _ in takewhile(lambda offsets: len(set(offsets)) == 1, zip(*found, strict=True)))
    for other in lanes[1:]:
        assert [r.tick for r in records(other)][:alike] == [r.tick for r in records(lanes[0])][:alike]
    for n in range(alike):
        now = carrier.sent[n * (axes + 1) : (n + 1) * (axes + 1)]
        assert len({frame.data for frame in now[1:]}) == 1
        assert COMMAND.decode(now[1].data)[2] == SYNC.counter(now[0].data)
    tally = lanes[0].tally
    skips = [r.tick.measurement.skipped for r in records(lanes[0])]
    assert tally.skipped == sum(skips[: tally.ticks + 1])  # with a stall at the very end
    assert 0 <= tally.ticks + sum(skips[: tally.ticks]) - round(RATE_HZ * 0.8) <= max(skips)
    assert any(r.tick.state == State.TRACKING for r in records(lanes[0]))
    for one in lanes:  # what it has done, and what came and went, is said to the very end
        counted = one.turn.inbox.counts()
        assert one.recorder.ring.mileage == one.turn.axis.mileage
        assert one.recorder.ring.mileage.engaged_s > 0.2
        assert one.recorder.ring.frames[:1] == (counted.rx,)
        assert one.recorder.ring.frames.tx == len(carrier.sent)


def test_a_run_that_is_to_arm_does_not_ask_before_it_can() -> None:
    one = lane(Link("here", Carrier()))
    one.prepare(0, ending=False)
    assert one.waits
    assert one.request is None


def test_a_loop_that_follows_sends_no_sync_and_misses_it_when_its_patience_is_over() -> None:
    options = OPTIONS._replace(duration_s=0.15, follow_s=0.06, auto_arm=False)
    carrier = Carrier()
    link = Link("here", carrier)
    one = lane(link, options)
    Loop([one], LOADED.codecs, link, options).run()
    assert {frame.can_id for frame in carrier.sent} == {COMMAND.can_id}
    ticks = [record.tick for record in records(one)]
    lost = [tick.t_ns for tick in ticks if tick.measurement.host & Host.SYNC_LOST]
    assert lost
    assert lost[0] - ticks[0].t_ns >= 0.04e9  # from when it has begun to wait


class Nodes:
    """Of two axes; the second one's are not ready any more as soon as both are engaged, until neither is."""

    lost = quiet = False

    def __init__(self, lanes: list[Lane]) -> None:
        self.lanes, self.missing = lanes, False

    def engaged(self) -> list[bool]:
        return [bool(records(one)) and is_engaged(one.turn.tick.state) for one in self.lanes]

    @property
    def ready(self) -> bool:
        self.missing = all(self.engaged()) or (self.missing and not self.quiet)
        return not self.missing

    def is_ready(self, axis: int) -> bool:
        return axis == 0 or not self.missing

    def look(self) -> None:
        pass


def test_nodes_that_are_not_ready_stop_the_axis_whose_they_are_and_no_other() -> None:
    carrier = Carrier()
    link = Link("here", carrier)
    lanes = [lane(link), lane(link)]
    Loop(lanes, LOADED.codecs, link, OPTIONS._replace(duration_s=0.5), Nodes(lanes)).run()
    lost = 1 << F.HEARTBEAT_LOST
    assert [one.tally.ever_latched & lost for one in lanes] == [0, lost]
    assert lanes[0].tally.state == State.TRACKING
    at = next(n for n, r in enumerate(records(lanes[1])) if r.tick.present & lost)
    syncs = [frame for frame in carrier.sent if frame.can_id == SYNC.can_id]
    assert len(syncs) > at + 10  # the bus is the other one's, as long as it needs it


def fail(one: Lane) -> None:
    """From now on every cycle does."""
    axis: Any = one.turn.axis
    axis._cycle = None


@pytest.mark.slow
def test_an_axis_with_a_fault_does_not_end_the_run_of_another() -> None:
    carrier = Carrier()
    link = Link("here", carrier)
    lanes = [lane(link), lane(link)]
    fail(lanes[1])
    Loop(lanes, LOADED.codecs, link, OPTIONS).run()
    assert lanes[0].tally.ticks + lanes[0].tally.skipped == pytest.approx(RATE_HZ * 0.8, abs=1)
    assert lanes[1].tally.state == State.FAULT
    alone = [lane(link)]
    fail(alone[0])
    Loop(alone, LOADED.codecs, link, OPTIONS).run()
    assert END_TICKS <= len(records(alone[0])) < END_TICKS + 10


def test_an_exception_in_the_loop_centres_every_valve() -> None:
    carrier = Carrier()
    link = Link("here", carrier)
    lanes = [lane(link), lane(link)]
    failing: Any = lanes[1].recorder.ring
    failing.fails_at = 60
    with pytest.raises(RuntimeError, match="no more"):
        Loop(lanes, LOADED.codecs, link, OPTIONS).run()
    last = carrier.sent[-2 * END_TICKS :]
    assert all(frame.can_id == COMMAND.can_id for frame in last)
    assert {COMMAND.decode(frame.data)[:2] for frame in last} == {(0.0, 0)}
    assert len({frame.data for frame in last}) == END_TICKS
