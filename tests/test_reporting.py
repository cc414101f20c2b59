"""What a report is made of: decimation, counting, spans, and the one pass over a log."""

from __future__ import annotations

import json
import math
import random
import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from commands import pneud_here
from log_samples import tick_at
from mangled import header_of, mangle, simulated
from pneud.config.reading import load_config
from pneud.loading import load
from pneud.log.files.columns import blocks
from pneud.log.files.naming import create_log
from pneud.log.files.reader import read_log
from pneud.log.files.writer import LogWriter
from pneud.report.decimate import Envelope
from pneud.report.decimate import Path as Curve
from pneud.report.figures import FIGURES, TIMED
from pneud.report.gather import COLUMNS, LoggedRun, Window, gather
from pneud.report.health import Health
from pneud.report.page import page
from pneud.report.spans import Span, Spans
from pneud.report.spread import Spread
from pneud.signals import Record, State, Timing


def in_pieces(rng: random.Random, n: int) -> list[slice]:
    cuts = sorted({0, n, *(rng.randrange(n + 1) for _ in range(rng.randrange(6)))})
    return [slice(a, b) for a, b in pairwise(cuts)]


@settings(max_examples=60, deadline=None)
@given(n=st.integers(1, 700), limit=st.integers(2, 40), seed=st.integers(0, 9999))
def test_every_peak_is_kept(n: int, limit: int, seed: int) -> None:
    rng = random.Random(seed)
    t = np.cumsum([rng.random() for _ in range(n)])
    values = np.array([[rng.gauss(0, 1), rng.choice([math.nan, math.inf, 1.0, rng.gauss(0, 1)])] for _ in t])
    envelope = Envelope(2, limit)
    for piece in in_pieces(rng, n):
        envelope.add(t[piece], values[piece])
    points = envelope.points()
    assert len(points.t_s) <= 2 * limit + 2
    assert (np.diff(points.t_s) >= 0).all()
    assert points.t_s[0] == t[0]
    for column in range(2):
        finite = values[np.isfinite(values[:, column]), column]
        drawn = points.values[np.isfinite(points.values[:, column]), column]
        assert set(drawn) <= set(finite)
        if len(finite):
            assert drawn.min() == finite.min()
            assert drawn.max() == finite.max()
    if n <= limit:
        assert np.array_equal(points.t_s, t)
        assert np.array_equal(points.values[:, 0], values[:, 0])


def test_peaks_stay_where_they_were() -> None:
    t = np.linspace(0.0, 99.999, 100_000)
    values = np.zeros((len(t), 1))
    for k, height in ((12_345, 5.0), (12_400, -4.0), (77_777, 9.0)):
        values[k] = height
    envelope = Envelope(1, 256)
    for k in range(0, len(t), 1000):
        envelope.add(t[k : k + 1000], values[k : k + 1000])
    points = envelope.points()
    for k, height in ((12_345, 5.0), (12_400, -4.0), (77_777, 9.0)):
        (found,) = np.flatnonzero(points.values[:, 0] == height)
        assert abs(points.t_s[found] - t[k]) <= 100.0 / 128
    up, down = (int(np.flatnonzero(points.values[:, 0] == h)[0]) for h in (5.0, -4.0))
    assert up < down


@settings(max_examples=40, deadline=None)
@given(n=st.integers(0, 900), limit=st.integers(2, 20), seed=st.integers(0, 9999))
def test_curves_keep_their_extremes(n: int, limit: int, seed: int) -> None:
    rng = random.Random(seed)
    t = np.arange(n, dtype=float)
    x, y = (np.array([rng.gauss(0, 1) for _ in t]) for _ in range(2))
    if n:
        x[rng.randrange(n)] = math.nan
    curve = Curve(limit)
    for piece in in_pieces(rng, n) if n else []:
        curve.add(t[piece], x[piece], y[piece])
    points = curve.points()
    assert (np.diff(points.t_s) >= 0).all()
    kept = points.t_s.astype(int)
    assert np.array_equal(points.values[:, 0], x[kept])
    assert np.array_equal(points.values[:, 1], y[kept])
    finite = np.isfinite(x)
    for axis in (x, y):
        if finite.any():
            assert axis[finite].max() in axis[kept]
            assert axis[finite].min() in axis[kept]


