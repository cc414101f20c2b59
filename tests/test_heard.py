"""A log's summary, block by block, is what its ticks say one by one."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hil.device_sets import device_sets
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pneud.bus.inbox import Inbox
from pneud.bus.mapped_inbox import inbox_of
from pneud.config.reading import parse
from pneud.loading import at_rate, codecs_of, load
from pneud.log.files.columns import blocks
from pneud.log.files.naming import create_log
from pneud.log.files.reader import LogReader, read_log
from pneud.log.files.writer import LogWriter
from pneud.loop.summary import summarise
from pneud.loop.tally import Tally
from pneud.loop.tracking import Led, Tracking
from pneud.notebook.summary import SIMULATED, summary_of
from pneud.replay.heard import Heard
from pneud.replay.lockstep import Simulation, backend_of, header_of, simulate
from pneud.rt.histogram import Histogram
from pneud.signals import Answer, Frame, Record, Request, RequestKind, State

SETS = device_sets()
FEW = ("counts", "flexible", "multiplexed-counted", "two-encoders")
GOLDEN = sorted(Path(__file__).with_name("golden").glob("*.mcap"))


def tick_by_tick(log: LogReader) -> dict[str, Any]:
    """The summary as the loop counts it."""
    config = at_rate(parse(log.config_text, log.config_name), log.rate_hz)
    codecs = codecs_of(config.bus, log.dbc_name, log.dbc, config.gas)
    inbox, bus = inbox_of(codecs, config.bus), log.metadata.get("bus", "")
    tally = Tally(truth=False, timed=bus != SIMULATED, sync=inbox.sync)
    tx, ending, leaving = 0, False, False
    for logged in log:
        for frame in logged.frames[: logged.before]:
            inbox.feed(frame)
        inbox.begin(logged.t_ns)
        for frame in logged.frames[logged.before :]:
            inbox.feed(frame)
        inbox.measurement(logged.skipped, logged.host)
        command_id = codecs.valve_command.can_id
        inbox.commanded_ns = next((f.stamp_ns for f in logged.sent if f.can_id == command_id), -1)
        tx += sum(f.stamp_ns >= 0 for f in logged.sent)
        request = logged.request
        ending = leaving or ending or (request is not None and request.kind == RequestKind.SHUTDOWN)
        if request is not None and request.kind == RequestKind.RESTART:
            leaving = leaving or logged.answer == Answer.TAKEN
        if math.isfinite(logged.truth_m):
            tally.tracking.has_truth = True
        tally.add(logged.record, ending=ending)
    return summarise(
        tally,
        bus=bus,
        rate_hz=log.rate_hz,
        counts=inbox.counts(),
        tx=tx,
        rx_dropped=0,
        log=str(log.path),
        log_dropped=log.missing,
    )


@pytest.mark.parametrize("path", GOLDEN, ids=lambda path: path.stem)
def test_the_summary_of_a_log_is_that_of_its_ticks(path: Path) -> None:
    assert summary_of(read_log(path)) == tick_by_tick(read_log(path))


@pytest.fixture(scope="module")
def records() -> list[Record]:
    return list(simulate("virtual.toml", 0.4, 3))


def spoiled(records: list[Record], seed: int, often: float) -> Iterator[Record]:
    """Frames that are lost, late, doubled, corrupt or strange; requests that end the run or do not."""
    chance = random.Random(seed)
    ids = sorted({frame.can_id for record in records for frame in record.frames})
    for record in records:
        frames, before = list(record.frames), record.before
        if chance.random() < often:
            place = chance.randrange(max(1, len(frames)))
            what = chance.randrange(6)
            if what == 0 and frames:
                del frames[place]
                before = min(before, len(frames))
            elif what == 1 and frames:
                frames.insert(place, frames[place])
            elif what == 2 and frames:
                frames[place] = frames[place]._replace(data=bytes(len(frames[place].data)))
            elif what == 3 and frames:
                frames[place] = frames[place]._replace(
                    stamp_ns=record.tick.t_ns - chance.randrange(2_000_000)
                )
            elif what == 4:
                frames.append(
                    Frame(record.tick.t_ns, chance.choice([*ids, 0x085, 0x20000004, 0x123]), bytes(8))
                )
            else:
                before = chance.randrange(len(frames) + 1)
        request, answer = record.tick.request, record.tick.answer
        if chance.random() < 0.002:
            request, answer = Request(int(chance.choice([*RequestKind])), (1.0,)), chance.choice([*Answer])
        tick = record.tick._replace(request=request, answer=int(answer))
        yield record._replace(frames=tuple(frames), before=before, tick=tick)


@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 10**6), often=st.sampled_from([0.0, 0.01, 0.1, 0.6]))
def test_what_is_spoiled_counts_the_same(
    records: list[Record], tmp_path: Path, seed: int, often: float
) -> None:
    path = tmp_path / "x.mcap"
    path.unlink(missing_ok=True)
    writer = LogWriter(create_log(path), header_of(load("virtual.toml")))
    for number, record in enumerate(spoiled(records, seed, often)):
        writer.write(record)
        if number % 97 == 0:
            writer.flush()
    writer.close()
    assert summary_of(read_log(path)) == tick_by_tick(read_log(path))


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in FEW else pytest.mark.slow) for name in sorted(SETS)]
)
def test_devices_of_all_kinds_count_the_same(name: str, tmp_path: Path) -> None:
    loaded = load(SETS[name].write(tmp_path, name))
    records = list(Simulation(loaded, 0.15, how=backend_of(loaded)).records())
    for often in (0.0, 0.1):
        writer = LogWriter(create_log(tmp_path / f"{often}.mcap"), header_of(loaded))
        for record in spoiled(records, 1, often):
            writer.write(record)
        writer.close()
        log = tmp_path / f"{often}.mcap"
        assert summary_of(read_log(log)) == tick_by_tick(read_log(log))


def test_an_inbox_hears_little_of_what_is_alike(tmp_path: Path) -> None:
    log = read_log(next(path for path in GOLDEN if path.stem == "virtual"))
    config = parse(log.config_text, log.config_name)
    heard = Heard(codecs_of(config.bus, log.dbc_name, log.dbc, config.gas), config.bus)
    ticks = 0
    for block in blocks(log):
        heard.add(block)
        ticks += len(block.number)
    assert heard.fed < 0.1 * ticks
    assert heard.inbox.at_ease
    assert heard.inbox.counts().rx == sum(len(tick.frames) for tick in read_log(log.path))


def test_what_is_passed_over_leaves_an_inbox_as_it_would_be(records: list[Record]) -> None:
    loaded = load("virtual.toml")
    one, other = (Inbox(loaded.codecs, loaded.config.bus) for _ in range(2))

    def feed(inbox: Inbox, record: Record) -> None:
        for frame in record.frames[: record.before]:
            inbox.feed(frame)
        inbox.begin(record.tick.t_ns)
        for frame in record.frames[record.before :]:
            inbox.feed(frame)
        inbox.measurement(0, 0)
        inbox.commanded_ns = record.sent[-1].stamp_ns

    for record in records[:300]:
        feed(one, record)
    for record in records[:100]:
        feed(other, record)
    assert other.at_ease
    other.pass_over(196)
    for record in records[296:300]:
        feed(other, record)
    assert one.freeze() == other.freeze()
    assert one.counts() == other.counts()


@settings(max_examples=20, deadline=None)
@given(
    values=st.lists(
        st.one_of(
            st.integers(-5, 300), st.integers(0, 2**63 - 1), st.sampled_from([2**k - 1 for k in range(64)])
        )
    )
)
def test_a_histogram_takes_many_as_it_takes_each(values: list[int]) -> None:
    one, many = Histogram(), Histogram()
    for value in values:
        one.add(value)
    for some in (values[: len(values) // 2], values[len(values) // 2 :]):
        many.add_many(np.array(some, dtype=np.int64))
    assert (many.count, many.counts()) == (one.count, one.counts())
    if values:
        assert (many.max, many.mean, many.percentile(0.0)) == (one.max, one.mean, one.percentile(0.0))


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6), size=st.integers(1, 60), truth=st.booleans())
def test_tracking_takes_many_as_it_takes_each(seed: int, size: int, truth: bool) -> None:
    chance = random.Random(seed)
    one, many = Tracking(truth), Tracking(truth)
    count, t_ns, state = 400, 0, int(State.TRACKING)
    rows = []
    for i in range(count):
        t_ns += chance.choice([1_000_000, 1_000_000, 3_000_000])
        if chance.random() < 0.02:
            state = int(chance.choice([State.TRACKING, State.MOVING, State.HOLDING, State.FAULT]))
        kind = chance.choice([RequestKind.GOTO, RequestKind.TRACK, RequestKind.JOG, RequestKind.MARK])
        request = Request(int(kind), (chance.choice([0.1, 1.0]),)) if chance.random() < 0.02 else None
        phase = 0.05 * i
        reference = (math.sin(phase), math.cos(phase), -math.sin(phase), chance.choice([0.0, math.nan]))
        error_m = chance.choice([math.nan, chance.gauss(0.0, 1e-3), chance.gauss(0.0, 1e-3)])
        rows.append((t_ns, state, request, error_m, reference, chance.gauss(0.0, 1.0)))
    for row in rows:
        one.add(*row)
    for first in range(0, count, size):
        some = rows[first : first + size]
        taken = {i: row[2] for i, row in enumerate(some) if row[2] is not None}
        columns = [np.array(column) for column in zip(*(row[4] for row in some), strict=True)]
        many.add_many(
            Led(
                np.array([row[0] for row in some]),
                np.array([row[1] for row in some]),
                taken,
                np.array([row[3] for row in some]),
                tuple(columns),
                np.array([row[5] for row in some]),
            )
        )
    assert repr(many.tracking_mm()) == repr(one.tracking_mm())
    assert many.command_v() == one.command_v()
