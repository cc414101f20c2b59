"""What a report says of a log: verdict, faults, differences, maps, and every tick where there is room."""

from __future__ import annotations

import math
import webbrowser
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from commands import pneud_here
from mangled import simulated
from pneud.config.conversions import reference_of
from pneud.config.reading import load_config, parse
from pneud.config.writing import noted
from pneud.log.files.columns import Block
from pneud.log.files.reader import read_log
from pneud.report.bins import Bins, Spectrum, fine_about_zero
from pneud.report.closeup import NONE, Closeup, decoded, encoded
from pneud.report.colours import colours_of
from pneud.report.differences import differences
from pneud.report.figures import TIMED, line
from pneud.report.frame import BAD, GOOD, LOOK, Section, Verdict, document
from pneud.report.gather import LoggedRun, gather
from pneud.report.page import page
from pneud.report.planes import _Period, sample
from pneud.report.sections import injections, learnt
from pneud.report.spans import Span
from pneud.report.stops import Stops, seen
from pneud.report.verdict import judge
from pneud.signals import State
from pneud.study.commissioning.written import changes, text_with
from pneud.study.identification.parameters import Estimate

GOLDEN = Path(__file__).parent / "golden"


def of(name: str) -> LoggedRun:
    return gather(read_log(GOLDEN / f"{name}.mcap"))


@pytest.fixture(scope="module")
def asked() -> LoggedRun:
    return of("requests")


@pytest.fixture(scope="module")
def lost() -> LoggedRun:
    return of("supply-lost")


def test_every_tick_comes_back_within_half_a_step() -> None:
    rng = np.random.default_rng(1)
    steps = np.array([1e-6, 1e-4, 0.5])
    table = np.column_stack((np.arange(500) * 1e-3, rng.normal(0, 1, 500), rng.normal(0, 1e12, 500)))
    table[7, 1] = math.nan
    table[8, 1] = -math.inf
    back = decoded(encoded(table, steps), 500, steps)
    assert np.isnan(back[7:9, 1]).all()
    good = np.isfinite(table[:, 1])
    assert np.abs(back[:, :2] - table[:, :2])[good].max() <= 0.5 * 1e-4 + 1e-12
    assert np.abs(back[:, 2]).max() == 0.5 * (-NONE - 1)  # as far as the numbers go


def test_stretches_with_events_come_before_those_with_great_errors() -> None:
    closeup = Closeup(("error_mm",), 400)
    rng = np.random.default_rng(2)
    for k in range(9):
        t_s = np.linspace(k, k + 0.059, 60)
        closeup.add(
            t_s,
            rng.normal(0, 1e-3, (60, 1)),
            k == 5,
            math.nan if k == 6 else float(k == 3),
        )
    begins = [round(s.begin_s) for s in sorted(closeup.stretches)]
    assert {3, 5} <= set(begins)
    assert sum(len(s.data) for s in closeup.stretches) <= 400
    assert closeup.kept == 60 * len(begins)
    assert closeup.ticks == 540
    assert begins[0] == 0  # of those that are alike, the earliest


def test_bins_average_what_is_in_them() -> None:
    rng = np.random.default_rng(3)
    x = rng.uniform(-1, 1, 20_000)
    bins = Bins(np.linspace(-2, 2, 401))
    for part in np.array_split(x, 3):
        bins.add(part, 2 * part + rng.normal(0, 0.1, len(part)))
    few = bins.merged(20)
    assert 20 <= len(few.kept) <= 21
    assert np.abs(few.mean - 2 * few.x).max() < 0.1
    assert few.count.sum() == len(x)
    assert 0.09 < few.deviation.mean() < 0.13
    edges = fine_about_zero(1.0, 400)
    assert (np.diff(edges) > 0).all()
    assert (edges[0], edges[-1]) == pytest.approx((-1.0, 1.0), rel=1e-12)


def test_a_spectrum_has_a_sine_where_it_is() -> None:
    n = np.arange(20_000)
    values = 3.0 * np.sin(2 * math.pi * 50.0 * n * 1e-3)
    wanted = (n < 9000) | (n > 9500)
    spectrum = Spectrum(1000.0, 4096)
    for part in np.array_split(n, 11):
        spectrum.add(part, values[part], wanted[part])
    f, density = spectrum.density()
    assert f[density.argmax()] == pytest.approx(50.0, abs=0.25)
    edges = np.append(f, 500.0)
    power = float((density**2 * np.diff(edges)).sum())
    assert power == pytest.approx(4.5, rel=0.05)  # of a sine of amplitude 3


def test_a_short_log_has_a_spectrum_too() -> None:
    spectrum = Spectrum(1000.0, 4096)
    n = np.arange(700)
    spectrum.add(n, np.sin(n), np.ones(700, dtype=bool))
    assert 100 < len(spectrum.density()[0]) <= 256
    assert len(Spectrum(1000.0, 4096).density()[0]) == 0