def test_percentiles() -> None:
    rng = np.random.default_rng(1)
    ns = np.concatenate((rng.lognormal(10, 2, 5000).astype(np.int64), [-1, 0, 7_000_000_000]))
    spread = Spread()
    for part in np.array_split(ns, 7):
        spread.add(part)
    known = np.sort(ns[ns >= 0])
    assert spread.count == len(known)
    assert spread.max_ns == 7_000_000_000
    assert spread.percentile_ns(100) == 7e9
    for q in (1, 50, 99, 99.9):
        exact = known[math.ceil(q / 100 * len(known)) - 1]
        assert spread.percentile_ns(q) == pytest.approx(exact, rel=1 / 128, abs=1)
    assert sum(count for _, _, count in spread.buckets()) == len(known)
    assert math.isnan(Spread().percentile_ns(50))


def test_spans() -> None:
    spans = Spans()
    spans.add(np.array([0.0, 1.0, 2.0]), np.array([0, 5, 5]))
    spans.add(np.array([3.0, 4.0, 5.0]), np.array([5, 6, 0]))
    spans.add(np.array([6.0]), np.array([7]))
    assert spans.finish(7.0) == [Span(1.0, 4.0, 5), Span(4.0, 5.0, 6), Span(6.0, 7.0, 7)]


def test_flicker_is_drawn_together() -> None:
    spans = Spans()
    t = np.linspace(0.0, 19.999, 20_000)
    spans.add(t, (np.arange(20_000) % 2).astype(np.int64))
    found = spans.finish(20.0)
    assert 0 < len(found) <= 2000
    assert found[0].begin_s == pytest.approx(0.001)
    assert found[-1].end_s == pytest.approx(20.0)


@pytest.fixture(scope="module")
def mangled_log(tmp_path_factory: pytest.TempPathFactory) -> Any:
    path = tmp_path_factory.mktemp("logs") / "mangled.mcap"
    return path, simulated(path, 1.2, mangle)


@pytest.mark.parametrize("size", [7, 4096])
def test_health_counts_as_the_inbox_does(mangled_log: Any, size: int) -> None:
    path, counts = mangled_log
    loaded = load("virtual.toml")
    health = Health(loaded.codecs, bool(loaded.config.bus.sync), 1_000_000)
    for block in blocks(read_log(path), size):
        health.add(block)
    found = [sum(getattr(s, name) for s in health.sources) for name in ("lost", "corrupt", "frozen", "late")]
    assert found == [counts.lost, counts.crc, counts.stale, counts.late]
    assert min(found) > 0
    assert sum(r.frames for r in health.rows() if r.direction == "received") == counts.rx
    assert tuple(health.emcy.items()) == counts.emcy
    assert health.foreign == counts.foreign == 0


@pytest.fixture(scope="module")
def calm_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("logs") / "calm.mcap"
    simulated(path, 1.0, remark="air at 5 bar")
    return path


@pytest.fixture(scope="module")
def run(calm_log: Path) -> LoggedRun:
    return gather(read_log(calm_log))


def test_a_run(run: LoggedRun) -> None:
    assert run.ticks == run.log.missing + sum(1 for _ in run.log)
    labels = [State(span.value - 1).label for span in run.states]
    assert labels == ["starting", "waiting", "disarmed", "tracking", "stopping", "disarmed"]
    assert [mark.text for mark in run.marks] == ["arm 1", "air at 5 bar", "shutdown"]
    assert run.first_engaged_s == pytest.approx(run.marks[0].t_s)
    assert run.error_against == "true position"
    assert set(COLUMNS) == {s.column for f in FIGURES for s in f.series}
    error = run.series.values[:, run.columns["error_mm"]]
    assert 0.0 < np.nanmax(np.abs(error)) < 1.0


def test_a_window(calm_log: Path) -> None:
    part = gather(read_log(calm_log), Window(0.5, 0.75))
    assert part.ticks == 250
    assert part.series.t_s[0] == 0.5
    assert [State(span.value - 1).label for span in part.states] == ["tracking"]


def data_of(text: str) -> Any:
    (found,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)
    return json.loads(found)


def test_the_page_needs_nothing_beside_it(run: LoggedRun) -> None:
    text = page([run])
    assert not re.search(r"<(link|img|iframe)\b|<script[^>]*\bsrc=|@import|url\(", text)
    assert "Leon Sorokin" in text
    assert "Permission is hereby granted" in text
    data = data_of(text)
    assert [f["name"] for f in data["figures"]] == [f.name for f in FIGURES]
    (one,) = data["runs"]
    assert set(one["columns"]) == set(COLUMNS) - TIMED
    assert "piston_area_1_m2" in text


