"""What is learnt, outside the law: kept for the next run, and shown in status, screen and report."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from commands import pneud_here
from console_bench import Bench
from log_samples import tick_at
from pneud.axis.state import switched_on
from pneud.config import conversions
from pneud.config.flow import area_of
from pneud.config.learnt import QUANTITIES, adaptation_of, start_of, values_learnt
from pneud.config.models import Config
from pneud.config.reading import load_config
from pneud.config.sections import ConfigError
from pneud.config.writing import put, rewrite
from pneud.console.operator import Operator
from pneud.control.adaptation import Learnt
from pneud.loading import load
from pneud.log.files.reader import read_log
from pneud.log.live.amiss import NEVER_NS, Amiss, Counts
from pneud.replay.learning import last_learnt
from pneud.report.gather import Window, gather
from pneud.report.page import page
from pneud.report.readings import SOURCES
from pneud.signals import ALL_SOURCES, Defect, Measurement, Record, Source, Timing
from pneud.verbs.status import in_words
from pneud.view.learnt import in_brief
from pneud.view.show import Show
from test_console import desk as desk  # noqa: PLC0414  (a fixture)
from test_view import INFO

LOG = Path(__file__).parent / "golden" / "composite.mcap"
C = load("virtual.toml").config
DIFFERENT = Learnt(0.02, -0.01, 1.1, 1.25, 0.8, 2.0, -12.0, 0.9)


def started(axis: str = "virtual", **values: float) -> Config:
    return load("virtual.toml", None, {"control": {"adaptation": {"start": {"axis": axis, **values}}}}).config


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    """A configuration of one's own."""
    path = tmp_path / "mine.toml"
    shutil.copy("configs/virtual.toml", path)
    shutil.copy("configs/pneud.dbc", tmp_path)
    return path


# in the terms of the configuration


def test_values_are_told_as_the_configuration_has_them() -> None:
    found = {name: v["value"] for name, v in values_learnt(DIFFERENT, C).items()}
    assert found == pytest.approx(
        {
            "dead_zone_positive_v": 0.12,
            "dead_zone_negative_v": 0.09,
            "orifice_area_m2": 1.1 * area_of(C),
            "bandwidth_hz": C.valve.bandwidth_hz / 1.25,
            "coulomb_n": 0.8 * C.control.friction.coulomb_n,
            "bristle_stiffness_n_m": 2.0 * C.control.friction.bristle_stiffness_n_m,
            "load_n": -12.0,
            "moving_mass_kg": 0.9 * C.cylinder.moving_mass_kg,
        },
        rel=1e-5,
    )
    assert not any(v["check"] for v in values_learnt(DIFFERENT, C).values())


def test_what_is_at_its_bound_says_what_to_check_and_what_is_configured_there_does_not() -> None:
    p = adaptation_of(C)
    found = values_learnt(Learnt(p.edges.most - 0.1, -0.1, 0.5, 4.0, 3.0, 20.0, p.load.most, 0.4), C)
    assert all(v["check"] for v in found.values())
    assert found["dead_zone_negative_v"]["check"] == "valve.dead_zone_v, the valve's centre"
    assert not any(
        v["check"] for v in values_learnt(Learnt(), C).values()
    )  # the lag's least is what is configured


def test_nothing_is_told_where_nothing_is_learnt() -> None:
    assert not values_learnt(
        DIFFERENT, load("virtual.toml", None, {"control": {"adaptation": {"enabled": False}}}).config
    )
    part = load("virtual.toml", None, {"control": {"adaptation": {"flow": False}}}).config
    assert "orifice_area_m2" not in values_learnt(Learnt(), part)
    assert "orifice_area_m2" in values_learnt(DIFFERENT, part)  # begun elsewhere, and kept
    rigid = load("paper-case1.toml").config
    assert not {"bandwidth_hz", "coulomb_n"} & set(values_learnt(Learnt(), rigid))


# kept for the next run


