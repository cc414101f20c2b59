"""Several axes in one file, or one file each in a folder: what each is, and what cannot be together."""

from __future__ import annotations

import json
import shutil
from functools import partial
from pathlib import Path

import pytest

from commands import pneud
from pneud import resources
from pneud.bus.load import load_of, most_axes, most_hz
from pneud.config.axes import own_text
from pneud.config.reading import parse
from pneud.config.sections import ConfigError
from pneud.console.protocol import ProtocolError
from pneud.console.tuning import Tuning
from pneud.loading import load, load_axes

FOLDER = resources.configs() / "axes"
TEXT = (FOLDER / "two-axes.toml").read_text()
LINE = TEXT[: TEXT.index("reference.frequency_hz")].count("\n") + 1
THIRD = """
[[axis]]
name = "z"
[axis.bus.frames]
encoder = { message = "ENCODER_3", node = 7 }
pressure = { message = "PRESSURE_3", node = 8 }
valve_status = { message = "VALVE_STATUS_3", node = 9 }
valve_command = { message = "VALVE_COMMAND_3" }
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    shutil.copy(FOLDER / "axes.dbc", tmp_path)
    return tmp_path / "a.toml"


def why(file: Path, text: str) -> str:
    file.write_text(text)
    with pytest.raises(ConfigError) as e:
        load_axes(file)
    return str(e.value)


def test_what_stands_above_holds_for_all_and_an_axis_has_its_own() -> None:
    x, y = load_axes("two-axes.toml")
    assert (x.config.name, y.config.name) == ("x", "y")
    assert x.config.cylinder == y.config.cylinder
    assert (x.config.reference.frequency_hz, y.config.reference.frequency_hz) == (0.5, 0.4)
    assert (x.codecs.encoder.can_id, y.codecs.encoder.can_id) == (0x181, 0x184)
    assert x.codecs.sync.can_id == y.codecs.sync.can_id == 0x80
    assert [getattr(y.config.bus.frames, role).node for role in ("encoder", "pressure", "valve_status")] == [
        *(4, 5, 6)
    ]
    assert load("two-axes.toml", axis="y").config == y.config


def test_the_text_of_an_axis_is_that_of_one_axis() -> None:
    for number, axis in enumerate(load_axes("two-axes.toml")):
        assert parse(axis.text, "x") == axis.config
        assert own_text(axis.config.name, number, 2, {}, TEXT) == axis.text


def test_a_command_waits_for_the_answers_of_all_and_the_commands_before_it() -> None:
    alone = load("virtual.toml").config.bus.command_delay_us
    x, y = (axis.config.bus.command_delay_us for axis in load_axes("two-axes.toml"))
    assert alone is None
    assert x is not None
    assert y == pytest.approx(x + 111 * 1.1, abs=0.1)


def test_a_folder_has_a_file_for_each(file: Path) -> None:
    for axis in load_axes("two-axes.toml"):
        text = axis.text.replace(f"command_delay_us = {axis.config.bus.command_delay_us}\n", "")
        (file.parent / f"{axis.config.name}.toml").write_text(text)
    found = load_axes(file.parent)
    assert [axis.config for axis in found] == [axis.config for axis in load_axes("two-axes.toml")]
    assert [axis.path.name for axis in found] == ["x.toml", "y.toml"]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('name = "y"', 'name = "x"', "two axes have the name x"),
        ('name = "y"', "", "axis 2 has no name"),
        ('name = "y"', 'name = "y"\nloop.rate_hz = 400.0', "differ in loop.rate_hz (500.0 and 400.0)"),
        ('"ENCODER_2", node = 4', '"ENCODER", node = 4', "0x181 is encoder of axis x and encoder of axis y"),
        ('"PRESSURE_2", node = 5', '"PRESSURE_2", node = 1', "0x081 is EMCY of node 1 of axis x"),
        (
            "reference.frequency_hz = 0.4",
            "reference.frequency_hz = -0.4",
            f"axis y: line {LINE}: reference.freq",
        ),
        ("set_deadline = 0.8", "set_deadline = 0.99", "axis x: line 29: loop.set_deadline = 0.99"),
    ],
)
def test_what_cannot_be_together_is_said_in_one_line(file: Path, old: str, new: str, words: str) -> None:
    assert old in TEXT
    said = why(file, TEXT.replace(old, new, 1))
    assert words in said
    assert "\n" not in said


def test_a_verb_of_one_axis_says_that_there_are_several() -> None:
    with pytest.raises(ConfigError, match=r"has several axes \(x, y\); choose one, with --axis"):
        load("two-axes.toml")
    with pytest.raises(ConfigError, match=r"--axis z: two-axes\.toml has no such axis; it has x, y"):
        load("two-axes.toml", axis="z")


@pytest.mark.parametrize(("axes", "rate_hz"), [(2, 700.0), (3, 500.0), (4, 300.0)])
def test_so_many_axes_fit_at_so_high_a_rate(axes: int, rate_hz: float) -> None:
    one = load("virtual.toml", rate_hz)
    most = most_hz(one.config, load_of(one.config, *[one.codecs] * axes))
    assert most >= rate_hz
    assert most_axes(one.config, one.codecs) >= axes


def test_each_axis_of_a_file_has_a_proof_of_its_own(file: Path) -> None:
    file.write_text(TEXT)
    assert [axis.proof_file.name for axis in load_axes(file)] == ["a.x.toml", "a.y.toml"]
    alone = load("virtual.toml")
    assert alone.proof_file == alone.path


def test_check_says_what_the_bus_carries(file: Path) -> None:
    file.write_text(TEXT + THIRD)
    found = json.loads(pneud("check", str(file), "--json").stdout)
    assert [axis["name"] for axis in found["axes"]] == ["x", "y", "z"]
    assert found["bus"] == {
        **{"bits_per_tick": 1785, "bitrate_bit_s": 1e6},
        **{"axes": 3, "most_axes": 3, "most_hz": 560},
    }
    assert "a tick of 3 axes takes up to 1785 bit times" in pneud("check", str(file)).stdout


def test_what_a_file_says_of_a_running_axis_is_taken_by_its_name(file: Path) -> None:
    file.write_text(TEXT)
    _, y = load_axes(file)
    own = partial(own_text, "y", 1, 2, {})
    tuning = Tuning(y.config, y.path, y.text, None, own)
    tuning.read()
    assert not tuning.changed_on_disk()
    file.write_text(TEXT.replace("reference.amplitude_m = 0.04", "reference.amplitude_m = 0.03"))
    tuning.read()
    assert tuning.changed_on_disk()
    assert tuning.reload().words == "tune from the file: reference.amplitude_m 0.04 → 0.03"
    file.write_text(TEXT.replace('name = "y"', 'name = "z"'))
    tuning.read()
    with pytest.raises(ProtocolError, match="no such axis"):
        tuning.reload()
