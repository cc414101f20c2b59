"""What is written into the file of several axes: into the one that is meant, and nowhere else."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest

from pneud import resources
from pneud.config.axes import axes_of
from pneud.config.sections import ConfigError
from pneud.config.writing import put, rewrite, with_axis
from pneud.loading import load, load_axes
from pneud.study.commissioning.bench import Simulated
from pneud.study.commissioning.written import Change, text_with

FOLDER = resources.configs() / "axes"


@pytest.fixture(params=["two-axes.toml", "gantry.toml"])
def file(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    for name in (request.param, "axes.dbc"):
        shutil.copy(FOLDER / name, tmp_path)
    return tmp_path / str(request.param)


def names(file: Path) -> list[str]:
    return [axis.config.name for axis in load_axes(file)]


@pytest.mark.parametrize("place", [0, 1])
def test_a_value_goes_into_the_table_of_the_axis_that_is_named(file: Path, place: int) -> None:
    before, name = load_axes(file), names(file)[place]
    text = file.read_text()

    def change(document: Any) -> None:
        put(document, ("control", "k1"), 9.0e4)
        put(document, ("cylinder", "moving_mass_kg"), 17.0)

    rewrite(file, change, name)
    after = load_axes(file)
    assert (after[place].config.control.k1, after[place].config.cylinder.moving_mass_kg) == (9.0e4, 17.0)
    assert after[1 - place].config == before[1 - place].config
    assert after[place].config.bus == before[place].config.bus
    shared = text[: text.index("\n[[axis]]")]
    assert file.read_text().startswith(shared)  # with its comments
    rewrite(file, change, name)
    assert [axis.config for axis in load_axes(file)] == [axis.config for axis in after]


def test_what_several_could_mean_is_refused(file: Path) -> None:
    text = file.read_text()
    with pytest.raises(ConfigError, match=r"has several axes \(.*\); choose one, with --axis"):
        rewrite(file, lambda document: put(document, ("control", "k1"), 9.0e4))
    with pytest.raises(ConfigError, match="has no such axis"):
        rewrite(file, lambda document: put(document, ("control", "k1"), 9.0e4), "nobody")

    def another_rating(document: Any) -> None:
        document["valve"].remove("orifice_area_m2")
        put(document, ("valve", "nominal_flow_l_min"), 1000.0)

    with pytest.raises(ConfigError, match=r"valve\.orifice_area_m2 stands above \[\[axis\]\], for all"):
        rewrite(file, another_rating, names(file)[1])
    assert file.read_text() == text


def test_a_commissioned_axis_has_its_values_with_where_they_are_from(file: Path) -> None:
    loaded = load(file, axis=names(file)[1])
    change = Change("cylinder.moving_mass_kg", 15.0, 16.25, "16.1 … 16.4")
    own = text_with(loaded.text, str(file), [change], "y.mcap, 2026-11-30")
    rig = Simulated(loaded, {}, 1, file.parent)
    rig.adopt(own, True)
    assert "moving_mass_kg = 16.25  # 16.1 … 16.4 by y.mcap, 2026-11-30" in file.read_text()
    assert [axis.config.cylinder.moving_mass_kg for axis in load_axes(file)] == [15.0, 16.25]
    rig.adopt(text_with(own, str(file), [change._replace(value=16.5)], "z.mcap, 2026-12-01"), True)
    assert load_axes(file)[1].config.cylinder.moving_mass_kg == 16.5


def test_what_goes_for_one_axis_and_stands_above_for_all_is_as_usual_for_that_one(file: Path) -> None:
    before = load_axes(file)

    def change(document: Any) -> None:
        document["plant"]["sensors"].remove("pressure_resolution_pa")
        put(document, ("plant", "sensors", "pressure_bits"), 16)

    rewrite(file, change, names(file)[1])
    one, other = load_axes(file)
    assert one.config == before[0].config
    sensors = other.config.plant.sensors
    assert (sensors.pressure_resolution_pa, sensors.pressure_bits) == (0.0, 16)
    assert sensors.pressure_noise_pa == 100.0


def test_the_file_of_one_axis_is_written_whole(tmp_path: Path) -> None:
    shutil.copy(resources.configs() / "virtual.toml", tmp_path)
    shutil.copy(resources.configs() / "pneud.dbc", tmp_path)
    path = tmp_path / "virtual.toml"
    (part,) = axes_of(path)
    assert with_axis(part.text, path, part, "# another\n") == "# another\n"


@pytest.mark.parametrize("name", ["virtual.toml", "axes/two-axes.toml"])
def test_what_comes_with_pneud_stays_as_it_is(name: str) -> None:
    file = resources.configs() / name
    before = file.read_bytes()
    with pytest.raises(ConfigError, match="comes with pneud and stays as it is; copy it"):
        rewrite(
            file, lambda document: put(document, ("control", "k1"), 9.0e4), "y" if "axes" in name else None
        )
    assert file.read_bytes() == before