@given(
    st.builds(
        Learnt,
        st.floats(-0.1, 0.3),
        st.floats(-0.1, 0.3),
        st.floats(0.5, 2.0),
        st.floats(1.0, 4.0),
        st.floats(0.3, 3.0),
        st.just(1.0),
        st.floats(-600.0, 600.0),
        st.floats(0.4, 2.5),
    )
)
def test_what_is_told_is_where_it_starts_again(learnt: Learnt) -> None:
    start = {name: v["value"] for name, v in values_learnt(learnt, C).items()}
    adaptation = C.control.adaptation
    begun = adaptation.start.model_copy(update={"axis": C.name, **start})
    control = C.control.model_copy(update={"adaptation": adaptation.model_copy(update={"start": begun})})
    again = start_of(C.model_copy(update={"control": control}))
    assert again[:8] == pytest.approx(learnt[:8], rel=1e-5, abs=1e-6)
    assert again[8:] == Learnt()[8:]


def test_an_axis_starts_from_it() -> None:
    c = started(moving_mass_kg=12.0, dead_zone_positive_v=0.15)
    p = conversions.axis_of(c, 5e-4)
    assert p.learnt == Learnt(edge_plus_v=pytest.approx(0.05), mass=pytest.approx(0.8))  # type: ignore[arg-type]
    assert switched_on(p).learnt == p.learnt


@pytest.mark.parametrize(
    ("axis", "values", "words"),
    [
        ("other", {"load_n": 1.0}, "start.axis = 'other': learnt on another axis than 'virtual'"),
        ("", {"load_n": 1.0}, "learnt on another axis"),
        ("virtual", {"moving_mass_kg": 5.0}, "start.moving_mass_kg = 5: beyond what is learnt, 6 … 37.5"),
        ("virtual", {"dead_zone_negative_v": -0.01}, "beyond what is learnt"),
        ("virtual", {"bandwidth_hz": 101.0}, "beyond what is learnt, 25 … 100"),
    ],
)
def test_values_of_another_rig_are_refused_in_one_line(
    axis: str, values: dict[str, float], words: str
) -> None:
    with pytest.raises(ConfigError) as refused:
        started(axis, **values)
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_value_beside_a_key_that_is_0_has_nothing_to_stand_for() -> None:
    change = {"control": {"adaptation": {"start": {"axis": "paper-case1", "bandwidth_hz": 10.0}}}}
    with pytest.raises(ConfigError, match=r"start\.bandwidth_hz = 10: valve\.bandwidth_hz is 0"):
        load("paper-case1.toml", None, change)


def test_the_verb_tells_and_writes_and_the_file_says_where_it_comes_from(rig: Path) -> None:
    told = pneud_here("learnt", LOG, "--json")
    values = json.loads(told.stdout)["learnt"]
    assert told.returncode == 0
    assert list(values) == [q.name for q in QUANTITIES]
    before = rig.read_text()
    for _ in range(2):  # what was there is replaced
        done = pneud_here("learnt", LOG, "--into", rig)
        assert done.returncode == 0
        assert f"written into {rig}" in done.stdout
    start = load_config(rig).control.adaptation.start
    assert start.model_dump(exclude_none=True) == {
        "axis": "virtual",
        "log": "composite.mcap",
        **{name: v["value"] for name, v in values.items()},
    }
    text = rig.read_text()
    assert text.count("[control.adaptation.start]") == 1
    assert "# learnt on simulated" in text
    assert set(before.splitlines()) <= set(text.splitlines())
    assert "adaptation starts from composite.mcap" in pneud_here("check", rig).stdout


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            ("name = ", 'name = "another"  # '),
            "name is another, in composite.mcap virtual: learnt on another rig",
        ),
        (("stroke_m = 1.0", "stroke_m = 1.01"), "cylinder.stroke_m is 1.01"),
    ],
)
def test_another_rig_does_not_get_it(rig: Path, change: tuple[str, str], words: str) -> None:
    text = rig.read_text()
    assert change[0] in text
    rig.write_text(text.replace(*change, 1))
    done = pneud_here("learnt", LOG, "--into", rig)
    assert done.returncode == 2
    assert words in done.stderr
    assert not done.stdout
    assert rig.read_text() == text.replace(*change, 1)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (
            "adaptation = {enabled = true}",
            "is written in one line, which cannot hold start: write [control.adaptation]",
        ),
        ("adaptation = {enabled = false}", "enabled is false: what was learnt would not count"),
    ],
)
def test_a_file_that_cannot_take_it_is_left_as_it_is(rig: Path, line: str, words: str) -> None:
    rig.write_text(rig.read_text().replace("[control]\n", f"[control]\n{line}\n", 1))
    before = rig.read_text()
    done = pneud_here("learnt", LOG, "--into", rig)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1), done
    assert words in done.stderr
    assert rig.read_text() == before


