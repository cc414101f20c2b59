"""A newcomer's way: answers, a configuration that `check` passes, an axis that tracks."""

from __future__ import annotations

import json
import os
import pty
import re
import subprocess
import sys
from contextlib import chdir
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from commands import pneud_here
from pneud.config import library
from pneud.config.conversions import cylinder_of
from pneud.config.flow import conductance_of
from pneud.config.sections import ConfigError
from pneud.loading import load
from pneud.replay.lockstep import Simulation, backend_of
from pneud.signals import State
from pneud.study.draft import Answers, drafted
from pneud.study.plausibility import findings
from pneud.verbs import VerbError
from pneud.verbs.check import check
from pneud.verbs.new import answered

SMALL = "--cylinder dsnu-16 --valve 100 --stroke 100 --mass 0.8 --encoder-step 10"
MIDDLE = {"cylinder": "dsbc-32", "valve": "mpye-5-1-8-lf", "stroke_mm": "300", "mass_kg": "8"}


def pneud(folder: Path, *args: str) -> subprocess.CompletedProcess[str]:
    with chdir(folder):
        return pneud_here(*args)


@pytest.mark.parametrize("name", library.names(library.VALVES))
def test_a_valve_of_the_library_has_the_flow_of_its_sheet(name: str) -> None:
    sheet = library.valve(name)
    c = drafted(answers(valve=name)).config
    C = conductance_of(c)
    assert pytest.approx(sheet.conductance, rel=1e-3) == C
    assert re.search(r"data sheet '.*', \d+, \d{4}/\d\d, p\. \d", sheet.source)


