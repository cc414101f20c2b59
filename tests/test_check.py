"""`pneud check` names the file, the key, the value and the bound."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from commands import pneud as pneud_alone
from commands import pneud_here as pneud
from pneud import resources
from pneud.bus.codec import DatabaseError
from pneud.bus.load import longest_s
from pneud.config.models import Config
from pneud.config.places import keys_of, line_of
from pneud.config.reading import load_config, parse
from pneud.config.sections import ConfigError
from pneud.loading import load
from pneud.scenario.files import is_scenario, load_scenario

GOOD = (resources.configs() / "virtual.toml").read_text()
ROOT = Path(__file__).parent.parent
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


def written(folder: Path, *changes: tuple[str, str]) -> Path:
    text = GOOD
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    file = folder / "axis.toml"
    file.write_text(text)
    return file


IMPLAUSIBLE = [
    (
        "orifice",
        "orifice_area_m2 = 2.8274e-5",
        "orifice_area_m2 = 6.9",
        "line 21: valve.orifice_area_m2 = 6.9",
    ),
    (
        "encoder step",
        "encoder_resolution_m = 1.0e-6",
        "encoder_resolution_m = 5.0",
        "encoder_resolution_m = 5.0",
    ),
    ("dead zone", "dead_zone_v = 0.1", "dead_zone_v = 2.0", "valve.dead_zone_v: a dead zone of 2 of 5 V"),
    ("friction", "static_n = 60.0", "static_n = 6000.0", "N of friction against"),
    ("no room to run up", "frequency_hz = 0.5", "frequency_hz = 5.0", "limits.transfer: the run-up to"),
    (
        "light",
        "moving_mass_kg = 15.0",
        "moving_mass_kg = 0.01",
        "cylinder.moving_mass_kg: 0.01 kg on a piston",
    ),
    (
        "gas in other units",
        "gas_constant_j_kg_k = 286.987",
        "gas_constant_j_kg_k = 0.287",
        "gas.gas_constant_j_kg_k = 0.287",
    ),
    (
        "viscous plant",
        "viscous_n_s_m = 60.0",
        "viscous_n_s_m = 60_000.0",
        "plant.friction.viscous_n_s_m: 9.42e+03 N of friction at 0.16 m/s against",
    ),
    (
        "beyond the valve",
        "orifice_area_m2 = 2.8274e-5",
        "orifice_area_m2 = 5e-7",
        "V of the valve's 5 V",
    ),
]


@pytest.mark.parametrize(("_name", "old", "new", "says"), IMPLAUSIBLE, ids=[b[0] for b in IMPLAUSIBLE])
def test_what_no_rig_has_is_refused_with_its_line(
    tmp_path: Path, _name: str, old: str, new: str, says: str
) -> None:
    done = pneud("check", written(tmp_path, (old, new)))
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1
    assert says in done.stderr
    assert "line " in done.stderr


@pytest.mark.parametrize(
    ("force_n", "says"),
    [
        (50, "50 N do not overcome 60 N of friction"),
        (400, "warning: line 50: encoder.homing.force_n: 400 N of the piston's 527 N"),
        (1200, "1200 N of the piston's 527 N"),
    ],
)
def test_homing_is_stronger_than_friction_and_weaker_than_the_piston(
    tmp_path: Path, force_n: int, says: str
) -> None:
    force = ("force_n = 120.0", f"force_n = {force_n}.0")
    assert "fine" in pneud("check", written(tmp_path, force)).stdout  # nobody homes an absolute encoder
    done = pneud("check", written(tmp_path, force, ('kind = "absolute"', 'kind = "incremental"')))
    assert done.returncode == (0 if "warning" in says else 2)
    assert says in (done.stdout or done.stderr)


def test_a_reference_beyond_the_piston_is_refused(tmp_path: Path) -> None:
    done = pneud("check", written(tmp_path, ("moving_mass_kg = 15.0", "moving_mass_kg = 1500.0")))
    assert done.returncode == 2
    assert "% of the piston's force" in done.stderr


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (
            "dead_zone_v = 0.1",
            "dead_zone_v = 1.0",
            "warning: line 25: valve.dead_zone_v: a dead zone of 1 of 5 V",
        ),
        ("static_n = 60.0", "static_n = 300.0", "N of friction against"),
        ("moving_mass_kg = 15.0", "moving_mass_kg = 0.3", "cylinder.moving_mass_kg"),
        ("dead_length_2_m = 0.0158", "dead_length_2_m = 15.8", "cylinder.dead_length_2_m: a dead length of"),
        ("orifice_area_m2 = 2.8274e-5", "orifice_area_m2 = 2.6e-6", "limits.motion: moves take up to"),
    ],
)
def test_what_few_rigs_have_is_a_warning(tmp_path: Path, old: str, new: str, says: str) -> None:
    done = pneud("check", written(tmp_path, (old, new)))
    assert done.returncode == 0, done.stderr
    assert says in done.stdout
    assert "fine" not in done.stdout


def test_what_a_rating_comes_to_is_told(tmp_path: Path) -> None:
    rating = 'nominal_flow_l_min = 350.0\nflow = "iso6358"\ncritical_ratio = 0.25'
    file = written(tmp_path, ("orifice_area_m2 = 2.8274e-5", rating))
    done = pneud("check", file)
    assert "valve 350 l/min ANR at 6 -> 5 bar, C 1.419 l/(s bar), b 0.25" in done.stdout
    assert "the plant's" not in done.stdout
    assert json.loads(pneud("check", file, "--json").stdout)["valve"]["nominal_flow_l_min"] == 350.0


@pytest.mark.parametrize(
    ("rate", "bitrate", "fits"),
    [
        *((1000, "1_000_000.0", True), (1400, "1_000_000.0", True), (1500, "1_000_000.0", False)),
        *((2000, "1_000_000.0", False), (2000, "inf", True), (5000, "inf", True)),
        *((500, "250_000.0", False), (390, "250_000.0", True), (250, "125_000.0", False)),
    ],
)
def test_the_bus_has_to_carry_the_rate(tmp_path: Path, rate: int, bitrate: str, fits: bool) -> None:
    file = written(
        tmp_path,
        ("rate_hz = 1000.0", f"rate_hz = {rate}.0"),
        ("bitrate_bit_s = 1_000_000.0", f"bitrate_bit_s = {bitrate}"),
    )
    if fits:
        assert load(file).config.loop.rate_hz == rate
        return
    with pytest.raises(ConfigError) as e:
        load(file)
    assert f"loop.rate_hz = {rate}" in str(e.value)
    assert "take at most" in str(e.value)


def test_the_rate_that_it_names_can_be_had(tmp_path: Path) -> None:
    changes = ("bitrate_bit_s = 1_000_000.0", "bitrate_bit_s = 250_000.0")
    with pytest.raises(ConfigError) as e:
        load(written(tmp_path, changes))
    most = re.search(r"at most (\d+) Hz", str(e.value))
    assert most is not None
    assert load(written(tmp_path, changes), float(most.group(1)))
    with pytest.raises(ConfigError):
        load(written(tmp_path, changes), float(most.group(1)) + 1.0)


@given(st.binary(max_size=8))
def test_no_frame_is_longer_than_the_longest(data: bytes) -> None:
    """Bits as ISO 11898 has them, stuffed one by one."""
    bits = [0, *(1 for _ in range(11)), 0, 0, 0, *(len(data) >> i & 1 for i in (3, 2, 1, 0))]
    bits += [byte >> i & 1 for byte in data for i in range(7, -1, -1)]
    crc = 0
    for bit in bits:
        crc = (crc << 1 ^ (0x4599 if (crc >> 14 & 1) != bit else 0)) & 0x7FFF
    bits += [crc >> i & 1 for i in range(14, -1, -1)]
    length, run, last = 0, 0, -1
    for bit in bits:
        run = run + 1 if bit == last else 1
        last = bit
        length += 1
        if run == 5:
            length, run, last = length + 1, 1, 1 - bit
    assert (length + 13) / 1e6 <= longest_s(len(data), 1e6)


def test_an_unknown_key_is_told_from_a_known_one(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"line 26: valve.dead_zon_v: unknown key; is dead_zone_v meant\?"):
        load(
            written(
                tmp_path, ("dead_zone_v = 0.1\n\n[loop]", "dead_zone_v = 0.1\ndead_zon_v = 0.1\n\n[loop]")
            )
        )
    with pytest.raises(ConfigError, match=r"gas.stroke_m: unknown key; is cylinder.stroke_m meant\?"):
        load(written(tmp_path, ("[gas]\n", "[gas]\nstroke_m = 1.0\n")))


@given(st.data())
def test_a_key_is_found_on_the_line_it_stands_on(data: st.DataObject) -> None:
    known = set(keys_of(Config))
    keys = sorted(known - {key[:-1] for key in known} - {key for key in known if len(key) == 1})
    some = data.draw(st.lists(st.sampled_from(keys), unique=True, min_size=1, max_size=8))
    lines: list[str] = []
    places = {}
    for key in some:
        if data.draw(st.booleans()):
            lines += ["", f"[{'.'.join(key[:-1])}]  # of it", f"{key[-1]} = 1"]
        else:
            lines += [f"[ {' . '.join(key[:1])} ]", f"{' . '.join(key[1:])} = 1"]
        places[key] = len(lines)
    text = "\n".join(lines)
    for key, line in places.items():
        assert line_of(text, key) == line


@pytest.mark.parametrize(
    ("key", "line"),
    [
        ("play", 2),
        ("play.0.do", 3),
        ("play.1", 5),
        ("play.1.move.by_m", 7),
        ("play.1.by_m", 7),
        ("play.1.move.to_mm", 5),
        ("bus.nodes.0.id", 10),
        ("bus.nodes.1.id", 12),
        ("bus.nodes.1.extra.x", 14),
        ("bus.rate", 16),
    ],
)
def test_a_key_of_one_of_several_tables_is_found_in_that_one(key: str, line: int) -> None:
    text = """
[[play]]
do = "sine"

[[play]]
do = "move"
by_m = 1

[[bus.nodes]]
id = 1
[[bus.nodes]]
id = 2
[bus.nodes.extra]
x = 1
[bus]
rate = 1
"""
    assert line_of(text, key.split(".")) == line


def test_the_page_of_all_keys_is_what_the_models_say() -> None:
    made = subprocess.run(
        [sys.executable, "docs/generators/configuration.py"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    assert (ROOT / "docs" / "configuration.md").read_text() == made.stdout
    for *_, key in keys_of(Config):
        assert key in made.stdout


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