def test_emergencies_are_named(mangled_log: Any) -> None:
    assert "emergency 0x2310 of node 1" in page([gather(read_log(mangled_log[0]))])


def test_text_from_a_log_cannot_become_markup(run: LoggedRun) -> None:
    evil = "</script><script>alert(1)</script>"
    log = run.log
    before = dict(log.metadata)
    log.metadata["bus"] = evil
    try:
        text = page([run._replace(name=evil)])
    finally:
        log.metadata = before
    assert evil not in text
    assert data_of(text)["runs"][0]["name"] == evil


def test_several_logs_begin_where_they_were_engaged(run: LoggedRun) -> None:
    text = page([run, run])
    data = data_of(text)
    assert [r["name"] for r in data["runs"]] == ["calm (1)", "calm (2)"]
    assert data["aligned"]
    assert data["runs"][0]["marks"][0][0] == 0.0


def test_the_verb(mangled_log: Any, tmp_path: Path) -> None:
    log, _ = mangled_log
    bench = tmp_path / "bench.json"
    machine = {"cpu_model": "x", "kernel": "y"}
    histograms = {"cyclictest": [[900, 1000, 3], [2000, 2100, 1]]}
    bench.write_text(json.dumps({"schema": 1, "machine": machine, "wakeup_histograms_ns": histograms}))
    done = pneud_here("report", log, log, "-o", tmp_path / "r.html", "--reference", bench)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == [str(tmp_path / "r.html")]
    assert "cyclictest (bench)" in (tmp_path / "r.html").read_text()


@pytest.mark.slow
def test_pictures(mangled_log: Any, calm_log: Path, tmp_path: Path) -> None:
    log, _ = mangled_log
    done = pneud_here("report", log, calm_log, "-o", tmp_path / "r.html", "--png")
    made = {Path(line).name for line in done.stdout.split()}
    maps = {f"r-{name}.png" for name in ("spectrum", "friction", "flow", "pressure-plane", "valve", "place")}
    assert made - maps == {"r.html", "r-phase.png", "r-timeline.png", *(f"r-{f.name}.png" for f in FIGURES)}
    assert len(made & maps) >= 4
    assert all((tmp_path / name).stat().st_size > 1000 for name in made)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--from", "3", "--to", "2"), "nothing between"),
        (("--from", "3000"), "no tick"),
        (("--reference", "pyproject.toml"), "pneud bench"),
        (("-o", "/nowhere/x.html"), "no folder"),
    ],
)
def test_what_cannot_be_done_is_said(
    mangled_log: Any, tmp_path: Path, options: tuple[str, ...], words: str
) -> None:
    done = pneud_here("report", mangled_log[0], "-o", tmp_path / "r.html", *options)
    assert done.returncode == 2
    assert words in done.stderr
    assert not done.stdout


def test_a_truncated_log_is_shown_as_far_as_it_goes(mangled_log: Any, tmp_path: Path) -> None:
    whole = mangled_log[0].read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) * 2 // 3])
    done = pneud_here("report", tmp_path / "cut.mcap", "-o", tmp_path / "r.html")
    assert done.returncode == 1
    assert "cut.mcap: not whole: cut short at byte" in done.stderr
    assert "cut short at byte" in (tmp_path / "r.html").read_text()


def test_bare_configuration_is_the_logs_own(run: LoggedRun) -> None:
    assert run.config == load_config("virtual.toml")


def test_a_report_says_for_how_long_the_load_hunted_and_was_in_position(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    ticks = [tick_at((n + 1) * 1_000_000) for n in range(4000)]
    ticks = [t._replace(in_position=n // 1000 % 2, hunting=n // 2000 * 3) for n, t in enumerate(ticks)]
    writer = LogWriter(create_log(path), header_of("virtual.toml"))
    for tick in ticks:
        writer.write(Record(tick, Timing(0, 0, 0, 0, 0, 0), (), 0, (), 0.0))
    writer.close()
    run = gather(read_log(path))
    assert [round(s.end_s - s.begin_s, 3) for s in run.in_position] == [1.0, 1.0]
    assert [(round(s.end_s - s.begin_s, 3), s.value) for s in run.hunting] == [(2.0, 3)]
    text = page([run])
    assert "2.0 s: check control.friction, valve.dead_zone_v" in text