@pytest.mark.parametrize("name", library.names(library.CYLINDERS))
def test_a_cylinder_of_the_library_makes_a_rig_that_nothing_speaks_against(name: str) -> None:
    sheet = library.cylinder(name)
    draft = drafted(answers(cylinder=name, mass_kg=str(0.01 * sheet.bore_mm**2), valve="350"))
    assert not [f for f in findings(draft.config, 0.001, draft.bandwidth_rad_s) if f.is_error]
    assert (cylinder_of(draft.config).rod_force_n < 0.01) == (sheet.rod_mm == 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("cylinder", library.names(library.CYLINDERS))
def test_check_passes_what_is_made_of_each_cylinder_with_each_valve(
    tmp_path: Path, cylinder: str, capsys: pytest.CaptureFixture[str]
) -> None:
    bore_mm = library.cylinder(cylinder).bore_mm
    usual = {"stroke_mm": str(10.0 * bore_mm), "mass_kg": str(0.01 * bore_mm**2)}
    for valve in library.names(library.VALVES):
        draft = drafted(answers(cylinder=cylinder, valve=valve, **usual))
        assert not draft.warnings
        file = tmp_path / f"{valve}.toml"
        file.write_text(draft.text)
        assert check(str(file), json=True) == 0
        doubts = json.loads(capsys.readouterr().out)["warnings"]
        small = valve == "mpye-5-m5" and bore_mm > 40.0  # for such a piston
        assert ["will lag behind" in doubt for doubt in doubts] == [True] * small


@pytest.mark.parametrize(
    ("text", "l_min"), [("350", 350), ("c=1", 254), ("C = 1, b = 0.3", 254), ("kv=0.3", 353), ("cv=1", 1017)]
)
def test_a_valve_by_a_rating(text: str, l_min: float) -> None:
    assert library.valve(text).flow_l_min == pytest.approx(l_min, rel=0.005)


@pytest.mark.parametrize("text", ["", "foo", "-350", "kv=", "c=1,b=0.9", "b=0.3", "c=1,d=2", "nan", "inf"])
def test_no_valve(text: str) -> None:
    with pytest.raises(ConfigError):
        library.valve(text)


@pytest.mark.parametrize("text", ["", "dsnu", "12/32", "32/x", "32/", "nan", "1e9", "32/12/8"])
def test_no_cylinder(text: str) -> None:
    with pytest.raises(ConfigError):
        library.cylinder(text)


def answers(**given: str) -> Answers:
    return answered({**MIDDLE, **given}, None)


@settings(max_examples=8, deadline=None)
@given(
    st.sampled_from(library.names(library.CYLINDERS)),
    st.sampled_from(["100", "350", "700", "kv=0.2", "c=2,b=0.2"]),
    st.floats(20.0, 2000.0),
    st.floats(0.3, 30.0),
    st.floats(-90.0, 90.0),
    st.floats(4.0, 8.0),
)
def test_what_it_writes_can_be_read_and_no_check_refuses_it(
    cylinder: str, valve: str, stroke: float, kg: float, degrees: float, bar: float
) -> None:
    a = answers(cylinder=cylinder, valve=valve, stroke_mm=str(stroke), mass_kg=str(kg))
    try:
        draft = drafted(a._replace(inclination_deg=degrees, supply_bar=bar))
    except ConfigError as e:
        assert "too heavy" in str(e)
        return
    c = draft.config
    assert c.control.k2 * c.control.k3 > c.control.k1
    wrong = [f.key for f in findings(c, 0.001, draft.bandwidth_rad_s) if f.is_error]
    assert set(wrong) <= {"cylinder.moving_mass_kg"}  # light as no rig is


def test_a_rig_that_cannot_be_is_not_written(tmp_path: Path) -> None:
    done = pneud(tmp_path, "new", *SMALL.replace("0.8", "40").split(), "--inclination", "90")
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert "40 kg are too heavy: 392 N of weight" in done.stderr
    done = pneud(
        tmp_path, "new", *SMALL.replace("16", "63").replace("0.8", "0.05").replace("dsnu", "dsbc").split()
    )
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert "no rig is like that: 0.05 kg on a piston" in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("bar", ["2", "10"])
def test_its_frames_can_carry_any_supply(tmp_path: Path, bar: str) -> None:
    done = pneud(tmp_path, "new", *SMALL.split(), "--supply", bar, "--json")
    assert (done.returncode, done.stderr) == (0, "")
    assert load(tmp_path / "axis.toml").config.gas.supply_pa == pytest.approx(101_000.0 + 1e5 * float(bar))


def test_what_is_missing_is_said_in_one_line_and_nothing_is_written(tmp_path: Path) -> None:
    done = pneud(tmp_path, "new", "press", "--stroke", "100")
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert "missing: --cylinder, --valve, --mass;" in done.stderr
    assert not list(tmp_path.iterdir())


def test_a_file_that_is_there_stays(tmp_path: Path) -> None:
    (tmp_path / "axis.toml").write_text("mine")
    done = pneud(tmp_path, "new", *SMALL.split())
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert "axis.toml: is there already" in done.stderr
    assert (tmp_path / "axis.toml").read_text() == "mine"


@pytest.mark.parametrize(
    ("option", "value", "says"),
    [
        ("--mass", "heavy", "--mass 'heavy': must be a number"),
        ("--stroke", "1e9", "between 10 and 10000"),
        ("--valve", "mpye", "mpye-5-m5"),
        ("--bus", "can0", "socketcan:IF"),
        ("--encoder", "linear", "absolute or incremental"),
    ],
)
def test_an_answer_that_cannot_be_used_is_named(option: str, value: str, says: str) -> None:
    of = {"--mass": "mass_kg", "--stroke": "stroke_mm"}.get(option, option.strip("-"))
    with pytest.raises(ConfigError, match=option) as e:
        answers(**{of: value})
    assert says in str(e.value)


def test_what_is_not_given_is_asked_for_and_the_rest_is_not() -> None:
    asked = []
    with pytest.raises(VerbError):
        answered({"stroke_mm": "300"}, None)
    a = answered(MIDDLE, lambda q: asked.append(q.of) or q.read(q.default))  # type: ignore[func-returns-value]
    assert a == answers()
    assert not set(asked) & set(MIDDLE)
    assert len(asked) == len(Answers._fields) - len(MIDDLE)


@pytest.mark.slow
def test_a_newcomer_on_a_terminal(tmp_path: Path) -> None:
    primary, secondary = pty.openpty()
    lines = ["press", "x", "dsbc-32", "350", "300", "8", "90", "", "", "", "", ""]
    os.write(primary, ("\n".join(lines) + "\n").encode())
    done = subprocess.run(
        [sys.executable, "-m", "pneud.cli", "new", "--json"],
        cwd=tmp_path,
        stdin=secondary,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    os.close(primary)
    os.close(secondary)
    assert done.returncode == 0, done.stderr
    assert "'x': none of dsnu-16" in done.stderr
    assert "dsbc-32 (32/12)" in done.stderr and "mpye-5-1-8-lf (350 l/min)" in done.stderr
    assert json.loads(done.stdout)["name"] == "press"
    assert load(tmp_path / "press.toml").config.cylinder.inclination_deg == 90.0


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        SMALL,
        "--cylinder 32/12 --valve 350 --stroke 300 --mass 8 --inclination -90",
        "--cylinder dsbc-63 --valve mpye-5-1-8-hf --stroke 600 --mass 60",
        "--cylinder dgc-40 --valve kv=0.6 --stroke 1000 --mass 10",
    ],
    ids=["small", "hanging", "large", "rodless"],
)
def test_a_newcomers_axis_tracks(tmp_path: Path, options: str) -> None:
    done = pneud(tmp_path, "new", "first", *options.split())
    assert (done.returncode, done.stderr) == (0, "")
    assert "warning" not in done.stdout
    done = pneud(tmp_path, "check", "first.toml")
    assert (done.returncode, done.stderr) == (0, "")
    assert "fine" in done.stdout
    loaded = load(tmp_path / "first.toml")
    run = Simulation(loaded, 8.0, how=backend_of(loaded))
    errors_m = [
        abs(r.tick.reference.position_m - r.truth_m) for r in run.records() if r.tick.state == State.TRACKING
    ]
    assert len(errors_m) > 6000
    assert max(errors_m[4000:]) < 5e-4
