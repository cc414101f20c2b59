"""One error: what is followed exactly shows 0 wherever a person, a script or a viewer looks."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from rich.console import Console

import pneud
from log_samples import tick_at
from mangled import header_of, mangle, simulated
from pneud.console.status_reply import StatusWatch
from pneud.control.reference import Sine, sine
from pneud.log.files.naming import LogError, create_log
from pneud.log.files.reader import read_log
from pneud.log.files.writer import LogWriter
from pneud.log.format.records import LoggedTick
from pneud.log.format.schema import TICK, topics
from pneud.log.live.ring import Ring
from pneud.loop.summary import in_words, summarise
from pneud.loop.tally import Tally
from pneud.replay import exporting
from pneud.report.gather import gather
from pneud.report.page import page
from pneud.safety.faults import FAULT_NAMES, F
from pneud.signals import Record, Reference, RequestKind, State, Timing, true_error_m
from pneud.view.history import History
from pneud.view.info import ScreenInfo
from pneud.view.screen import Page, ScreenState

WAY = Sine(0.5, 0.05, math.pi)  # at up to 157 mm/s
OFFSET_NS = 60_000  # from SYNC to the sampling: 9 µm of it
PERIOD_NS = 10_000_000
ZERO_M = 1e-12
ZERO_COMPACT_M = 1e-7  # positions are floats of 32 bits there


def followed(count: int, error_m: float = 0.0) -> Iterator[Record]:
    """An axis that follows a sine exactly, or so far behind."""
    for k in range(count):
        t_ns = (k + 1) * PERIOD_NS
        reference = sine((t_ns + OFFSET_NS) * 1e-9, WAY)
        at_m = reference.position_m - error_m
        tick = tick_at(t_ns)
        tick = tick._replace(
            reference=reference,
            estimate=tick.estimate._replace(position_m=at_m, velocity_m_s=reference.velocity_m_s),
            measurement=tick.measurement._replace(position_m=at_m, encoder_offset_ns=OFFSET_NS),
            present=1 << F.SUPPLY_PRESSURE if k == 0 else 0,
        )
        truth_m = sine(t_ns * 1e-9, WAY).position_m - error_m
        yield Record(tick, Timing(0, 0, 0, 0, 0, 0), (), 0, (), truth_m)


def logged(path: Path, records: Iterator[Record], detail: Any = "full") -> Path:
    writer = LogWriter(create_log(path), header_of("virtual.toml")._replace(detail=detail, rate_hz=100.0))
    for record in records:
        writer.write(record)
    writer.close()
    return path


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return logged(tmp_path_factory.mktemp("followed") / "x.mcap", followed(1200))


def test_in_python(log: Path) -> None:
    ticks = list(read_log(log))
    for n, (tick, record) in enumerate(zip(ticks, followed(1200), strict=True)):
        for error_m in (tick.error_m, tick.true_error_m, record.tick.error_m, record.true_error_m):
            assert abs(error_m) < ZERO_M
        assert tick.t_s == pytest.approx(0.01 * n)
        assert (tick.state_name, record.tick.state_name) == ("tracking", "tracking")
    assert [t.fault_names for t in ticks[:2]] == [("supply_pressure",), ()]
    later = next(t for t in read_log(log).items(ticks[-1].log_time_ns) if isinstance(t, LoggedTick))
    assert later == ticks[later.number - 1]


def test_on_the_screen() -> None:
    history = History()
    history.add(followed(300))
    text = screen(history)
    for label in ("── error", "  rms", "  true"):
        at = text.index(f"{label} ") + len(label)
        assert float(text[at:].split()[0]) == 0.0, label


def screen(history: History) -> str:
    info = ScreenInfo("virtual", "x", 100.0, 0.0, 1.0, 5.0, "", FAULT_NAMES, "x.mcap")
    console = Console(file=io.StringIO(), width=120, color_system=None)
    with console.capture() as capture:
        console.print(Page(ScreenState(history.last, info), history, (120, 40)), end="")
    return capture.get()


def test_in_status() -> None:
    ring = Ring.create(64)
    watch = StatusWatch(ring)
    for record in followed(20):
        ring.put(record)
    watch.poll()
    assert watch.fields()["error_mm"] == 0.0


@pytest.mark.parametrize("truth", [True, False])
def test_in_summary_and_report(log: Path, truth: bool) -> None:
    tally = Tally(truth=truth, timed=True)
    for record in followed(1200):
        tally.add(record, ending=False)
    found = tally.tracking.tracking_mm()
    assert found["periods"] >= 2
    assert max(found["rms"], found["max"]) < 1e3 * ZERO_M
    if truth:
        run = gather(read_log(log))
        assert run.tracking_mm == found
        errors = run.series.values[:, run.columns["error_mm"]]
        assert abs(errors).max() < 1e3 * ZERO_M


@pytest.mark.parametrize("detail", ["full", "compact"])
def test_in_tables_and_for_viewers(tmp_path: Path, detail: str) -> None:
    path = logged(tmp_path / "x.mcap", followed(50), detail)
    zero_m = ZERO_M if detail == "full" else ZERO_COMPACT_M
    exporting.table(read_log(path), tmp_path / "x.csv")
    with (tmp_path / "x.csv").open() as file:
        rows = list(csv.DictReader(file))
    exporting.for_viewers(read_log(path), tmp_path / "viewers.mcap")
    with (tmp_path / "viewers.mcap").open("rb") as file:
        found = [(s, m) for s, c, m in make_reader(file).iter_messages() if c.topic == TICK]
    kind = message_of(found[0][0])
    for n, (row, (_, message)) in enumerate(zip(rows, found, strict=True)):
        tick = kind.FromString(message.data)
        for error_m in (row["error_m"], row["true_error_m"], tick.error_m, tick.true_error_m):
            assert abs(float(error_m)) < zero_m
        assert float(row["t_s"]) == pytest.approx(tick.t_s) == pytest.approx(0.01 * n)
        assert row["state_name"] == tick.state_name == "tracking"
        assert row["fault_names"].split() == list(tick.fault_names) == ["supply_pressure"] * (n == 0)


def message_of(schema: Any) -> Any:
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))


def test_in_a_simulated_run() -> None:
    for record in islice(pneud.simulate("virtual.toml", 0.5), 400, 500):
        assert record.t_s == pytest.approx(1e-9 * (record.tick.t_ns - 1_000_000_000))
        assert (record.state_name, record.fault_names) == ("tracking", ())
        assert abs(record.error_m - record.true_error_m) < 5e-6


@settings(max_examples=30, deadline=None)
@given(st.floats(-2, 2), st.floats(-20, 20), st.floats(-500, 500), st.integers(-2_000_000, 2_000_000))
def test_the_reference_is_taken_back_to_sync(v: float, a: float, j: float, offset_ns: int) -> None:
    t = offset_ns * 1e-9
    at_sync = Reference(0.3, v, a, j)
    later = Reference(
        0.3 + t * (v + t * (a / 2 + t * j / 6)), v + t * (a + t * j / 2), a + t * j, j
    )  # fmt: skip
    assert true_error_m(later, offset_ns, at_sync.position_m) == pytest.approx(0.0, abs=1e-13)


def test_an_error_is_the_same_everywhere(tmp_path: Path) -> None:
    path = logged(tmp_path / "x.mcap", followed(1200, 1e-3))
    tally = Tally(truth=True, timed=True)
    for record in followed(1200, 1e-3):
        tally.add(record, ending=False)
        assert record.tick.error_m == pytest.approx(1e-3, abs=ZERO_M)
        assert record.true_error_m == pytest.approx(1e-3, abs=ZERO_M)
    found = tally.tracking.tracking_mm()
    assert (found["rms"], found["max"]) == (pytest.approx(1.0), pytest.approx(1.0))
    assert gather(read_log(path)).tracking_mm == found


def test_units_and_meanings_are_in_the_schema_and_in_a_parquet(log: Path, tmp_path: Path) -> None:
    topic = next(topics("compact"))
    (file,) = descriptor_pb2.FileDescriptorSet.FromString(topic.descriptors).file
    comments = {tuple(p.path): p.leading_comments for p in file.source_code_info.location}
    (at,) = [i for i, m in enumerate(file.message_type) if m.name == "Tick"]
    fields = file.message_type[at].field
    for i, field in enumerate(fields):
        assert ((4, at, 2, i) in comments) == (field.type != field.TYPE_MESSAGE), field.name
    for n, inner in enumerate(file.message_type[at].nested_type):
        assert all((4, at, 3, n, 2, i) in comments for i in range(len(inner.field)))
    (estimate,) = [n for n, m in enumerate(file.message_type[at].nested_type) if m.name == "Estimate"]
    assert comments[4, at, 3, estimate, 2, 2] == " [N] F̂, unmatched force acting on the load\n"
    pq = pytest.importorskip("pyarrow.parquet")
    exporting.table(read_log(log), tmp_path / "x.parquet")
    for field in pq.read_schema(tmp_path / "x.parquet"):
        assert field.metadata[b"description"], field.name
    schema = pq.read_schema(tmp_path / "x.parquet")
    units = {name: schema.field(name).metadata[b"unit"].decode() for name in schema.names}
    assert (units["estimate.d_hat_n_s"], units["true_error_m"], units["t_s"]) == ("N/s", "m", "s")
    assert units["state"] == ""


def test_a_log_is_not_replaced_by_what_is_made_of_it(log: Path) -> None:
    with pytest.raises(LogError, match="is the log itself"):
        exporting.for_viewers(read_log(log), log)


def test_the_state_is_the_one_before_the_run_was_told_to_end(tmp_path: Path) -> None:
    simulated(tmp_path / "x.mcap", 0.6)
    log, tally = read_log(tmp_path / "x.mcap"), Tally(truth=True, timed=True)
    ending = False
    for tick in log:
        ending = ending or (tick.request is not None and tick.request.kind == RequestKind.SHUTDOWN)
        tally.add(tick.record, ending=ending)
    run = gather(log)
    assert State(run.states[-1].value - 1) == State.DISARMED
    assert run.counted[:2] == (tally.state, tally.ticks) == (State.TRACKING, 600)
    assert "<dt>state</dt><dd>tracking</dd>" in page([run])


@pytest.mark.slow
def test_one_run_has_the_same_words_and_counts(tmp_path: Path) -> None:
    """Screen, summary and report of a run whose frames get lost, corrupt, stuck and late."""
    counts = simulated(tmp_path / "x.mcap", 1.2, mangle)
    log, history, tally = read_log(tmp_path / "x.mcap"), History(), Tally(truth=True, timed=True)
    ending = False
    for tick in log:
        ending = ending or (tick.request is not None and tick.request.kind == RequestKind.SHUTDOWN)
        tally.add(tick.record, ending=ending)
        if not ending:
            history.add([tick.record])
    assert ending
    run = gather(log)
    assert run.counted == (tally.state, tally.ticks, tally.skipped, tally.saturated)
    assert run.counted[1:] == (history.ticks, history.skipped, history.saturated)
    history.add([tick.record for tick in log if tick.number > history.ticks])
    summary = summarise(
        tally, bus="simulated", rate_hz=1000.0, counts=counts, tx=0, rx_dropped=0, log=None, log_dropped=0
    )
    amiss = summary["amiss"]
    assert min(amiss["missing"], amiss["late"], amiss["corrupt"]) > 0
    assert amiss == history.amiss.all._asdict() | {
        "corrupt": history.amiss.corrupt,
        "frozen": history.amiss.frozen,
    }
    words = ", ".join(f"{count} {kind}" for kind, count in amiss.items())
    assert words == run.readings.total_in_words()
    assert f"readings amiss: {words}" in in_words(summary)
    assert f"<dt>readings amiss</dt><dd>{words}</dd>" in page([run])
    shown = screen(history)
    for kind, count in (*amiss.items(), ("skipped", tally.skipped)):
        assert f"{kind} {count:,} " in shown, kind
    frames = summary["frames"]
    for kind, name in (("lost", "lost"), ("crc", "corrupt"), ("stale", "frozen"), ("late", "late")):
        assert frames[kind] == sum(getattr(source, name) for source in run.health.sources)