def test_maps_of_a_run(asked: LoggedRun) -> None:
    planes = {plane.name: plane for plane in asked.planes}
    assert {"spectrum", "friction", "flow", "pressure-plane", "valve", "place"} <= set(planes)
    shares = planes["valve"].traces[0].y
    assert shares.sum() == pytest.approx(100.0)
    friction = planes["friction"].traces[0]
    fast = np.abs(friction.x) > 100.0
    assert (np.sign(friction.y[fast]) == np.sign(friction.x[fast])).all()
    flow, model = planes["flow"].traces
    assert np.abs(flow.y - model.y).max() < 5.0


def test_periods_are_told_by_the_reference() -> None:
    config = load_config("virtual.toml")
    period = _Period(config)
    centre_m, amplitude_m, omega = reference_of(config)
    t = np.arange(0.0, 9.0, 1e-3)
    sine, cosine = amplitude_m * np.sin(omega * t), amplitude_m * omega * np.cos(omega * t)
    error_mm = 0.01 * t + np.where(t < 0.7, 5.0, np.sin(omega * t))  # until then it joins
    columns = {"position_m": centre_m + sine + np.where(t < 0.7, 0.02, 0.0), "velocity_m_s": cosine}
    for part in np.array_split(np.arange(len(t)), 5):
        block: Any = SimpleNamespace(real=lambda name, part=part: columns[name.partition(".")[2]][part])
        state = np.full(len(part), State.TRACKING)
        period.add(sample(block, t[part], state, error_mm[part]))
    plane = period.plane()
    assert plane.note.startswith("3 whole periods")
    mean = plane.traces[0]
    assert np.abs(mean.y - np.sin(np.radians(mean.x)))[10:-10].max() < 0.1


def test_a_good_run_is_good() -> None:
    verdict = judge(of("composite"))
    assert verdict.level == GOOD
    (reason,) = verdict.reasons
    assert reason == "no error to judge: no whole period of the reference, and no motion to its end"


@pytest.mark.parametrize(("name", "level"), [("supply-lost", BAD), ("virtual", LOOK), ("requests", LOOK)])
def test_what_is_amiss_is_said(name: str, level: str) -> None:
    verdict = judge(of(name))
    assert verdict.level == level
    why = {"supply-lost": "supply_falling", "virtual": "skipped", "requests": "operator_lost"}
    assert why[name] in verdict.reasons[0]


def test_the_worst_reason_comes_first() -> None:
    verdict = Verdict().and_then(GOOD, "a").and_then(LOOK, "b").and_then(BAD, "c").and_then(LOOK, "d")
    assert verdict == Verdict(BAD, ("c", "b", "a", "d"))


def test_a_fault_has_its_moment_and_its_stop(lost: LoggedRun) -> None:
    first, second = lost.faults
    assert lost.fault_name(first.bit) == "supply_falling"
    assert first.seen_s == first.latched_s
    assert first.stop is not None
    assert first.stop.speed_m_s == pytest.approx(0.157, abs=0.01)
    assert 0.1 < first.stop.time_s < 0.2
    assert 0.01 < first.stop.farthest_m < 0.02
    assert lost.fault_name(second.bit) == "supply_pressure"
    assert second.stop is None
    text = page([lost])
    assert "latched at 0.606 s" in text
    assert 'class="closeup"' in text


@pytest.mark.parametrize("bit", [21, 70])
def test_how_far_a_load_goes_on_behind_a_fault(bit: int) -> None:
    stops = Stops(load_config("virtual.toml"))
    t = np.arange(0.0, 6.0, 1e-3)
    x = 0.1 + np.where(t < 1.0, 0.2 * t, 0.2 + np.where(t < 1.2, 0.2 * (t - 1.0), 0.04))
    ticks = np.zeros(len(t), dtype=[("latched", "u8"), ("state", "u4")])
    ticks["state"] = np.where(t < 1.0, State.TRACKING, State.STOPPING)
    beyond = np.zeros(len(t), dtype=np.uint64)
    words = beyond if bit >= 63 else ticks["latched"]
    words[t >= 1.0] = 1 << bit % 63
    for part in np.array_split(np.arange(len(t)), 7):
        more = {"latched_more": beyond[part]} if bit >= 63 else {}
        none: Any = ()
        stops.add(Block(part, part, ticks[part], none, none, none, none, more), t[part], x[part])
    (stop,) = stops.finish()
    assert stop.t_s == 1.0
    assert stop.latched == 1 << bit
    assert stop.speed_m_s == pytest.approx(0.2)
    assert stop.time_s == pytest.approx(0.2, abs=0.01)
    assert stop.distance_m == pytest.approx(0.04, abs=1e-3)