def test_without_a_log_a_file_or_a_snapshot_it_says_so(rig: Path) -> None:
    for args, words in (
        ((LOG.with_name("none.mcap"),), "cannot be read"),
        ((LOG.with_name("virtual.mcap"),), "no snapshot that tells what was learnt; there is one every 2 s"),
        ((LOG, "--into", rig.with_name("none.toml")), "there is no such file"),
    ):
        done = pneud_here("learnt", *args)
        assert done.returncode == 2
        assert words in done.stderr
        assert done.stderr.count("\n") == 1


@pytest.mark.slow
def test_a_run_that_starts_from_a_log_goes_on_there_and_replays(rig: Path, tmp_path: Path) -> None:
    first, second = tmp_path / "first.mcap", tmp_path / "second.mcap"
    rewrite(rig, lambda tables: put(tables, ("valve", "dead_zone_v"), 0.2))  # where the plant has 0.1
    assert pneud_here("sim", rig, "--duration", 12, "-o", first).returncode == 0
    assert pneud_here("learnt", first, "--into", rig).returncode == 0
    assert pneud_here("sim", rig, "--duration", 3, "-o", second).returncode == 0
    edges = ("edge_plus_v", "edge_minus_v")
    for log in (first, second):
        learnt, _ = last_learnt(read_log(log))
        assert [0.2 + getattr(learnt, edge) for edge in edges] == pytest.approx([0.1, 0.1], abs=0.02)
    for begin_s in (0, 2.5):
        replayed = pneud_here("replay", second, "--from", begin_s, "--json")
        assert json.loads(replayed.stdout)["identical"] is True


# readings amiss


def heard(t_s: float = 1.0, fresh: int = ALL_SOURCES, **more: int) -> Measurement:
    return tick_at(round(t_s * 1e9)).measurement._replace(fresh=fresh, **more)


def test_ticks_without_a_reading_are_counted_by_what_became_of_it() -> None:
    amiss = Amiss()
    for m in (
        heard(),
        heard(fresh=ALL_SOURCES & ~Source.ENCODER),
        heard(fresh=ALL_SOURCES & ~Source.VALVE, valve_defects=int(Defect.LATE)),
        heard(fresh=ALL_SOURCES & ~Source.PRESSURE, pressure_defects=int(Defect.CORRUPT)),
        heard(fresh=ALL_SOURCES & ~Source.PRESSURE, pressure_age_ns=2 * NEVER_NS),
        heard(encoder_defects=int(Defect.ODD)),  # and shown as the one before
        heard(fresh=ALL_SOURCES & ~Source.PRESSURE, pressure_defects=int(Defect.ODD)),
        heard(pressure_defects=int(Defect.CONFIRMED)),  # so it was none
    ):
        amiss.add(m)
    assert amiss.all == amiss.lately() == Counts(1, 1, 1)


def test_an_odd_one_from_before_it_began_is_not_taken_back() -> None:
    amiss = Amiss()
    amiss.add(heard(encoder_defects=int(Defect.CONFIRMED)))
    assert amiss.all == amiss.lately() == Counts()
    amiss.add(heard(2.999, encoder_defects=int(Defect.ODD)))
    amiss.add(heard(3.0, encoder_defects=int(Defect.CONFIRMED)))
    amiss.add(heard(62.5))
    assert amiss.lately() == Counts()


def test_the_last_minute_is_what_it_says() -> None:
    amiss = Amiss()
    for second in range(100):
        amiss.add(heard(second, fresh=3))
        amiss.add(heard(second + 0.5, fresh=3))
    assert amiss.lately() == Counts(120, 0, 0)
    amiss.add(heard(159.0))
    assert amiss.lately() == Counts()
    assert amiss.all == Counts(200, 0, 0)


def test_sensors_that_run_free_owe_nothing() -> None:
    amiss = Amiss(sync=False)
    amiss.add(heard(fresh=0))
    assert amiss.all == Counts()


# shown


def state_of(learnt: Learnt) -> dict[str, Any]:
    return {"axis": switched_on(conversions.axis_of(C, 5e-4))._replace(learnt=learnt)}


