"""`pneud check` names the file, the key, the value and the bound."""

from __future__ import annotations

from pathlib import Path

import pytest

from commands import pneud as pneud_alone
from commands import pneud_here as pneud
from pneud import resources
from pneud.bus.codec import DatabaseError
from pneud.config.models import ConfigError, load_config, parse
from pneud.loading import is_scenario, load, load_scenario

GOOD = (resources.configs() / "virtual.toml").read_text()
DBC = (resources.configs() / "pneud.dbc").read_text()

BROKEN = [
    ("unknown key", "stroke_m = 1.0", "stroke_m = 1.0\nstroke_mm = 1000", "cylinder.stroke_mm: unknown key"),
    ("value out of its range", "rate_hz = 1000.0", "rate_hz = 100000.0", "loop.rate_hz = 100000.0"),
    ("gains that are not Hurwitz", "k3 = ", "k3 = 0.001 # ", "not Hurwitz"),
    ("more than 5 V", "u_max_v = 5.0", "u_max_v = 6.0", "valve.u_max_v = 6.0"),
    (
        "limits the wrong way round",
        "travel_min_m = 0.02",
        "travel_min_m = 0.99",
        "must lie below travel_max_m",
    ),
    ("filters too far apart", "push_bandwidth_rad_s = 600.0", "push_bandwidth_rad_s = 900.0", "2.5 times it"),
    ("NaN", "moving_mass_kg = 15.0", "moving_mass_kg = nan", "cylinder.moving_mass_kg = nan"),
    ("missing key", "moving_mass_kg = 15.0", "", "cylinder.moving_mass_kg: missing"),
    ("wrong type", "moving_mass_kg = 15.0", 'moving_mass_kg = "heavy"', "cylinder.moving_mass_kg = 'heavy'"),
    ("no TOML", "[gas]", "[gas", "not valid TOML"),
    ("another schema", "schema = 1", "schema = 2", "schema = 2"),
    ("reference beyond the travel", "amplitude_m = 0.05", "amplitude_m = 0.6", "reference reaches"),
    ("supply outside its limits", "supply_min_pa = 450_000.0", "supply_min_pa = 650_000.0", "gas.supply_pa"),
    (
        "time-out below two ticks",
        "sensor_timeout_ms = 50.0",
        "sensor_timeout_ms = 1.5",
        "bus.sensor_timeout_ms",
    ),
    ("missing DBC", 'dbc = "pneud.dbc"', 'dbc = "absent.dbc"', "absent.dbc: no such file"),
    ("observer that cannot follow", "lambda1 = 1.1", "lambda1 = 0.9", "lambda1 must exceed 1"),
    ("bus of no known form", 'channel = "auto"', 'channel = "can0"', "none of auto"),
]


@pytest.mark.parametrize(("_name", "old", "new", "says"), BROKEN, ids=[b[0] for b in BROKEN])
def test_a_broken_configuration_gets_one_line(
    tmp_path: Path, _name: str, old: str, new: str, says: str
) -> None:
    assert old in GOOD
    (tmp_path / "pneud.dbc").write_text(DBC)
    file = tmp_path / "axis.toml"
    file.write_text(GOOD.replace(old, new, 1))
    with pytest.raises(ConfigError) as e:
        load(file)
    text = str(e.value)
    assert says in text
    assert str(file) in text
    assert "\n" not in text


def test_the_answers_differ(tmp_path: Path) -> None:
    answers = set()
    for _, old, new, _ in BROKEN:
        file = tmp_path / "axis.toml"
        file.write_text(GOOD.replace(old, new, 1))
        with pytest.raises(ConfigError) as e:
            load(file)
        answers.add(str(e.value))
    assert len(answers) == len(BROKEN)


def test_check_exits_2_with_the_line_on_standard_error(tmp_path: Path) -> None:
    file = tmp_path / "axis.toml"
    file.write_text(GOOD.replace("u_max_v = 5.0", "u_max_v = 50.0"))
    done = pneud("check", file)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert "valve.u_max_v = 50.0" in done.stderr


def test_a_dbc_without_a_signal_is_named(tmp_path: Path) -> None:
    (tmp_path / "pneud.dbc").write_text(DBC.replace("SG_ P2 ", "SG_ Pressure2 "))
    file = tmp_path / "axis.toml"
    file.write_text(GOOD)
    done = pneud("check", file)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert "PRESSURE" in done.stderr
    assert "P2" in done.stderr


def test_two_messages_of_one_name_are_refused_and_both_named(tmp_path: Path) -> None:
    again = 'BO_ 400 ENCODER: 8 ENCODER_NODE\n SG_ Position : 0|32@1- (1E-003,0) [0|0] "m" CONTROLLER\n\n'
    (tmp_path / "pneud.dbc").write_text(DBC.replace("\nBO_ 386 ", f"\n{again}BO_ 386 "))
    file = tmp_path / "axis.toml"
    file.write_text(GOOD)
    done = pneud_alone("check", file)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1
    assert "message ENCODER: is there 2 times, as 0x181 and 0x190" in done.stderr


def test_files_may_begin_with_a_byte_order_mark(tmp_path: Path) -> None:
    (tmp_path / "pneud.dbc").write_text(DBC, encoding="utf-8-sig")
    file = tmp_path / "axis.toml"
    file.write_text(GOOD, encoding="utf-8-sig")
    done = pneud("check", file)
    assert (done.returncode, done.stderr) == (0, "")
    assert load(file).text == GOOD
    scenario = tmp_path / "s.toml"
    scenario.write_text((resources.scenarios() / "babble.toml").read_text(), encoding="utf-8-sig")
    assert is_scenario(scenario)
    load_scenario(scenario)


@pytest.mark.parametrize("file", sorted(resources.configs().glob("*.toml")), ids=lambda f: f.name)
def test_every_configuration_that_comes_with_pneud_is_fine(file: Path) -> None:
    assert load(file).config.name == file.stem


def test_rig_and_virtual_describe_the_same_axis() -> None:
    rig, virtual = load_config("rig.toml"), load_config("virtual.toml")
    for section in ("cylinder", "gas", "valve", "loop", "control", "reference", "limits"):
        assert getattr(rig, section) == getattr(virtual, section), section
    assert rig.realtime.required
    assert rig.bus.sensor_timeout_ms == 5.0


def test_text_of_a_configuration_can_be_parsed_again() -> None:
    assert parse(GOOD, "virtual.toml") == load_config("virtual.toml")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("SG_ Voltage : 0|16@1- ", "SG_ Voltage : 0|16@1+ "),  # no negative voltage
        ("SG_ Voltage : 0|16@1- (0.0005,0)", "SG_ Voltage : 0|8@1- (0.0005,0)"),
        ("SG_ Voltage : 0|16@1- (0.0005,0)", "SG_ Voltage : 0|16@1- (0.5,0)"),
        ("SG_ Position : 0|32@1- ", "SG_ Position : 0|16@1- "),
        ("SG_ Sequence : 24|8@1+ ", "SG_ Sequence : 24|4@1+ "),
    ],
    ids=["unsigned command", "short command", "coarse command", "short position", "short sequence"],
)
def test_a_dbc_too_narrow_for_the_axis_is_refused(tmp_path: Path, old: str, new: str) -> None:
    assert old in DBC
    (tmp_path / "pneud.dbc").write_text(DBC.replace(old, new))
    file = tmp_path / "axis.toml"
    file.write_text(GOOD)
    with pytest.raises(DatabaseError) as e:
        load(file)
    assert "\n" not in str(e.value)