def test_a_fault_that_was_cleared_and_came_back_is_two() -> None:
    found = seen({3: [Span(0.9, 2.5, 1)]}, {3: [Span(1.0, 2.0, 1), Span(4.0, 9.0, 1)]}, [], 9.0)
    assert [(f.seen_s, f.latched_s, f.cleared_s) for f in found[:1]] == [(0.9, 1.0, 2.0)]
    assert math.isnan(found[1].seen_s)
    assert math.isnan(found[1].cleared_s)


def test_differences_come_first_and_only_they(asked: LoggedRun, lost: LoggedRun) -> None:
    found = dict(differences([asked, lost]))
    assert all(len(set(values)) > 1 for values in found.values())
    text = page([asked, lost])
    places = [text.index(f"<h2>{title}</h2>") for title in ("Differences", "Motions", "Summary")]
    assert places == sorted(places)
    assert "the same" in page([asked, asked])
    assert "<h2>Differences</h2>" not in page([asked])


def test_motions_can_be_zoomed_to(asked: LoggedRun) -> None:
    text = page([asked])
    assert text.count("data-from=") == len(asked.motions) == 7
    assert 'data-name="motions"' in text


def test_twenty_logs_have_twenty_colours_and_one_row_each(asked: LoggedRun) -> None:
    assert len(set(colours_of(20))) == 20
    runs = [asked._replace(name=f"rig-2026-11-{n:02d}.mcap") for n in range(1, 21)]
    text = page(runs)
    assert text.count('<button data-run="') == 20
    assert "</i>07</td>" in text  # without what all names begin with
    assert text.count("<pre") == 1  # they have the same configuration
    assert len(set(colours_of(7))) == 7


def test_sections_without_content_are_left_out() -> None:
    text = document("t", "h", [Section("A", "x"), Section("B", "")])
    assert "<h2>A</h2>" in text
    assert "<h2>B</h2>" not in text
    assert "<nav" not in text


def test_a_page_keeps_every_tick_where_the_overview_does_not(tmp_path: Path) -> None:
    simulated(tmp_path / "run.mcap", 0.6)
    run = gather(read_log(tmp_path / "run.mcap"), buckets=64, closeup=1_000_000)
    (stretch,) = run.closeup.stretches
    assert stretch.ticks == run.ticks > len(run.series.t_s)
    few: Any = gather(read_log(tmp_path / "run.mcap"), buckets=64)
    assert not few.closeup.stretches


def test_no_time_is_drawn_that_nobody_has_measured(tmp_path: Path, lost: LoggedRun) -> None:
    simulated(tmp_path / "run.mcap", 0.1)
    run = gather(read_log(tmp_path / "run.mcap"))
    assert run.simulated
    assert [line(run, column) for column in TIMED] == [None] * 3
    assert line(run, "position_mm") is not None


def test_values_that_were_identified_say_by_what(asked: LoggedRun) -> None:
    assert "identified" not in learnt(asked)
    text = asked.log.config_text
    found = {"control.friction.coulomb_n": Estimate(35.2, 34.1, 36.4, 36.0, told=True)}
    c = parse(text, "virtual.toml")
    what = changes(c, text, {"control.friction.coulomb_n": 35.2, "name": "other"}, found)
    with_them = text_with(text, "virtual.toml", what, "moves.mcap, 2026-05-01")
    rows = [
        ("name", '"other"', "by moves.mcap, 2026-05-01"),
        ("control.friction.coulomb_n", "35.2", "34.1 … 36.4 by moves.mcap, 2026-05-01"),
    ]
    assert noted(with_them) == rows
    shown = learnt(
        cast(
            Any,
            SimpleNamespace(config=c, learning=asked.learning, log=SimpleNamespace(config_text=with_them)),
        )
    )
    assert "2 values identified from logs" in shown
    assert "34.1 … 36.4 by moves.mcap" in shown


def test_a_simulated_log_tells_when_its_scenario_began(tmp_path: Path) -> None:
    done = pneud_here("sim", "--scenario", "hose-burst", "-o", tmp_path / "burst.mcap")
    assert "as expected" in done.stdout
    run = gather(read_log(tmp_path / "burst.mcap"))
    assert run.log.metadata["scenario"] == "hose-burst"
    ((t_s, words),) = injections(run)
    assert words == "hose-burst begins"
    assert 0.4 < t_s < run.faults[0].latched_s
    assert f"Injected at {t_s:.3f} s" in page([run])


def test_a_report_is_shown_where_there_is_a_browser(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[str] = []

    def nowhere(address: str) -> bool:
        shown.append(address)
        return False

    monkeypatch.setattr(webbrowser, "open", nowhere)
    log = GOLDEN / "composite.mcap"
    done = pneud_here("report", log, "-o", tmp_path / "r.html", "--open")
    assert shown == [(tmp_path / "r.html").as_uri()]
    assert "no browser" in done.stderr
    assert done.returncode == 0