def test_status_has_what_is_learnt_and_what_was_amiss(desk: Bench) -> None:
    client = desk.connect()
    assert desk.ask(client, "status")["learnt"] == values_learnt(Learnt(), C)
    tick = tick_at(1)._replace(measurement=heard(fresh=6))
    desk.ring.put(Record(tick, Timing(0, 1, 1, 1, 1, 1), (), 0, (), 0.0))
    desk.ring.put_state(1, state_of(DIFFERENT._replace(mass=0.4)))
    desk.watch.poll()
    desk.watch.poll()
    found = desk.ask(client, "status")
    assert found["amiss"] == found["amiss_last_minute"] == {"missing": 1, "late": 0, "odd": 0}
    assert found["learnt"] == values_learnt(DIFFERENT._replace(mass=0.4), C)
    assert found["learnt_from"] is None
    desk.ring.put_state(1, None)  # one that was too long
    desk.watch.poll()
    desk.watch.poll()
    assert desk.ask(client, "status")["learnt"] == found["learnt"]
    words = "\n".join(in_words(found))
    assert "readings amiss: 1 missing, 0 late, 0 odd; in the last minute: 1 missing" in words
    assert "learnt: zone 120/90 mV, flow +10%, valve -20%, dry -20%, bristles +100%, mass -60%," in words
    assert "moving_mass_kg = 6 is at its bound: check cylinder.moving_mass_kg, the load" in words
    begun = "\n".join(in_words({**found, "learnt_from": "x.mcap"}))
    assert "learnt (from x.mcap on): zone" in begun
    assert "zone" not in "\n".join(in_words({**found, "learnt": None}))


def test_a_few_words_say_what_stands_at_its_bound() -> None:
    words = list(in_brief(values_learnt(Learnt(edge_plus_v=0.3, flow=0.999), C)))
    assert [w.text for w in words] == ["400/100 mV", "+0%", "+0%", "+0%", "+0%", "+0%", "+0 N"]
    assert [w.at_bound for w in words] == [True, False, False, False, False, False, False]


def test_the_report_counts_as_the_run_does_and_shows_what_was_learnt() -> None:
    log = read_log(LOG.with_name("frames-lost.mcap"))
    run, amiss = gather(log), Amiss()
    for tick in log:
        amiss.add(tick.measurement)
    for kind, count in amiss.all._asdict().items():
        assert sum(run.readings.by_second[source, kind].total() for source in SOURCES) == count
    assert min(amiss.all.missing, amiss.all.late) > 20
    rows = {name: words for name, *words in run.learning.rows()}
    values = values_learnt(last_learnt(log)[0], run.config)
    assert list(rows) == list(values)
    assert rows["bandwidth_hz"][:2] == ["100", f"{values['bandwidth_hz']['value']:.4g}"]
    assert values["bandwidth_hz"]["value"] < 90.0
    assert "<polyline" in rows["bandwidth_hz"][-1]
    text = page([run])
    assert text.count('<svg class="small"') == len(rows)
    assert "worst second" in text


def test_a_part_of_a_log_shows_what_was_learnt_in_it_if_anything() -> None:
    run = gather(read_log(LOG), Window(0.0, 0.02))
    assert not run.learning.last
    assert "Nothing: adaptation was off" in page([run])


def test_the_screen_of_a_running_daemon_asks_for_it_now_and_then() -> None:
    class Daemon:
        def __init__(self) -> None:
            self.asked: list[str] = []
            self.answers: list[dict[str, Any]] = []

        def send(self, verb: str) -> None:
            self.asked.append(verb)

        def replies(self) -> list[dict[str, Any]]:
            return self.answers

    daemon, learnt = Daemon(), values_learnt(DIFFERENT, C)
    operator = Operator(lambda: daemon, look_only=False)  # type: ignore[arg-type,return-value]
    show = Show(list, INFO, lambda: False, operator=operator)

    def shown() -> object:
        show.attend()
        return show.snapshot.info.learnt

    assert shown() is None
    daemon.answers = [{"ok": True, "state": "holding", "learnt": learnt}]
    assert shown() == learnt
    daemon.answers = [{"ok": True}]  # to something else
    assert shown() == learnt
    assert daemon.asked == ["status"]
